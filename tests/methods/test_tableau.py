"""Tableaux: names, orders, stability against eigenvalues, closed forms, the misprint of the paper's table 3.

``test_proofs.py`` proves orders, symplecticity, symmetry and the numbers.
"""

import re
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial as NumpyPolynomial

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, mp
from scvi_codegen.methods.tables import nodes
from scvi_codegen.methods.tables.closed_forms import exact_tableau
from scvi_codegen.methods.tables.tableau import (
    TABLEAU_FAMILIES,
    Tableau,
    chebyshev_lobatto,
    collocation_tableau,
    explicit_euler,
    gauss,
    is_nonnegative,
    lobatto_iiia,
    radau_ia,
    radau_iia,
    tableau_by_name,
)

FIFTY_DIGITS = mp.mpf("1e-50")
HALF = Fraction(1, 2)
ORDERS = {
    "gauss": lambda s: 2 * s,
    "radau-iia": lambda s: 2 * s - 1,
    "radau-ia": lambda s: 2 * s - 1,
    "lobatto-iiia": lambda s: 2 * s - 2,
    "lobatto-iiib": lambda s: 2 * s - 2,
    "chebyshev-gauss": lambda s: s + s % 2,
    "chebyshev-lobatto": lambda s: s + s % 2,
}


def members(counts: list[int]) -> list[Tableau]:
    return [
        tableau_by_name(f"{name}:{s}") for name in TABLEAU_FAMILIES for s in counts if s > 1 or "obatto" not in name
    ]


def floats(tableau: Tableau) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.array(tableau.A, float), np.array(tableau.b, float), np.array(tableau.c, float)


@pytest.mark.parametrize("tableau", members([1, 2, 3, 4, 5, 6, 9]), ids=lambda tableau: tableau.name)
def test_orders_names_and_a_stability_of_every_family(tableau: Tableau) -> None:
    family, _, count = tableau.name.partition(":")
    assert tableau.stages == int(count)
    assert tableau.order == ORDERS[family](int(count))
    assert tableau_by_name(tableau.name) == tableau
    assert tableau.is_a_stable


@pytest.mark.parametrize("tableau", members([1, 2, 3, 4, 5, 6, 7, 8]), ids=lambda tableau: tableau.name)
def test_closed_forms_have_the_value_of_the_tableau(tableau: Tableau) -> None:
    family = tableau.name.partition(":")[0]
    most = {"gauss": 4, "lobatto-iiia": 5, "lobatto-iiib": 5, "chebyshev-lobatto": 7}.get(family, 3)
    exact = exact_tableau(tableau)
    assert (exact is not None) == (tableau.stages <= most)
    if exact is not None:
        for ours, numbers in zip((*exact[0], *exact[1:]), (*tableau.A, tableau.b, tableau.c), strict=True):
            for expression, number in zip(ours, numbers, strict=True):
                assert not expression.has(sp.Float, sp.sin, sp.cos)
                assert abs(mp.mpf(str(sp.N(expression, 60))) - number) < FIFTY_DIGITS


def test_user_defined_tableau_is_recognised_by_its_numbers() -> None:
    assert exact_tableau(Tableau(name="gauss:1", A=((1,),), b=(1,), c=(1,))) == (((1,),), (1,), (1,))
    quarter = sp.Rational(1, 4)
    assert exact_tableau(collocation_tableau((0, HALF))) == (((0, 0), (quarter, quarter)), (0, 1), (0, 2 * quarter))
    assert exact_tableau(Tableau(name="gauss:1", A=((mp.pi,),), b=(1,), c=(1,))) is None


@pytest.mark.parametrize("s", [1, 2, 3, 5, 8, 12])
def test_the_stability_function_of_gauss_is_the_diagonal_pade_approximant(s: int) -> None:
    P, Q = gauss(s).stability_function()
    taylor = [1 / mp.factorial(k) for k in range(2 * s + 1)]
    p, q = mp.pade(taylor, s, s)
    for ours, expected in ((P, p), (Q, q)):
        assert all(abs(a / b - 1) < mp.mpf("1e-35") for a, b in zip(ours, expected, strict=True))


def test_the_stability_function_of_radau_loses_its_leading_coefficient() -> None:
    for tableau in (radau_iia(3), radau_ia(3)):
        P, Q = tableau.stability_function()
        assert (len(P), len(Q)) == (3, 4)
        np.testing.assert_allclose(np.array(P, float), [1, 2 / 5, 1 / 20], rtol=1e-15)
        np.testing.assert_allclose(np.array(Q, float), [1, -3 / 5, 3 / 20, -1 / 60], rtol=1e-15)


@pytest.mark.tiers(7, 9)
@pytest.mark.parametrize("degree", range(1, 12))
def test_collocation_without_the_left_end_is_a_stable_by_its_eigenvalues(degree: int) -> None:
    """SC of the paper, Chebyshev-Lobatto without node 0: not A-stable from degree 3 on."""
    c = [(1 + x) / 2 for x in nodes.chebyshev_lobatto(degree).points[1:]]
    tableau = collocation_tableau(c)
    A, b, _ = floats(tableau)
    y = 1j * np.geomspace(0.1, 100, 4000)
    systems = np.eye(degree) - y[:, None, None] * A
    R = 1 + y * (np.linalg.solve(systems, np.ones((len(y), degree, 1)))[..., 0] @ b)
    poles_right = np.all(np.linalg.eigvals(A).real > 0)
    sampled = bool(poles_right and np.all(np.abs(R) <= 1 + 1e-9))
    assert tableau.is_a_stable == sampled == (degree <= 2)


def tableau_of(A: Matrix, b: tuple[object, ...]) -> Tableau:
    return Tableau(name="mine", A=A, b=b, c=tuple(sum(row) for row in A))


def test_cancelling_pole_does_not_affect_a_stability() -> None:
    assert tableau_of(((HALF, 0), (0, -1)), (1, 0)).is_a_stable
    assert tableau_of(((HALF, 0, 0), (0, -1, 0), (0, 0, -1)), (1, 0, 0)).is_a_stable
    assert not tableau_of(((HALF, 0), (0, -1)), (HALF, HALF)).is_a_stable
    assert not tableau_of(((-HALF,),), (1,)).is_a_stable


def test_explicit_methods_are_not_a_stable() -> None:
    euler = explicit_euler()
    assert (euler.order, euler.is_a_stable, euler.is_symmetric, euler.is_symplectic) == (1, False, False, False)
    assert euler.stability_function() == ((1, 1), (1,))
    classical = tableau_of(((0, 0, 0, 0), (HALF, 0, 0, 0), (0, HALF, 0, 0), (0, 0, 1, 0)), ("1/6", "1/3", "1/3", "1/6"))
    P, Q = classical.stability_function()
    np.testing.assert_allclose(np.array(P, float), [1, 1, 1 / 2, 1 / 6, 1 / 24], rtol=1e-15)
    assert Q == (1,)
    assert not classical.is_a_stable


@pytest.mark.parametrize(
    "theta", [Fraction(2, 5), Fraction(499999, 1000000), HALF, Fraction(500001, 1000000), Fraction(1)]
)
def test_the_theta_method_is_a_stable_from_one_half_on(theta: Fraction) -> None:
    assert tableau_of(((theta,),), (1,)).is_a_stable == (theta >= HALF)


@pytest.mark.rotated
@settings(max_examples=60, deadline=None)
@example(roots=[(-2, 2), (-1, 1), (2, 2)], sign=1)  # quotients with rounding where a coefficient is 0
@given(
    roots=st.lists(
        st.tuples(st.integers(-4, 4), st.integers(1, 3)), min_size=1, max_size=3, unique_by=lambda pair: pair[0]
    ),
    sign=st.sampled_from([1, -1]),
)
def test_nonnegativity_accounts_for_multiplicity_of_roots(roots: list[tuple[int, int]], sign: int) -> None:
    polynomial = NumpyPolynomial([sign])
    for root, multiplicity in roots:
        polynomial *= NumpyPolynomial([-root, 1]) ** multiplicity
    expected = all(polynomial(k + 0.5) >= 0 for k in range(6))
    assert is_nonnegative([mp.mpf(int(c)) for c in polynomial.coef]) == expected


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Tableau(name="mine", A=((0, 0),), b=(1,), c=(0,)), r"rows of lengths \[2\]"),
        (lambda: Tableau(name="mine", A=(), b=(), c=()), "give s rows"),
        (lambda: Tableau(name="mine", A=((0,),), b=(1,), c=("x",)), "not a real number"),
        (lambda: collocation_tableau((0.5, 0.25)), "abscissa 1 is 0.25, not greater"),
        (lambda: collocation_tableau((0.5, 0.5)), "not greater"),
        (lambda: collocation_tableau(()), "at least one point"),
        (lambda: lobatto_iiia(1), "at least 2, not 1"),
        (lambda: chebyshev_lobatto(1), "at least 2, not 1"),
        (lambda: gauss(0), "at least 1, not 0"),
        (lambda: gauss(2.0), r"not 2\.0"),
        (lambda: tableau_by_name("radau-iib:3"), "did you mean 'radau-iia'"),
        (lambda: tableau_by_name("gauss"), "lacks its number"),
        (lambda: collocation_tableau(range(65)), "65 abscissae are too many: use at most 64"),
    ],
)
def test_invalid_requests_are_rejected(call: object, message: str) -> None:
    gauss(2)
    with pytest.raises(MethodError, match=message):
        call()


@pytest.mark.parametrize(
    ("floats", "meant", "order", "symmetric"),
    [
        ([0.1, 0.5, 0.9], [Fraction(1, 10), Fraction(1, 2), Fraction(9, 10)], 4, True),
        ([0.1, 0.7, 1.0 - 0.1], [Fraction(1, 10), Fraction(7, 10), Fraction(9, 10)], 3, False),
        ([1 / 3, 1.0], [Fraction(1, 3), 1], 3, False),
        ([0.21132486540518713, 0.7886751345948129], None, 2, True),
        ([0.1, 0.5, 0.9 + 1e-14], None, 3, False),
    ],
)
def test_floats_are_read_as_the_numbers_they_round(floats, meant, order, symmetric):
    tableau = collocation_tableau(floats)
    assert (tableau.order, tableau.is_symmetric) == (order, symmetric)
    if meant is not None:
        assert max(abs(c - other) for c, other in zip(tableau.c, collocation_tableau(meant).c, strict=True)) < 1e-50
    assert max(abs(c - given) for c, given in zip(tableau.c, floats, strict=True)) < 3e-16


PRINTED = """
    2*w1 + 2*v1 - 2*w3 - w5 : w1, v1 - w3 + v4, v1 - w3 - v4, w1 - w5
    2*w1 + 2*v1 - 2*v3 - v5 : w1 - v3 + w4, v1, v1 - v5, w1 - v3 - w4
    2*w1 + 2*v1 + 2*v3 + v5 : w1 + v3 + w4, v1 + v5, v1, w1 - v3 - w4
    2*w1 + 2*v1 + 2*w3 + w5 : w1 + w5, v1 + w3 + v4, v1 + w3 - v4, w1
"""
LETTERS = """
    w1 = 1/8 - sqrt(30)/144;  w2 = sqrt((15 + 2*sqrt(30))/35)/2;  v2 = sqrt((15 - 2*sqrt(30))/35)/2
    v1 = 1/8 + sqrt(30)/144;  w3 = w2*(1/6 + sqrt(30)/24);        v3 = v2*(1/6 - sqrt(30)/24)
    w5 = w2 - 2*w3;           w4 = w2*(1/21 + 5*sqrt(30)/168);    v4 = v2*(1/21 - 5*sqrt(30)/168)
    v5 = v2 - 2*v3
"""


def test_table_3_of_the_paper_has_one_wrong_entry():
    """Li, Wu, Leok print w1 - w3' - w4 for a_34 of Gauss's method with four stages, where v is w'."""
    values = {"sqrt": mp.sqrt}
    for line in re.split(r"[;\n]", LETTERS.strip()):
        name, _, formula = line.partition("=")
        values[name.strip()] = eval(formula.strip(), values)
    wrong, exact = [], gauss(4)
    for i, line in enumerate(PRINTED.strip().splitlines()):
        c, row = line.split(" : ")
        assert abs(eval(c.strip(), values) - exact.c[i]) < 1e-15
        printed = [eval(entry, values) for entry in row.split(", ")]
        wrong += [(i + 1, j + 1) for j, a in enumerate(exact.A[i]) if abs(printed[j] - a) > 1e-15]
    assert wrong == [(3, 4)]
    assert abs(eval("w1 + v3 - w4", values) - exact.A[2][3]) < 1e-15
