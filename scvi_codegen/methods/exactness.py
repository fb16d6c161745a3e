"""Which momentum maps a method conserves exactly."""

from __future__ import annotations

import math
from dataclasses import dataclass

from scvi_codegen.mechanics.symmetry.symmetry import Symmetry

__all__ = ["Exactness"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exactness:
    """What a method is known to conserve to round-off, for every step; the default claims nothing.

    A variational method of degree s conserves a momentum map if the symmetry maps its curves to each other (A constant,
    b of degree s in t) and its quadrature is exact for df/dt along them (of degree d s + k - 1 for terms t^k q^d of f):
    then L_d changes by what f does from end to end. Runge-Kutta methods in phase space conserve what is linear in
    (t, q, p), symplectic ones what is quadratic. Of others nothing is claimed: a map may be conserved nevertheless.

    Attributes:
        polynomials: degree of the polynomials in (t, q, p) that are conserved whenever the motion conserves them.
        curve, quadrature: degree of the curves, and order of the quadrature along them, of a variational method.
        gauge: highest degree of f in q, where it is not the quadrature that bounds it.
    """

    polynomials: int = 0
    curve: int = -1
    quadrature: int = -1
    gauge: float = math.inf

    def keeps(self, symmetry: Symmetry) -> bool:
        """Whether the momentum map of a symmetry is conserved exactly."""
        terms = symmetry.degrees()
        if terms is None:
            return False
        return max(map(sum, terms)) <= self.polynomials or all(self._allows(*term) for term in terms)

    def _allows(self, k: int, d: int, e: int) -> bool:
        """Whether a term t^k q^d p^e is one of the direction (e = 1) or gauge (e = 0) that the curves allow."""
        if e == 0:
            return d <= self.gauge and d * self.curve + k <= self.quadrature
        return e == 1 and ((d == 0 and k <= self.curve) or (d == 1 and k == 0 <= self.curve))
