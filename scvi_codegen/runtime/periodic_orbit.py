"""A periodic orbit: its motion, its Floquet multipliers, whether it is stable."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["PeriodicOrbit"]

SYMPLECTIC = 1e-9
"""Beside the square of a monodromy matrix: a larger defect is not rounding."""
SAME = 1e-6
"""Beside 1: what may be rounding of a stability index."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicOrbit:
    """A motion that ends where it began, of the computed map.

    Attributes:
        q, p: (m,) where it begins.
        t: when.
        period: after which it is there again.
        steps: of a period, each of ``period / steps``.
        monodromy: (2m, 2m) derivative of the end by the start.
        residual: how far the end is from the start, the largest number.
        iterations: of Newton.
        parameters: (k,) in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
    """

    q: Array
    p: Array
    t: float
    period: float
    steps: int
    monodromy: Array
    residual: float
    iterations: int
    parameters: Array
    stepper: Stepper = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)

    def run(self, *, save_every: int = 1) -> Trajectory:
        """The motion of a period, ``save_every``-th state."""
        return self.stepper.integrate(
            self.q,
            self.p,
            h=self.period / self.steps,
            steps=self.steps,
            save_every=save_every,
            t=self.t,
            parameters=self.parameters,
            options=self.options,
        )

    @property
    def energy(self) -> float:
        """Where it begins."""
        return float(self.stepper.energy(self.q, self.p, self.t, self.parameters))

    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """(2m,) Floquet multipliers, the eigenvalues of the monodromy matrix, the largest first.

        Of those near 1, which are several for a motion that keeps its energy, only half of the digits are known.
        """
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @property
    def reciprocal_error(self) -> float:
        """How far sizes of multipliers are from the pairs s, 1/s of symplectic steps: the largest of s s' - 1."""
        sizes = np.abs(self.multipliers)
        return float(np.abs(sizes * sizes[::-1] - 1.0).max())

    @property
    def symplectic_error(self) -> float:
        """How far the monodromy matrix is from symplectic, beside its square."""
        product = _inverse(self.monodromy) @ self.monodromy - np.eye(len(self.monodromy))
        return float(np.abs(product).max() / max(1.0, np.linalg.norm(self.monodromy, 2) ** 2))

    @cached_property
    def stability_indices(self) -> NDArray[np.complex128]:
        """(m,) of each pair of multipliers s, 1/s its (s + 1/s)/2, the largest first: stable between -1 and 1.

        They are known to the digits of the monodromy matrix, also at 1 (Broucke, AIAA J. 7 (1969) 1003; Howell, Celest.
        Mech. 32 (1984) 53).

        Raises:
            MethodError: where steps are not symplectic.
        """
        if self.symplectic_error > SYMPLECTIC:
            raise MethodError(f"multipliers are no pairs: the steps of '{self.stepper.title}' are not symplectic here")
        left = list(np.linalg.eigvals(self.monodromy + _inverse(self.monodromy)).astype(complex) / 2.0)
        indices = []
        while left:
            one = left.pop(int(np.argmax(np.abs(left))))
            indices.append((one + left.pop(int(np.argmin(np.abs(np.array(left) - one))))) / 2.0)
        return np.array(indices)

    @property
    def stable(self) -> bool:
        """Whether no multiplier is larger than 1, to rounding."""
        if self.symplectic_error > SYMPLECTIC:
            return bool(np.abs(self.multipliers).max() <= 1.0 + SAME)
        indices = self.stability_indices
        return bool((np.abs(indices.real) <= 1.0 + SAME).all() and (np.abs(indices.imag) <= SAME).all())


def _inverse(matrix: Array) -> Array:
    """Of a symplectic matrix."""
    m = len(matrix) // 2
    a, b, c, d = matrix[:m, :m], matrix[:m, m:], matrix[m:, :m], matrix[m:, m:]
    return np.block([[d.T, -b.T], [-c.T, a.T]])
