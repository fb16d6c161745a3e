"""Errors of orbits, multipliers and paths have the size and sign of the differences from closed forms."""

import warnings
from contextlib import suppress

import numpy as np
import pytest
from notation import lagrange
from scipy.special import ellipkm1

import scvi_codegen as sc

SADDLE = lagrange("saddle", "x y", "(x_dot**2 + y_dot**2)/2 - (w*x)**2/2 + (k*y)**2/2", w=1.0, k=0.5)
"""x oscillates, y leaves: periods 2 pi/w, multipliers 1, 1, exp(+-2 pi k/w)."""


@pytest.fixture(
    scope="module",
    params=[pytest.param("svi:2", marks=pytest.mark.second), pytest.param("gauss:3", marks=pytest.mark.rotated)],
)
def saddle(request):
    return sc.compile_stepper(SADDLE, request.param)


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_an_orbit_are_those_of_its_period_and_multipliers(saddle, seed):
    """Of equal steps, at random frequencies, amplitudes and numbers of steps."""
    random = np.random.default_rng(seed)
    w, k, amplitude = random.uniform(0.5, 2.0), random.uniform(0.1, 0.6), 10.0 ** random.uniform(-3, 3)
    guess = {"velocity": [0.0, 0.0], "period": 6.2 / w, "steps": int(random.integers(20, 60)), "fixed": ["x"]}
    orbit = sc.periodic_orbit(saddle, [amplitude, 0.0], **guess, parameters={"w": w, "k": k}, error=0.1)
    period, largest = 2.0 * np.pi / w, np.exp(2.0 * np.pi * k / w)
    assert orbit.errors.period == pytest.approx(orbit.period - period, rel=0.02, abs=1e-13 / w)
    assert orbit.errors.bounds[-1] >= abs(orbit.period - period)
    true = orbit.multipliers[0] - largest
    assert orbit.multiplier_errors[0] == pytest.approx(true, rel=0.02, abs=1e-12 * largest)
    assert str(orbit).startswith(f"x = {amplitude!r}\n")
    assert (np.abs(orbit.multipliers - [largest, 1.0, 1.0, 1.0 / largest]) <= orbit.multiplier_bounds).all()
    assert orbit.multiplier_bounds[0] <= 1e4 * abs(true) + 1e-9 * largest


@pytest.mark.second
def test_errors_near_a_separatrix_are_right_or_unknown():
    """Pendulums of random amplitude beside the upper equilibrium, in few steps: of 4 pi, 3e-8 was stated for 5e-4."""
    pendulum = sc.compile_stepper(lagrange("pendulum", "a", "a_dot**2/2 + cos(a)"), "svi:4")
    random, outcomes = np.random.default_rng(3), []
    for _ in range(20):
        amplitude, steps = np.pi - 10.0 ** random.uniform(-3.0, 0.5), int(random.integers(8, 40))
        period = float(4.0 * ellipkm1(np.cos(amplitude / 2.0) ** 2))
        with warnings.catch_warnings(action="ignore"), suppress(sc.OrbitError, sc.StepFailedError):
            orbit = sc.periodic_orbit(pendulum, [amplitude], [0.0], period=period, steps=steps, fixed=["a"])
            known = bool(np.isfinite(orbit.errors.period))
            outcomes.append(known)
            assert known != bool(orbit.errors.reason)
            if known:  # the orbit of the system from the state without its errors
                a, p = orbit.q[0] - orbit.errors.q[0], orbit.p[0] - orbit.errors.p[0]
                exact = 4.0 * ellipkm1(np.cos(a / 2.0) ** 2 - p**2 / 4.0)
                apart = abs(orbit.errors.period - (orbit.period - exact))
                assert apart <= 0.1 * orbit.errors.bounds[-1] + 1e-10, (amplitude, steps)
    assert sum(outcomes) >= 7
    assert not all(outcomes)


@pytest.mark.second
def test_multiple_multipliers_have_bounds_that_contain_roots_of_rounding():
    """All four of Kepler's orbits are 1."""
    kepler = sc.compile_stepper(lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"), "svi:4")
    for e in np.random.default_rng(5).uniform(0.0, 0.6, 3):
        start = [1.0 - e, 0.0], [0.0, np.sqrt((1.0 + e) / (1.0 - e))]
        orbit = sc.periodic_orbit(kepler, *start, period=2.0 * np.pi, fixed=["x"])
        assert (np.abs(orbit.multipliers - 1.0) <= orbit.multiplier_bounds).all(), e
        assert orbit.multiplier_bounds.max() < 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_a_path_are_those_of_its_positions_and_momenta(saddle, seed):
    """A path between random ends; ends are exact."""
    random = np.random.default_rng(seed)
    w, k, T = random.uniform(0.5, 2.0), random.uniform(0.1, 1.0), random.uniform(0.3, 1.5)
    first, last = random.uniform(-1.0, 1.0, (2, 2))
    path = saddle.path(first, last, T, steps=int(random.integers(3, 7)), parameters={"w": w, "k": k})
    t, c, s = path.t, np.cos(w * T), np.sin(w * T)
    speeds = (last[0] - first[0] * c) / s, (last[1] - first[1] * np.cosh(k * T)) / np.sinh(k * T)
    x = [first[0] * np.cos(w * t) + speeds[0] * np.sin(w * t), -first[0] * np.sin(w * t) + speeds[0] * np.cos(w * t)]
    y = [first[1] * f(k * t) + speeds[1] * g(k * t) for f, g in ((np.cosh, np.sinh), (np.sinh, np.cosh))]
    true = path.q - np.transpose([x[0], y[0]]), path.p - np.transpose([w * x[1], k * y[1]])
    for errors, own in zip(true, (path.q_error, path.p_error), strict=True):
        np.testing.assert_allclose(own, errors, rtol=0.02, atol=1e-3 * np.abs(errors).max() + 1e-14)
    assert not path.q_error[[0, -1]].any()
