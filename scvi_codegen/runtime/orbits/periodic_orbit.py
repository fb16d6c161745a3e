"""Periodic orbit: trajectory, Floquet multipliers and stability."""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.representation import summary
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

SYMPLECTIC = 1e-9
"""Symplecticity defect of a monodromy matrix, relative to its squared norm, above which it is not due to rounding."""
SAME = 1e-6
"""Deviation of a stability index from 1 that rounding may cause."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PeriodicOrbit:
    """Periodic orbit of the computed map.

    Attributes:
        q, p: (m,) initial state.
        t: initial time.
        period: the period.
        steps: number of steps per period, each of size ``period / steps``.
        monodromy: (2m, 2m) derivative of the end with respect to the start; of systems with rotations in canonical
            coordinates of the reduced space, with 6 rows for a rotation, 4 for a direction and 2 for a spin.
        residual: largest entry of the end minus the start.
        iterations: number of Newton iterations.
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

    __repr__ = summary("q", "p", "period", "steps")

    def run(self, *, save_every: int = 1) -> Trajectory:
        """Return the trajectory of one period, every ``save_every``-th state."""
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
        """Energy of the initial state."""
        return float(self.stepper.energy(self.q, self.p, self.t, self.parameters))

    @cached_property
    def multipliers(self) -> NDArray[np.complex128]:
        """(2m,) Floquet multipliers, the eigenvalues of the monodromy matrix, in descending order of modulus.

        Multiple eigenvalues at 1, caused by conserved quantities, are accurate to half of the digits only.
        """
        values = np.linalg.eigvals(self.monodromy).astype(complex)
        return values[np.argsort(-np.abs(values))]

    @property
    def reciprocal_error(self) -> float:
        """Deviation of the multipliers' moduli from the pairs s, 1/s of symplectic maps: the largest ``|s s' - 1|``."""
        sizes = np.abs(self.multipliers)
        return float(np.abs(sizes * sizes[::-1] - 1.0).max())

    @property
    def symplectic_error(self) -> float:
        """Symplecticity defect of the monodromy matrix, relative to its squared norm."""
        product = _inverse(self.monodromy) @ self.monodromy - np.eye(len(self.monodromy))
        return float(np.abs(product).max() / max(1.0, np.linalg.norm(self.monodromy, 2) ** 2))

    @cached_property
    def stability_indices(self) -> NDArray[np.complex128]:
        """(m,) stability indices (s + 1/s)/2 of the pairs of multipliers s, 1/s, descending; stable between -1 and 1.

        They have the accuracy of the monodromy matrix, also at 1 (Broucke, AIAA J. 7 (1969) 1003; Howell, Celest. Mech.
        32 (1984) 53).

        Raises:
            MethodError: if the steps are not symplectic.
        """
        if self.symplectic_error > SYMPLECTIC:
            raise MethodError(
                f"stability indices are undefined: steps of '{self.stepper.title}' are not symplectic; use multipliers"
            )
        left = list(np.linalg.eigvals(self.monodromy + _inverse(self.monodromy)).astype(complex) / 2.0)
        indices = []
        while left:
            one = left.pop(int(np.argmax(np.abs(left))))
            indices.append((one + left.pop(int(np.argmin(np.abs(np.array(left) - one))))) / 2.0)
        return np.array(indices)

    @property
    def stable(self) -> bool:
        """Return whether no multiplier exceeds 1 in modulus, up to rounding."""
        if self.symplectic_error > SYMPLECTIC:
            return bool(np.abs(self.multipliers).max() <= 1.0 + SAME)
        indices = self.stability_indices
        return bool((np.abs(indices.real) <= 1.0 + SAME).all() and (np.abs(indices.imag) <= SAME).all())


def _inverse(matrix: Array) -> Array:
    m = len(matrix) // 2
    a, b, c, d = matrix[:m, :m], matrix[:m, m:], matrix[m:, :m], matrix[m:, m:]
    return np.block([[d.T, -b.T], [-c.T, a.T]])
