"""Fits of systems with rotations and spins to measured attitudes, without gauge unknowns."""

from __future__ import annotations

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

TOP = lagrange(
    "top", (), "(A*omega_1**2 + B*omega_2**2 + omega_3**2/2)/2 - g*R_33", rotations={"R": "omega"}, A=1.3, B=1.8, g=1.2
)
TRUE = {"A": 1.2, "B": 1.7, "g": 1.3}
ENTRIES = [f"R_{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]
NOISE = 1e-3


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(TOP, "svi:3", flags=QUICK_FLAGS)


@pytest.fixture(scope="module")
def true(stepper):
    start = {"R": {"euler": "zxz", "angles": [0.3, 0.8, -0.4]}}
    return stepper.integrate(start, velocity={"omega": [0.7, -0.4, 2]}, h=0.1, steps=60, parameters=TRUE)


def fitted(stepper, true, measured, observed, **more):
    guess = {"q": {"R": {"euler": "zxz", "angles": [0.35, 0.75, -0.45]}}, "velocity": {"omega": [0.6, -0.3, 1.9]}}
    return sc.fit(stepper, true.t[::2], measured, h=0.1, observed=observed, **guess, **more)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("segments", [1, 4])
def test_inertia_and_attitude_are_fitted_to_measured_matrices(stepper, true, segments):
    exact = true.rotation().reshape(-1, 9)[::2]
    noisy = exact + NOISE * np.random.default_rng(1).normal(size=exact.shape)
    fit = fitted(stepper, true, noisy, ENTRIES, deviations=NOISE, segments=segments)
    errors = fit.standard_errors
    for name, value in TRUE.items():
        assert abs(fit.parameters[name] - value) < 4 * errors[name]
        assert 1e-4 < errors[name] < 2e-3
    assert np.linalg.norm(fit.q) == pytest.approx(1, abs=1e-9)
    assert fit.q @ fit.p == pytest.approx(0, abs=1e-9)
    along = fit.q @ fit.covariance[3:7, 3:7] @ fit.q
    assert np.sqrt(along) < 2e-6
    again = stepper.integrate(fit.q, fit.p, h=0.1, steps=60, parameters=fit.parameters)
    assert np.abs(again.rotation() - true.rotation()).max() < NOISE


@pytest.mark.second
def test_body_momenta_are_measurements(stepper, true):
    measured = np.hstack([true.body_momentum(), true.rotation()[:, 2]])[::2]
    names = ["p_R_1", "p_R_2", "p_R_3", "R_31", "R_32", "R_33"]
    with pytest.raises(sc.FitError, match="do not determine"):  # attitudes about the vertical
        fitted(stepper, true, measured, names)
    with pytest.raises(sc.StateError, match=r"'omega_1' cannot be observed. Possible: R_w, .*, R_33, p_R_1"):
        fitted(stepper, true, measured[:, :1], ["omega_1"])
    fit = fitted(stepper, true, np.hstack([measured, true.rotation()[::2, :1, 0]]), [*names, "R_11"])
    assert max(abs(fit.parameters[name] - value) for name, value in TRUE.items()) < 1e-8


def test_spins_are_fitted_without_their_phase():
    pair = hamilton("pair", (), "J*(a_1*b_1 + a_2*b_2 + 1.5*a_3*b_3) + f*a_3", spins=["a", "b"], J=1.0, f=0.5)
    stepper = sc.compile_stepper(pair, "svi:2", flags=QUICK_FLAGS)
    run = stepper.integrate({"a": [1, 0, 0], "b": [0, 0.6, 0.8]}, h=0.05, steps=80, parameters={"J": 1.1, "f": 0.6})
    measured, names = np.hstack([run.spin("a"), run.spin("b")]), [f"{s}_{k}" for s in "ab" for k in (1, 2, 3)]
    fit = sc.fit(stepper, run.t, measured, q={"a": [1, 0.1, 0], "b": [0, 0.7, 0.7]}, h=0.05, observed=names)
    np.testing.assert_allclose([fit.parameters["J"], fit.parameters["f"]], [1.1, 0.6], rtol=0, atol=1e-8)
