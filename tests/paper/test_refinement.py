"""Errors of one step over the number of points and over the step size: orders in 60 digits, and the paper's lines."""

from dataclasses import replace

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.paper.experiment import Verdict
from scvi_codegen.extras.paper.refinement import (
    CASES,
    ErrorCurve,
    Law,
    _kepler_errors,
    _point_checks,
    _study,
    factors,
    fitted_line,
    fitted_power,
    is_straight,
    refinement,
    step_errors,
    within,
)

pytestmark = pytest.mark.long

KEPLER = ("q1", "q2", "momentum", "energy")
ORDERS = [
    (CASES["N points"], ("q", "energy"), {"SVI": ((5, 4), (9, 8), (13, 12)), "SC": ((3, 2), (5, 4), (7, 6))}),
    (
        CASES["N the degree"],
        ("q", "energy"),
        {"SVI": ((5, None), (9, None), (13, None)), "SC": ((3, 4), (5, 6), (7, 8))},
    ),
    (CASES["N the degree, N + 1 Gauss points"], ("energy",), {"SVI": ((6,), (10,), (14,)), "SC": ((4,), (6,), (8,))}),
    (
        CASES["circle, N points"],
        KEPLER,
        {
            "SVI": ((4, 3, None, 6), (8, 7, None, 14), (12, 11, None, 22)),
            "SC": ((2, 3, 2, 2), (4, 5, 4, 4), (6, 7, 6, 6)),
        },
    ),
    (
        CASES["e = 0.5, N the degree"],
        KEPLER,
        {
            "SVI": ((6, 5, None, 6), (10, 9, None, 10), (14, 13, None, 14)),
            "SC": ((4, 3, 4, 4), (6, 5, 6, 6), (8, 7, 8, 8)),
        },
    ),
]
"""Powers of h by scheme for N = 2, 4, 6 and each quantity; on the circle q1 has the lines that the paper draws."""


@pytest.mark.tiers(1, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("case", "quantities", "expected"), ORDERS)
def test_convergence_orders_of_the_local_error(case, quantities, expected):
    for scheme, powers in expected.items():
        for n, row in zip((2, 4, 6), powers, strict=True):
            found = [fitted_power(case, scheme, n, what) for what in quantities]
            assert [law and round(law.base, 0) for law in found] == list(row)
            assert all(abs(law.base - power) < 0.1 for law, power in zip(found, row, strict=True) if law)


def test_constants_of_two_points_are_those_found_by_hand():
    """Implicit Euler, q = h / (1 + h^2), and SVI of degree 1 with two Gauss points, whose error is 7/360 h^5."""
    two = [fitted_power(CASES["N points"], scheme, 2, "q").constant for scheme in ("SC", "SVI")]
    assert two == pytest.approx([5 / 6, 7 / 360], rel=0.01)


@pytest.mark.second
def test_errors_are_those_of_an_independent_step():
    """SVI with as many Gauss points as the degree maps (q, p) as the stability function of Gauss collocation does."""
    P, Q = sc.Gauss(16).tableau.stability_function()
    z = mp.mpc(0, 20)
    exact = mp.polyval(P[::-1], z) / mp.polyval(Q[::-1], z)  # of p + i q under rotation
    found = step_errors(CASES["N the degree"], "SVI", 16, 20.0)["q"]
    assert found == pytest.approx(float(abs(exact.imag - mp.sin(20))), rel=1e-6)


@pytest.mark.tiers(1)
@pytest.mark.parametrize("case", [CASES["N points"], CASES["e = 0.5, N the degree"]])
@pytest.mark.parametrize("scheme", ["SVI", "SC"])
def test_compiled_errors_are_those_in_60_digits(case, scheme):
    for h in (0.02, 0.2):
        compiled, precise = (step_errors(case, scheme, 2, h, precise=flag) for flag in (False, True))
        assert list(compiled.values()) == pytest.approx(list(precise.values()), rel=1e-6, abs=1e-14)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("scheme", "constant", "base"), [("SVI", 1e10, 0.03), ("SC", 1e7, 0.1)])
def test_errors_on_the_circle_follow_the_lines_of_figure_16(scheme, constant, base):
    for points in (10, 14):
        errors = step_errors(_study("kepler-over-n").cases[0], scheme, points, 5.0)
        assert 1 / 10 < errors["q1"] / (constant * base**points) < 1
        assert 1 / 20 < errors["q2"] / (constant * base**points) < 1


def test_lines_are_fitted_to_resolved_errors():
    """Errors along 1e14 (0.09)^N are as far from the line as N is from what was meant."""
    n = np.arange(11.0, 17.0)
    errors = 1e11 * 0.09**n
    assert within(errors).tolist() == [False, True, True, True, True, True]
    assert fitted_line(n, errors) == pytest.approx((1e11, 0.09))
    assert factors(n, errors, Law(1e14, 0.09)) == pytest.approx(1000.0)
    assert factors(n - 1, errors, Law(1e11, 0.09)) == pytest.approx(1 / 0.09)
    assert is_straight(n, errors)
    assert not is_straight(n, errors[::-1])
    assert fitted_line(n, np.full(6, 1e-16)) is None


def test_verdicts_follow_from_the_lines_of_the_judged_cases():
    """Errors along c b^N and 50 times above it, of the case that is judged and of one that is only shown."""
    judged, shown = CASES["N points"], CASES["N the degree"]
    law, n = Law(1e3, 0.1), np.arange(6.0, 12.0)
    study = replace(_study("oscillator-over-n"), cases=(judged, shown), lines={("SVI", "q"): law})
    for far, verdict in (((50, 1), Verdict.FAILS), ((1, 50), Verdict.HOLDS)):
        pairs = zip(study.cases, far, strict=True)
        curves = [ErrorCurve(case, "q", "SVI", 0, n, factor * 1e3 * 0.1**n, law) for case, factor in pairs]
        straight, lines = _point_checks(study, curves)
        assert straight.measured.startswith("1 of 1 curves above round-off are straight")
        assert f" is {far[0]} (N points), {far[1]} (N the degree). Below 30 counts" in lines.measured
        assert (straight.verdict, lines.verdict) == (Verdict.HOLDS, verdict)


def test_errors_of_a_step_are_differences_from_the_ellipse():
    """At e = 1/2 a quarter of the period ends where x = -a e and y = b, for the mean anomaly pi/2 - 1/2."""
    e, minor = mp.mpf("0.5"), mp.sqrt(mp.mpf(3) / 4)
    q, p = (-e, minor), (-mp.one, mp.zero)
    for moved, names in (((1e-3, 0), "q1 energy"), ((0, 1e-3), "q2 energy momentum")):
        errors = _kepler_errors(e, [x + mp.mpf(d) for x, d in zip(q, moved, strict=True)], p, mp.pi / 2 - e)
        assert {name for name, error in errors.items() if error > 1e-12} == {*names.split()}
        assert errors[names[:2]] == pytest.approx(1e-3)


COARSE = {
    6: replace(_study("oscillator-over-n"), degrees={"SVI": (16, 19, 22), "SC": (16, 22, 28)}),
    7: replace(_study("oscillator-over-h"), steps=_study("oscillator-over-h").steps[:13:3]),
    18: replace(_study("kepler-over-h"), steps=_study("kepler-over-h").steps[::7], quantities=("q1",)),
}
"""Whole, these take many compilations and solutions in 60 digits."""


@pytest.mark.full
def test_figures_have_the_papers_lines_and_verdicts_can_fail():
    found = {number: refinement(f"figure-{number}", "title", study).result({}) for number, study in COARSE.items()}
    assert {number: result.verdict for number, result in found.items()} == {
        6: Verdict.HOLDS,
        7: Verdict.PARTLY,
        18: Verdict.PARTLY,
    }
    bases = {row[:4]: row[5] for row in found[6].tables[0].rows}
    assert bases["N points", "SVI", None, "q"] == pytest.approx(0.078, abs=0.002)
    assert bases["N points", "SC", None, "q"] == pytest.approx(0.221, abs=0.002)
    assert all(len(row) == len(table.columns) for each in found.values() for table in each.tables for row in table.rows)
    wrong = replace(COARSE[7], powers={"q": {4: 1.0, 5: 1e3}})
    powers, constants, _ = refinement("figure-7", "title", wrong).result({}).checks
    assert (powers.verdict, constants.verdict) == (Verdict.PARTLY, Verdict.FAILS)
