"""States kept along a run, with all that leads from one to the next."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["KeptStates", "checked_row", "checked_rows"]

Array = NDArray[np.float64]


def checked_row(row: Any, count: int) -> int:
    """Return the number of a state from the start, where negative ones count from the end; IndexError if none is there.

    Raises:
        TypeError: for anything but a whole number.
    """
    if isinstance(row, bool) or not hasattr(row, "__index__"):
        raise TypeError(f"states are indexed by whole numbers and slices, as in run[-1] and run[10:], not by {row!r}")
    number = operator.index(row)
    if not -count <= number < count:
        raise IndexError(f"there is no state {number} among {count}")
    return number % count


def checked_rows(rows: slice, count: int) -> tuple[int, int, int]:
    """Return first, end and stride of a slice of that many states; IndexError if it is empty or goes backward."""
    first, last, stride = rows.indices(count)
    if stride < 0 or first >= last:
        raise IndexError(f"a slice of a trajectory goes forward and holds at least one state, unlike {rows}")
    return first, last, stride


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KeptStates:
    """What states between these, and crossings, are found from; other fields as of :class:`Trajectory`.

    Attributes:
        lengths: (n,) of the step that follows each state, not a number for a state between two steps.
        tau: (n,) of each state where time is transformed, else ``None``; lengths are then of tau.
    """

    t: Array
    q: Array
    p: Array
    lengths: Array
    h: float
    parameters: Array
    stepper: Integrator = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)
    goal: Goal | None = field(default=None, repr=False)
    tau: Array | None = None

    @property
    def stepped(self) -> Array:
        """(n,) what lengths are differences of: tau, or t."""
        return self.t if self.tau is None else self.tau

    @property
    def forward(self) -> float:
        """1, or -1 for a run back in time."""
        return math.copysign(1.0, self.t[-1] - self.t[0])

    def __len__(self) -> int:
        return len(self.t)
