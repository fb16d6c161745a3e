"""Explicit compositions: the same maps by the explicit solver and by Newton's iteration, of the order they claim."""

import numpy as np
import pytest

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import SVI, Composition, StoermerVerlet, method_from_specification
from scvi_codegen.models.problems import problem
from scvi_codegen.models.systems import outer_solar_system

DOUBLE_PENDULUM, DUFFING, KEPLER = (problem(name).system for name in ("double-pendulum", "duffing", "kepler"))

DRIVEN = DUFFING.with_parameters(gamma=0.3, omega=1.3)
STATES = {1: ([0.7], [0.4], 0.2), 2: ([0.7, -0.3], [0.3, 0.9], 0.15)}


@pytest.mark.sampled(4)
@pytest.mark.parametrize("system", [KEPLER, DRIVEN], ids=lambda s: s.name)
@pytest.mark.parametrize("method", [StoermerVerlet(), Composition(2), Composition(8), Composition(10)])
def test_explicit_and_newton_solvers_give_the_same_map(system, method):
    q, p, h = STATES[system.dimension]
    explicit = compile_stepper(system, method, solver="explicit").step(q, p, h, t=0.4)
    implicit = compile_stepper(system, method, solver="newton").step(q, p, h, t=0.4)
    np.testing.assert_allclose(explicit, implicit, rtol=1e-14, atol=2e-15)


def test_leapfrog_agrees_with_a_handwritten_step():
    """Kick, drift, kick on the driven oscillator alpha = -1, beta = 8/3."""

    def force(q, t):
        return q - 8 / 3 * q**3 + 0.3 * np.cos(1.3 * t)

    q, p, h, t = 0.7, 0.4, 0.2, 0.4
    half = p + h / 2 * force(q, t)
    q1 = q + h * half
    p1 = half + h / 2 * force(q1, t + h)
    for method in (StoermerVerlet(), Composition(2)):
        step = compile_stepper(DRIVEN, method).step([q], [p], h, t=t)
        np.testing.assert_allclose(np.ravel(step), [q1, p1], rtol=4e-16)


@pytest.mark.parametrize(
    ("system", "order"), [(DRIVEN, 2), (DRIVEN, 4), (DRIVEN, 6), (DRIVEN, 8), (KEPLER, 2), (KEPLER, 8), (KEPLER, 10)]
)
def test_order_is_the_claimed_one(system, order):
    q, p, span = ([0.7], [0.4], 4.0) if system is DRIVEN else ([1.0, 0.0], [0.0, 1.1], 8.0)
    reference = compile_stepper(system, SVI(8)).integrate(q, p, h=span / 400, steps=400).q[-1]
    stepper = compile_stepper(system, Composition(order))
    counts = np.round(8 * 1.2 ** np.arange(24)).astype(int)
    runs = [stepper.integrate(q, p, h=span / n, steps=int(n)) for n in counts]
    errors = np.array([np.abs(run.q[-1] - reference).max() for run in runs])
    used = np.flatnonzero(errors > 1e-12)[-4:]  # the shortest steps above round-off and the reference's 1e-14
    derivative = -np.polyfit(np.log(counts[used]), np.log(errors[used]), 1)[0]
    assert derivative == pytest.approx(order, abs=0.4)


def test_force_at_the_end_of_a_step_is_reused_correctly():
    """A run remembers the last force; repeated steps do not."""
    stepper = compile_stepper(KEPLER, Composition(8))
    q, p, h = np.array([0.5, 0.0]), np.array([0.0, 3**0.5]), 0.05
    run = stepper.integrate(q, p, h=h, steps=200)
    for _ in range(200):
        q, p = stepper.step(q, p, h)
    np.testing.assert_allclose(run.q[-1], q, rtol=0, atol=1e-12)


def test_energy_does_not_drift():
    entry = problem("kepler")
    stepper = compile_stepper(entry.system, Composition(8))
    run = stepper.integrate(entry.q, stepper.momentum(entry.q, entry.velocity), h=0.05, steps=100_000, save_every=10)
    error = np.abs(run.energy() + 0.5)
    assert error[-2000:].max() < 1.5 * error[:2000].max()


def test_composition_of_many_bodies():
    entry = problem("outer-solar-system")
    stepper = compile_stepper(outer_solar_system(), Composition(10))
    p = stepper.momentum(entry.q, entry.velocity)
    run = stepper.integrate(entry.q, p, h=200.0, steps=1000)
    assert np.abs(run.energy() / run.energy()[0] - 1).max() < 1e-12


def test_momenta_at_rest_are_not_velocities():
    """L + 3 v has the same motion, and momenta that are larger by 3; leapfrog steps of p / m would be others."""
    plain, shifted = (
        LagrangianSystem.from_text(name="o", coordinates=["q"], lagrangian=f"q_dot**2/2 - q**4/4{more}")
        for more in ("", " + 3*q_dot")
    )
    q, p = compile_stepper(plain, StoermerVerlet()).step([0.7], [0.4], 0.1)
    np.testing.assert_allclose(
        compile_stepper(shifted, StoermerVerlet()).step([0.7], [3.4], 0.1), [q, p + 3], rtol=1e-14
    )
    with pytest.raises(MethodError, match="separable"):
        compile_stepper(shifted, Composition(8))


def test_unsupported_systems_are_rejected():
    with pytest.raises(MethodError, match="separable"):
        compile_stepper(DOUBLE_PENDULUM, Composition(8))
    with pytest.raises(MethodError, match="order must be 2, 4, 6, 8 or 10"):
        Composition(5)
    with pytest.raises(MethodError, match="not explicit"):
        compile_stepper(DOUBLE_PENDULUM, StoermerVerlet(), solver="explicit")


def test_specification_round_trip():
    assert method_from_specification(Composition(8).specification()) == Composition(8)
