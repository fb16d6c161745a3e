"""Public methods for constrained states: projection, multipliers and constraint values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.runtime.constraints import constraint_values, multipliers, projected
from scvi_codegen.runtime.inputs import Array, Parameters
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["ConstrainedStates"]


class ConstrainedStates(Integrator):
    """:class:`Integrator` with projection onto the constraints, constraint values and Lagrange multipliers."""

    def project(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        t: float = 0.0,
        parameters: Parameters = None,
    ) -> tuple[Array, Array]:
        """Return the nearest state (q, p) on the constraint manifold, in the metric of the mass matrix.

        Without p and velocity the initial velocity is 0.

        Raises:
            MethodError: if the system has no constraints.
            StateError: if the iteration fails, or if the constraints are linearly dependent there.
        """
        momenta = self._initial_momenta(
            q, p, np.zeros(self.dimension) if p is velocity is None else velocity, t, parameters
        )
        q1, p1, _ = projected(self, q, momenta, t, parameters)
        return q1, p1

    def multipliers(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return the Lagrange multipliers lambda of the constraint forces G^T lambda at states: (c,), or (n, c).

        They satisfy d/dt L_v = L_q + f + G^T lambda with G = g_q, or g_v for a velocity constraint; for ``x**2 + y**2 =
        l**2`` the tension of the rod is -2 l lambda. They depend on the state alone and are as accurate as the state.
        """
        found = multipliers(self, q, p, t, parameters)
        return found[0] if np.ndim(q) == 1 else found

    def constraint_values(
        self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None
    ) -> tuple[Array, Array]:
        """Return the constraint residuals g and their rates g_q v + g_t: (c,) each, or (n, c).

        For a velocity constraint only the rate is defined; its g is 0 if it does not restrict positions.
        """
        g, rate = constraint_values(self, q, p, t, parameters)
        return (g[0], rate[0]) if np.ndim(q) == 1 else (g, rate)
