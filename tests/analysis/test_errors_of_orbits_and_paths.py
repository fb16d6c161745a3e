"""Errors of orbits, multipliers and paths have the size and sign of the differences from closed forms."""

import numpy as np
import pytest
from notation import lagrange

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
