"""Saved states of a run with the data needed for dense output, events and derivatives."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.runs.states.words import scalar
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed, StepPlan

Array = NDArray[np.float64]
ROUNDINGS, STEP_END_TOLERANCE = 4.0, 1e-6


def checked_row(row: Any, count: int) -> int:
    """Return a row index counted from the start; negative indices count from the end.

    Raises:
        IndexError: if the index is out of range.
        TypeError: if the index is not a whole number.
    """
    if isinstance(row, bool) or not hasattr(row, "__index__"):
        raise TypeError(f"the index of a state must be a whole number or a slice (run[-1], run[10:]), not {row!r}")
    number = operator.index(row)
    if not -count <= number < count:
        raise IndexError(f"the index {number} is out of range: the trajectory has {count} states")
    return number % count


@dataclass(slots=True, kw_only=True, eq=False)
class SavedStates:
    """Saved states with the data for dense output and events; other fields as of :class:`Trajectory`.

    Attributes:
        step_sizes: (n,) size of the step that follows each state, NaN for a state within a step.
        tau: (n,) values of tau in transformed time, else ``None``; ``step_sizes`` are then steps of tau.
    """

    t: Array
    q: Array
    p: Array
    step_sizes: Array
    h: float
    parameters: Array
    stepper: Integrator = field(repr=False)
    plan: StepPlan = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)
    tau: Array | None = None
    steps: int = 0
    step_error: float = math.nan
    worst_step_time: float = math.nan

    @property
    def stepped(self) -> Array:
        """(n,) independent variable of the steps: tau or t."""
        return self.t if self.tau is None else self.tau

    @property
    def forward(self) -> float:
        """1, or -1 for a run backward in time."""
        return math.copysign(1.0, self.t[-1] - self.t[0])

    @property
    def grid_tolerance(self) -> Array:
        """(n,) distances within which a time counts as the end of a step: times are rounded."""
        rounding = ROUNDINGS * np.finfo(float).eps * np.abs(self.stepped).max()
        return np.asarray(np.fmax(STEP_END_TOLERANCE * np.abs(self.step_sizes), rounding))

    def __len__(self) -> int:
        return len(self.t)

    def _restarted(self, k: int, h: float) -> Memory:
        """Return a run from saved state k with fixed steps h."""
        settings: dict[str, Any] = {"parameters": self.parameters, "options": self.options}
        return Memory.started(self.stepper, self.q[k], self.p[k], plan=Fixed(h), t=scalar(self.t[k]), **settings)


SIDE = 2.0**1000
"""Size of the mode of a kink that decides its side, as in ``kinks.h``."""


def parameters_on_sides(states: SavedStates, t: float) -> Array:
    """Return the parameters of the steps after time t, with the sides of the kinks that the run passed."""
    switches = getattr(states, "switches", ())
    if not any(map(len, switches)):
        return states.parameters
    parameters = states.parameters.copy()
    sides = parameters[len(parameters) - len(switches) :]
    for k, kink in enumerate(switches):
        if len(kink):
            passed = int(np.searchsorted(states.forward * kink.t, states.forward * t, side="right"))
            sides[k] = SIDE * (kink.side[passed - 1] if passed else -kink.side[0])
    return parameters
