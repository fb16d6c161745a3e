"""A flow in JAX: against leapfrog written in JAX, closed forms and runs; its transformations, and what it refuses."""

import subprocess
import sys
from functools import cache

import numpy as np
import pumped_leapfrog as pumped
import pytest
from notation import lagrange
from numpy.testing import assert_allclose, assert_array_equal
from samples import QUICK_FLAGS

import scvi_codegen as sc

jax = pytest.importorskip("jax", reason="needs the extra 'jax'")
jnp = jax.numpy

Q, P, H, STEPS = 0.4, -0.3, 0.1, 150


@pytest.fixture(autouse=True)
def binary64():
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield
    jax.config.update("jax_enable_x64", before)


@cache
def kepler():
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(4), flags=QUICK_FLAGS)


def test_transformations_apply_in_any_order():
    flow = sc.jax_flow(kepler(), steps=30)
    q, p = jnp.array([[0.5, 0.0], [0.6, 0.1], [0.9, -0.2]]), jnp.array([0.0, 1.6])

    def x_of_end(q, p, mu, h):
        return flow(q, p, parameters={"mu": mu}, h=h)[0][..., 0]

    each = [jax.grad(x_of_end, argnums=(0, 1, 2, 3))(row, p, 1.0, H) for row in q]
    together = jax.jit(jax.vmap(jax.grad(x_of_end, argnums=(0, 1, 2, 3)), in_axes=(0, None, None, None)))(q, p, 1.0, H)
    for k, found in enumerate(together):
        assert_allclose(found, jnp.stack([one[k] for one in each]), rtol=1e-12, atol=1e-12)
    summed = jax.grad(lambda q: jax.vmap(x_of_end, in_axes=(0, None, None, None))(q, p, 1.0, H).sum())(q)
    assert_allclose(summed, together[0], rtol=1e-12, atol=1e-12)
    last = jax.vmap(x_of_end, in_axes=(1, None, None, None))(q.T, p, 1.0, H)
    assert_array_equal(last, x_of_end(q, p, 1.0, H))
    lengths = jnp.array([0.05, 0.1])
    grid = jax.vmap(jax.vmap(jax.jacfwd(x_of_end), (0, None, None, None)), (None, None, None, 0))(q, p, 1.0, lengths)
    back = jax.vmap(jax.vmap(jax.jacrev(x_of_end), (0, None, None, None)), (None, None, None, 0))(q, p, 1.0, lengths)
    assert grid.shape == (2, 3, 2)
    assert_allclose(grid, back, rtol=1e-11, atol=1e-12)
    assert_allclose(grid[1], together[0], rtol=1e-11, atol=1e-12)
    along = jax.linearize(lambda q: x_of_end(q, p, 1.0, H), q[0])[1](jnp.array([0.3, 0.4]))
    assert_allclose(along, together[0][0] @ jnp.array([0.3, 0.4]), rtol=1e-11)


def pumped_states(x):
    """States of two coupled oscillators by their starts, parameters, time and step size."""
    flow = sc.jax_flow(pumped.stepper(), steps=pumped.STEPS, save_every=pumped.EVERY)
    return jnp.concatenate(flow(x[:2], x[2:4], h=x[9], t=x[8], parameters=x[4:8]), axis=-1)


def test_second_derivatives_are_those_of_leapfrog():
    """Forward and reverse over a gradient, compiled, batched, times vectors."""

    def weighted(x):
        return jnp.sin((pumped_states(x) * pumped.weights()).sum())

    row, weights = jnp.array(pumped.ROWS[0]), pumped.weights()
    angle = (pumped.states(pumped.ROWS[0]) * weights).sum()
    gradient = np.tensordot(weights, pumped.partials(pumped.ROWS[0]), 2)
    # (sin u)'' = cos u u'' - sin u u' u'^T
    expected = np.cos(angle) * pumped.hessian(pumped.ROWS[0]) - np.sin(angle) * np.outer(gradient, gradient)
    limit = 1e-7 * np.abs(expected).max()
    assert_allclose(jax.jit(jax.hessian(weighted))(row), expected, rtol=0, atol=limit)
    assert_allclose(jax.jacrev(jax.grad(weighted))(row), expected, rtol=0, atol=limit)
    batch = jax.vmap(jax.hessian(weighted))(jnp.stack([1.01 * row, row]))
    assert_allclose(batch[1], expected, rtol=0, atol=limit)
    product = jax.jvp(jax.grad(weighted), (row,), (jnp.arange(10.0),))[1]
    assert_allclose(product, expected @ np.arange(10.0), rtol=0, atol=100 * limit)


def test_inputs_with_zero_order_hold_are_parameters():
    system = lagrange("pushed", "x", "x_dot**2/2", forces={"x": "u"}, inputs="u")
    flow = sc.jax_flow(sc.compile_stepper(system, sc.SVI(1), flags=QUICK_FLAGS), steps=10)
    start = {"q": jnp.zeros(1), "p": jnp.zeros(1)}
    derivative = jax.grad(lambda u: flow(**start, parameters={"u_0": u}, h=0.2)[0][0])(3.0)
    assert_allclose(derivative, 2.0, rtol=1e-13)  # t^2 / 2
    with pytest.raises(sc.StateError, match="input 'u' is not set"):
        flow(**start, h=0.2)


def test_constrained_trajectories_have_the_derivatives_of_their_runs():
    system = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - g*y", g=9.0, constraints=["x**2 + y**2 = 1"])
    stepper = sc.compile_stepper(system, sc.SVI(2, "gauss-lobatto:3"), flags=QUICK_FLAGS)
    flow, run = sc.jax_flow(stepper, steps=20), stepper.integrate([1.0, 0.0], [0.0, 0.5], h=0.02, steps=20)
    found = jax.jacrev(lambda q, p: flow(q, p, h=0.02)[0], (0, 1))(jnp.array([1.0, 0.0]), jnp.array([0.0, 0.5]))
    assert_allclose(np.concatenate(found, axis=1), run.sensitivity().state[-1, :2], rtol=0, atol=1e-12)


def test_failed_step_reports_its_time():
    flow = sc.jax_flow(kepler(), steps=5)
    with pytest.raises((RuntimeError, ValueError), match=r"step 0 at t = 0 failed: a value is infinite or NaN"):
        jax.block_until_ready(flow(jnp.zeros(2), jnp.zeros(2), h=H))


def test_unsupported_functions_are_rejected():
    q, p = jnp.array([0.5, 0.0]), jnp.array([0.0, 1.6])
    flow = sc.jax_flow(kepler(), steps=5)
    with pytest.raises(sc.MethodError, match=r"no forward-over-forward second derivatives.* use jax\.hessian"):
        jax.jacfwd(jax.jacfwd(lambda q: flow(q, p, h=H)[0].sum()))(q)
    with pytest.raises(sc.MethodError, match="no third derivatives"):
        jax.jacrev(jax.hessian(lambda q: flow(q, p, h=H)[0].sum()))(q)
    with pytest.raises(sc.StateError, match="q is float32, but a flow is computed in binary64"):
        flow(q.astype(jnp.float32), p, h=H)
    with pytest.raises(sc.StateError, match=r"p must have shape \(.., 2\), not \(3,\)"):
        flow(q, jnp.zeros(3), h=H)
    with pytest.raises(sc.StateError, match="leading axes"):
        flow(jnp.zeros((3, 2)), jnp.zeros((4, 2)), h=H)
    with pytest.raises(sc.StateError, match="did you mean 'mu'"):
        flow(q, p, h=H, parameters={"Mu": 1.0})
    with pytest.raises(sc.StateError, match="must be a multiple of save_every = 3"):
        sc.jax_flow(kepler(), steps=10, save_every=3)
    with pytest.raises(sc.MethodError, match="time_transformation"):
        sc.jax_flow(
            sc.compile_stepper(sc.problem("kepler").system, sc.SVI(2), time_transformation="q1**2 + q2**2"), steps=3
        )
    clocked = sc.compile_stepper(sc.reparametrise(sc.problem("kepler").system, "q1**2 + q2**2"), sc.SVI(2))
    with pytest.raises(sc.MethodError, match="flow of JAX, PyTorch or CasADi is not available in transformed time"):
        sc.jax_flow(clocked, steps=3)(q, p, h=H)


ALONE = """
import jax.numpy as jnp, scvi_codegen as sc
flow = sc.jax_flow(sc.compile_stepper(sc.problem("planar-pendulum").system, "svi:1"), steps=3)
try:
    flow(jnp.ones(1), jnp.ones(1), h=0.1)
except sc.StateError as error:
    print(error)
"""


def test_missing_binary64_is_reported_with_the_remedy():
    result = subprocess.run([sys.executable, "-c", ALONE], capture_output=True, text=True, check=True)
    assert "jax.config.update('jax_enable_x64', True)" in result.stdout


def test_derivatives_by_time_and_parameters_of_a_segmented_flow():
    for row in pumped.ROWS:
        assert_allclose(pumped_states(jnp.array(row)), pumped.states(row), rtol=0, atol=2e-12)
        for derivative in (jax.jacfwd, jax.jacrev):
            assert_allclose(derivative(pumped_states)(jnp.array(row)), pumped.partials(row), rtol=1e-11, atol=1e-11)
    flow = sc.jax_flow(pumped.stepper(), steps=pumped.STEPS)
    with pytest.raises(sc.ArgumentError, match=r"no 't_end'.*fixed number of steps give h = \(t_end - t\) / steps"):
        flow(pumped.ROWS[0][:2], pumped.ROWS[0][2:4], t_end=3.0)
    with pytest.raises(sc.ArgumentError, match=r"no 'velocity': use momenta, p = stepper.momentum"):
        flow(pumped.ROWS[0][:2], velocity=pumped.ROWS[0][2:4], h=0.1)
    with pytest.raises(sc.ArgumentError, match=r"no 't_end'.*fixed number of steps"):
        sc.jax_flow(pumped.stepper(), t_end=3.0)
