"""Result of optimal control: a trajectory of the integrator, its inputs and their cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.runtime.core.validation import Array

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

__all__ = ["ControlledMotion"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlledMotion:
    """Trajectory of n steps with its inputs.

    Attributes:
        t, q, p: (n + 1,), (n + 1, m), (n + 1, m) times and states, those of the integrator with these inputs.
        coefficients: (n, degree + 1) of each input by name, in Bernstein form, one row a step.
        coordinates: names.
        cost: minimum of the cost: the integral and the cost of the end.
        costates: (n, 2 m) derivatives of the remaining cost with respect to q and p, at all times but the first.
        iterations, status, solved: iterations of IPOPT, its return status, and True on success.
        unknowns, equations: size of the nonlinear program; inequalities and end conditions count as equations.
    """

    t: Array
    q: Array
    p: Array
    coefficients: dict[str, Array]
    coordinates: tuple[str, ...]
    cost: float
    costates: Array
    iterations: int
    status: str
    solved: bool
    unknowns: int
    equations: int

    @property
    def h(self) -> float:
        """Step size."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    @property
    def inputs(self) -> dict[str, PPoly]:
        """Inputs as functions of time, in the form that :meth:`Stepper.integrate` takes."""
        from scipy.interpolate import BPoly, PPoly  # here: slow to import

        return {
            name: PPoly.from_bernstein_basis(BPoly(coefficients.T, self.t))
            for name, coefficients in self.coefficients.items()
        }

    @property
    def guess(self) -> dict[str, Any]:
        """Positions, mean inputs of the steps and duration: an initial guess for a further problem."""
        result: dict[str, Any] = dict(zip(self.coordinates, self.q.T, strict=True))
        result |= {name: coefficients.mean(axis=1) for name, coefficients in self.coefficients.items()}
        return {**result, "duration": float(self.t[-1] - self.t[0])}

    def __repr__(self) -> str:
        shown = np.format_float_scientific(self.cost, precision=6, trim="-") if self.cost else "0"
        return (
            f"<motion of {len(self.t) - 1} steps to t = {self.t[-1]:.6g}, cost {shown}, {self.iterations} iterations>"
        )
