"""Cardinal functions: exactness on polynomials in rational arithmetic, known matrices, and stability at degree 30."""

from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scvi_codegen import MethodError, chebyshev_lobatto, equispaced, gauss_legendre, legendre_lobatto
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.tables.basis import (
    cardinal_derivatives,
    cardinal_integrals,
    cardinal_values,
    continuation,
    differentiation_matrix,
    extrapolation,
    legendre_functional,
)

FIFTY_DIGITS = mp.mpf("1e-50")

rationals = st.fractions(min_value=-3, max_value=3, max_denominator=20)
point_sets = st.lists(rationals, min_size=1, max_size=7, unique=True)


def apply(matrix: Matrix, values: Vector) -> Vector:
    return tuple(mp.fdot(row, values) for row in matrix)


def number(value: Fraction) -> object:
    return mp.mpf(value.numerator) / value.denominator


def polynomial(coefficients: list[Fraction], x: Fraction) -> Fraction:
    return sum((c * x**k for k, c in enumerate(coefficients)), Fraction(0))


def derivative(coefficients: list[Fraction], x: Fraction) -> Fraction:
    return sum((k * c * x ** (k - 1) for k, c in enumerate(coefficients) if k), Fraction(0))


def integral(coefficients: list[Fraction], start: Fraction, end: Fraction) -> Fraction:
    return sum((c * (end ** (k + 1) - start ** (k + 1)) / (k + 1) for k, c in enumerate(coefficients)), Fraction(0))


@pytest.mark.rotated
@settings(max_examples=60, deadline=None)
@given(points=point_sets, at=st.lists(rationals, min_size=1, max_size=4), start=rationals, data=st.data())
def test_tables_reproduce_polynomials_on_any_points(
    points: list[Fraction], at: list[Fraction], start: Fraction, data: st.DataObject
) -> None:
    coefficients = data.draw(st.lists(rationals, min_size=1, max_size=len(points)))
    values = tuple(number(polynomial(coefficients, x)) for x in points)
    for table, exact in [
        (cardinal_values(points, at), [polynomial(coefficients, t) for t in at]),
        (cardinal_derivatives(points, at), [derivative(coefficients, t) for t in at]),
        (cardinal_integrals(points, at, start), [integral(coefficients, start, t) for t in at]),
        (differentiation_matrix(points), [derivative(coefficients, x) for x in points]),
        (extrapolation(points, start), [polynomial(coefficients, x + start) for x in points]),
    ]:
        scale = 1 + max(abs(entry) for row in table for entry in row) * max(map(abs, values))
        for ours, theirs in zip(apply(table, values), exact, strict=True):
            assert abs(ours - number(theirs)) < FIFTY_DIGITS * scale


@pytest.mark.second
@settings(max_examples=30, deadline=None)
@given(points=st.lists(rationals, min_size=2, max_size=7, unique=True), shift=rationals, data=st.data())
def test_least_squares_extrapolation_is_the_normal_equations(
    points: list[Fraction], shift: Fraction, data: st.DataObject
) -> None:
    import sympy as sp

    degree = data.draw(st.integers(min_value=0, max_value=len(points) - 1))
    here = sp.Matrix([[sp.Rational(x) ** k for k in range(degree + 1)] for x in points])
    there = sp.Matrix([[sp.Rational(x + shift) ** k for k in range(degree + 1)] for x in points])
    exact = there * (here.T * here).inv() * here.T
    ours = extrapolation(points, shift, degree)
    size = len(points)
    assert all(
        abs(ours[i][j] - mp.mpf(exact[i, j].p) / exact[i, j].q) < FIFTY_DIGITS for i in range(size) for j in range(size)
    )


@pytest.mark.parametrize("nodes", [chebyshev_lobatto(30), legendre_lobatto(30), equispaced(30)], ids=lambda n: n.name)
def test_degree_thirty_has_fifty_digits(nodes: object) -> None:
    points = nodes.points
    at = gauss_legendre(31).points
    values, partials = cardinal_values(points, at), cardinal_derivatives(points, at)
    for power in (0, 1, 17, 30):
        f = tuple(x**power for x in points)
        scale = max(abs(entry) for row in partials for entry in row)
        for x, ours, derivative in zip(at, apply(values, f), apply(partials, f), strict=True):
            assert abs(ours - x**power) < FIFTY_DIGITS
            assert abs(derivative - (power * x ** (power - 1) if power else 0)) < FIFTY_DIGITS * scale
        total = apply(cardinal_integrals(points, (1,), -1), f)[0]
        assert abs(total - (mp.mpf(2) / (power + 1) if power % 2 == 0 else 0)) < FIFTY_DIGITS


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: cardinal_values((0, 1, 0), (0,)), "point 2 .* occurs twice"),
        (lambda: differentiation_matrix(()), "at least one point"),
        (lambda: extrapolation((0, 1), 1, 2), "degree 2 is too high for 2 points"),
        (lambda: extrapolation((0, 1), 1, 0.5), "must be a whole number"),
        (lambda: extrapolation((0, 1), 1, -1), "at least 0"),
        (lambda: continuation((0, 1), 3), "degree 3 must be between 0 and 2 for 3 points"),
    ],
)
def test_invalid_requests_are_rejected(call: object, message: str) -> None:
    with pytest.raises(MethodError, match=message):
        call()


@pytest.mark.parametrize("count", range(1, 12))
@pytest.mark.parametrize("nodes", [lambda n: gauss_legendre(n).abscissae, lambda n: [Fraction(k, n) for k in range(n)]])
def test_coefficients_of_legendre_polynomials_are_one_and_zero(count, nodes):
    points = tuple(mp.mpf(c) if not isinstance(c, Fraction) else number(c) for c in nodes(count))
    values = {k: [mp.legendre(k, 2 * c - 1) for c in points] for k in range(count)}
    for degree in range(count):
        functional = legendre_functional(points, degree)
        for k, own in values.items():
            assert abs(mp.fdot(functional, own) - (k == degree)) < mp.mpf("1e-45")
    assert legendre_functional(points, -1) == (mp.zero,) * count
