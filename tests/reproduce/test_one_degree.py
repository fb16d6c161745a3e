"""The figures of systems with one degree of freedom have the numbers computed elsewhere, and verdicts can fail."""

from __future__ import annotations

import pickle
from fractions import Fraction
from functools import cache

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.exact.step import derived_step
from scvi_codegen.reproduce.kepler import overview
from scvi_codegen.reproduce.laboratory.experiment import Experiment, Result, Verdict
from scvi_codegen.reproduce.laboratory.running import SECTION_4, stepper_of
from scvi_codegen.reproduce.oscillators import duffing, one_degree, oscillator, oscillator_orders, pendulum
from scvi_codegen.reproduce.writing import draw
from scvi_codegen.tables.precision import mp

pytestmark = pytest.mark.long

MODULES = (overview, oscillator, oscillator_orders, pendulum, duffing)
EXPERIMENTS: dict[str, Experiment] = {e.name: e for module in MODULES for e in module.EXPERIMENTS}
NOT_AS_PRINTED = {"figure-1", "figure-3", "figure-4", "figure-7", "figure-8"}


@cache
def result(name: str) -> Result:
    return EXPERIMENTS[name].run({})


def column(name: str, heading: str) -> dict[str, float]:
    """A column of a result's main table, by scheme."""
    table = result(name).tables[0]
    return {row[0]: row[table.columns.index(heading)] for row in table.rows}


def test_there_is_every_figure():
    assert list(EXPERIMENTS) == [f"figure-{n}" for n in (*range(1, 9), 9, 10, 21, 22, 11, 12)]


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_results_are_whole(name):
    found = result(name)
    assert (found.name, found.title) == (name, EXPERIMENTS[name].title)
    assert found.setting
    assert found.checks
    assert found.tables[0].name == ""
    assert all(len(row) == len(table.columns) for table in found.tables for row in table.rows)
    assert found.verdict is (Verdict.PARTLY if name in NOT_AS_PRINTED else Verdict.HOLDS)
    assert draw(pickle.loads(pickle.dumps(found.picture)), "png")[1:4] == b"PNG"


def test_figure_1_has_the_areas():
    areas = column("figure-1", "change of the area of the ellipse")
    assert areas["explicit Euler"] > 1
    assert areas["Chebyshev collocation"] == pytest.approx(0.053, rel=0.1)
    assert abs(areas["Stoermer-Verlet"]) < 1e-3
    assert abs(areas["symplectic Runge-Kutta"]) < 5e-3


def test_figure_4_has_the_position_errors():
    errors = column("figure-4", "to t = 100")
    assert errors["SVI, 7 Gauss points"] == pytest.approx(7.7e-12, rel=0.03)
    assert errors["SVI, 8 Gauss points"] < 2e-15
    assert errors["SVI, 9 Gauss points"] < 2e-15
    assert errors["SC"] == pytest.approx(9.5e-9, rel=0.01)


def test_figure_5_has_the_energy_errors():
    errors = column("figure-5", "largest energy error")
    assert errors["SVI, 7 Gauss points"] == pytest.approx(1e-13, rel=0.1)
    assert errors["SVI, 8 Gauss points"] < 4e-15
    assert errors["SC"] == pytest.approx(2.5e-8, rel=0.03)


def test_figure_6_has_the_bases():
    rows = {row[:2]: row[3] for row in result("figure-6").tables[1].rows}
    assert rows["SVI, s Gauss points", "q"] == pytest.approx(0.096, abs=0.01)
    assert rows["SC", "q"] == pytest.approx(0.24, abs=0.02)
    assert rows["SVI, s Gauss points", "energy"] is None


@pytest.mark.parametrize(
    ("what", "scheme", "powers"),
    [
        ("q", oscillator_orders.EQUAL, (5, 9, 13)),
        ("q", oscillator_orders.SC, (3, 5, 7)),
        ("energy", oscillator_orders.MORE, (6, 10, 14)),
        ("energy", oscillator_orders.SC, (4, 6, 8)),
        ("energy", oscillator_orders.FEWER, (2, 6, 10)),
    ],
)
def test_figures_7_and_8_have_the_orders(what, scheme, powers):
    fits = [oscillator_orders.fitted_power(what, scheme, degree) for degree in (2, 4, 6)]
    assert [fit[1] for fit in fits] == pytest.approx(powers, abs=0.01)


def test_as_many_gauss_points_as_the_degree_conserve_the_energy_of_the_oscillator():
    assert all(oscillator_orders.fitted_power("energy", oscillator_orders.EQUAL, n) is None for n in (2, 4, 6))


def test_figure_7_compiled_errors_are_those_in_60_digits():
    """Up to round-off of the end and of the state's size."""
    table = result("figure-7").tables[1]
    values = dict(zip(table.columns, np.array(table.rows, dtype=float).T, strict=True))
    compiled = [name for name in values if name.endswith(", compiled")]
    assert len(compiled) == 6
    for name in compiled:
        assert np.abs(values[name] - values[name.removesuffix(", compiled")]).max() < 1e-14


def test_figure_10_has_the_energy_errors():
    errors = column("figure-10", "largest energy error")
    assert errors["SVI, degree 3"] == pytest.approx(1.1e-8, rel=0.05)
    assert errors["SVI, degree 4"] == pytest.approx(8.2e-11, rel=0.05)
    assert errors["SC, degree 3"] == pytest.approx(5.4e-2, rel=0.02)
    assert errors["SC, degree 4"] == pytest.approx(3.7e-4, rel=0.02)


def test_figure_12_has_the_energy_errors():
    errors = column("figure-12", "largest energy error")
    assert errors["SVI, degree 5"] == pytest.approx(1.4e-6, rel=0.05)
    assert errors["SVI, degree 6"] == pytest.approx(2.9e-8, rel=0.05)
    assert errors["SC, degree 5"] == pytest.approx(7.0e-3, rel=0.02)
    assert errors["SC, degree 6"] == pytest.approx(1.0e-2, rel=0.05)


def test_figure_21_the_printed_form_is_the_same_map_with_two_points():
    whole, printed = (sc.SCVI(1, "gauss-legendre:2", variational=flag) for flag in (True, False))
    ends = [stepper_of(pendulum.PENDULUM, m).step([0.5], [0.1], h=0.1, options=SECTION_4) for m in (whole, printed)]
    assert np.abs(np.subtract(*ends)).max() < 1e-15


def test_a_derived_step_is_exact():
    """The midpoint rule for the oscillator: a rational map."""
    end = derived_step(oscillator.OSCILLATOR, sc.SVI(1, "gauss-legendre:1"))([1], [0.5], 0.25)
    h, q, p = Fraction(1, 4), Fraction(1), Fraction(1, 2)
    scale = 1 + h * h / 4
    expected = (((1 - h * h / 4) * q + h * p) / scale, ((1 - h * h / 4) * p - h * q) / scale)
    for got, want in zip((*end.q, *end.p), expected, strict=True):
        assert abs(got - mp.mpf(want.numerator) / want.denominator) < mp.mpf("1e-55")


def test_a_derived_step_of_a_coupled_system_is_the_compiled_one():
    double, method = sc.problem("double-pendulum").system, sc.SCVI(2)
    end = derived_step(double, method)([1.0, 0.5], [0.2, -0.1], 0.05)
    q, p = stepper_of(double, method).step([1.0, 0.5], [0.2, -0.1], h=0.05)
    assert np.abs(np.array([*end.q, *end.p], dtype=float) - [*q, *p]).max() < 1e-14


def test_drift_is_told_from_oscillation():
    t = np.linspace(0.0, 100.0, 1000)
    assert one_degree.drifts(1e-6 * t)
    assert not one_degree.drifts(1e-6 * np.sin(t))
    assert not one_degree.drifts(1e-15 * t)
    assert one_degree.drift(1e-6 * t) == pytest.approx(0.8e-4, rel=1e-2)


@pytest.mark.parametrize(
    ("conditions", "verdict"),
    [((True, True), Verdict.HOLDS), ((True, False), Verdict.PARTLY), ((False, False), Verdict.FAILS)],
)
def test_verdicts_follow_conditions(conditions, verdict):
    assert one_degree.judged(*conditions) is verdict


def test_area_changes_as_the_energy_of_an_oscillator():
    """Implicit Euler multiplies the energy of the oscillator, and the area, by 1/(1 + h^2) a step."""
    stepper = stepper_of(oscillator.OSCILLATOR, sc.SpectralCollocation(1))
    run = stepper.integrate([0.0], [1.0], h=0.01, steps=20_000)
    expected = np.exp(-np.log1p(1e-4) * 0.8 * 20_000) - 1.0
    assert one_degree.area_change(run) == pytest.approx(expected, rel=0.02)
    assert one_degree.area_factor(stepper, 0.3, 0.2, 0.01) == pytest.approx(1 / (1 + 1e-4), abs=1e-10)
    radius = np.hypot(run.q[:, 0], run.p[:, 0])
    assert one_degree.offset_from_curve(run)[:200] == pytest.approx(radius[:200] - 1.0, abs=1e-3)
