"""A state may be given by its velocity, and a method by its name."""

from __future__ import annotations

import numpy as np
import pytest
from samples import QUICK_FLAGS

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.methods import SCVI, SVI, Composition, Gauss, StoermerVerlet, as_method
from scvi_codegen.models.problems import problem

Q, V = [1.2, 0.4], [0.3, -0.7]


def pendulum_on_cart():
    return compile_stepper(problem("cart-pole").system, "svi:2", flags=QUICK_FLAGS)


def test_velocities_stand_for_momenta_with_the_parameters_and_the_time_of_the_run():
    stepper = pendulum_on_cart()
    name = stepper.parameters[0]
    given = {"parameters": {name: 2.5}, "t": 0.7, "h": 0.01}
    p = stepper.momentum(Q, V, 0.7, given["parameters"])
    one, other = stepper.integrate(Q, p, steps=20, **given), stepper.integrate(Q, velocity=V, steps=20, **given)
    assert np.array_equal(one.q, other.q)
    assert np.array_equal(one.p, other.p)
    assert other.velocity[0] == pytest.approx(V, rel=1e-14)
    assert stepper.momentum(other.q, other.velocity, other.t, given["parameters"]) == pytest.approx(other.p, rel=1e-13)
    run = stepper.start(Q, velocity=V, **given)
    assert np.array_equal(run.record(20).q, one.q)


def test_one_of_both_is_wanted():
    stepper = pendulum_on_cart()
    with pytest.raises(StateError, match="give p or velocity, one of them"):
        stepper.integrate(Q, h=0.1, steps=1)
    with pytest.raises(StateError, match="not both"):
        stepper.integrate(Q, V, velocity=V, h=0.1, steps=1)
    with pytest.raises(StateError, match="velocity must have shape"):
        stepper.integrate(Q, velocity=[1.0], h=0.1, steps=1)


@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("svi", SVI(8)),
        ("svi:6", SVI(6)),
        ("scvi:3", SCVI(3)),
        ("gauss:4", Gauss(4)),
        ("stoermer-verlet", StoermerVerlet()),
        ("composition:10", Composition(10)),
    ],
)
def test_names_are_methods(name, method):
    assert as_method(name) == method
    assert as_method(method) is method


@pytest.mark.parametrize("name", ["svy", "svi:", "svi:x", "svi:0", "svi:-3", "stoermer-verlet:3", "", "svi:2:3", 3])
def test_what_is_no_name_is_refused(name):
    with pytest.raises(MethodError):
        as_method(name)
    with pytest.raises(MethodError):
        compile_stepper(problem("kepler").system, name)
