"""Detect a time transformation dt = g dtau whose g reaches zero, where a run would not terminate.

Where g = 0 not a number of steps of tau advances t. In transformed time rounding then decides the continuation, because
the constraint K = g (H - E) = 0 holds there for any energy.
"""

from typing import Final

import numpy as np

from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.trajectory import Trajectory

MOST_STEPS: Final = 1e9
"""Number of remaining steps at the present rate above which slow progress counts."""
SLOW: Final = 1e-6
"""Time per step, relative to the largest so far, below which progress counts as slow."""
SLOW_STEPS: Final = 30_000
"""Number of slow steps before an error; close encounters take fewer."""
SHORT_STEP: Final = 1e-9
"""Duration of a step, relative to the longest of a run, below which the energy is checked."""
ENERGY_ERROR: Final = 1e-3
"""Relative energy error that shows that g (H - E) is below rounding."""


class ProgressWatch:
    """Progress in t of runs whose step size in t is unbounded below; ``end`` is the target time."""

    def __init__(self, stepper: Integrator, end: float) -> None:
        self.stepper, self.end, self.best, self.slow = stepper, end, 0.0, 0

    def check_progress(self, before: float, t: float, steps: int, number: int) -> None:
        """Raise an error if the target time is out of reach after ``steps`` steps from ``before`` to t.

        ``number`` is the step number in the run.
        """
        if not steps:
            return
        passed, left = abs(t - before), abs(self.end - t)
        time_per_step = passed / steps
        self.best = max(self.best, time_per_step)
        self.slow = self.slow + steps if time_per_step < SLOW * self.best and left > MOST_STEPS * time_per_step else 0
        if self.slow >= SLOW_STEPS:
            raise _singular_time_error(
                self.stepper, t, number, f"{steps} steps advanced t by {passed:.1e}, {left:.3g} is left"
            )


def check_energy_surface(states: Trajectory, longest: float) -> None:
    """Raise an error if states in transformed time lost their energy because the rate dt/dtau underflowed.

    ``longest`` is the longest duration of a step in the run.
    """
    short = np.flatnonzero(np.abs(np.diff(states.t)) < SHORT_STEP * longest)
    if not len(short):
        return
    stepper = states.stepper
    energy = states.parameters[stepper.interface.energy_index]
    arguments = states.q[short], states.p[short], states.t[short], states.parameters
    moving = np.abs((states.p[short] * stepper.velocity(*arguments)).sum(axis=1))
    energies = stepper.energy(*arguments)
    wrong = np.flatnonzero(~(np.abs(energies - energy) <= ENERGY_ERROR * (abs(energy) + moving)))
    if not len(wrong):
        return
    first = int(wrong[0])
    evidence = f"the energy there is {energies[first]:g}, not {energy:g}"
    failure = _singular_time_error(
        stepper, float(states.t[short][first]), states.steps - len(states) + 1 + int(short[first]), evidence
    )
    failure.trajectory = states
    raise failure


def _singular_time_error(stepper: Integrator, t: float, number: int, evidence: str) -> StepFailedError:
    return StepFailedError(
        f"step {number} at t = {t:.17g} failed: the time transformation dt = g dtau is singular there: g "
        f"reaches 0 ({evidence}). g must be positive along the whole motion: use another g, or adaptive steps",
        status="time transformation singular",
        step=number,
        t=t,
        residual=float("nan"),
    )
