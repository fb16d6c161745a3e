"""What an integrator says of states that constraints hold, as users ask for it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.runtime.constraints import constraint_values, multipliers, projected
from scvi_codegen.runtime.inputs import Array, Parameters
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["ConstrainedStates"]


class ConstrainedStates(Integrator):
    """:class:`Integrator` with states that meet constraints, how far others are off them, and multipliers."""

    def project(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        t: float = 0.0,
        parameters: Parameters = None,
    ) -> tuple[Array, Array]:
        """The nearest state (q, p) that meets the constraints, in the metric of the masses; at rest without p.

        Raises:
            MethodError: for a system without constraints.
            StateError: if none is found, or constraints depend on each other there.
        """
        momenta = self.momenta_given(
            q, p, np.zeros(self.dimension) if p is velocity is None else velocity, t, parameters
        )
        q1, p1, _ = projected(self, q, momenta, t, parameters)
        return q1, p1

    def multipliers(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """The lambda with which G^T lambda are the forces that keep a state on its constraints: (c,), or (n, c).

        d/dt L_v = L_q + f + G^T lambda, where G = g_q, or g_v of a constraint of velocities: of ``x**2 + y**2 = l**2``
        the tension of the rod is -2 l lambda. It is what the state itself says, as exact as the state.
        """
        found = multipliers(self, q, p, t, parameters)
        return found[0] if np.ndim(q) == 1 else found

    def constraint_values(
        self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None
    ) -> tuple[Array, Array]:
        """How far states are off: g, and its rate g_q v + g_t; (c,) each, or (n, c).

        A constraint of velocities is a rate alone: 0 stands where it says nothing of positions.
        """
        g, rate = constraint_values(self, q, p, t, parameters)
        return (g[0], rate[0]) if np.ndim(q) == 1 else (g, rate)
