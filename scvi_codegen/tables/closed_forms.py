"""Closed forms: nodes, quadratures and tableaux as SymPy rationals and radicals, where these are short.

Each function returns the exact form of 60-digit numbers in :mod:`~scvi_codegen.tables.nodes`,
:mod:`~scvi_codegen.tables.quadrature` and :mod:`~scvi_codegen.tables.tableau`, or ``None``. User-defined ones have no
closed form, whatever their name. SymPy is imported only where an expression is made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from scvi_codegen.tables.nodes import NODE_FAMILIES, Expressions, Nodes, family_named
from scvi_codegen.tables.quadrature import (
    Quadrature,
    clenshaw_curtis_weights,
    fejer_weights,
    is_built_in,
    quadrature_by_name,
)
from scvi_codegen.tables.tableau import Tableau, explicit_euler, partner_matrix, tableau_by_name


def reflected(values: Expressions) -> Expressions:
    """Return exact points mirrored at 0, ascending again."""
    return tuple(-value for value in reversed(values))


def exact_points(nodes: Nodes) -> Expressions | None:
    """Return the nodes as SymPy rationals and radicals, or None if no short closed form is known.

    Closed forms: equispaced always; Chebyshev whenever SymPy knows the cosines as radicals (Lobatto degree 1 to 6, 8,
    10, 12, ...); Legendre-Lobatto up to degree 5; Legendre-Gauss up to degree 4; Radau up to degree 2. User-defined
    nodes have no closed form, whatever their name.
    """
    family = NODE_FAMILIES.get(nodes.name)
    if family is None or family(nodes.degree) != nodes:
        return None
    return exact_family_points(nodes.name, nodes.degree + 1)


def exact_family_points(name: str, count: int) -> Expressions | None:
    """Return the ``count`` ascending points of the node family as SymPy radicals, or None (see ``exact_points``)."""
    exact: Mapping[str, Callable[[int], Expressions | None]] = {
        "chebyshev-lobatto": lambda n: exact_sines(range(1 - n, n, 2), 2 * (n - 1)),
        "legendre-lobatto": exact_lobatto,
        "equispaced": exact_equispaced,
        "legendre-gauss": exact_gauss,
        "chebyshev-gauss": lambda n: exact_sines(range(1 - n, n, 2), 2 * n),
        "radau-left": exact_radau_left,
        "radau-right": exact_radau_right,
    }
    return family_named(name, exact, "node family")(count)


def exact_sines(numerators: Iterable[int], denominator: int) -> Expressions | None:
    """Return sin(k pi / denominator) as radicals, or None when SymPy keeps a sine or cosine."""
    import sympy as sp

    values = tuple(sp.sin(sp.Rational(k, denominator) * sp.pi) for k in numerators)
    return None if any(value.has(sp.sin, sp.cos) for value in values) else values


def exact_equispaced(count: int) -> Expressions:
    """Return the rationals (2j - N) / N, N = count - 1."""
    import sympy as sp

    return tuple(sp.Rational(j, count - 1) for j in range(1 - count, count, 2))


def mirrored(positive: Expressions | None, count: int) -> Expressions | None:
    """Return the symmetric points of which ``positive`` are the positive ones, ascending."""
    if positive is None:
        return None
    import sympy as sp

    return (*reflected(positive), *([sp.Integer(0)] if count % 2 else []), *positive)


def exact_gauss(count: int) -> Expressions | None:
    """Return the Legendre-Gauss points for count <= 5 (Abramowitz & Stegun, table 25.4, in radicals)."""
    from sympy import Rational, sqrt

    four, five = 2 * sqrt(30) / 35, 2 * sqrt(70) / 63
    positive: dict[int, Expressions] = {
        1: (),
        2: (sqrt(3) / 3,),
        3: (sqrt(15) / 5,),
        4: (sqrt(Rational(3, 7) - four), sqrt(Rational(3, 7) + four)),
        5: (sqrt(Rational(5, 9) - five), sqrt(Rational(5, 9) + five)),
    }
    return mirrored(positive.get(count), count)


def exact_lobatto(count: int) -> Expressions | None:
    """Return the Legendre-Lobatto points for count <= 6 (Abramowitz & Stegun, table 25.6, in radicals)."""
    from sympy import Integer, Rational, sqrt

    six = 2 * sqrt(7) / 21
    inside: dict[int, Expressions] = {
        2: (),
        3: (),
        4: (sqrt(5) / 5,),
        5: (sqrt(21) / 7,),
        6: (sqrt(Rational(1, 3) - six), sqrt(Rational(1, 3) + six)),
    }
    return mirrored((*inside[count], Integer(1)) if count in inside else None, count)


def exact_radau_left(count: int) -> Expressions | None:
    """Return the left Radau points for count <= 3, in radicals."""
    from sympy import Integer, Rational, sqrt

    inside: dict[int, Expressions] = {
        1: (),
        2: (Rational(1, 3),),
        3: ((1 - sqrt(6)) / 5, (1 + sqrt(6)) / 5),
    }
    return (Integer(-1), *inside[count]) if count in inside else None


def exact_radau_right(count: int) -> Expressions | None:
    """Return the right Radau points for count <= 3, in radicals."""
    left = exact_radau_left(count)
    return None if left is None else tuple(value.expand() for value in reflected(left))


POINT_FAMILIES: Mapping[str, str] = {
    "gauss-legendre": "legendre-gauss",
    "gauss-lobatto": "legendre-lobatto",
    "gauss-radau-left": "radau-left",
    "gauss-radau-right": "radau-right",
    "clenshaw-curtis": "chebyshev-lobatto",
    "fejer": "chebyshev-gauss",
}


def exact_rule(quadrature: Quadrature) -> tuple[Expressions, Expressions] | None:
    """Return (points, weights) as SymPy rationals and radicals, or None if no short closed form is known.

    Closed forms: Gauss-Legendre n <= 5, Lobatto n <= 6, Radau n <= 3; Clenshaw-Curtis and Fejer wherever SymPy knows
    the cosines as radicals. A user-defined rule has no closed form, whatever its name.
    """
    family, count = quadrature.name.partition(":")[0], len(quadrature)
    if family not in POINT_FAMILIES:
        return None
    if quadrature.name != f"{family}:{count}" or not is_built_in(quadrature_by_name, quadrature.name, quadrature):
        return None
    points = exact_family_points(POINT_FAMILIES[family], count)
    return None if points is None else (points, exact_weights(family, count))


def exact_weights(family: str, count: int) -> Expressions:
    """Return the weights of a rule whose points have a closed form, in radicals."""
    import sympy as sp

    if family in ("clenshaw-curtis", "fejer"):
        weights = clenshaw_curtis_weights if family == "clenshaw-curtis" else fejer_weights
        return tuple(sp.expand(weight) for weight in weights(count, sp.pi, sp.cos))
    if family == "gauss-radau-right":
        return tuple(reversed(exact_weights("gauss-radau-left", count)))
    if family == "gauss-radau-left":
        return exact_radau_weights()[count - 1]
    table = exact_gauss_weights() if family == "gauss-legendre" else exact_lobatto_weights()
    half = table[count]
    return (*half, *reversed(half[: count // 2]))


def rationals(*values: tuple[int, int]) -> Expressions:
    """Return SymPy rationals from numerators and denominators."""
    import sympy as sp

    return tuple(sp.Rational(*value) for value in values)


def exact_gauss_weights() -> Mapping[int, Expressions]:
    """Return the Gauss-Legendre weights up to the middle, by number of points (Davis & Rabinowitz, section 2.7)."""
    from sympy import sqrt

    return {
        1: rationals((2, 1)),
        2: rationals((1, 1)),
        3: rationals((5, 9), (8, 9)),
        4: ((18 - sqrt(30)) / 36, (18 + sqrt(30)) / 36),
        5: ((322 - 13 * sqrt(70)) / 900, (322 + 13 * sqrt(70)) / 900, *rationals((128, 225))),
    }


def exact_lobatto_weights() -> Mapping[int, Expressions]:
    """Return the Lobatto weights up to the middle, by number of points (Davis & Rabinowitz, section 2.7)."""
    from sympy import sqrt

    return {
        2: rationals((1, 1)),
        3: rationals((1, 3), (4, 3)),
        4: rationals((1, 6), (5, 6)),
        5: rationals((1, 10), (49, 90), (32, 45)),
        6: (*rationals((1, 15)), (14 - sqrt(7)) / 30, (14 + sqrt(7)) / 30),
    }


def exact_radau_weights() -> tuple[Expressions, ...]:
    """Return the weights of the left Radau rules with 1, 2 and 3 points."""
    from sympy import sqrt

    return (
        rationals((2, 1)),
        rationals((1, 2), (3, 2)),
        (*rationals((2, 9)), (16 + sqrt(6)) / 18, (16 - sqrt(6)) / 18),
    )


EXACT_FAMILIES: Mapping[str, tuple[str, int]] = {
    "gauss": ("legendre-gauss", 4),
    "radau-iia": ("radau-right", 3),
    "radau-ia": ("radau-left", 3),
    "lobatto-iiia": ("legendre-lobatto", 5),
    "lobatto-iiib": ("legendre-lobatto", 5),
    "chebyshev-gauss": ("chebyshev-gauss", 3),
    "chebyshev-lobatto": ("chebyshev-lobatto", 7),
}


def exact_tableau(tableau: Tableau) -> tuple[tuple[Expressions, ...], Expressions, Expressions] | None:
    """Return (A, b, c) as SymPy rationals and radicals, or None if no short closed form is known.

    Closed forms: Gauss s <= 4, Radau s <= 3, Lobatto s <= 5, Chebyshev-Gauss s <= 3, Chebyshev-Lobatto s <= 7, explicit
    Euler. A user-defined tableau has no closed form, whatever its name.
    """
    family, s = tableau.name.partition(":")[0], tableau.stages
    if tableau == explicit_euler():
        from sympy import Integer

        return ((Integer(0),),), (Integer(1),), (Integer(0),)
    points, most = EXACT_FAMILIES.get(family, ("", 0))
    if s > most or not is_built_in(tableau_by_name, tableau.name, tableau):
        return None
    if tableau.name == "gauss:4":
        return exact_gauss_four()
    A, b, c = exact_collocation(exact_family_points(points, s) or ())
    if family in ("radau-ia", "lobatto-iiib"):
        from sympy import radsimp

        A = tuple(tuple(radsimp(value).expand() for value in row) for row in partner_matrix(A, b))
    return A, b, c


def exact_collocation(points: Expressions) -> tuple[tuple[Expressions, ...], Expressions, Expressions]:
    """Return equation (23) on exact points of [-1, 1], all in one quadratic field, so that radicals do not nest."""
    import sympy as sp

    t = sp.Symbol("t")
    c = tuple(sp.expand((1 + point) / 2) for point in points)
    ends, columns = (*c, sp.Integer(1)), []
    for j, here in enumerate(c):
        others = [other for k, other in enumerate(c) if k != j]
        scale = sp.radsimp(1 / sp.expand(sp.prod(here - other for other in others)))
        primitive = sp.Poly(sp.expand(sp.prod(t - other for other in others)), t).integrate()
        columns.append([sp.expand(scale * sp.expand(primitive.as_expr().subs(t, end))) for end in ends])
    *A, b = zip(*columns, strict=True)
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
