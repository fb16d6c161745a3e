"""A flow in CasADi: against integrate and closed forms; programs that IPOPT solves to what is known."""

from functools import cache

import numpy as np
import pumped_leapfrog as pumped
import pytest
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS
from scipy.special import ellipk

from scvi_codegen import SVI, MethodError, StateError, casadi_flow, compile_stepper, problem

ca = pytest.importorskip("casadi", reason="needs the extra 'casadi'")

Q, P, H = [0.5, 0.1], [0.0, 1.6], 0.1
GRADIENTS = {
    "ipopt.hessian_approximation": "limited-memory",
    "ipopt.print_level": 0,
    "print_time": 0,
    "ipopt.sb": "yes",
}


@cache
def kepler():
    return compile_stepper(problem("kepler").system, SVI(4), flags=QUICK_FLAGS)


@cache
def pendulum():
    return compile_stepper(problem("planar-pendulum").system, SVI(6), flags=QUICK_FLAGS)


def symbols(flow):
    return [ca.MX.sym(flow.name_in(i), flow.size1_in(i)) for i in range(flow.n_in())]


def run(save_every):
    return kepler().integrate(Q, P, h=H, steps=90, save_every=save_every, t=0.0, parameters={"mu": 1.1})


def test_states_are_those_of_integrate():
    flow = casadi_flow(kepler(), steps=90, save_every=30)
    found = flow(Q, P, 1.1, 0.0, H)
    assert_allclose(found[0].full().T, run(30).q, rtol=0, atol=1e-13)
    assert_allclose(found[1].full().T, run(30).p, rtol=0, atol=1e-13)
    end = casadi_flow(kepler(), steps=90)(q=Q, p=P, parameters=1.1, h=H)
    assert_allclose(end["q1"].full()[:, 0], run(30).q[-1], rtol=0, atol=1e-13)
    assert flow.map(2)(np.c_[Q, Q], np.c_[P], 1.1, 0.0, H)[0].shape == (2, 8)


def test_ipopt_finds_the_turning_point_of_a_pendulum():
    """Momentum at the bottom and time to the turning point, both unknown; m = l = g = 1."""
    flow, angle = casadi_flow(pendulum(), steps=12), 2.0
    p, h = ca.MX.sym("p"), ca.MX.sym("h")
    end = flow(q=0.0, p=p, parameters=pendulum().defaults, h=h)
    program = {"x": ca.vertcat(p, h), "f": p**2, "g": ca.vertcat(end["q1"], end["p1"])}
    solver = ca.nlpsol("solver", "ipopt", program, GRADIENTS | {"ipopt.tol": 1e-12})
    found = solver(x0=[1.5, 0.15], lbg=[angle, 0.0], ubg=[angle, 0.0], lbx=[0.0, 0.01], ubx=[1.95, 0.3])
    assert solver.stats()["success"]
    p, h = found["x"].full()[:, 0]
    assert_allclose(p, 2.0 * np.sin(angle / 2.0), rtol=1e-9)
    assert_allclose(12 * h, ellipk(np.sin(angle / 2.0) ** 2), rtol=1e-9)


def test_failed_step_and_missing_arguments_fail_the_call():
    flow = casadi_flow(kepler(), steps=3)
    with pytest.raises(RuntimeError, match="Evaluation failed"):
        flow([0.0, 0.0], P, 1.0, 0.0, H)
    with pytest.raises(RuntimeError, match="Evaluation failed"):
        flow(q=Q, p=P, h=H)


def test_unsupported_functions_are_rejected():
    with pytest.raises(StateError, match="stepper must be a compiled stepper"):
        casadi_flow("kepler", steps=3)
    with pytest.raises(StateError, match="steps must be at least 1, not 0"):
        casadi_flow(kepler(), steps=0)
    with pytest.raises(MethodError, match="time_transformation"):
        casadi_flow(compile_stepper(problem("kepler").system, SVI(2), time_transformation="q1**2 + q2**2"), steps=3)
    flow = casadi_flow(kepler(), steps=3)
    given = symbols(flow)
    with pytest.raises(RuntimeError, match="Derivatives cannot be calculated"):
        ca.hessian(flow(*given)[0][0], given[0])[0]


def test_derivatives_by_time_and_parameters_of_a_segmented_flow():
    flow = casadi_flow(pumped.stepper(), steps=pumped.STEPS, save_every=pumped.EVERY)
    given = symbols(flow)
    values = ca.vec(ca.vertcat(*flow(*given)))
    jacobian = ca.Function("J", given, [ca.jacobian(values, ca.vertcat(*given))])
    for row in pumped.ROWS:
        at = (row[:2], row[2:4], row[4:8], row[8], row[9])
        found = np.vstack([each.full() for each in flow(*at)])
        assert_allclose(found.T, pumped.states(row), rtol=0, atol=2e-12)
        assert_allclose(jacobian(*at).full(), pumped.partials(row).reshape(-1, 10), rtol=1e-11, atol=1e-11)
