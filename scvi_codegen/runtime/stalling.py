"""Runs in the time of a monitor that comes to nothing: refused, where they would go on for ever, or turn back.

With dt = g dtau no time passes where g = 0: no number of steps of tau leads beyond, and in transformed time rounding
decides what comes after, as the level K = g (H - E) = 0 holds there whatever the energy.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["Watch", "lost_level"]

MOST_STEPS: Final = 1e9
"""That a run may still take, at its present pace, if that has become a millionth of what it was."""
SLOW: Final = 1e-6
ENOUGH: Final = 30_000
"""Steps at such a pace: a close encounter is over by then."""
TINY: Final = 1e-9
"""Of the longest duration of a step in a run: at those so short the energy is looked at."""
LOST: Final = 1e-3
"""Of the energy: nothing conserves it where rounding is all that is left of g (H - E)."""


class Watch:
    """Over how much time the steps of a run take on; ``end``: where a monitor leads it, or ``None`` for other runs."""

    def __init__(self, stepper: Integrator, end: float | None) -> None:
        self.stepper, self.end, self.best, self.slow = stepper, end, 0.0, 0

    def halt(self, before: float, t: float, steps: int, number: int) -> StepFailedError | None:
        """What is wrong after so many steps from a time to another: the end is out of reach.

        ``number``: of the last step in the run.
        """
        if self.end is None or not steps:
            return None
        passed, left = abs(t - before), abs(self.end - t)
        pace = passed / steps
        self.best = max(self.best, pace)
        self.slow = self.slow + steps if pace < SLOW * self.best and left > MOST_STEPS * pace else 0
        if self.slow < ENOUGH:
            return None
        return _halt(self.stepper, t, number, f"{steps} steps took {passed:.1e} of it, {left:.3g} is left")


def lost_level(states: Trajectory, longest: float) -> StepFailedError | None:
    """What is wrong with states in transformed time: they lost the energy as the rate of time came to nothing.

    ``longest``: of all steps of the run.
    """
    short = np.flatnonzero(np.abs(np.diff(states.t)) < TINY * longest)
    if not len(short):
        return None
    stepper = states.stepper
    level = states.parameters[stepper.parameters.index(stepper.interface.energy_parameter)]
    given = states.q[short], states.p[short], states.t[short], states.parameters
    moving = np.abs((states.p[short] * stepper.velocity(*given)).sum(axis=1))
    energies = stepper.energy(*given)
    wrong = np.flatnonzero(~(np.abs(energies - level) <= LOST * (abs(level) + moving)))
    if not len(wrong):
        return None
    first = int(wrong[0])
    evidence = f"there the energy is {energies[first]:g}, not {level:g}"
    return _halt(stepper, float(states.t[short][first]), states.steps - len(states) + 1 + int(short[first]), evidence)


def _halt(stepper: Integrator, t: float, number: int, evidence: str) -> StepFailedError:
    return StepFailedError(
        f"step {number} at t = {t:.17g} failed: the time transformation dt = g dtau is singular there: its monitor g "
        f"reaches 0 ({evidence}). A monitor must be positive all along the motion: use another, or adaptive steps",
        status="stalled",
        step=number,
        t=t,
        residual=float("nan"),
    )
