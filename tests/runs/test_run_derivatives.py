"""Derivatives of runs: motions x situations, and a chain of identities.

``sensitivity`` of a run is the product of those of its steps (compared with 60 digits in test_sensitivity), ``tangent``
its columns, and ``pullback`` its transpose; difference quotients of both: tests/motions.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS, damped_pendulum
from scipy.interpolate import PPoly

import scvi_codegen as sc

BREAKS, COEFFICIENTS = np.array([0.0, 1.0, 2.3, 3.1, 4.0]), np.random.default_rng(5).normal(size=(4, 4))
"""An input; coefficients of descending powers."""


def pendulum(force, parameters, **options):
    return sc.LagrangianSystem.from_text(
        name="damped pendulum with a force",
        coordinates=["q"],
        lagrangian="l*q_dot**2/2 + cos(q)",
        parameters=parameters,
        forces={"q": force},
        dissipation="c*q_dot**2/2",
        **options,
    )


@dataclass(frozen=True, eq=False)
class Motion:
    """A stepper and an initial state (q, p); ``plan``: arguments of its runs."""

    system: object
    method: object
    x: tuple[float, ...]
    plan: dict
    options: dict = field(default_factory=dict)
    has_data: bool = False

    @cached_property
    def stepper(self):
        return sc.compile_stepper(self.system, self.method, flags=QUICK_FLAGS, **self.options)

    def run(self, x=None, coefficients=COEFFICIENTS, **changes):
        """The run from x = (q, p) or (q, p, parameters, t, h)."""
        m, x = self.stepper.dimension, np.array(self.x if x is None else x)
        arguments = {"t": 0.3, **self.plan, **changes}
        if len(x) > 2 * m:
            arguments |= {"parameters": x[2 * m : -2], "t": x[-2]} | ({"h": x[-1]} if arguments.get("h") else {})
        if self.has_data:
            arguments |= {"inputs": {"u": PPoly(coefficients, BREAKS)}, "t": 0.0}
        arguments = {name: value for name, value in arguments.items() if value is not None}
        return self.stepper.integrate(x[:m], x[m : 2 * m], **arguments)


MOTIONS = {
    "pendula": Motion(sc.problem("double-pendulum").system, sc.SVI(4), (0.9, -0.6, 1.0, 0.5), {"h": 0.05, "steps": 36}),
    "driven": Motion(
        pendulum("f*cos(t)", {"c": 0.1, "f": 0.3, "l": 1.2}), sc.SVI(3), (0.4, -0.8), {"h": 0.07, "steps": 60}
    ),
    "data": Motion(
        pendulum("u", {"c": 0.1, "l": 1.2}, inputs=["u"]),
        sc.SVI(3),
        (0.4, -0.8),
        {"h": 0.07, "t_end": 4.0},
        has_data=True,
    ),
    "reversible": Motion(
        sc.problem("kepler").system,
        sc.SVI(4),
        (0.5, 0.0, 0.0, 3**0.5),
        {"h": 0.05, "t_end": 3.3},
        {"time_transformation": "frequency"},
    ),
    "damped": Motion(damped_pendulum(), sc.SVI(2), (1.0, 1.0, 0.0, 0.0), {"h": 0.1, "steps": 12}),
}
ADAPTIVE = {"h": None, "steps": None, "t_end": 4.0}
CASES = [("driven", ADAPTIVE), ("data", {}), ("data", {"save_every": 12}), ("reversible", {})]
"""Runs with steps of different sizes; the others are in the table of motions."""


def states_of(run):
    return np.concatenate([run.q, run.p], axis=1)


def assert_close(found, expected, error):
    assert_allclose(found, expected, rtol=0, atol=error * np.abs(expected).max(initial=1e-3))


def stacked(gradient):
    """(inputs, ..) derivatives in the order of the inputs of a step."""
    last = [np.asarray(x)[np.newaxis] for x in (gradient.t, gradient.h) if x is not None]
    return np.concatenate([gradient.q, gradient.p, gradient.parameters, *last])


def derivatives_of(run):
    """(n, 2m, inputs) derivatives of all states."""
    if run.pieces:
        return run.tangent()
    found = run.sensitivity()
    times = [found.t] if found.h is None else [found.t, found.h]
    return np.concatenate([found.state, found.parameters, np.stack(times, axis=-1)], axis=-1)


def differences(function, x, width=1e-4):
    """(.., x) derivatives, of fourth order."""
    columns = []
    for unit in width * np.eye(x.size).reshape(-1, *x.shape):
        a, b, c, d = (function(x + s * unit) for s in (1, -1, 2, -2))
        columns.append((8 * (a - b) - (c - d)) / (12 * width))
    return np.array(columns).T


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("name", "changes"), CASES)
def test_gradients_are_the_transpose_of_sensitivities(name, changes):
    run = MOTIONS[name].run(**changes)
    whole, seeds = derivatives_of(run), np.random.default_rng(1).normal(size=(len(run), 2 * run.q.shape[1], 3))
    gradient = run.pullback(seeds)
    found = stacked(gradient)[: whole.shape[2]]
    assert_close(found, np.einsum("nic,nij->jc", seeds, whole), 1e-10)
    assert_close(stacked(run.pullback(seeds[:, :, 0]))[: whole.shape[2]], found[:, 0], 1e-12)
    assert gradient.h is None


@pytest.mark.second
def test_hessians_of_adaptive_runs_are_symmetric():
    run = MOTIONS["driven"].run(**ADAPTIVE)
    directions = np.eye(7)[:, :6]  # the step sizes are constant
    product = run.hessian_product(np.ones((len(run), 2)), directions, np.tile(np.eye(2), (len(run), 1, 1)))
    found = np.vstack([product.q, product.p, product.parameters, product.t])
    assert_close(found, found.T, 1e-11)


@pytest.mark.rotated
def test_derivatives_by_data_and_named_parameters():
    motion = MOTIONS["data"]
    run, start = motion.run(), np.array([*motion.x, 0.1, 1.2])
    rows = [0, 1, *(2 + motion.stepper.parameters.index(name) for name in ("c", "l"))]
    w = np.random.default_rng(1).normal(size=(len(run), 2))

    def run_from(x, coefficients=COEFFICIENTS):
        return motion.run(x[:2], coefficients, parameters={"c": x[2], "l": x[3]})

    def gradient(x):
        return stacked(run_from(x).pullback(w))[rows]

    found = run.pullback(w)
    by_data = differences(lambda c: (w * states_of(motion.run(None, c))).sum(), COEFFICIENTS)
    assert_close(found.inputs["u"], by_data.reshape(4, 4)[::-1].T, 1e-7)
    assert_close(gradient(start), differences(lambda x: (w * states_of(run_from(x))).sum(), start), 1e-8)
    assert np.isnan(found.parameters).sum() == 5
    directions = np.eye(motion.stepper._input_size)[:, rows]
    by_all = differences(lambda x: states_of(run_from(x)), start)
    assert_close(run.tangent(directions), by_all.transpose(1, 0, 2), 1e-8)
    product = run.hessian_product(w, directions)
    assert_close(stacked(product)[rows], differences(gradient, start), 1e-7)
    assert product.inputs["u"].shape == (4, 4, 4)


W = np.zeros((61, 2))
REJECTED = [
    ("pendula", lambda run: run.tangent([1.0, 2.0]), sc.StateError, r"shape \(4,\) or \(4, k\)"),
    ("driven", lambda run: run.pullback(W[1:]), sc.StateError, r"of each state, must have shape \(61, 2\)"),
    ("driven", lambda run: run.pullback(W + np.nan), sc.StateError, "cotangents must be finite"),
    (
        "driven",
        lambda run: run.hessian_product(np.zeros((61, 2, 3)), [1.0, 0.0]),
        sc.StateError,
        r"cotangents of one function must have shape \(61, 2\)",
    ),
    (
        "driven",
        lambda run: run.hessian_product(W, [1.0] * 3),
        sc.StateError,
        r"or \(7,\) or \(7, k\), of .*, not \(3,\)",
    ),
    (
        "driven",
        lambda run: run.hessian_product(W, [1.0, 0.0], W),
        sc.StateError,
        r"curvatures, Hessians .* not \(61, 2\)",
    ),
    ("driven", lambda run: moved(run).sensitivity(), sc.StateError, r"from t = 2\.33, computed again, end in another"),
    (
        "damped",
        lambda run: run.hessian_product(np.ones((13, 4)), np.ones(4)),
        sc.MethodError,
        "damping have first derivatives only",
    ),
    (
        "data",
        lambda run: run.tangent(np.ones(run.stepper._input_size)),
        sc.StateError,
        "directions must be 0 for the parameters of inputs",
    ),
    ("data", lambda run: run.pullback(np.zeros((3, 2))), sc.StateError, "cotangents, derivatives by"),
]


def moved(run):
    """The run with another state 30."""
    return replace(run, q=run.q + (np.arange(61) == 30)[:, np.newaxis] * 1e-3)


@pytest.mark.rotated
@pytest.mark.parametrize(("name", "call", "error", "message"), REJECTED)
def test_arguments_of_derivatives_are_checked(name, call, error, message):
    with pytest.raises(error, match=message):
        call(MOTIONS[name].run())


@pytest.mark.rotated
def test_runs_without_derivatives_are_rejected():
    with pytest.raises(sc.StateError, match="whole steps"):
        MOTIONS["driven"].run(steps=9, t=0.0, t_eval=[0.03, 0.1]).sensitivity()
    hill = sc.LagrangianSystem.from_text(name="hill", coordinates=["q"], lagrangian="q_dot**2/2 + q**2/2")
    with pytest.raises(sc.StateError, match="derivatives exceed the largest double"):
        sc.compile_stepper(hill, sc.SVI(2)).integrate([0.0], [0.0], h=0.5, steps=1600).tangent()
