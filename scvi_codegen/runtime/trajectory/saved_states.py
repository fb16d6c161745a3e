"""Saved states of a run with the data needed for dense output, events and derivatives."""

import math
import operator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.run.step_plan import StepPlan

Array = NDArray[np.float64]


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


def checked_rows(rows: slice, count: int) -> tuple[int, int, int]:
    """Return first, end and stride of a slice of ``count`` states; raise IndexError if it is empty or descending."""
    first, last, stride = rows.indices(count)
    if stride < 0 or first >= last:
        raise IndexError(f"a slice of a trajectory must be ascending and not empty, unlike {rows} of {count} states")
    return first, last, stride


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

    def __len__(self) -> int:
        return len(self.t)
