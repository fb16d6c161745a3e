"""Runge-Kutta tableaux by collocation and duality, and their properties computed from the coefficients.

The collocation tableau on abscissae c is equation (23) of Li, Wu & Leok, "Spectral-collocation variational
integrators". Order, symplecticity, symmetry and A-stability are computed from A, b, c (Hairer, Lubich & Wanner,
*Geometric Numerical Integration*, 2nd ed. 2006, here GNI; Hairer & Wanner, *Solving Ordinary Differential Equations
II*, 2nd ed. 1996, here HW).

A-stability is tested by Routh's criterion and the roots of a polynomial; coefficients below 1e-30 of their scale count
as zero.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import count as count_from
from itertools import pairwise
from typing import Any, TypeAlias

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import DIGITS, Matrix, Number, Vector, mp
from scvi_codegen.common.representation import summary
from scvi_codegen.methods.tables.basis import cardinal_integrals, matrix_product, transpose
from scvi_codegen.methods.tables.nodes import (
    cached_family,
    chebyshev_gauss_points,
    chebyshev_lobatto_points,
    point_count,
    to_number,
    to_unit,
)
from scvi_codegen.methods.tables.quadrature import gauss_legendre, gauss_lobatto, gauss_radau, split_name

ZERO_TOLERANCE = mp.mpf("1e-30")
ROOT_DIGITS, ROOT_TOLERANCE = 20, mp.mpf("1e-6")
"""Digits of roots, and the relative distance of equal ones, which may be multiple."""

Polynomial: TypeAlias = list[Number]
"""Coefficients in ascending powers; the last is not zero, and the zero polynomial is empty."""


def determinant_polynomial(matrix: Matrix) -> Polynomial:
    """Return det(I - z M) in powers of z, by the Faddeev-LeVerrier recurrence with guard digits.

    Coefficient k is rounded to zero below 1e-30 of binomial(s, k) (2s - k)! / (2s)!, the natural scale: it is the
    coefficient of the Gauss method.
    """
    s = len(matrix)
    coefficients, power = [mp.one], matrix
    with mp.workdps(DIGITS + 20 + 2 * s):
        for k in range(1, s + 1):
            coefficients.append(-mp.fsum(power[i][i] for i in range(s)) / k)
            moved = [[power[i][j] + (coefficients[k] if i == j else 0) for j in range(s)] for i in range(s)]
            power = matrix_product(matrix, tuple(map(tuple, moved)))
        scales = [mp.binomial(s, k) * mp.factorial(2 * s - k) / mp.factorial(2 * s) for k in range(s + 1)]
    return trimmed(coefficients, scales)


def trimmed(coefficients: Iterable[Number], scales: Iterable[Number]) -> Polynomial:
    """Return the polynomial with coefficients below 1e-30 of their scales set to zero and trailing zeros dropped."""
    trimmed_values = [
        +value if abs(value) > ZERO_TOLERANCE * scale else mp.zero
        for value, scale in zip(coefficients, scales, strict=True)
    ]
    while trimmed_values and trimmed_values[-1] == 0:
        trimmed_values.pop()
    return trimmed_values


def size(polynomial: Sequence[Number]) -> Number:
    """Return the largest coefficient in absolute value."""
    return max(map(abs, polynomial), default=mp.zero)


def roots(polynomial: Polynomial) -> list[Number]:
    """Return the complex roots to 20 digits, roots of multiplicity k to 60 / k, by the method of Durand and Kerner."""
    with mp.workdps(ROOT_DIGITS):
        return list(mp.polyroots(polynomial[::-1], maxsteps=2000, extraprec=600)) if len(polynomial) > 1 else []


def has_poles_right(P: Polynomial, Q: Polynomial) -> bool:
    """Return whether all poles of P / Q have positive real parts; a root of Q that is a root of P is no pole."""
    if has_roots_right(Q):
        return True
    left = [pole for pole in roots(Q) if pole.real <= ROOT_TOLERANCE * abs(pole)]
    magnitudes = [abs(value) for value in P]
    at_poles = [(abs(mp.polyval(P[::-1], pole)), mp.polyval(magnitudes[::-1], abs(pole))) for pole in left]
    zeros = roots(P) if all(value <= ROOT_TOLERANCE * terms for value, terms in at_poles) else []
    for pole in left:
        nearest = min(zeros, key=lambda zero: abs(zero - pole), default=mp.inf)
        if abs(nearest - pole) > ROOT_TOLERANCE * abs(pole):
            return False
        zeros.remove(nearest)
    return True


def has_roots_right(polynomial: Polynomial) -> bool:
    """Return whether all roots have positive real parts: Routh's criterion on the polynomial of -z."""
    mirrored = [value if k % 2 == 0 else -value for k, value in enumerate(polynomial)]
    descending = [value / mirrored[-1] for value in reversed(mirrored)]
    upper, lower = descending[0::2], descending[1::2]
    while lower:
        if lower[0] <= ZERO_TOLERANCE * size(lower):
            return False
        ratio = upper[0] / lower[0]
        padded = [*lower[1:], mp.zero]
        upper, lower = lower, [a - ratio * b for a, b in zip(upper[1:], padded, strict=False)]
    return True


def squared_modulus(polynomial: Sequence[Number]) -> list[Number]:
    """Return |F(iy)|^2 in ascending powers of x = y^2: even(-x)^2 + x odd(-x)^2."""
    return even_products([value if k % 4 < 2 else -value for k, value in enumerate(polynomial)])


def even_products(values: Sequence[Number]) -> list[Number]:
    """Return the sums of a_i a_j with i + j = 2 k, by k."""
    sums = [mp.zero] * len(values)
    for i, left in enumerate(values):
        for j in range(i % 2, len(values), 2):
            sums[(i + j) // 2] += left * values[j]
    return sums


def modulus_gap(Q: Polynomial, P: Polynomial) -> Polynomial:
    """Return |Q(iy)|^2 - |P(iy)|^2 in ascending powers of y^2, with round-off coefficients set to zero."""
    length = max(len(P), len(Q))
    padded = [[*polynomial, *[mp.zero] * (length - len(polynomial))] for polynomial in (Q, P)]
    gap = [left - right for left, right in zip(*map(squared_modulus, padded), strict=True)]
    sizes = [even_products([abs(value) for value in polynomial]) for polynomial in padded]
    return trimmed(gap, map(sum, zip(*sizes, strict=True)))


def is_nonnegative(polynomial: Polynomial) -> bool:
    """Return whether the polynomial is nonnegative for x >= 0: its sign at a point between each two of its roots.

    Values below 1e-30 of the sum of the absolute values of its terms, as between the parts of a double root that
    rounding separates, count as zero.
    """
    if all(value >= 0 for value in polynomial):
        return True
    positive = sorted(root.real for root in roots(polynomial) if root.real > 0)
    ends = [mp.zero, *positive, 3 * positive[-1] if positive else mp.one]
    for x in ((left + right) / 2 for left, right in pairwise(ends)):
        terms = [value * x**k for k, value in enumerate(polynomial)]
        if mp.fsum(terms) < -ZERO_TOLERANCE * mp.fsum(map(abs, terms)):
            return False
    return True


CONDITION_TOLERANCE = mp.mpf("1e-45")
SMALL_DENOMINATOR, ROUNDINGS = 1000, 2
"""Largest denominator of a rational that replaces a float, and the largest deviation in roundings."""
MAX_STAGES = 64


@dataclass(frozen=True, slots=True, kw_only=True)
class Tableau:
    """Runge-Kutta method: s x s matrix ``A``, weights ``b`` and abscissae ``c`` of s numbers, on the step [0, 1].

    Integers, fractions, decimal strings and SymPy numbers are converted to 60 digits. The properties are tested to 45
    digits: give exact or 50-digit numbers, not floats. Raises ``MethodError`` when the shapes do not agree.
    """

    name: str
    A: Matrix
    b: Vector
    c: Vector

    __repr__ = summary("name")

    def __post_init__(self) -> None:
        object.__setattr__(self, "A", tuple(tuple(map(to_number, row)) for row in self.A))
        object.__setattr__(self, "b", tuple(map(to_number, self.b)))
        object.__setattr__(self, "c", tuple(map(to_number, self.c)))
        stages = len(self.b)
        if not stages or {len(self.A), len(self.c), *map(len, self.A)} != {stages}:
            raise MethodError(
                f"tableau {self.name!r} has {len(self.A)} rows of lengths {[len(row) for row in self.A]}, {stages} "
                f"weights and {len(self.c)} abscissae; give s rows of s numbers, s weights and s abscissae"
            )

    @property
    def stages(self) -> int:
        """Number of stages s."""
        return len(self.b)

    @property
    def order(self) -> int:
        """Order guaranteed by the simplifying conditions: min(B, C + D + 1, 2 C + 2).

        B(p), C(q), D(r) are Butcher's conditions and this is his theorem (HW, theorem IV.5.1). It is sharp for every
        family of this module; for other tableaux, especially explicit ones, it is a lower bound.
        """
        B, C, D = simplifying_conditions(self)
        return min(B, C + D + 1, 2 * C + 2)

    @property
    def is_symplectic(self) -> bool:
        """True if b_i a_ij + b_j a_ji = b_i b_j for all i, j (GNI, theorem VI.4.3)."""
        A, b, span = self.A, self.b, range(self.stages)
        return all(is_zero(b[i] * A[i][j] + b[j] * A[j][i] - b[i] * b[j]) for i in span for j in span)

    @property
    def is_symmetric(self) -> bool:
        """True if a_ij + a_{s+1-i,s+1-j} = b_j for all i, j: steps of h and -h are inverse (GNI, theorem V.2.3)."""
        A, b, span = self.A, self.b, range(self.stages)
        return all(is_zero(A[i][j] + A[-1 - i][-1 - j] - b[j]) for i in span for j in span)

    @property
    def is_a_stable(self) -> bool:
        """True if |R(z)| <= 1 for every z in the left half plane.

        By the maximum principle this holds when R = P / Q has its poles in the open right half plane (Routh's
        criterion) and |Q(iy)|^2 - |P(iy)|^2, a polynomial in y^2, is never negative (HW, section IV.3). Coefficients
        below 1e-30 of their scale count as zero, so that |R(iy)| = 1 is recognised, where the polynomial is zero and
        sampled values would be round-off.
        """
        P, Q = map(list, self.stability_function())
        return has_poles_right(P, Q) and is_nonnegative(modulus_gap(Q, P))

    def stability_function(self) -> tuple[Vector, Vector]:
        """Return numerator and denominator of R(z) in ascending powers of z, trailing zeros dropped.

        R(z) = det(I - z A + z 1 b^T) / det(I - z A) (HW, proposition IV.3.2); common factors are not cancelled.
        """
        shifted = tuple(tuple(a - weight for a, weight in zip(row, self.b, strict=True)) for row in self.A)
        return tuple(determinant_polynomial(shifted)), tuple(determinant_polynomial(self.A))


def is_zero(value: Number) -> bool:
    """Return whether a residual of conditions on A, b, c is zero to 45 digits."""
    return bool(abs(value) < CONDITION_TOLERANCE)


@lru_cache(maxsize=256)
def simplifying_conditions(tableau: Tableau) -> tuple[int, int, int]:
    """Return the largest p, q, r (at most 2 s) with B(p), C(q), D(r).

    B: sum_i b_i c_i^{k-1} = 1/k.  C: sum_j a_ij c_j^{k-1} = c_i^k / k.
    D: sum_i b_i c_i^{k-1} a_ij = b_j (1 - c_j^k) / k.  Each for k = 1, 2, ... (HW, section IV.5).
    """
    A, b, c = tableau.A, tableau.b, tableau.c
    columns = transpose(A)

    def powers(k: int) -> Vector:
        return tuple(x**k for x in c)

    def weighted(k: int) -> Vector:
        return tuple(weight * x ** (k - 1) for weight, x in zip(b, c, strict=True))

    def B(k: int) -> bool:
        return is_zero(mp.fsum(weighted(k)) - mp.one / k)

    def C(k: int) -> bool:
        return all(is_zero(mp.fdot(row, powers(k - 1)) - x / k) for row, x in zip(A, powers(k), strict=True))

    def D(k: int) -> bool:
        left = [mp.fdot(column, weighted(k)) for column in columns]
        return all(is_zero(value - weight * (1 - x) / k) for value, weight, x in zip(left, b, powers(k), strict=True))

    def largest(condition: Callable[[int], bool]) -> int:
        return next(k for k in count_from(0) if k == 2 * len(b) or not condition(k + 1))

    return largest(B), largest(C), largest(D)


def collocation_tableau(abscissae: Iterable[Any], name: str = "collocation") -> Tableau:
    """Return the collocation method on ascending distinct abscissae c_1 .. c_s (usually in [0, 1]).

    a_ij is the integral of l_j from 0 to c_i, b_j that from 0 to 1: equation (23); GNI, theorem II.1.4. Raises
    ``MethodError`` when the abscissae are not ascending. Floats are replaced by the rational, or the symmetric pair, of
    which they are roundings: order and symmetry of [0.1, 0.5, 0.9] are those of 1/10, 1/2, 9/10.
    """
    c = _intended(tuple(abscissae))
    if len(c) > MAX_STAGES:
        raise MethodError(f"{len(c)} abscissae are too many: use at most {MAX_STAGES}, and more steps")
    for index, (left, right) in enumerate(pairwise(c), start=1):
        if left >= right:
            raise MethodError(
                f"abscissa {index} is {mp.nstr(right, 8)}, not greater than the one before it; give "
                "distinct abscissae in ascending order"
            )
    return tableau_on(c, name)


def _intended(abscissae: Sequence[Any]) -> Vector:
    """Convert to numbers; floats within a few roundings of a simple rational, or of 1 - c, are replaced by it."""
    c, slack = list(map(to_number, abscissae)), ROUNDINGS * mp.mpf(2) ** -53
    floats = [isinstance(value, float) for value in abscissae]
    for i, number in enumerate(c):
        if floats[i]:
            near = Fraction(abscissae[i]).limit_denominator(SMALL_DENOMINATOR)
            rational = mp.mpf(near.numerator) / near.denominator
            c[i] = rational if abs(rational - number) <= slack * abs(number) else number
    for i in range((len(c) + 1) // 2):
        j = len(c) - 1 - i
        if floats[i] and floats[j] and not is_zero(c[i] + c[j] - 1) and abs(c[i] + c[j] - 1) <= slack:
            c[i] = (c[i] - c[j] + 1) / 2
            c[j] = 1 - c[i]
    return tuple(c)


@lru_cache(maxsize=256)
def tableau_on(c: Vector, name: str) -> Tableau:
    """Return the collocation method on numbers that are known to ascend."""
    *A, b = cardinal_integrals(c, (*c, mp.one), 0)
    return Tableau(name=name, A=tuple(A), b=b, c=c)


def symplectic_partner(tableau: Tableau, name: str) -> Tableau:
    """Return the symplectic partner a^_ij = b_j - b_j a_ji / b_i of the tableau.

    The pair is GNI, theorem VI.4.6. On the c and b of a collocation method the result satisfies D(s), since then
    b_i a^_ij is b_j times the integral of l_i from c_j to 1.
    """
    b, A, span = tableau.b, tableau.A, range(tableau.stages)
    partner = tuple(tuple(b[j] - b[j] * A[j][i] / b[i] for j in span) for i in span)
    return Tableau(name=name, A=partner, b=b, c=tableau.c)


def _stages(s: Any) -> int:
    """Check the number of stages before points are computed."""
    return point_count(s, "the number of stages", least=0, most=MAX_STAGES)


@cached_family
def gauss(s: int) -> Tableau:
    """Return the s-stage Gauss method: collocation on the Gauss-Legendre points; order 2s, symplectic, symmetric.

    >>> gauss(1).order, gauss(3).order, gauss(3).is_symplectic
    (2, 6, True)
    """
    return collocation_tableau(gauss_legendre(_stages(s)).abscissae, f"gauss:{s}")


@cached_family
def radau_iia(s: int) -> Tableau:
    """Return the s-stage Radau IIA method: collocation on the right Radau points; order 2s - 1."""
    return collocation_tableau(gauss_radau(_stages(s), "right").abscissae, f"radau-iia:{s}")


@cached_family
def radau_ia(s: int) -> Tableau:
    """Return the s-stage Radau IA method: b of the left Radau quadrature, A from D(s); order 2s - 1.

    Not a collocation method (HW, section IV.5), but the symplectic partner of collocation on the same points.
    """
    return symplectic_partner(collocation_tableau(gauss_radau(_stages(s), "left").abscissae), f"radau-ia:{s}")


@cached_family
def lobatto_iiia(s: int) -> Tableau:
    """Return the s-stage Lobatto IIIA method (s >= 2): collocation on the Lobatto points; order 2s - 2, symmetric."""
    return collocation_tableau(gauss_lobatto(_stages(s)).abscissae, f"lobatto-iiia:{s}")


@cached_family
def lobatto_iiib(s: int) -> Tableau:
    """Return the s-stage Lobatto IIIB method (s >= 2), the symplectic partner of Lobatto IIIA; order 2s - 2.

    a^_ij = b_j - b_j a_ji / b_i (GNI, section II.1.4).
    """
    return symplectic_partner(lobatto_iiia(s), f"lobatto-iiib:{s}")


@cached_family
def chebyshev_gauss(s: int) -> Tableau:
    """Return collocation on the s Chebyshev-Gauss points: symmetric, of order s for even s and s + 1 for odd s."""
    s = point_count(s, "the number of Chebyshev-Gauss stages", least=1, most=MAX_STAGES)
    return collocation_tableau(to_unit(chebyshev_gauss_points(s)), f"chebyshev-gauss:{s}")


@cached_family
def chebyshev_lobatto(s: int) -> Tableau:
    """Return collocation on the s >= 2 Chebyshev-Lobatto points: symmetric, of order s (even s) or s + 1 (odd s)."""
    s = point_count(s, "the number of Chebyshev-Lobatto stages", least=2, most=MAX_STAGES)
    return collocation_tableau(to_unit(chebyshev_lobatto_points(s)), f"chebyshev-lobatto:{s}")


@lru_cache(maxsize=None, typed=True)
def explicit_euler() -> Tableau:
    """Return the explicit Euler method, of order 1."""
    return Tableau(name="explicit-euler", A=((0,),), b=(1,), c=(0,))


TABLEAU_FAMILIES: Mapping[str, Callable[[int], Tableau]] = {
    "gauss": gauss,
    "radau-iia": radau_iia,
    "radau-ia": radau_ia,
    "lobatto-iiia": lobatto_iiia,
    "lobatto-iiib": lobatto_iiib,
    "chebyshev-gauss": chebyshev_gauss,
    "chebyshev-lobatto": chebyshev_lobatto,
}


def tableau_by_name(name: str) -> Tableau:
    """Return the tableau of a name such as ``"radau-iia:3"`` or ``"explicit-euler"``, the inverse of ``name``.

    Raises ``MethodError`` for an unknown family (with the known ones and the closest) or a missing or too small count.
    """
    if name == "explicit-euler":
        return explicit_euler()
    family, stages = split_name(name, TABLEAU_FAMILIES, "tableau")
    return family(stages)
