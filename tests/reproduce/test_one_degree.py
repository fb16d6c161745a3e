"""The figures of systems with one degree of freedom have the numbers computed elsewhere, and verdicts can fail."""

import pickle
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.reproduce.catalogue import EXPERIMENTS as ALL
from scvi_codegen.reproduce.laboratory import geometric
from scvi_codegen.reproduce.laboratory.experiment import Result, Verdict, judged
from scvi_codegen.reproduce.laboratory.running import SECTION_4, stepper_of
from scvi_codegen.reproduce.oscillators import (
    one_degree,
    oscillator,
    pendulum_and_duffing,
)
from scvi_codegen.reproduce.refinement import oscillator as refinement
from scvi_codegen.reproduce.refinement.over_steps import fitted_power
from scvi_codegen.reproduce.writing import draw
from scvi_codegen.tables.precision import mp

pytestmark = pytest.mark.long

EXPERIMENTS = {f"figure-{n}": ALL[f"figure-{n}"] for n in (1, *range(3, 13), 21, 22)}
NOT_AS_PRINTED = {"figure-1", "figure-3", "figure-4", "figure-7", "figure-8"}
COARSE: dict[str, dict[str, Any]] = {
    "figure-6": {"degrees": {"SVI": (16, 19, 22), "SC": (16, 22, 28)}},
    "figure-7": {"steps": refinement.STEPS[:13:3]},
    "figure-8": {"steps": refinement.STEPS[:13:3]},
}
"""Whole, these take many compilations or solutions in 60 digits."""


@cache
def result(name: str, *, whole: bool = False) -> Result:
    experiment, coarse = EXPERIMENTS[name], {} if whole else COARSE.get(name, {})
    return replace(experiment, run=partial(experiment.run, **coarse)).result({})


def column(name: str, heading: str) -> dict[str, float]:
    """A column of a result's main table, by scheme."""
    table = result(name).tables[0]
    return {row[0]: row[table.columns.index(heading)] for row in table.rows}


@pytest.mark.parametrize(
    ("name", "whole"),
    [(name, False) for name in EXPERIMENTS] + [pytest.param(name, True, marks=pytest.mark.full) for name in COARSE],
)
def test_results_are_complete(name, whole):
    found = result(name, whole=whole)
    assert (found.name, found.title) == (name, EXPERIMENTS[name].title)
    assert found.setting
    assert found.checks
    assert found.tables[0].name == ""
    assert all(len(row) == len(table.columns) for table in found.tables for row in table.rows)
    assert found.verdict is (Verdict.PARTLY if name in NOT_AS_PRINTED else Verdict.HOLDS)
    assert draw(pickle.loads(pickle.dumps(found.picture)), "png")[1:4] == b"PNG"


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


@pytest.mark.parametrize(
    ("whole", "svi", "sc"), [(False, 0.078, 0.221), pytest.param(True, 0.107, 0.238, marks=pytest.mark.full)]
)
def test_figure_6_has_the_bases(whole, svi, sc):
    fits = {row[:3]: row[4] for row in result("figure-6", whole=whole).tables[0].rows}
    assert fits["by points", "SVI", "q"] == pytest.approx(svi, abs=0.002)
    assert fits["by points", "SC", "q"] == pytest.approx(sc, abs=0.002)
    assert fits["by degree", "SVI", "energy"] is None


def test_figure_6_errors_are_those_of_an_independent_step():
    """SVI with as many Gauss points as the degree maps (q, p) as the stability function of Gauss collocation does."""
    P, Q = sc.Gauss(16).tableau.stability_function()
    z = mp.mpc(0, 20)
    exact = mp.polyval(P[::-1], z) / mp.polyval(Q[::-1], z)  # of p + i q under rotation
    row = next(row for row in result("figure-6").tables[1].rows if row[:3] == ("by degree", "SVI", 16))
    assert row[3] == pytest.approx(float(abs(exact.imag - mp.sin(20))), rel=1e-6)


def test_legends_state_what_n_counts():
    """Errors along 1e14 (0.09)^N are as far from the line as N is from what was meant."""
    n = np.arange(11.0, 17.0)
    errors = 1e11 * 0.09**n
    inside = geometric.within(errors)
    assert inside.tolist() == [False, True, True, True, True, True]
    assert geometric.fitted_line(n, errors) == pytest.approx((1e11, 0.09))
    assert geometric.factors(n, errors, (1e14, 0.09)) == pytest.approx(1000.0)
    assert geometric.factors(n - 1, errors, (1e11, 0.09)) == pytest.approx(1 / 0.09)
    assert geometric.is_straight(n, errors)
    assert not geometric.is_straight(n, errors[::-1])
    assert geometric.fitted_line(n, np.full(6, 1e-16)) is None


ORDERS = [
    ("q", refinement.POINTS, "SVI", (5, 9, 13)),
    ("q", refinement.POINTS, "SC", (3, 5, 7)),
    ("q", refinement.DEGREE, "SVI", (5, 9, 13)),
    ("q", refinement.DEGREE, "SC", (3, 5, 7)),
    ("energy", refinement.POINTS, "SVI", (4, 8, 12)),
    ("energy", refinement.POINTS, "SC", (2, 4, 6)),
    ("energy", refinement.BEYOND, "SVI", (6, 10, 14)),
    ("energy", refinement.BEYOND, "SC", (4, 6, 8)),
]


@pytest.mark.parametrize(("what", "variant", "scheme", "powers"), ORDERS)
def test_figures_7_and_8_have_the_orders(what, variant, scheme, powers):
    fits = [fitted_power(variant, scheme, n, what) for n in (2, 4, 6)]
    assert [fit.power for fit in fits] == pytest.approx(powers, abs=0.01)


def test_figure_7_constants_of_two_points_are_those_found_by_hand():
    """Implicit Euler, q = h / (1 + h^2), and SVI of degree 1 with two Gauss points, whose error is 7/360 h^5."""
    two = [fitted_power(refinement.POINTS, scheme, 2, "q").constant for scheme in ("SC", "SVI")]
    assert two == pytest.approx([5 / 6, 7 / 360], rel=0.01)


def test_equal_numbers_of_gauss_points_and_degree_conserve_the_energy_of_the_oscillator():
    assert all(fitted_power(refinement.DEGREE, "SVI", n, "energy") is None for n in (2, 4, 6))


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
    ends = [
        stepper_of(pendulum_and_duffing.PENDULUM, m).step([0.5], [0.1], h=0.1, options=SECTION_4)
        for m in (whole, printed)
    ]
    assert np.abs(np.subtract(*ends)).max() < 1e-15


def test_drift_is_distinguished_from_oscillation():
    t = np.linspace(0.0, 100.0, 1000)
    assert one_degree.drifts(1e-6 * t)
    assert not one_degree.drifts(1e-6 * np.sin(t))
    assert not one_degree.drifts(1e-15 * t)
    assert one_degree.drift(1e-6 * t) == pytest.approx(0.8e-4, rel=1e-2)


@pytest.mark.parametrize(
    ("conditions", "verdict"),
    [((True, True), Verdict.HOLDS), ((True, False), Verdict.PARTLY), ((False, False), Verdict.FAILS)],
)
def test_verdicts_follow_from_conditions(conditions, verdict):
    assert judged(*conditions) is verdict


def test_area_changes_as_the_energy_of_an_oscillator():
    """Implicit Euler multiplies the energy of the oscillator, and the area, by 1/(1 + h^2) a step."""
    stepper = stepper_of(oscillator.OSCILLATOR, sc.SpectralCollocation(1))
    run = stepper.integrate([0.0], [1.0], h=0.01, steps=20_000)
    expected = np.exp(-np.log1p(1e-4) * 0.8 * 20_000) - 1.0
    assert one_degree.area_change(run) == pytest.approx(expected, rel=0.02)
    assert one_degree.area_factor(stepper, 0.3, 0.2, 0.01) == pytest.approx(1 / (1 + 1e-4), abs=1e-10)
    radius = np.hypot(run.q[:, 0], run.p[:, 0])
    assert one_degree.offset_from_curve(run)[:200] == pytest.approx(radius[:200] - 1.0, abs=1e-3)
