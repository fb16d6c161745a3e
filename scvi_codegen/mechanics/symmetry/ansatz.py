"""Ansatz for momentum maps: the polynomials in q, p and t that are tried, and arithmetic on them.

The state is q_0 .. q_(m-1), p_0 .. p_(m-1), with indices 0 .. 2 m - 1.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations, combinations_with_replacement
from typing import TypeAlias

import numpy as np
import sympy
from sympy import Expr, prime

from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.symmetry.bodies import Body, bodies
from scvi_codegen.mechanics.symmetry.invariants import Column, Monomial, Polynomial
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = [
    "Terms",
    "bodies_of",
    "boost_columns",
    "combined",
    "gauge_columns",
    "independent",
    "is_shift",
    "monomial_columns",
    "planes_of",
    "polynomial_in",
    "rigid_columns",
    "turn",
]

Terms: TypeAlias = Mapping[Monomial, Expr]
"""Polynomial whose coefficients depend on parameters."""

MAX_CYCLIC = 12


def monomial_columns(m: int, *, curved: bool) -> Iterator[dict[Monomial, int]]:
    """Yield all monomials of the ansatz, beginning with those that are to occur in few momentum maps."""
    q, p = range(m), range(m, 2 * m)
    planes = sorted(combinations(q, 2), reverse=True)
    turns = [*planes, *((i, i) for i in q), *((j, i) for i, j in planes)]
    factors: list[tuple[int, tuple[int, ...]]] = [(0, (i,)) for i in p]
    factors += [(0, (i,)) for i in q] * curved
    factors += [(0, (i, m + j)) for i, j in turns]
    factors += [(k, pair) for k in (0, 1) for pair in (*combinations(p, 2), *((i, i) for i in p))] * curved
    factors += [(k, (i,)) for k in (1, 2) for i in p]
    factors += [(1, (i, m + j)) for i, j in turns]
    columns = [{Monomial(*factor): 1} for factor in factors]
    yield from columns
    yield from (column for column in gauge_columns(m, quadratic=True) if column not in columns)


def gauge_columns(m: int, *, quadratic: bool) -> Iterator[dict[Monomial, int]]:
    """Yield the monomials of the gauge f: of degree 2 in q (1 in t), 1 in q (3 in t), 0 in q (4 in t)."""
    q = range(m)
    yield from ({Monomial(k, (i,)): 1} for k in range(4) for i in q)
    pairs = (*combinations(q, 2), *((i, i) for i in q)) if quadratic else ()
    yield from ({Monomial(k, pair): 1} for k in (0, 1) for pair in pairs)
    yield from ({Monomial(k, ()): 1} for k in range(1, 5))


def rigid_columns(system: MechanicalSystem) -> Iterator[dict[Monomial, int]]:
    """Yield momenta of cyclic coordinates, translations and rotations of all bodies together, and t."""
    m, free = system.dimension, system.formula.free_symbols
    cyclic = [i for i, q in enumerate(system.coordinates) if q not in free][:MAX_CYCLIC]
    yield from ({Monomial(0, (m + i,)): 1} for i in cyclic)
    rigid = bodies_of(system)
    groups = zip(*(body.columns for body in rigid), strict=True) if rigid else [range(m)]
    yield from ({Monomial(0, (m + i,)): 1 for i in group} for group in groups)
    yield from (turn(m, rigid, plane) for plane in planes_of(rigid))
    yield {Monomial(1, ()): 1}


def is_shift(column: Polynomial) -> bool:
    """Return whether a polynomial is a sum of single momenta (a translation)."""
    return all(len(monomial.factors) == 1 for monomial in column)


def boost_columns(system: MechanicalSystem, rigid: Sequence[Polynomial]) -> list[Polynomial]:
    """Return Galilean boosts: translations times t minus the masses that they move times their positions, and t^2."""
    m, constants = system.dimension, set(system.parameters)
    masses = {column: x for column, x in forms_of(system).mass.items() if x.free_symbols <= constants}
    boosts: list[Polynomial] = []
    for shift in filter(is_shift, rigid):
        moved = {monomial.factors[0] - m for monomial in shift}
        boost: dict[Monomial, Expr | int] = {Monomial(1, monomial.factors): 1 for monomial in shift}
        for (i, j), mass in masses.items():
            if i in moved:
                boost[Monomial(0, (j,))] = boost.get(Monomial(0, (j,)), 0) - mass
        boosts.append(boost)
    return [*boosts, {Monomial(2, ()): 1}]


def bodies_of(system: MechanicalSystem) -> tuple[Body, ...]:
    """Return bodies by names such as jupiter_x, x_jupiter, x1; 2 or 3 coordinates with other names are one body."""
    names = [q.name for q in system.coordinates]
    alone = (Body(name="", columns=tuple(range(len(names)))),) if 2 <= len(names) <= 3 else ()
    return bodies(names) or alone


def planes_of(rigid: Sequence[Body]) -> list[tuple[int, int]]:
    """Return pairs of axes of right-handed rotations: about x, y, z, or the one of the plane."""
    size = len(rigid[0].columns) if rigid else 0
    return [(1, 2), (2, 0), (0, 1)] if size == 3 else [(0, 1)] if size == 2 else []


def turn(m: int, rigid: Sequence[Body], plane: tuple[int, int]) -> dict[Monomial, int]:
    """Return the angular momentum of all bodies in a plane of rotation."""
    pairs = [(body.columns[plane[0]], body.columns[plane[1]]) for body in rigid]
    return {Monomial(0, (i, m + j)): 1 for i, j in pairs} | {Monomial(0, (j, m + i)): -1 for i, j in pairs}


def combined(row: Mapping[int, Expr], columns: Sequence[Column]) -> Terms:
    """Return the linear combination of polynomial columns with these coefficients."""
    terms: dict[Monomial, Expr] = {}
    for c, coefficient in row.items():
        column = columns[c]
        assert not isinstance(column, Expr)
        for monomial, factor in column.items():
            terms[monomial] = terms.get(monomial, sympy.S.Zero) + factor * coefficient
    return {monomial: coefficient for monomial, coefficient in terms.items() if coefficient != 0}


def polynomial_in(system: MechanicalSystem, terms: Terms) -> Expr:
    """Return the polynomial as an expression in the symbols of the system."""
    state = (*system.coordinates, *system.momentum_symbols)
    return sympy.Add(
        *(
            sympy.Mul(coefficient, system.time**monomial.power, *(state[i] for i in monomial.factors))
            for monomial, coefficient in terms.items()
        )
    )


def independent(candidates: Sequence[Terms], first: Sequence[Terms] = (), trivial: Sequence[Terms] = ()) -> list[Terms]:
    """Return ``first`` and those found that are no combinations of them, of products of linear ones and of ``trivial``.

    ``candidates`` and ``first`` span the products that they have; ``first``, unless empty, has all linear ones.
    """
    chosen = list(first) or [terms for terms in candidates if _is_linear(terms)]
    linear = [terms for terms in chosen if _is_linear(terms)]
    known = [*chosen, *(_product(a, b) for a, b in combinations_with_replacement(linear, 2)), *trivial]
    rank = _rank(known)
    for terms in sorted((terms for terms in candidates if not _is_linear(terms)), key=len):
        if _rank([*known, terms]) > rank:
            chosen, known, rank = [*chosen, terms], [*known, terms], rank + 1
    return chosen


def _is_linear(terms: Terms) -> bool:
    return all(len(monomial.factors) <= 1 for monomial in terms)


def _product(a: Terms, b: Terms) -> Terms:
    product: dict[Monomial, Expr] = {}
    for (one, x), (other, y) in itertools.product(a.items(), b.items()):
        both = Monomial(one.power + other.power, tuple(sorted(one.factors + other.factors)))
        product[both] = product.get(both, sympy.S.Zero) + x * y
    return product


def _rank(candidates: Sequence[Terms]) -> int:
    """Return the rank of polynomials, with numbers in place of the parameters; roots of these may be complex."""
    columns = {monomial: k for k, monomial in enumerate({monomial: None for terms in candidates for monomial in terms})}
    constants = sorted(set().union(*(x.free_symbols for terms in candidates for x in terms.values())), key=str)
    numbers = {constant: sympy.Rational(prime(k + 5), 7) for k, constant in enumerate(constants)}
    matrix = np.zeros((len(candidates), len(columns)), dtype=complex)
    for k, terms in enumerate(candidates):
        for monomial, coefficient in terms.items():
            matrix[k, columns[monomial]] = complex(coefficient.xreplace(numbers))
    return int(np.linalg.matrix_rank(matrix)) if matrix.size else 0  # NumPy 1.26 has no rank of empty ones
