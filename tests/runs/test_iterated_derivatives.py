"""Derivatives by fixed-point iteration compared with those by factorisation: equal equations, two solvers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from samples import fixed_point, tangle

import scvi_codegen as sc
from scvi_codegen.codegen.lowering import derivatives

pytestmark = pytest.mark.rotated

WHIRL = sc.LagrangianSystem.from_text(
    name="whirl in a moving trap",
    coordinates=["x", "y"],
    lagrangian="m*x_dot**2/2 + (m + n)*y_dot**2/2 - k*(x**2 + y**4/2)*(1 + cos(w*t)/3)",
    forces={"x": "-c*y*x", "y": "c*x + sin(t)*y"},
    parameters={"m": 1.2, "n": 0.4, "k": 0.8, "w": 1.1, "c": 0.3},
)
"""Forces without a potential, masses that are parameters, time."""

RUBBED = sc.LagrangianSystem.from_text(
    name="rubbed pendulum on a cart",
    coordinates=["x", "a"],
    lagrangian="m*x_dot**2/2 + x_dot*a_dot*cos(a) + a_dot**2/2 - (1 + cos(t)/3)*x**2 + cos(a)",
    forces={"x": "-r*x_dot*(1 + a**2)", "a": "r*x*x_dot - a_dot*r/2"},
    parameters={"m": 2.0, "r": 0.4},
)
"""Velocity-dependent forces, so that no Jacobian is symmetric."""

CASES = {
    "whirl": (WHIRL, sc.SVI(2, "gauss-lobatto:5"), 0.2),
    "chain": (sc.problem("fput-chain:10").system, sc.Gauss(2), 0.2),
    "tangle": (tangle(), sc.SVI(2), 0.02),
    "rubbed": (RUBBED, sc.SVI(5), 0.1),
    "rubbed, several vectors of points": (RUBBED, sc.SVI(9), 0.2),
    "whirl, several vectors of points": (WHIRL, sc.SVI(2, "gauss-lobatto:9"), 0.2),
}
STEPS = 70
"""More than are solved before vectors are carried over them."""


def numbers_of(gradient):
    return np.concatenate([gradient.q, gradient.p, gradient.parameters, [gradient.t, gradient.h]])


QUICK = ("whirl", "tangle", "rubbed, several vectors of points")


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.full) for name in CASES]
)
def test_iterated_derivatives_equal_those_by_factorisation(name):
    """Forward and back, by all that is given; more directions than factors take at a time; runs kept now and then."""
    system, method, h = CASES[name]
    iterated, factored = (sc.compile_stepper(system, method, solver=solver) for solver in ("auto", "newton"))
    assert "define VECTORS_BY_ITERATION" in iterated.derivatives.code
    assert "define VECTORS_BY_ITERATION" not in factored.derivatives.code
    random, m = np.random.default_rng(20261122), iterated.dimension
    q = np.array([0.9, -0.4, 0.1, 0.6, -0.8, 0.2, 0.5, -0.3, 0.4, 0.7])[:m]
    p = iterated.momentum(q, random.uniform(-0.4, 0.4, m) + (np.arange(m) == 1))
    directions = random.normal(size=(iterated._input_size, 9))
    partials = random.normal(size=(STEPS + 1, 2 * m, 2))
    found = []
    for stepper in (iterated, factored):
        run = stepper.integrate(q, p, h=h, steps=STEPS, t=0.3)
        some = stepper.integrate(q, p, h=h, steps=STEPS, t=0.3, save_every=35)
        gradient, other = run.pullback(partials), some.pullback(partials[::35])
        step = stepper.sensitivity(q, p, h, 0.3)
        columns = (step.state, step.parameters, step.t[:, np.newaxis], step.h[:, np.newaxis])
        found.append((np.hstack(columns), run.tangent(directions)[-1], numbers_of(gradient), numbers_of(other)))
    for one, other in zip(*found, strict=True):
        assert_allclose(one, other, rtol=0, atol=1e-13 * np.abs(other).max())


@pytest.mark.quick
def test_large_jacobians_are_factorised(monkeypatch):
    system = sc.problem("kepler").system
    found = fixed_point(system, sc.SVI(2))
    partials = derivatives.point_derivatives_of(system, found)
    assert partials is not None
    monkeypatch.setattr(derivatives, "MOST_DERIVATIVES", partials.count + len(partials.by_inputs.entries) - 1)
    assert derivatives.point_derivatives_of(system, found) is None
