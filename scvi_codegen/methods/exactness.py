"""Exactness of methods: the momentum maps that they conserve to round-off."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scvi_codegen.mechanics.symmetry.symmetry import Symmetry

__all__ = ["Exactness"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exactness:
    """Momentum maps that a method conserves to round-off at any step size; by default none is claimed.

    A variational method of degree s conserves a momentum map if the symmetry maps its curves to each other (A constant,
    b of degree s in t) and its quadrature is exact for df/dt along them (of degree d s + k - 1 for terms t^k q^d of f):
    L_d then changes by the difference of f between the ends. Runge-Kutta methods in phase space conserve momentum maps
    linear in (t, q, p), symplectic ones also quadratic ones. Other momentum maps may be conserved without being
    claimed.

    Attributes:
        polynomials: degree of the polynomials in (t, q, p) that the method conserves whenever the flow does.
        curve, quadrature: degree of the curves, and order of the quadrature along them, of a variational method.
        gauge: highest degree of f in q, if bounded otherwise than by the quadrature.
    """

    polynomials: int = 0
    curve: int = -1
    quadrature: int = -1
    gauge: float = math.inf

    def conserves(self, symmetry: Symmetry) -> bool:
        """Return whether the momentum map of a symmetry is conserved exactly."""
        terms = symmetry.degrees()
        if terms is None:
            return False
        return max(map(sum, terms)) <= self.polynomials or all(self._allows(*term) for term in terms)

    def _allows(self, k: int, d: int, e: int) -> bool:
        """Return whether a term t^k q^d p^e is admissible: in the direction (e = 1) or the gauge (e = 0)."""
        if e == 0:
            return d <= self.gauge and d * self.curve + k <= self.quadrature
        return e == 1 and ((d == 0 and k <= self.curve) or (d == 1 and k == 0 <= self.curve))
