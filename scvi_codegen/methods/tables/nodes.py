"""Nodes on [-1, 1] that parametrise a trial curve of degree s by its s + 1 values.

Chebyshev points are sines of rational multiples of pi. Legendre-Gauss, Lobatto and Radau points are the roots of Jacobi
polynomials (Davis & Rabinowitz, *Methods of Numerical Integration*, 2nd ed. 1984, section 2.7), computed by Newton's
method on the three-term recurrence with twenty guard digits: no eigenvalue problem, no monomials.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from typing import Any, TypeAlias, TypeVar, cast

from scvi_codegen.common.errors import MethodError, closest
from scvi_codegen.common.precision import DIGITS, Number, Vector, mp
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import TEXT, WHOLE, checked_count, checks_arguments

GUARD = 20
MOST_POINTS = 128
"""Maximum number of points of a rule or a curve: about a second of 60-digit arithmetic."""

point_count = partial(checked_count, most=MOST_POINTS, error=MethodError)
"""Validation of a number of points, or a degree."""

Expressions: TypeAlias = tuple[Any, ...]
"""Tuple of SymPy expressions (SymPy is imported only where one is made)."""

Item = TypeVar("Item")
Family = TypeVar("Family", bound=Callable[..., Any])


@dataclass(frozen=True, slots=True, kw_only=True)
class Nodes:
    """Distinct ascending points on [-1, 1] that determine a polynomial of degree ``degree``.

    ``points`` has ``degree + 1`` entries; floats, integers, fractions, decimal strings and SymPy numbers are converted
    to numbers of 60 digits. Raises ``MethodError`` when they are not ascending, not in [-1, 1], or too few or many.
    """

    name: str
    degree: int
    points: Vector

    __repr__ = summary("name", "degree")

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", point_count(self.degree, "the degree", least=1))
        object.__setattr__(self, "points", ascending_points(self.points, "node"))
        if len(self.points) != self.degree + 1:
            raise MethodError(
                f"degree {self.degree} needs {self.degree + 1} nodes, got {len(self.points)}; "
                f"give {self.degree + 1} points or set degree={len(self.points) - 1}"
            )

    @property
    def abscissae(self) -> Vector:
        """Points mapped to [0, 1]: c = (x + 1) / 2."""
        return to_unit(self.points)

    @property
    def contains_ends(self) -> bool:
        """True if the first node is -1 and the last is 1, exactly."""
        return bool(self.points[0] == -1 and self.points[-1] == 1)

    @property
    def symmetric(self) -> bool:
        """True if the negative of each node is a node, to 50 digits."""
        return is_antisymmetric(self.points)


def to_unit(points: Vector) -> Vector:
    """Map points of [-1, 1] to [0, 1]: c = (x + 1) / 2."""
    return tuple((x + 1) / 2 for x in points)


def to_number(value: Any) -> Number:
    """Round an int, float, fraction, decimal string, mpmath or SymPy number to 60 digits.

    A float is converted exactly. Raises ``MethodError`` for anything else, infinities and nan.
    """
    try:
        number = mp.mpf(mp.convert(str(value.evalf(DIGITS + GUARD)) if hasattr(value, "evalf") else value))
    except (TypeError, ValueError, ArithmeticError) as error:
        raise MethodError(f"{value!r} is not a real number; give a number or a constant expression") from error
    if not mp.isfinite(number):
        raise MethodError(f"{value!r} is not finite; give a finite number")
    return number


def ascending_points(values: Iterable[Any], name: str) -> Vector:
    """Return ``values`` as numbers, checked to be strictly ascending and in [-1, 1]; ``name`` is that of one."""
    points = tuple(map(to_number, values))
    for index, point in enumerate(points):
        if abs(point) > 1:
            raise MethodError(f"{name} {index} is {mp.nstr(point, 8)}, outside [-1, 1]; map the interval to [-1, 1]")
        if index and point <= points[index - 1]:
            raise MethodError(
                f"{name} {index} is {mp.nstr(point, 8)}, not greater than the one before it; give "
                "distinct points in ascending order"
            )
    return points


def is_antisymmetric(points: Vector) -> bool:
    """Return whether reversing the points equals changing their signs, to 50 digits."""
    tolerance = mp.mpf(10) ** (10 - DIGITS)
    return all(abs(left + right) <= tolerance for left, right in zip(points, reversed(points), strict=True))


def family_named(name: str, families: Mapping[str, Item], kind: str) -> Item:
    """Return ``families[name]``, or raise ``MethodError`` with the known names and the closest match."""
    if name in families:
        return families[name]
    raise MethodError(f"unknown {kind} {name!r}{closest(str(name), families)} Known: {', '.join(families)}")


def jacobi_value_and_derivative(count: int, alpha: int, beta: int, x: Number) -> tuple[Number, Number]:
    """Return the Jacobi polynomial of degree ``count >= 1`` and its derivative at ``x`` in (-1, 1).

    Three-term recurrence and derivative formula: Abramowitz & Stegun 22.7.1 and 22.8.1.
    """
    both = alpha + beta
    before, value = 1, alpha + 1 + (both + 2) * (x - 1) / 2
    for k in range(2, count + 1):
        twice = 2 * k + both
        middle = (twice - 1) * (twice * (twice - 2) * x + alpha**2 - beta**2) * value
        last = 2 * (k + alpha - 1) * (k + beta - 1) * twice * before
        before, value = value, (middle - last) / (2 * k * (k + both) * (twice - 2))
    twice = 2 * count + both
    derivative = count * (alpha - beta - twice * x) * value + 2 * (count + alpha) * (count + beta) * before
    return value, derivative / (twice * (1 - x * x))


BINARY64_ITERATIONS = 3
"""Iterations of a root in binary64, from the two digits of the guess to about 15."""


def jacobi_root(count: int, alpha: int, beta: int, index: int) -> Number:
    """Return root ``index`` (0 is the smallest) by Newton's method from an asymptotic guess, first in binary64.

    The guess is cos((2k + alpha - 1/2) pi / (2 count + alpha + beta + 1)), k counted from the largest root: the leading
    term of Darboux's asymptotic formula, close enough for quadratic convergence at every degree.
    """
    guess = math.cos(math.pi * (4 * (count - index) + 2 * alpha - 1) / (4 * count + 2 * (alpha + beta + 1)))
    for _ in range(BINARY64_ITERATIONS):
        value, derivative = jacobi_value_and_derivative(count, alpha, beta, guess)
        guess -= value / derivative
    x, converged = mp.mpf(guess), mp.mpf(10) ** (-mp.dps // 2 - 5)
    while True:
        value, derivative = jacobi_value_and_derivative(count, alpha, beta, x)
        x -= value / derivative
        if abs(value / derivative) < converged:
            return x


@cache
def jacobi_roots(count: int, alpha: int, beta: int) -> Vector:
    """Return the ascending roots of the Jacobi polynomial of degree ``count >= 0`` and integer ``alpha, beta >= 0``.

    They include guard digits, since ``Nodes`` and ``Quadrature`` round them.
    """
    with mp.workdps(DIGITS + GUARD):
        roots = [jacobi_root(count, alpha, beta, index) for index in range(count // 2 if alpha == beta else count)]
        if alpha == beta:
            roots += [mp.zero] * (count % 2) + [-root for root in reversed(roots)]
    return tuple(roots)


def legendre_gauss_points(count: int) -> Vector:
    """Return the ``count`` roots of the Legendre polynomial P_count."""
    return jacobi_roots(count, 0, 0)


def legendre_lobatto_points(count: int) -> Vector:
    """Return -1, the roots of P'_{count-1} (Jacobi, alpha = beta = 1) and 1; ``count >= 2``."""
    return (-mp.one, *jacobi_roots(count - 2, 1, 1), mp.one)


def radau_left_points(count: int) -> Vector:
    """Return the roots of P_{count-1} + P_count: -1 and the Jacobi roots for alpha = 0, beta = 1."""
    return (-mp.one, *jacobi_roots(count - 1, 0, 1))


def radau_right_points(count: int) -> Vector:
    """Return the roots of P_{count-1} - P_count: the Jacobi roots for alpha = 1, beta = 0, and 1."""
    return (*jacobi_roots(count - 1, 1, 0), mp.one)


def sines(numerators: Iterable[int], denominator: int) -> Vector:
    """Return sin(k pi / denominator) for each numerator k; odd in k to the last bit."""
    with mp.workdps(DIGITS + GUARD):
        return tuple(mp.sinpi(mp.mpf(k) / denominator) for k in numerators)


def chebyshev_lobatto_points(count: int) -> Vector:
    """Return -cos(j pi / N), j = 0..N = count - 1, written as sin((2j - N) pi / 2N)."""
    return sines(range(1 - count, count, 2), 2 * (count - 1))


def chebyshev_gauss_points(count: int) -> Vector:
    """Return the roots of the Chebyshev polynomial T_count: -cos((2j + 1) pi / (2 count))."""
    return sines(range(1 - count, count, 2), 2 * count)


def nodes_of(name: str, degree: int, points: Callable[[int], Vector]) -> Nodes:
    """Return the family member of this degree, after checking the degree."""
    return Nodes(name=name, degree=degree, points=points(point_count(degree, "the degree", least=1) + 1))


def cached_family(member: Family) -> Family:
    """Decorate a function of whole numbers and texts: its arguments are checked, its results are cached."""
    kinds = {
        name: WHOLE if kind == "int" else TEXT for name, kind in member.__annotations__.items() if name != "return"
    }
    return checks_arguments(MethodError, **kinds)(cast("Family", lru_cache(maxsize=None, typed=True)(member)))


@cached_family
def chebyshev_lobatto(degree: int) -> Nodes:
    """Return the Chebyshev-Gauss-Lobatto nodes -cos(j pi / degree), both ends among them.

    >>> [float(x) for x in chebyshev_lobatto(2).points]
    [-1.0, 0.0, 1.0]
    """
    return nodes_of("chebyshev-lobatto", degree, chebyshev_lobatto_points)


@cached_family
def legendre_lobatto(degree: int) -> Nodes:
    """Return -1, 1 and the extrema of the Legendre polynomial of this degree."""
    return nodes_of("legendre-lobatto", degree, legendre_lobatto_points)


@cached_family
def equispaced(degree: int) -> Nodes:
    """Return nodes with equal gaps, both ends among them; interpolation on them is unstable beyond degree 10 or so."""
    return nodes_of(
        "equispaced", degree, lambda count: tuple(mp.mpf(j) / (count - 1) for j in range(1 - count, count, 2))
    )


WITHOUT_BOTH_ENDS = {
    "legendre-gauss": legendre_gauss_points,
    "chebyshev-gauss": chebyshev_gauss_points,
    "radau-left": radau_left_points,
    "radau-right": radau_right_points,
}
"""Points of the families of degree + 1 nodes without -1 or 1, by name."""
NODE_FAMILIES: Mapping[str, Callable[[int], Nodes]] = {
    "chebyshev-lobatto": chebyshev_lobatto,
    "legendre-lobatto": legendre_lobatto,
    "equispaced": equispaced,
    **{name: cache(partial(nodes_of, name, points=points)) for name, points in WITHOUT_BOTH_ENDS.items()},
}


def nodes_by_name(name: str, degree: int) -> Nodes:
    """Return the nodes of the named family; ``MethodError`` lists the names when there is no such family."""
    return family_named(name, NODE_FAMILIES, "node family")(degree)
