"""Derivatives without gauge: reduced tangent maps, Lyapunov exponents, periodic orbits.

Expected values: linearised Euler equations about steady rotations, periods of pendulums by elliptic integrals.
"""

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.states.reduction import Reduction

pytestmark = pytest.mark.rotated

BODY = lagrange("free body", (), "(omega_1**2 + 2*omega_2**2 + 2.5*omega_3**2)/2", rotations={"R": "omega"})
MIXED = lagrange(
    "body, pendulum and mass",
    "x",
    "x_dot**2/2 - x**2/2 + (omega_1**2 + 2*omega_2**2 + omega_3**2/2)/2 - x*R_33"
    " + (n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - n_3*(1 + R_13)",
    rotations={"R": "omega"},
    directions=["n"],
)
START = {"x": 0, "n": [1, 0, 0], "R": {"euler": "zxz", "angles": [0.3, 0.8, -0.4]}}
MOVING = {"x": 1, "n": [0, 0.2, 0.1], "omega": [0.7, -0.4, 2.5]}
SPINS = hamilton("three spins", (), "a_1*b_1 + 2*a_2*b_2 + b_3*c_3 + b_1*c_2 + a_1/3 + c_3/2", spins=["a", "b", "c"])
DIRECTIONS = {"a": [1, 0, 0], "b": [0, 0.6, 0.8], "c": [0, 0, -1]}


def compiled(system, method):
    return sc.compile_stepper(system, method, flags=QUICK_FLAGS)


def symplectic_form(degrees):
    zero, one = np.zeros((degrees, degrees)), np.eye(degrees)
    return np.block([[zero, one], [-one, zero]])


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("system", "start"), [(MIXED, (START, MOVING)), (SPINS, (DIRECTIONS, None))])
def test_the_reduced_derivative_of_a_step_is_symplectic_and_does_not_depend_on_gauge(system, start):
    stepper = compiled(system, "svi:3")
    run = stepper.integrate(start[0], velocity=start[1], h=0.1, steps=20)
    reduction, m = Reduction(stepper.interface), stepper.dimension
    inward, outward = reduction.inward(run.q, run.p), reduction.outward(run.q, run.p)
    form = symplectic_form(reduction.size // 2)
    np.testing.assert_allclose(outward @ inward, np.tile(np.eye(reduction.size), (21, 1, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(np.swapaxes(inward, 1, 2) @ symplectic_form(m) @ inward, [form] * 21, rtol=0, atol=1e-14)
    step = outward[4] @ stepper.jacobian(run.q[3], run.p[3], 0.1) @ inward[3]
    np.testing.assert_allclose(step.T @ form @ step, form, rtol=0, atol=3e-14)
    q, p = run.q[3].copy(), run.p[3].copy()
    if system is MIXED:
        q[1:] *= [-2] * 4 + [3] * 3
        p[1:] /= [-2] * 4 + [3] * 3
    else:
        z = (q + 1j * p) * np.exp(0.7j)
        q, p = z.real, z.imag
    other = reduction.outward(*stepper.step(q, p, 0.1)) @ stepper.jacobian(q, p, 0.1) @ reduction.inward(q, p)
    np.testing.assert_allclose(other, step, rtol=0, atol=1e-14)
    state = np.concatenate([run.q[3], run.p[3]])
    np.testing.assert_allclose(reduction.aligned(np.concatenate([q, p]), state), state, rtol=0, atol=1e-15)


def test_a_rotation_has_six_lyapunov_exponents_and_they_are_those_of_the_linearised_equations():
    stepper = compiled(BODY, "svi:4")
    unstable = np.sqrt((2 - 1) * (2.5 - 2) / (1 * 2.5))
    run = stepper.integrate({"R": [1, 0, 0, 0]}, velocity={"omega": [0, 1, 0]}, h=0.2, steps=300)
    exponents = run.lyapunov_exponents()
    assert exponents.shape == (6,)
    assert abs(exponents[0] - unstable) < 0.1
    np.testing.assert_allclose(exponents, -exponents[::-1], rtol=0, atol=1e-13)
    growth = np.diff(stepper.integrate({"R": [1, 0, 0, 0]}, velocity={"omega": [0, 1, 0]}, h=0.2, steps=600).fli())
    assert growth[-100:].mean() / 0.2 == pytest.approx(unstable, rel=1e-6)
    together = stepper.chaos_indicators_ensemble(
        {"R": [1, 0, 0, 0]}, velocity={"omega": [[0, 1, 0], [0.1, 0.2, 1]]}, h=0.2, steps=300
    )
    np.testing.assert_allclose(together.lyapunov_exponents()[-1, 0], exponents, rtol=0, atol=1e-10)


@pytest.mark.second
def test_directions_of_changes_are_projected_and_pure_gauge_is_rejected():
    run = compiled(BODY, "svi:2").integrate({"R": [1, 0, 0, 0]}, velocity={"omega": [0.1, 1, 0.1]}, h=0.1, steps=20)
    gauge = np.append(run.q[0], -run.p[0])
    change = np.random.default_rng(2).normal(size=8)
    plain, shifted = (run.chaos_indicators(directions=each).log_norms for each in (change, change + 3 * gauge))
    np.testing.assert_allclose(shifted, plain, rtol=0, atol=1e-12)
    with pytest.raises(sc.StateError, match="not only the lengths of quaternions"):
        run.chaos_indicators(directions=gauge)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("method", ["svi:4", pytest.param("scvi:4", marks=pytest.mark.full)])
def test_a_steady_rotation_is_a_periodic_orbit_although_its_quaternion_changes_sign(method):
    orbit = sc.periodic_orbit(
        compiled(BODY, method), {"R": [1, 0.1, 0.2, 0]}, velocity={"omega": [0, 0, 1.01]}, period=6.2, steps=40
    )
    spin = orbit.run().angular_velocity()[0]
    assert orbit.period * spin[2] == pytest.approx(2 * np.pi, abs=1e-11)
    np.testing.assert_allclose(orbit.run().quaternion()[-1], -orbit.run().quaternion()[0], rtol=0, atol=1e-11)
    nutation = np.cos(2 * np.pi * np.sqrt((2.5 - 1) * (2.5 - 2) / (1 * 2)))
    np.testing.assert_allclose(sorted(orbit.stability_indices.real), [nutation, 1, 1], rtol=0, atol=1e-7)
    assert orbit.monodromy.shape == (6, 6)
    assert orbit.stable


def test_unstable_orbits_are_found_by_segments_with_their_multipliers():
    orbit = sc.periodic_orbit(
        compiled(BODY, "svi:6"), {"R": [1, 0, 0, 0]}, velocity={"omega": [0, 1.02, 0]}, period=2 * np.pi, steps=60
    )
    rate = np.log(np.abs(orbit.multipliers[0])) / orbit.period
    assert rate / orbit.run().angular_velocity()[0, 1] == pytest.approx(np.sqrt(0.5 / 2.5), rel=1e-8)
    assert not orbit.stable
