"""Tangent maps of runs; those of steps are in test_sensitivity."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from scvi_codegen import SVI, LagrangianSystem, StateError, compile_stepper, problem


def test_runs_propagate_tangent_vectors():
    """Tangents of a run against difference quotients of runs; with several steps per saved state and adaptive steps."""
    stepper = compile_stepper(problem("double-pendulum").system, SVI(4))
    start = np.array([0.9, -0.6, 1.0, 0.5])
    run = stepper.integrate(start[:2], start[2:], h=0.05, steps=40)
    derivative = run.tangent()
    columns = []
    for unit in 1e-4 * np.eye(4):
        ends = [stepper.integrate(*np.split(start + s * unit, 2), h=0.05, steps=40) for s in (1, -1, 2, -2)]
        a, b, c, d = (np.concatenate([end.q[-1], end.p[-1]]) for end in ends)
        columns.append((8 * (a - b) - (c - d)) / 12e-4)
    assert_allclose(derivative[-1], np.array(columns).T, rtol=0, atol=1e-7 * np.abs(derivative[-1]).max())
    some = stepper.integrate(start[:2], start[2:], h=0.05, steps=40, save_every=8)
    assert_allclose(some.tangent()[-1], derivative[-1], rtol=1e-11, atol=1e-11)
    one = run.tangent([1.0, 0.0, -1.0, 0.5])
    assert_allclose(one[-1], derivative[-1] @ [1.0, 0.0, -1.0, 0.5], rtol=1e-12)
    free = stepper.integrate(start[:2], start[2:], t_end=2.0)
    assert_allclose(free.tangent()[-1], derivative[-1], rtol=2e-4, atol=2e-4 * np.abs(derivative[-1]).max())


def test_kepler_orbit_has_the_exact_shear_after_a_period():
    """After a period all multipliers are 1, and only the phase depends on the energy: M - 1 has rank one."""
    entry = problem("kepler")
    stepper = compile_stepper(entry.system, SVI(8))
    run = stepper.integrate([0.5, 0.0], [0.0, np.sqrt(3.0)], h=2 * np.pi / 64, steps=64)
    monodromy = run.tangent()[-1]
    assert np.linalg.matrix_rank(monodromy - np.eye(4), tol=1e-4) == 1
    gradient = np.array([4.0, 0.0, 0.0, np.sqrt(3.0)])  # of the energy, which is conserved
    assert_allclose(gradient @ monodromy, gradient, rtol=0, atol=1e-6)


def test_derivatives_at_fixed_transformed_steps():
    """The product of the derivatives of steps of these lengths."""
    kepler = problem("kepler")
    chosen = compile_stepper(kepler.system, SVI(4), time_transformation="frequency")
    run = chosen.integrate([0.5, 0.0], [0.0, np.sqrt(3.0)], h=0.05, t_end=3.0)
    assert np.ptp(run.step_sizes[:-2]) > 0.01
    plain, product = compile_stepper(kepler.system, SVI(4)), np.eye(4)
    for q, p, h in zip(run.q, run.p, np.diff(run.t), strict=False):
        product = plain.jacobian(q, p, h) @ product
    assert_allclose(run.tangent()[-1], product, rtol=1e-9, atol=1e-9 * np.abs(product).max())


def test_systems_without_derivatives_are_rejected():
    kepler = problem("kepler")
    stepper = compile_stepper(kepler.system, SVI(2))
    run = stepper.integrate(kepler.q, velocity=kepler.velocity, h=0.05, steps=4)
    with pytest.raises(StateError, match=r"shape \(4,\) or \(4, k\)"):
        run.tangent([1.0, 2.0])
    with pytest.raises(StateError, match="whole steps"):
        stepper.integrate(kepler.q, velocity=kepler.velocity, h=0.05, steps=4, t_eval=[0.03, 0.1]).tangent()
    elsewhere = run.q.copy()
    elsewhere[2] += 0.01
    with pytest.raises(StateError, match=r"t = 0\.05, computed again, end in another state"):
        replace(run, q=elsewhere).tangent()


def test_tangents_beyond_the_largest_double_are_an_error():
    hill = LagrangianSystem.from_text(name="hill", coordinates=["q"], lagrangian="q_dot**2/2 + q**2/2")
    run = compile_stepper(hill, SVI(2)).integrate([0.0], [0.0], h=0.5, steps=1600)
    with pytest.raises(StateError, match="derivatives exceed the largest double"):
        run.tangent()
