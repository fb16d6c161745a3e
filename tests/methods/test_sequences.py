"""Leapfrog steps in both sequences, of Lagrangians and of H = T(p) + V(q, t): explicit, and what they should be."""

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

from scvi_codegen import HamiltonianSystem, MethodError, StepFailedError, compile_stepper
from scvi_codegen.methods import SVI, Composition, StoermerVerlet, method_from_specification

DRIFTS_FIRST = "drift-kick-drift"
RELATIVISTIC = hamilton(
    "relativistic oscillator", "x y", "sqrt(1 + p_x**2 + p_y**2) + k*(x**2 + 2*y**2)/2 + x*y**2/3 - x*cos(t)/5", k=1.5
)
DUFFING = lagrange("driven", "x", "m*x_dot**2/2 - x**4/4 + x*cos(t)", m=2.0)


def compiled(system, method, solver="auto"):
    return compile_stepper(system, method, solver=solver, flags=QUICK_FLAGS)


def force(t, q):
    x, y = q
    return np.array([-1.5 * x - y**2 / 3.0 + np.cos(t) / 5.0, -3.0 * y - 2.0 * x * y / 3.0])


def velocity(p):
    return p / np.sqrt(1.0 + p @ p)


def leapfrog(sequence, t, h, q, p):
    if sequence == DRIFTS_FIRST:
        q = q + h / 2 * velocity(p)
        p = p + h * force(t + h / 2, q)
        return q + h / 2 * velocity(p), p
    p = p + h / 2 * force(t, q)
    q = q + h * velocity(p)
    return q, p + h / 2 * force(t + h, q)


@pytest.mark.tiers(1, 2)
@pytest.mark.parametrize("sequence", ["kick-drift-kick", DRIFTS_FIRST])
@pytest.mark.parametrize("make", [StoermerVerlet, lambda sequence: Composition(2, sequence)], ids=["verlet", "of two"])
def test_a_step_is_a_leapfrog_step(sequence, make):
    stepper = compiled(RELATIVISTIC, make(sequence))
    assert "_derivatives(" not in stepper.source.code
    q, p, t = np.array([0.7, -0.4]), np.array([1.2, 0.3]), 0.2
    run = stepper.integrate(q, p, h=0.1, steps=50, t=t)
    for k in range(50):
        q, p = leapfrog(sequence, t + k * 0.1, 0.1, q, p)
    assert np.abs(run.q[-1] - q).max() < 1e-13
    assert np.abs(run.p[-1] - p).max() < 1e-13


@pytest.mark.tiers(1, 1)
@pytest.mark.sampled(4)
@pytest.mark.parametrize("system", [RELATIVISTIC, DUFFING], ids=["hamiltonian", "lagrangian"])
@pytest.mark.parametrize("sequence", ["kick-drift-kick", DRIFTS_FIRST])
@pytest.mark.parametrize("make", [StoermerVerlet, lambda sequence: Composition(10, sequence)], ids=["verlet", "ten"])
def test_explicit_steps_solve_the_equations(system, sequence, make):
    m = system.dimension
    q, p = np.array([0.7, -0.4])[:m], np.array([1.2, 0.3])[:m]
    explicit, newton = (compiled(system, make(sequence), solver) for solver in ("explicit", "newton"))
    for h in (0.1, -0.3):
        assert np.abs(np.subtract(explicit.step(q, p, h, 0.4), newton.step(q, p, h, 0.4))).max() < 1e-14


@pytest.mark.rotated
@pytest.mark.parametrize("order", [2, 8, 10])
def test_sequences_have_their_orders(order):
    start, end = (np.array([0.7, -0.4]), np.array([1.2, 0.3])), 4.0
    exact = compiled(RELATIVISTIC, SVI(8)).integrate(*start, h=0.02, steps=200).q[-1]
    stepper = compiled(RELATIVISTIC, Composition(order, DRIFTS_FIRST))
    coarse, fine = (np.abs(stepper.integrate(*start, h=end / n, steps=n).q[-1] - exact).max() for n in (5, 20))
    assert np.log2(coarse / fine) / 2.0 > order - 0.5


def test_the_map_is_symplectic_and_symmetric():
    stepper = compiled(RELATIVISTIC, StoermerVerlet(DRIFTS_FIRST))
    state, eps = np.array([0.7, -0.4, 1.2, 0.3]), 1e-5

    def step(z, h=0.3, t=0.0):
        return np.concatenate(stepper.step(z[:2], z[2:], h, t))

    jacobian = np.array([(step(state + eps * e) - step(state - eps * e)) / (2 * eps) for e in np.eye(4)]).T
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    assert np.abs(jacobian.T @ J @ jacobian - J).max() < 1e-9
    assert np.abs(step(step(state), -0.3, 0.3) - state).max() < 1e-15


def test_drift_first_sequences_have_no_discrete_lagrangian():
    stepper = compiled(DUFFING, StoermerVerlet(DRIFTS_FIRST))
    with pytest.raises(MethodError, match="discrete_lagrangian is not available without an action"):
        stepper.discrete_lagrangian([0.1], [0.2], 0.1)


def test_step_fails_where_the_velocity_is_nan():
    falling = HamiltonianSystem.from_text(name="root", coordinates=["x"], hamiltonian="p_x*sqrt(p_x) + x")
    with pytest.raises(StepFailedError, match="infinite or NaN"):
        compiled(falling, StoermerVerlet(DRIFTS_FIRST)).integrate([0.0], [1.0], h=0.5, steps=20)


@pytest.mark.parametrize("method", [StoermerVerlet(DRIFTS_FIRST), Composition(8, DRIFTS_FIRST), Composition(10)])
def test_specification_contains_the_sequence(method):
    assert method_from_specification(method.specification()) == method
    assert method.name.endswith(DRIFTS_FIRST) == method.drifts_first


def test_momenta_at_rest_are_not_velocities():
    """L + 3 v has the same motion, and momenta that are larger by 3; leapfrog steps of p / m would be others."""
    plain, shifted = (lagrange("o", "q", f"q_dot**2/2 - q**4/4{more}") for more in ("", " + 3*q_dot"))
    q, p = compiled(plain, StoermerVerlet()).step([0.7], [0.4], 0.1)
    np.testing.assert_allclose(compiled(shifted, StoermerVerlet()).step([0.7], [3.4], 0.1), [q, p + 3], rtol=1e-14)
    with pytest.raises(MethodError, match="separable"):
        compiled(shifted, Composition(8))
