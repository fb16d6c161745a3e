"""Tangent spaces of the states on holonomic constraints g(q, t) = 0, in canonical coordinates.

Steps map the changes (0, G^T mu) of momenta to 0, with G = g_q. Modulo these the tangent space at a state is that of
T*M of the constraint manifold M: with an orthonormal basis B of the null space of G, dq = B a and dp = B b, or
a = B^T dq and b = B^T dp (V. I. Arnold, *Mathematical Methods of Classical Mechanics*, appendix 5). In systems with
rotations dq and dp are those of the tangent space without gauge directions.
"""

from __future__ import annotations

import numpy as np

from scvi_codegen.api.states import Array, Reduction
from scvi_codegen.common.errors import OrbitError, StateError
from scvi_codegen.runs.stepper import Stepper

MOMENT = 2.0**-30
"""Part of a period in which a motion changes by rounding errors of its derivatives."""


def reduction_of(stepper: Stepper, t: float, parameters: Array) -> Reduction:
    """Return the maps to the tangent spaces of a system without gauge directions and on its constraints."""
    if not stepper.interface.imposed:
        return stepper.products.reduction
    return ConstraintManifold(stepper, t, parameters)


class ConstraintManifold(Reduction):
    """Maps between tangent vectors of (q, p) and those of the constraint manifold at a time."""

    def __init__(self, stepper: Stepper, t: float, parameters: Array) -> None:
        super().__init__(stepper.interface)
        self.stepper, self.t, self.parameters, self.free = stepper, t, parameters, stepper.products.reduction
        self.count = len(stepper.interface.imposed)
        self.size -= 2 * self.count

    def at(self, t: float, parameters: Array) -> ConstraintManifold:
        """Return the maps at another time or other parameters."""
        return ConstraintManifold(self.stepper, t, parameters)

    def inward(self, q: Array, p: Array) -> Array:
        """Return the (2m, size) matrix from (a, b) to changes of (q, p)."""
        return self.free.inward(q, p) @ np.kron(np.eye(2), self._basis(q, p))

    def outward_beside(self, state: Array, other: Array) -> Array:
        """Return ``outward`` at a state with the basis that is nearest to that at another one."""
        own, near = (self._basis(*np.split(at, 2)) for at in (state, other))
        left, _, right = np.linalg.svd(near.T @ own)
        return np.kron(np.eye(2), left @ right) @ self.outward(*np.split(state, 2))

    def normalised(self, q: Array, p: Array) -> tuple[Array, Array]:
        """Return the nearest state on the constraints."""
        try:
            return self.stepper.project(*self.free.normalised(q, p), t=self.t, parameters=self.parameters)
        except StateError as error:
            raise OrbitError(str(error)) from error

    def shift(self, state: Array, parameter: int, period: float) -> Array:
        """Return the change (2m,) of a state by a parameter, -M^-1 G^T (G M^-1 G^T)^-1 g_lambda of positions.

        It is the derivative of the end of a step without duration, whose end is on the constraints, by the parameter.
        """
        (q, p), seed = np.split(state, 2), np.eye(self.stepper.products.tangents)[[len(state) + parameter]]
        ends = self.stepper._products(q, p, MOMENT * period, self.t, self.parameters, None, seed)
        return np.append(ends[0, : len(q)], np.zeros(len(p)))

    def _jacobian(self, q: Array) -> Array:
        """Return G."""
        return self.stepper.products.constraint_jacobian(q, self.t, self.parameters)[: self.count]

    def _basis(self, q: Array, p: Array) -> Array:
        """Return the orthonormal basis B."""
        by_q = self.free.inward(q, p)[: len(q), : self.free.size // 2]
        return np.asarray(np.linalg.svd(self._jacobian(q) @ by_q)[2][self.count :].T)
