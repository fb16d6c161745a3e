"""States kept along a run, with all that leads from one to the next."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["KeptStates"]

Array = NDArray[np.float64]


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
