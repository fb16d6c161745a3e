"""Theorems 2.1 and 4.1 to 4.3 as measured."""

import pickle

import numpy as np
import pytest
import sympy

import scvi_codegen as sc
from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SCVI, SVI, SpectralCollocation
from scvi_codegen.reproduce import writing
from scvi_codegen.reproduce.catalogue import EXPERIMENTS
from scvi_codegen.reproduce.laboratory.experiment import Verdict
from scvi_codegen.reproduce.theorems import collocation as collocation_theorem
from scvi_codegen.reproduce.theorems import kronecker
from scvi_codegen.reproduce.theorems import order as order_theorem
from scvi_codegen.reproduce.theorems.collocation import FAMILIES, abscissae, collocation_step, tableau_step
from scvi_codegen.reproduce.theorems.convergence import (
    FEW,
    FULL,
    METHODS,
    PRINTED,
    errors,
    exact_steps,
    fitted_order,
    quadrature_error,
    quick_stepper,
    rate,
)
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.tableau import collocation_tableau, radau_ia

pytestmark = pytest.mark.long

KEPLER = order_theorem.STEPS["kepler"]
DEGREES = (2, 4, 6)


@pytest.fixture(scope="module")
def results():
    return {name: EXPERIMENTS[name].result({}) for name in ("section-2.1", "theorem-2.1")}


def orders(method):
    found = [errors("kepler", method, h) for h in KEPLER]
    return [fitted_order(KEPLER, [getattr(error, key) for error in found]) - 1 for key in ("action", "legendre", "map")]


@pytest.mark.parametrize("family", FAMILIES)
def test_collocation_polynomials_end_where_the_tableau_does(family):
    start = np.array([mp.mpf("0.7"), mp.mpf("0.4")])
    field, c = collocation_theorem.FIELDS["planar-pendulum"], abscissae(family, 3)
    left = collocation_step(field, start, mp.mpf("0.3"), c)
    right = tableau_step(field, start, mp.mpf("0.3"), collocation_tableau(c))
    assert max(abs(left - right)) < mp.mpf("1e-52")


@pytest.mark.parametrize("form", kronecker.FORMS)
def test_kronecker_forms_hold_only_for_their_own_method(form):
    """Masses that are not constant make two methods of (18) and (21)."""
    assert kronecker.residual("double-pendulum", form, 2) < 1e-45
    system = sc.problem("double-pendulum").system
    (one, other) = (
        derived_step(system, SpectralCollocation(2, form=form))([0.7, -0.4], [0.3, 0.2], 0.1).q
        for form in kronecker.FORMS
    )
    assert max(abs(a - b) for a, b in zip(one, other, strict=True)) > 1e-6


def test_lemmas_refer_to_existing_rows():
    assert all(difference.is_zero_matrix for difference in kronecker.lemma_differences())
    A, B = sympy.Matrix(2, 2, sympy.symbols("a:4")), sympy.Matrix(2, 2, sympy.symbols("b:4"))
    by_columns = (A * B).T.reshape(4, 1) - sympy.kronecker_product(A, sympy.eye(2)) * B.T.reshape(4, 1)
    assert not by_columns.expand().is_zero_matrix


def test_radau_ia_does_not_end_at_its_collocation_polynomial():
    start = np.array([mp.mpf("0.7"), mp.mpf("0.4")])
    field, tableau = collocation_theorem.FIELDS["planar-pendulum"], radau_ia(2)
    left = collocation_step(field, start, mp.mpf("0.3"), tableau.c)
    assert max(abs(left - tableau_step(field, start, mp.mpf("0.3"), tableau))) > 1e-6


@pytest.mark.parametrize(
    ("method", "order"),
    [
        (SVI(2), 4),
        (SCVI(1), 2),
        (SCVI(2), 4),
        (SCVI(3), 6),
        (METHODS[FEW](3), 2),
        (METHODS[FEW](4), 4),
        (SCVI(4, "clenshaw-curtis:5"), 6),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_order_is_min_of_twice_the_degree_and_of_the_quadrature_but_one_less_for_legendre_transforms(method, order):
    assert orders(method) == pytest.approx([order, order - 1, order], abs=0.2)


@pytest.mark.parametrize(("degree", "points", "order"), [(4, 4, 2), (5, 6, 4), (6, 7, 6)])
def test_galerkin_order_is_lower_for_insufficient_quadratures(degree, points, order):
    """Twice (order of the quadrature) - degree + 1."""
    assert orders(SVI(degree, f"clenshaw-curtis:{points}"))[2] == pytest.approx(order, abs=0.15)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_the_printed_equations_have_order_one_less_than_the_degree(degree):
    assert orders(METHODS[PRINTED](degree))[2] == pytest.approx(degree - 1, abs=0.1)


def test_the_legendre_transform_of_the_midpoint_rule_by_hand():
    """P0 - p0^E = -h^2 q'''/12 along the exact solution; of the pendulum q''' = -cos(q) q'."""
    h, exact = 0.01, exact_steps("planar-pendulum", 0.01)[0]
    q0, q1 = ([float(x) for x in ends] for ends in (exact.q0, exact.q1))
    p0 = quick_stepper("planar-pendulum", SVI(1)).discrete_legendre_minus(q0, q1, h)[1][0]
    third = -np.cos(q0[0]) * float(exact.v0[0])
    assert (p0 - float(exact.p0[0])) / h**2 == pytest.approx(-third / 12, rel=0.05)


def test_rates_in_the_degree():
    found = {label: [errors("kepler", METHODS[label](s), 1.0).map for s in (4, 6, 8)] for label in (FULL, PRINTED)}
    full, printed = (rate((4, 6, 8), found[label])[1] for label in (FULL, PRINTED))
    assert full == pytest.approx(0.022, abs=0.004)
    assert printed == pytest.approx(np.sqrt(full), rel=0.25)


@pytest.mark.parametrize("label", [FULL, FEW])
def test_the_action_is_bounded_by_collocation_and_quadrature(label):
    for s in DEGREES:
        method = METHODS[label](s)
        parts = (
            errors("planar-pendulum", SpectralCollocation(s), 2.0).map,
            quadrature_error("planar-pendulum", method.rule, 2.0),
        )
        assert errors("planar-pendulum", method, 2.0).action < sum(parts)


def test_orders_and_rates_exclude_round_off():
    steps = [2.0**-k for k in range(12)]
    assert fitted_order(steps, [h**5 + 1e-16 for h in steps]) == pytest.approx(5, abs=1e-3)
    assert rate([2, 4, 6, 8], [1e-4, 1e-8, 1e-12, 1e-16])[1] == pytest.approx(0.01)
    assert np.isnan(fitted_order(steps[:2], [1.0, 0.5]))
    assert np.isnan(rate([1, 2], [1.0, 0.5])[1])


def test_verdicts_follow_from_the_numbers(results):
    assert results["section-2.1"].verdict is Verdict.HOLDS
    assert results["theorem-2.1"].verdict is Verdict.HOLDS


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "satisfied", "failed"), [("theorem-4.1", 2, 2), ("theorem-4.2", 2, 1), ("theorem-4.3", 4, 0)]
)
def test_verdicts_on_the_order_and_on_the_rates(name, satisfied, failed, tmp_path):
    result = EXPERIMENTS[name].result({})
    assert [check.verdict for check in result.checks] == [Verdict.HOLDS] * satisfied + [Verdict.FAILS] * failed
    assert all(len(row) == len(table.columns) for table in result.tables for row in table.rows)
    writing.write_result(pickle.loads(pickle.dumps(result)), tmp_path)
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".png", ".svg", ".txt"}


def test_results_can_be_pickled_and_written(results, tmp_path):
    for result in pickle.loads(pickle.dumps(results)).values():
        assert len(writing.write_result(result, tmp_path)) >= 2
    assert {path.suffix for path in tmp_path.iterdir()} == {".csv", ".txt"}


def test_rows_are_as_long_as_their_headings(results):
    for result in results.values():
        assert all(len(row) == len(table.columns) for table in result.tables for row in table.rows)
