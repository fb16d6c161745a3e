"""Ensembles in single precision: beside double precision, kept digits."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc

EPS = float(np.finfo(np.float32).eps)
COUNTS = (1, 2, 7, 33)
GM = 1.32712440018e20  # m^3/s^2, of the Sun
CASES = {
    "kepler": ("stoermer-verlet", [1.0, 0.0], [0.0, 1.1]),
    "planar-pendulum": ("composition:6", [1.0], [0.2]),
    "henon-heiles": ("svi:4", [0.1, 0.2], [0.3, 0.0]),
    "double-pendulum": ("svi:2", [0.5, 0.3], [0.1, 0.2]),
}


@cache
def stepper_of(name: str) -> sc.Stepper:
    return sc.compile_stepper(sc.problem(name).system, CASES[name][0], flags=QUICK_FLAGS)


def runs_of(name: str, count: int, precision: str, **more: Any) -> Any:
    """Trajectories from states that differ in the velocities."""
    _, q, v = CASES[name]
    velocity = np.linspace(1.0, 1.1, 33)[:count, np.newaxis] * v
    arguments = {"h": 0.04, "steps": 100, "precision": precision, **more}
    return stepper_of(name).integrate_ensemble(np.tile(q, (count, 1)), velocity=velocity, **arguments)


@pytest.mark.second
@pytest.mark.parametrize("name", CASES)
def test_states_are_those_in_double_precision_within_ten_units_of_rounding(name: str) -> None:
    double, single = (runs_of(name, 33, precision) for precision in ("double", "single"))
    assert single.ok.all()
    assert not single.fallback_steps.any()
    assert np.array_equal(single.t, double.t)
    for values, expected in ((single.q, double.q), (single.p, double.p)):
        error = np.abs(values - expected).max(axis=(1, 2)) / np.abs(expected).max()
        assert error[1] < 2 * EPS
        assert 0 < error[100] < 10 * EPS
    for count in COUNTS:
        assert np.array_equal(runs_of(name, count, "single").q, single.q[:, :count])


def test_momentum_and_energy_are_kept_to_rounding() -> None:
    single, double = (runs_of("kepler", 7, x, steps=20000, save_every=1000) for x in ("single", "double"))
    assert np.abs(single.momentum_maps() - single.momentum_maps()[0]).max() < 10 * EPS
    assert np.abs(single.energy() - double.energy()).max() < 20 * EPS


def test_sums_are_compensated_and_continue_in_double_precision_beyond_the_range() -> None:
    free = sc.compile_stepper(sc.LagrangianSystem.from_text("free", ["x"], "x_dot**2/2"), "stoermer-verlet")
    runs = free.integrate_ensemble([[1 / 3]], [[0.1]], h=0.01, steps=10**5, save_every=10**5, precision="single")
    assert runs.q[0, 0, 0] == 1 / 3
    assert runs.q[-1, 0, 0] == pytest.approx(1 / 3 + 100.0, rel=EPS)  # without compensation: 1e-4
    runs = free.integrate_ensemble([[3e38], [1.0]], [[1e37], [1.0]], h=1.0, steps=10, precision="single")
    assert runs.ok.all()
    assert runs.q[-1, :, 0] == pytest.approx([4e38, 11.0], rel=1e-6)
    for r in (2e-12, 1.5e11):  # r^4 underflows, and overflows
        start = [[r, 0.0]], [[0.0, (GM / r) ** 0.5]]
        span = {"h": (r / GM) ** 0.5 * r / 64, "steps": 100, "parameters": {"mu": GM}}
        runs = [stepper_of("kepler").integrate_ensemble(*start, **span, precision=x) for x in ("single", "double")]
        assert np.abs(runs[0].q - runs[1].q).max() < 10 * EPS * r
