"""Explicit compositions: the same maps by the explicit solver and by Newton's iteration, of the order they claim."""

import numpy as np
import pytest
from notation import lagrange

from scvi_codegen import Composition, MethodError, StoermerVerlet, compile_stepper, problem

pytestmark = pytest.mark.second

DOUBLE_PENDULUM, DUFFING, KEPLER = (problem(name).system for name in ("double-pendulum", "duffing", "kepler"))

DRIVEN = DUFFING.with_parameters(gamma=0.3, omega=1.3)
STATES = {1: ([0.7], [0.4], 0.2), 2: ([0.7, -0.3], [0.3, 0.9], 0.15)}


@pytest.mark.tiers(1, 3)
@pytest.mark.sampled(4)
@pytest.mark.parametrize("system", [KEPLER, DRIVEN], ids=lambda s: s.name)
@pytest.mark.parametrize("method", [StoermerVerlet(), Composition(2), Composition(8), Composition(10)])
def test_explicit_and_newton_solvers_give_the_same_map(system, method):
    q, p, h = STATES[system.dimension]
    explicit = compile_stepper(system, method, solver="explicit").step(q, p, h, t=0.4)
    implicit = compile_stepper(system, method, solver="newton").step(q, p, h, t=0.4)
    np.testing.assert_allclose(explicit, implicit, rtol=1e-14, atol=2e-15)


def test_energy_does_not_drift():
    entry = problem("kepler")
    stepper = compile_stepper(entry.system, Composition(8))
    run = stepper.integrate(entry.q, stepper.momentum(entry.q, entry.velocity), h=0.05, steps=100_000, save_every=10)
    error = np.abs(run.energy() + 0.5)
    assert error[-2000:].max() < 1.5 * error[:2000].max()


def test_momenta_at_rest_are_not_velocities():
    """L + 3 v has the same motion, and momenta that are larger by 3; leapfrog steps of p / m would be others."""
    plain, shifted = (lagrange("o", "q", f"q_dot**2/2 - q**4/4{more}") for more in ("", " + 3*q_dot"))
    q, p = compile_stepper(plain, StoermerVerlet()).step([0.7], [0.4], 0.1)
    np.testing.assert_allclose(
        compile_stepper(shifted, StoermerVerlet()).step([0.7], [3.4], 0.1), [q, p + 3], rtol=1e-14
    )
    with pytest.raises(MethodError, match="separable"):
        compile_stepper(shifted, Composition(8))
