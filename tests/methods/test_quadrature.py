"""Quadrature rules: names, orders, closed forms, errors; points and weights are proved in ``test_proofs.py``."""

from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.tables.closed_forms import exact_rule
from scvi_codegen.methods.tables.quadrature import quadrature_by_name

FIFTY_DIGITS = mp.mpf("1e-50")
NEEDS_TWO = ("gauss-lobatto", "clenshaw-curtis")
ORDERS = {
    "gauss-legendre": lambda n: 2 * n,
    "gauss-lobatto": lambda n: 2 * n - 2,
    "gauss-radau-left": lambda n: 2 * n - 1,
    "gauss-radau-right": lambda n: 2 * n - 1,
    "clenshaw-curtis": lambda n: n + n % 2,
    "fejer": lambda n: n + n % 2,
}


def names_of(counts: list[int]) -> list[str]:
    """Return the names of all rules with these numbers of points."""
    return [f"{family}:{n}" for family in ORDERS for n in counts if n > 1 or family not in NEEDS_TWO]


@pytest.fixture
def rule(name: str) -> sc.Quadrature:
    return quadrature_by_name(name)


@pytest.mark.parametrize("name", names_of([1, 2, 3, 7, 20]))
def test_names_read_back_and_the_unit_interval_is_the_same_rule(rule: sc.Quadrature) -> None:
    family, _, count = rule.name.partition(":")
    assert rule.order == ORDERS[family](int(count))
    assert quadrature_by_name(rule.name) == rule
    assert quadrature_by_name(rule.name) is quadrature_by_name(rule.name)
    assert len(rule) == len(rule.points) == len(rule.weights) == int(count)
    assert all(weight > 0 for weight in rule.weights)
    assert abs(mp.fsum(rule.unit_weights) - 1) < FIFTY_DIGITS
    assert all(
        0 <= c <= 1 and abs(2 * c - 1 - x) < FIFTY_DIGITS for c, x in zip(rule.abscissae, rule.points, strict=True)
    )
    assert rule.symmetric == ("radau" not in rule.name)


def test_rules_share_their_points_with_the_nodes() -> None:
    assert sc.clenshaw_curtis(7).points == sc.chebyshev_lobatto(6).points
    assert sc.gauss_lobatto(7).points == sc.legendre_lobatto(6).points


@pytest.mark.parametrize("name", names_of([1, 2, 3, 4, 5, 6, 7]))
def test_closed_forms_have_the_value_of_the_rule(rule: sc.Quadrature) -> None:
    family = rule.name.partition(":")[0]
    longest = {"gauss-legendre": 5, "gauss-lobatto": 7, "gauss-radau-left": 3, "gauss-radau-right": 3}.get(family, 6)
    exact = exact_rule(rule)
    if len(rule) > longest:
        assert exact is None or family == "clenshaw-curtis"
        return
    assert exact is not None
    for expressions, numbers in zip(exact, (rule.points, rule.weights), strict=True):
        for expression, number in zip(expressions, numbers, strict=True):
            assert not expression.has(sp.Float, sp.cos, sp.sin)
            assert abs(mp.mpf(str(sp.N(expression, 60))) - number) < FIFTY_DIGITS


def test_user_defined_rule_is_recognised_by_its_numbers() -> None:
    third = Fraction(1, 3)
    simpson = sc.Quadrature(name="Simpson", points=(-1, 0, 1), weights=(third, 4 * third, third))
    assert exact_rule(simpson) == ((-1, 0, 1), (sp.Rational(1, 3), sp.Rational(4, 3), sp.Rational(1, 3)))
    assert exact_rule(sc.Quadrature(name="gauss-legendre:1", points=(0.5,), weights=(2,))) == (
        (sp.Rational(1, 2),),
        (2,),
    )
    assert exact_rule(sc.Quadrature(name="gauss-legendre:3", points=(0.1,), weights=(2,))) is None


def test_order_of_a_user_defined_rule_is_computed() -> None:
    third = Fraction(1, 3)
    simpson = sc.Quadrature(name="Simpson", points=(-1, 0, 1), weights=(third, 4 * third, third))
    assert (simpson.order, simpson.symmetric) == (4, True)
    x, w = np.polynomial.legendre.leggauss(12)
    assert sc.Quadrature(name="from NumPy", points=tuple(x), weights=tuple(w)).order == 24
    exact = sc.Quadrature(name="radicals", points=(-sp.sqrt(3) / 3, sp.sqrt(3) / 3), weights=(1, 1))
    assert (exact.points, exact.weights, exact.order) == (sc.gauss_legendre(2).points, sc.gauss_legendre(2).weights, 4)
    assert sc.Quadrature(name="modest", points=(-1, 0, 1), weights=(third, 4 * third, third), order=2).order == 2
    assert not sc.Quadrature(name="lopsided", points=(-1, 1), weights=(0.5, 1.5)).symmetric
