"""Sparse derivatives against SymPy's own, entry by entry."""

from itertools import pairwise

import pytest
import sympy
from counting import at_most
from sympy import Rational, Symbol, atan2, cos, exp, log, sin, sqrt

from scvi_codegen.systems.formulas.expressions import gradient, hessian

X, Y, Z = sympy.symbols("x y z", real=True)
M = Symbol("m", real=True)
EXPRESSIONS = [
    M * (X**2 + Y**2) / 2 - cos(X - Y),
    -sqrt(1 - X**2 - Y**2),
    atan2(Y, X) * exp(-M * Z) + log(2 + X**2) ** Rational(3, 2),
    X**Y + 2 ** (X * Z) + (X + Y) ** (M * Z),
    X * Y * Z * sin(X * Y * Z) / (1 + X**2),
    sympy.asin(X / 4) * sympy.acos(Y / 4) + sympy.atan(Z) - sympy.tan(X) / sympy.tanh(Y),
    sympy.sinh(X) * sympy.cosh(Y) + sympy.asinh(Z) + sympy.acosh(3 + X**2) + sympy.atanh(Y / 4),
]
POINT = {X: Rational(3, 7), Y: Rational(5, 11), Z: Rational(-2, 3), M: Rational(9, 8)}


def same(mine: sympy.Expr, theirs: sympy.Expr) -> bool:
    return abs(sympy.N((mine - theirs).subs(POINT), 40)) < 1e-30


@pytest.mark.parametrize("expression", EXPRESSIONS, ids=str)
def test_first_and_second_derivatives_agree_with_sympy(expression: sympy.Expr) -> None:
    variables = [X, Y, Z]
    partials, curvatures = gradient(expression, variables), hessian(expression, variables)
    assert list(partials) == sorted(partials)
    assert list(curvatures) == sorted(curvatures)
    for row, first in enumerate(variables):
        assert same(partials.get(row, sympy.S.Zero), expression.diff(first))
        for column, second in enumerate(variables):
            assert same(curvatures.get((row, column), sympy.S.Zero), expression.diff(first, second))
            assert curvatures.get((row, column)) is curvatures.get((column, row))


def test_zeros_and_unknown_symbols_are_omitted() -> None:
    assert gradient(M**2 + 1, [X, Y]) == {}
    assert gradient(X - X + Y, [X, Y]) == {1: 1}
    assert hessian(X * Y + M * Z, [X, Y, Z]) == {(0, 1): 1, (1, 0): 1}
    assert gradient(Y, [X, Y]) == {1: 1}


@pytest.mark.rotated
def test_long_lattice_is_fast_and_sparse() -> None:
    q = [Symbol(f"q{index}", real=True) for index in range(257)]
    energy = sympy.Add(*((b - a) ** 2 / 2 + (b - a) ** 4 / 4 for a, b in pairwise(q)))
    with at_most(5_000_000):
        entries = hessian(energy, q)
    assert len(entries) == 257 + 2 * 256


def test_equal_products_of_dense_second_derivatives_are_made_once() -> None:
    velocities = [Symbol(f"v{k}", real=True) for k in range(24)]
    angles = [Symbol(f"a{k}", real=True) for k in range(24)]
    rates = [
        sympy.Add(*(v * f(a) for v, a in zip(velocities[: k + 1], angles, strict=False)))
        for k in range(24)
        for f in (cos, sin)
    ]
    energy = sympy.Add(*(rate**2 / 2 for rate in rates))
    with at_most(900_000):  # 1,400,000 if each of the n^3 products is made
        entries = hessian(energy, velocities)
    v, w = angles[3], angles[17]
    assert len(entries) == 24**2
    assert sympy.expand(entries[3, 17] - 7 * (cos(v) * cos(w) + sin(v) * sin(w))) == 0
