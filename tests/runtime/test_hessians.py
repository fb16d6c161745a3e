"""Second derivatives of functions of runs; those of a step, against 60 digits, are in test_sensitivity."""

import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS, damped_pendulum

from scvi_codegen import SVI, LagrangianSystem, MethodError, StateError, compile_stepper, problem, reparametrise

START = np.array([0.4, -0.8, 0.1, 0.3, 1.2, 0.3, 0.07])
"""q, p, the parameters c, f and l, t and h."""


@pytest.fixture(scope="module")
def stepper():
    """A driven, damped pendulum."""
    system = LagrangianSystem.from_text(
        name="bent pendulum",
        coordinates=["q"],
        lagrangian="l*q_dot**2/2 + cos(q)",
        parameters={"c": 0.1, "f": 0.3, "l": 1.2},
        forces={"q": "f*cos(t)"},
        dissipation="c*q_dot**2/2",
    )
    return compile_stepper(system, SVI(3), flags=QUICK_FLAGS)


def run_from(stepper, x, **options):
    given = {"h": x[-1], "steps": 60} | options
    return stepper.integrate(x[:1], x[1:2], t=x[-2], parameters=x[2:-2], **given)


def states_of(run):
    return np.concatenate([run.q, run.p], axis=1)


def stacked(gradient):
    return np.array([*gradient.q, *gradient.p, *gradient.parameters, gradient.t, gradient.h])


def square(count, seed=0):
    """Weights w and symmetric matrices C of F = sum w . x + x . C x / 2 of so many states."""
    rng = np.random.default_rng(seed)
    weights, hessians = rng.normal(size=(count, 2)), rng.normal(size=(count, 2, 2))
    return weights, hessians + hessians.transpose(0, 2, 1)


@pytest.mark.parametrize("save_every", [1, 12])
def test_hessian_of_a_function_of_all_states(stepper, save_every):
    """Against differences of exact gradients, of fourth order; also where steps between are taken again."""
    run = run_from(stepper, START, save_every=save_every)
    weights, hessians = square(len(run))

    def partials(run):
        return weights + np.einsum("nij,nj->ni", hessians, states_of(run))

    columns = []
    for unit in np.eye(len(START)):
        ends = [
            stacked(r.pullback(partials(r)))
            for r in (run_from(stepper, START + s * 1e-4 * unit, save_every=save_every) for s in (1, -1, 2, -2))
        ]
        columns.append((8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / 12e-4)
    expected = np.array(columns).T
    product = run.hessian_product(partials(run), np.eye(stepper._input_size), hessians)
    found = np.vstack([product.q, product.p, product.parameters, product.t, product.h])
    assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert_allclose(found, found.T, rtol=0, atol=1e-13 * np.abs(found).max())
    one = run.hessian_product(partials(run), [0.5, -2.0], hessians)
    assert_allclose(stacked(one), found[:, :2] @ [0.5, -2.0], rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize(
    "options", [{"h": None, "steps": None, "t_end": 4.0}, {"h": -0.07}], ids=["own lengths", "back"]
)
def test_hessian_is_the_derivative_of_the_gradient(stepper, options):
    """The Hessian is symmetric, v . H w = w . H v, and is the change of all states along two directions."""
    run = run_from(stepper, START, **options)
    weights, hessians = square(len(run), 1)
    v, w = np.random.default_rng(2).normal(size=(2, stepper._input_size))
    v[-1] = w[-1] = 0.0  # the lengths are held
    both = run.hessian_product(weights, np.stack([v, w], axis=1), hessians)
    found = np.concatenate([both.q, both.p, both.parameters, both.t[np.newaxis]])
    assert v[:-1] @ found[:, 1] == pytest.approx(w[:-1] @ found[:, 0], rel=1e-11)


def test_many_directions_equal_single_directions(stepper):
    """More of them than are taken through a step at once."""
    run = run_from(stepper, START)
    weights, hessians = square(len(run), 3)
    directions = np.random.default_rng(4).normal(size=(stepper._input_size, 19))
    many = run.hessian_product(weights, directions, hessians)
    names = ("q", "p", "parameters", "t", "h")
    for k in range(directions.shape[1]):
        alone = run.hessian_product(weights, directions[:, k], hessians)
        for name in names:
            assert_allclose(np.asarray(getattr(many, name))[..., k], getattr(alone, name), rtol=1e-12, atol=1e-12)


def test_hessian_of_a_long_run_equals_that_of_its_segments(stepper):
    """More steps than are linearised at a time, with all states and with few."""
    weights, hessians = square(2501, 3)
    weights[np.arange(2501) % 500 > 0] = 0.0
    hessians[np.arange(2501) % 500 > 0] = 0.0
    whole, some = run_from(stepper, START, steps=2500), run_from(stepper, START, steps=2500, save_every=500)
    expected = stacked(whole.hessian_product(weights, [1.0, 0.5], hessians))
    found = stacked(some.hessian_product(weights[::500], [1.0, 0.5], hessians[::500]))
    assert_allclose(found, expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())


def test_hessian_of_the_energy_at_the_end_equals_that_at_the_start():
    """At high order the Hessian at the end, pulled back, equals that at the start, a closed form."""
    stepper = compile_stepper(problem("planar-pendulum").system, SVI(8), flags=QUICK_FLAGS)
    run = stepper.integrate([2.0], [0.3], h=0.05, steps=200)
    m, length, g = stepper.defaults
    partials, hessians = np.zeros((len(run), 2)), np.zeros((len(run), 2, 2))
    partials[-1] = m * g * length * np.sin(run.q[-1, 0]), run.p[-1, 0] / (m * length**2)
    hessians[-1] = np.diag([m * g * length * np.cos(run.q[-1, 0]), 1 / (m * length**2)])
    found = run.hessian_product(partials, np.eye(2), hessians)
    assert_allclose(found.q, [[m * g * length * np.cos(2.0), 0.0]], rtol=0, atol=1e-7)
    assert_allclose(found.p, [[0.0, 1 / (m * length**2)]], rtol=0, atol=1e-7)


def test_directions_of_all_arguments_are_propagated_forward(stepper):
    run = run_from(stepper, START)
    found, whole = run.tangent(np.eye(stepper._input_size)), run.sensitivity()
    assert_allclose(found[:, :, 2:-2], whole.parameters, rtol=1e-13, atol=1e-13)
    assert_allclose(found[:, :, -1], whole.h, rtol=1e-13, atol=1e-13)


def test_pickled_stepper_retains_second_derivatives(stepper):
    run = run_from(stepper, START)
    expected = stacked(run.hessian_product(np.ones((61, 2)), [1.0, 0.0]))
    again = run_from(pickle.loads(pickle.dumps(stepper)), START)
    assert_allclose(stacked(again.hessian_product(np.ones((61, 2)), [1.0, 0.0])), expected)


def test_a_run_without_steps_has_the_hessian_of_the_function(stepper):
    run = run_from(stepper, START, steps=0)
    _, hessians = square(1)
    found = run.hessian_product(np.ones((1, 2)), np.eye(2), hessians)
    assert_allclose(np.concatenate([found.q, found.p]), hessians[0])


def test_systems_without_a_hessian_are_rejected(stepper):
    run = run_from(stepper, START)
    with pytest.raises(StateError, match=r"cotangents of one function must have shape \(61, 2\)"):
        run.hessian_product(np.zeros((61, 2, 3)), [1.0, 0.0])
    with pytest.raises(StateError, match=r"or \(7,\) or \(7, k\), of \(q, p, parameters, t, h\), not \(3,\)"):
        run.hessian_product(np.zeros((61, 2)), [1.0, 0.0, 0.0])
    with pytest.raises(StateError, match=r"curvatures, Hessians .* \(61, 2, 2\), not \(61, 2\)"):
        run.hessian_product(np.zeros((61, 2)), [1.0, 0.0], np.zeros((61, 2)))
    kepler = problem("kepler")
    clocked = compile_stepper(reparametrise(kepler.system, "frequency"), SVI(4), flags=QUICK_FLAGS)
    with pytest.raises(MethodError, match="second derivatives of the steps are unavailable"):
        clocked.integrate(kepler.q, [0.0, 1.0], h=0.1, steps=3).hessian_product(np.ones((4, 4)), np.ones(4))


def test_damped_systems_have_first_derivatives_only():
    system = damped_pendulum()
    state = [1.0] * system.dimension, [0.0] * system.dimension
    run = compile_stepper(system, "svi:2").integrate(*state, h=0.1, steps=3)
    assert run.tangent([1.0, 0.0, 0.0, 0.0]).shape == (4, 4)
    with pytest.raises(MethodError, match="systems with damping have first derivatives only"):
        run.hessian_product(np.ones((4, 4)), np.ones((4, 1)))
