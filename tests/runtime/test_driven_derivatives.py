"""Derivatives of runs whose inputs are data, by all that they start from and by the data; against differences."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS
from scipy.interpolate import PPoly

from scvi_codegen import SVI, LagrangianSystem, StateError, compile_stepper

BREAKS = np.array([0.0, 1.0, 2.3, 3.1, 4.0])
COEFFICIENTS = np.random.default_rng(5).normal(size=(4, 4))
"""Of powers, descending, in each piece."""
START = np.array([0.4, -0.8, 0.1, 1.2])
"""q, p and the parameters c and l."""


@pytest.fixture(scope="module")
def stepper():
    system = LagrangianSystem.from_text(
        name="pushed by data",
        coordinates=["q"],
        lagrangian="l*q_dot**2/2 + cos(q)",
        parameters={"c": 0.1, "l": 1.2},
        forces={"q": "u"},
        dissipation="c*q_dot**2/2",
        inputs=["u"],
    )
    return compile_stepper(system, SVI(3), flags=QUICK_FLAGS)


def run_from(stepper, x, coefficients=COEFFICIENTS, **options):
    own = {"parameters": {"c": x[2], "l": x[3]}, "h": 0.07, "t_end": 4.0} | options
    return stepper.integrate(x[:1], x[1:2], inputs={"u": PPoly(coefficients, BREAKS)}, **own)


def states_of(run):
    return np.concatenate([run.q, run.p], axis=1)


def by_start(gradient, stepper):
    columns = [stepper.parameters.index(name) for name in ("c", "l")]
    return np.array([*gradient.q, *gradient.p, *gradient.parameters[columns]])


def derivative(function, x, width=1e-4):
    """(k, ..) of fourth order."""
    columns = []
    for unit in np.eye(x.size).reshape(-1, *x.shape):
        a, b, c, d = (function(x + s * width * unit) for s in (1, -1, 2, -2))
        columns.append((8 * (a - b) - (c - d)) / (12 * width))
    return np.array(columns)


@pytest.mark.parametrize("options", [{}, {"save_every": 3}], ids=["all", "some"])
def test_gradients_by_initial_state_parameters_and_data(stepper, options):
    run = run_from(stepper, START, **options)
    weights = np.random.default_rng(1).normal(size=(len(run), 2))

    def weighted(x, coefficients=COEFFICIENTS):
        return (weights * states_of(run_from(stepper, x, coefficients, **options))).sum()

    found = run.pullback(weights)
    assert_allclose(by_start(found, stepper), derivative(weighted, START), rtol=1e-8)
    expected = derivative(lambda c: weighted(START, c), COEFFICIENTS).reshape(4, 4)
    assert_allclose(found.inputs["u"], expected[::-1].T, rtol=1e-7, atol=1e-8)
    assert found.h is None
    assert np.isnan(found.parameters).sum() == 5
    two = run.pullback(np.stack([weights, 2 * weights], axis=2))
    assert_allclose(two.inputs["u"][..., 1], 2 * found.inputs["u"], rtol=1e-12)
    assert_allclose(two.q[:, 1], 2 * found.q, rtol=1e-12)


def test_tangent_vectors_are_propagated_across_segments(stepper):
    run = run_from(stepper, START)
    expected = derivative(lambda x: states_of(run_from(stepper, x)), START)
    assert_allclose(run.tangent(), expected[:2].transpose(1, 2, 0), rtol=0, atol=1e-9)
    direction = np.zeros(stepper._input_size)
    direction[2 + stepper.parameters.index("l")] = 1.0
    assert_allclose(run.tangent(direction), expected[3], rtol=0, atol=1e-9)


def test_the_hessian_is_the_derivative_of_the_gradient(stepper):
    run = run_from(stepper, START)
    rng = np.random.default_rng(2)
    weights, hessians = rng.normal(size=(len(run), 2)), rng.normal(size=(len(run), 2, 2))
    hessians = hessians + hessians.transpose(0, 2, 1)

    def gradient(x):
        other = run_from(stepper, x)
        return by_start(other.pullback(weights + np.einsum("nij,nj->ni", hessians, states_of(other))), stepper)

    directions = np.zeros((stepper._input_size, 4))
    directions[[0, 1, *(2 + stepper.parameters.index(name) for name in ("c", "l"))], range(4)] = 1.0
    partials = weights + np.einsum("nij,nj->ni", hessians, states_of(run))
    product = run.hessian_product(partials, directions, hessians)
    found = by_start(product, stepper)
    expected = derivative(gradient, START)
    assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert product.inputs["u"].shape == (4, 4, 4)


def test_tangent_vectors_of_data_are_not_supported(stepper):
    run = run_from(stepper, START)
    with pytest.raises(StateError, match="directions must be 0 for the parameters of inputs"):
        run.tangent(np.ones(stepper._input_size))
    with pytest.raises(StateError, match="cotangents, derivatives by"):
        run.pullback(np.zeros((3, 2)))
