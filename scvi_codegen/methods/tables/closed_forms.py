"""Closed forms: nodes, quadratures and tableaux as SymPy rationals and radicals, where these are short.

The 60-digit numbers of :mod:`~scvi_codegen.methods.tables.nodes`, :mod:`~scvi_codegen.methods.tables.quadrature` and
:mod:`~scvi_codegen.methods.tables.tableau` are recognised, built in or user-defined: each is compared with a rational
number, a root of a quadratic polynomial and the square root of such a root. SymPy is imported only where an expression
is made.
"""

from fractions import Fraction
from functools import lru_cache
from itertools import takewhile
from typing import Any

from scvi_codegen.common.precision import Number, Vector, mp
from scvi_codegen.methods.tables.nodes import Expressions, Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau, gauss

AGREEMENT = mp.mpf("1e-50")
LARGEST_DENOMINATOR, LARGEST_COEFFICIENT = 10**9, 10**12
SMALLEST_IRRATIONAL = mp.mpf("1e-12")


@lru_cache(maxsize=4096)
def exact_number(value: Number) -> Any:
    """Return the rational number, the root of a quadratic polynomial or the square root of one, or None."""
    from sympy import sqrt, sqrtdenest

    if value < 0:
        positive = exact_number(-value)
        return None if positive is None else -positive
    exact = rational_or_quadratic(value)
    square = rational_or_quadratic(value * value) if exact is None and value > SMALLEST_IRRATIONAL else None
    if square is not None:
        exact = sqrt(square)
        denested = sqrtdenest(exact)
        return denested if denested.is_Add else exact
    return exact


def rational_or_quadratic(value: Number) -> Any:
    """Return the rational number or root of an integer quadratic polynomial that agrees to 50 digits, or None."""
    from sympy import Rational, sqrt

    near = (int(value.man) * Fraction(2) ** int(value.exp)).limit_denominator(LARGEST_DENOMINATOR)
    if abs(value - mp.mpf(near.numerator) / near.denominator) < AGREEMENT:
        return Rational(near.numerator, near.denominator)
    if value < SMALLEST_IRRATIONAL:
        return None
    relation = mp.pslq([value * value, value, mp.one], tol=AGREEMENT, maxcoeff=LARGEST_COEFFICIENT, maxsteps=1000)
    a, b, c = relation or (0, 0, 0)
    discriminant = b * b - 4 * a * c
    if a == 0 or discriminant < 0:
        return None
    center, radius = mp.mpf(-b) / (2 * a), mp.sqrt(discriminant) / (2 * abs(a))
    sign = 1 if value > center else -1
    if abs(center + sign * radius - value) > AGREEMENT:
        return None
    return Rational(-b, 2 * a) + sign * sqrt(Rational(discriminant, 4 * a * a))


def exact_numbers(values: Vector) -> Expressions | None:
    """Return the exact form of every number, or None at the first that has none."""
    root = tuple(takewhile(lambda exact: exact is not None, map(exact_number, values)))
    return root if len(root) == len(values) else None


def exact_points(nodes: Nodes) -> Expressions | None:
    """Return the nodes as SymPy rationals and radicals, or None if a node is not recognised.

    Recognised are equispaced nodes; Chebyshev-Lobatto of degree 1 to 6, 8, 10 and 12; Legendre-Lobatto up to degree 6;
    Chebyshev-Gauss up to degree 5; Legendre-Gauss up to degree 4; Radau up to degree 2; user-defined nodes of such
    numbers.
    """
    return exact_numbers(nodes.points)


def exact_rule(quadrature: Quadrature) -> tuple[Expressions, Expressions] | None:
    """Return (points, weights) as SymPy rationals and radicals, or None if a number is not recognised.

    Recognised are Gauss-Legendre n <= 5, Lobatto n <= 7, Radau n <= 3, Clenshaw-Curtis n <= 7, 9, 11 and 13, Fejer
    n <= 6, Hermite of the same Lobatto points, and user-defined rules of such numbers.
    """
    n, numbers = len(quadrature), exact_numbers((*quadrature.points, *quadrature.weights))
    return None if numbers is None else (numbers[:n], numbers[n:])


def exact_tableau(tableau: Tableau) -> tuple[tuple[Expressions, ...], Expressions, Expressions] | None:
    """Return (A, b, c) as SymPy rationals and radicals, or None if an entry is not recognised.

    Recognised are Gauss s <= 3, Radau s <= 3, Lobatto s <= 5, Chebyshev-Gauss s <= 3, Chebyshev-Lobatto s <= 7,
    explicit Euler, and user-defined tableaux of such numbers. Gauss s = 4, of degree 8, is taken from the literature.
    """
    if tableau == gauss(4):
        return exact_gauss_four()
    s, entries = tableau.stages, exact_numbers(sum(tableau.A, (*tableau.c, *tableau.b)))
    if entries is None:
        return None
    c, b, *A = (entries[i : i + s] for i in range(0, len(entries), s))
    return tuple(A), b, c


def exact_gauss_four() -> tuple[tuple[Expressions, ...], Expressions, Expressions]:
    """Return the Gauss method of order 8, table 3 of Li, Wu & Leok (HW, section IV.5), where v is their w'.

    Their entry a_34 is misprinted: it must be w1 + w3' - w4.
    """
    from sympy import Rational, sqrt

    def letters(root: Any) -> Expressions:
        first = Rational(1, 8) - root / 144
        second = sqrt((15 + 2 * root) / 35) / 2
        third, fourth = second * (Rational(1, 6) + root / 24), second * (Rational(1, 21) + 5 * root / 168)
        return first, second, third, fourth, second - 2 * third

    half = Rational(1, 2)
    w1, w2, w3, w4, w5 = letters(sqrt(30))
    v1, v2, v3, v4, v5 = letters(-sqrt(30))
    A = (
        (w1, v1 - w3 + v4, v1 - w3 - v4, w1 - w5),
        (w1 - v3 + w4, v1, v1 - v5, w1 - v3 - w4),
        (w1 + v3 + w4, v1 + v5, v1, w1 + v3 - w4),
        (w1 + w5, v1 + w3 + v4, v1 + w3 - v4, w1),
    )
    return A, (2 * w1, 2 * v1, 2 * v1, 2 * w1), (half - w2, half - v2, half + v2, half + w2)


def exact_part(part: Nodes | Quadrature | Tableau) -> list[Any] | None:
    """Return all exact points, weights and coefficients of a part of a method, or None."""
    if isinstance(part, Tableau):
        tableau = exact_tableau(part)
        return None if tableau is None else [x for row in (*tableau[0], *tableau[1:]) for x in row]
    if isinstance(part, Quadrature):
        rule = exact_rule(part)
        return None if rule is None else [x for group in rule for x in group]
    points = exact_points(part)
    return None if points is None else [*points]
