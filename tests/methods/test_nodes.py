"""Nodes: names, symmetry, closed forms, wrong arguments; their numbers are proved in ``test_proofs.py``."""

from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.tables.closed_forms import exact_points
from scvi_codegen.methods.tables.nodes import NODE_FAMILIES, nodes_by_name, to_number

chebyshev_gauss, legendre_gauss, radau_left, radau_right = (
    NODE_FAMILIES[name] for name in ("chebyshev-gauss", "legendre-gauss", "radau-left", "radau-right")
)
DEGREES = [1, 2, 3, 4, 5, 8, 13, 30, 47]
FIFTY_DIGITS = mp.mpf("1e-50")


@pytest.mark.tiers(56, 57)
@pytest.mark.parametrize("name", NODE_FAMILIES)
@pytest.mark.parametrize("degree", DEGREES)
def test_every_family_gives_ascending_points_under_its_name(name: str, degree: int) -> None:
    nodes = nodes_by_name(name, degree)
    assert (nodes.name, nodes.degree, len(nodes.points)) == (name, degree, degree + 1)
    assert all(left < right for left, right in zip(nodes.points, nodes.points[1:], strict=False))
    assert nodes.contains_ends == (name in ("chebyshev-lobatto", "legendre-lobatto", "equispaced"))
    assert nodes.symmetric == (not name.startswith("radau"))
    assert nodes_by_name(name, degree) is nodes


@pytest.mark.parametrize(
    ("name", "degrees"),
    [
        ("chebyshev-lobatto", [1, 2, 3, 4, 5, 6, 8, 10, 12]),
        ("legendre-lobatto", [1, 2, 3, 4, 5, 6]),
        ("equispaced", [1, 2, 7, 30]),
        ("legendre-gauss", [1, 2, 3, 4]),
        ("chebyshev-gauss", [1, 2, 3, 4, 5]),
        ("radau-left", [1, 2]),
        ("radau-right", [1, 2]),
    ],
)
def test_closed_forms_are_radicals_of_the_same_value(name: str, degrees: list[int]) -> None:
    for degree in degrees:
        nodes = nodes_by_name(name, degree)
        exact = exact_points(nodes)
        assert exact is not None
        for expression, point in zip(exact, nodes.points, strict=True):
            assert expression.is_algebraic
            assert not expression.has(sp.Float, sp.cos, sp.sin)
            assert abs(mp.mpf(str(sp.N(expression, 60))) - point) < FIFTY_DIGITS


def test_nodes_of_higher_degree_and_rounded_nodes_have_no_closed_form() -> None:
    assert exact_points(sc.chebyshev_lobatto(7)) is None
    assert exact_points(sc.legendre_lobatto(7)) is None
    assert exact_points(legendre_gauss(5)) is None
    assert exact_points(radau_left(3)) is None
    assert exact_points(sc.Nodes(name="legendre-gauss", degree=1, points=(-(1 / 3**0.5), 1 / 3**0.5))) is None
    assert exact_points(sc.Nodes(name="mine", degree=1, points=(mp.mpf("1e-30"), mp.pi / 4))) is None


def test_user_defined_nodes_are_recognised() -> None:
    assert exact_points(sc.Nodes(name="equispaced", degree=2, points=(-1, 0.25, 1))) == (-1, sp.Rational(1, 4), 1)
    silver, half = sp.sqrt(2) - 1, sp.Rational(1, 2)
    for points in [(-silver, half), (-sp.sqrt(half - sp.sqrt(2) / 4), silver), (sp.Rational(-12345, 678901), silver)]:
        assert exact_points(sc.Nodes(name="mine", degree=1, points=points)) == points


def test_numbers_of_many_kinds_are_converted() -> None:
    third = Fraction(1, 3)
    nodes = sc.Nodes(name="mine", degree=4, points=(-1, "-0.1", np.float64(0.25), third, sp.sqrt(2) / 2))
    assert nodes.points[1] == -mp.mpf(1) / 10
    assert abs(nodes.points[3] - mp.mpf(1) / 3) < FIFTY_DIGITS
    assert abs(nodes.points[4] ** 2 - mp.mpf(1) / 2) < FIFTY_DIGITS
    assert not nodes.symmetric
    assert not nodes.contains_ends
    assert to_number(0.1) == mp.mpf(0.1) != mp.mpf("0.1")


@pytest.mark.parametrize("value", ["x", 1j, None, [1], sp.Symbol("x"), sp.I, float("nan"), float("inf")])
def test_non_finite_and_non_real_numbers_are_rejected(value: object) -> None:
    with pytest.raises(sc.MethodError, match="give a"):
        to_number(value)
