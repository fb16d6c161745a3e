"""Recognition of 60-digit numbers as short combinations of radicals, by PSLQ."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from itertools import combinations

import sympy

from scvi_codegen.tables.precision import DIGITS, Number, Vector, mp

LARGEST_BASIS = 8
LARGEST_COEFFICIENT = 10**5
SLACK = 6
"""Number of digits excluded from the comparison, so that 54 must agree."""


def radical_basis(expressions: Iterable[sympy.Expr]) -> tuple[sympy.Expr, ...]:
    """Return 1, the square roots in the expressions and their pairwise products; () if these are too many."""
    roots: set[sympy.Expr] = set()
    for expression in expressions:
        roots |= {atom for atom in expression.atoms(sympy.Pow) if atom.exp in (sympy.S.Half, -sympy.S.Half)}
    roots = {sympy.sqrt(root.base) if root.base.is_Rational else root for root in roots}
    squares = sorted({square_free(root) for root in roots}, key=str)
    basis = [sympy.S.One, *squares, *(sympy.sqrtdenest(a * b) for a, b in combinations(squares, 2))]
    return tuple(basis) if len(basis) <= LARGEST_BASIS else ()


def recognised(value: Number, basis: tuple[sympy.Expr, ...]) -> sympy.Expr | None:
    """Return the combination of basis elements with small rational coefficients that equals ``value``, or ``None``."""
    if value == 0:
        return sympy.S.Zero
    if not basis:
        return None
    tolerance = mp.mpf(10) ** (SLACK - DIGITS)
    relation = mp.pslq([value, *in_digits(basis)], tol=tolerance, maxcoeff=LARGEST_COEFFICIENT, maxsteps=10**5)
    if not relation or relation[0] == 0:
        return None
    terms = [sympy.Rational(-int(c), int(relation[0])) * e for c, e in zip(relation[1:], basis, strict=True)]
    return sympy.Add(*terms)


@lru_cache(maxsize=64)
def in_digits(basis: tuple[sympy.Expr, ...]) -> Vector:
    """Return the elements in 60 digits."""
    return tuple(mp.mpf(str(sympy.N(element, DIGITS + 5))) for element in basis)


def square_free(root: sympy.Expr) -> sympy.Expr:
    """Return the square root of n without its rational factor."""
    coefficient, rest = sympy.sqrt(root.base).as_coeff_Mul()
    return rest if coefficient.is_Rational else root
