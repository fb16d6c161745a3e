"""Optimal control by discrete mechanics: against closed forms, and the stepper with the inputs found."""

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS
from scipy.integrate import quad_vec

import scvi_codegen as sc

pytest.importorskip("casadi", reason="needs the extra 'casadi'")

POINT = lagrange("point", "x", "x_dot**2/2", forces={"x": "u"}, inputs="u")
SWING = lagrange("swing", "q", "(1 + a)*q_dot**2/2 + cos(q)", a=0.5, forces={"q": "u"}, inputs="u")
REST = {"start": {"x": 0.0, "x_dot": 0.0}, "end": {"x": 1.0, "x_dot": 0.0}}
UP = {
    "steps": 12,
    "duration": 5.0,
    "start": {"q": 0.0, "q_dot": 0.0},
    "end": {"q": np.pi, "q_dot": 0.0},
    "cost": "u**2",
    "bounds": {"u": (-1.0, 1.0)},
}


def test_minimum_effort_rest_to_rest_has_the_exact_costates():
    """u = 6 - 12 t; the gradient of the cost-to-go is -12 by x and 12 t - 6 by p."""
    motion = sc.optimal_control(POINT, sc.SVI(2), steps=5, duration=1.0, cost="u**2/2", degree=1, **REST)
    assert motion.cost == pytest.approx(6.0, rel=1e-9)
    assert_allclose(motion.inputs["u"](motion.t[:-1] + 0.05), 6 - 12 * (motion.t[:-1] + 0.05), atol=1e-8)
    assert_allclose(motion.costates, np.c_[np.full(5, -12.0), 12 * motion.t[1:] - 6], atol=1e-7)
    assert motion.iterations <= 2  # quadratic, with an exact Hessian


@pytest.mark.parametrize("s", [2, 3])
def test_cost_and_costates_have_the_order_of_the_method(s):
    """Beside the Gramian of a spring that is pushed: inputs of degree s - 1 by Gauss's s points."""
    spring = lagrange("spring", "x", "(x_dot**2 - x**2)/2", forces={"x": "u"}, inputs="u")
    turned = np.array([[np.sin(1.0)], [np.cos(1.0)]])  # where a unit impulse leads, a unit of time later
    gramian = quad_vec(lambda t: np.outer(v := [np.sin(t), np.cos(t)], v), 0.0, 3.0)[0]
    costate = np.linalg.solve(gramian, [1.0, 0.0])
    pushed = costate @ turned  # the input at t = 2
    errors = []
    for steps in (3, 6):
        motion = sc.optimal_control(spring, sc.SVI(s), steps=steps, duration=3.0, cost="u**2/2", degree=s - 1, **REST)
        at_2 = motion.costates[2 * steps // 3 - 1]
        errors.append([motion.cost - costate[0] / 2, *(motion.costates[-1] + costate), at_2[1] + pushed.item()])
    orders = np.log2(np.abs(np.divide(*errors)))
    assert_allclose(orders, 2 * s, atol=0.3)


def test_minimum_time_is_found_for_free_duration():
    motion = sc.optimal_control(
        POINT, sc.SVI(1), steps=6, duration=(0.1, 9.0), cost="1", bounds={"u": (-1, 1)}, t=3.0, **REST
    )
    assert motion.t[-1] - 3.0 == pytest.approx(2.0, abs=1e-6)
    assert_allclose(motion.coefficients["u"][:, 0], np.repeat([1.0, -1.0], 3), atol=1e-5)


def test_terminal_cost_is_included():
    """Far for little: x(1) less the integral of u^2 / 2 is most for u = 1 - t."""
    motion = sc.optimal_control(
        POINT, sc.SVI(2), steps=3, duration=1.0, start=REST["start"], end={}, cost="u**2/2", end_cost="-x", degree=1
    )
    assert motion.cost == pytest.approx(-1 / 6, rel=1e-8)


def test_trajectory_is_that_of_the_stepper_and_inputs_satisfy_bounds():
    motion = sc.optimal_control(SWING, sc.SVI(3), degree=2, parameters={"a": 0.4}, **UP)
    stepper = sc.compile_stepper(SWING, sc.SVI(3), flags=QUICK_FLAGS)
    given = {"inputs": motion.inputs, "h": motion.h, "t_end": 5.0, "parameters": {"a": 0.4}}
    again = stepper.integrate(motion.q[0], motion.p[0], **given)
    assert_allclose(again.q, motion.q, atol=1e-6)
    assert abs(motion.inputs["u"](np.linspace(0.0, 5.0, 999))).max() < 1.0 + 1e-7
    assert abs(motion.coefficients["u"]).max() > 0.999  # they bind
    finer = sc.optimal_control(SWING, sc.SVI(3), parameters={"a": 0.4}, **{**UP, "steps": 24}, guess=motion.guess)
    assert finer.cost == pytest.approx(motion.cost, rel=0.05)


def test_path_bounds_hold_at_the_quadrature_points():
    motion = sc.optimal_control(
        POINT, sc.SVI(2), steps=8, duration=1.0, cost="u**2", bounds={"x_dot": (None, 1.2)}, **REST
    )
    assert motion.p.max() < 1.3
    free = sc.optimal_control(POINT, sc.SVI(2), steps=8, duration=1.0, cost="u**2", **REST)
    assert free.p.max() > 1.4
    assert free.cost < motion.cost


def test_unreachable_end_is_an_error_with_the_last_iterate():
    with pytest.raises(sc.ControlError, match=r"no optimal control was found: IPOPT ended with .* after") as raised:
        sc.optimal_control(POINT, sc.SVI(1), steps=4, duration=1.0, bounds={"u": (-0.1, 0.1)}, **REST)
    assert raised.value.motion.q.shape == (5, 1)


@pytest.mark.parametrize(
    ("changed", "error", "message"),
    [
        ({"bounds": {"u": (1, -1)}}, sc.StateError, "u: the lower bound 1 exceeds the upper bound -1"),
        ({"bounds": {"u": (1, 2, 3)}}, sc.StateError, "u must be a number, or two numbers"),
        ({"duration": (0.0, 1.0)}, sc.StateError, "duration must be a positive number"),
        ({"parameters": {"b": 1.0}}, sc.StateError, "there is no parameter 'b'.* There are: a"),
        ({"guess": {"u_0": 1.0}}, sc.StateError, "there is no coordinate or input 'u_0'"),
        ({"guess": {"q": [0.0, np.nan]}}, sc.StateError, "the guess of q must be a finite number, or a list"),
        ({"degree": 2}, sc.MethodError, "use degree 1 or less"),
        ({"method": sc.RadauIIA(2)}, sc.MethodError, "no quadrature"),
        ({"system": sc.problem("kepler").system}, sc.MethodError, "'Kepler problem' has no inputs"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_invalid_problems_are_reported(changed, error, message):
    asked = {"system": SWING, "method": sc.SVI(2), **UP, **changed}
    with pytest.raises(error, match=message):
        sc.optimal_control(**asked)


BOB = lagrange(
    "bob", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"], forces={"x": "u"}, inputs="u"
)
ANGLE = lagrange("angle", "a", "a_dot**2/2 + cos(a)", forces={"a": "u*cos(a)"}, inputs="u")


def test_constraints_hold_and_the_optimum_is_that_in_the_angle():
    """A bob on a rod, from rest below to rest at half a right angle: as with its angle alone."""
    known, turn = {"steps": 10, "duration": 2.0, "cost": "u**2", "degree": 1}, np.linspace(0.0, 0.5, 11)
    free = sc.optimal_control(ANGLE, sc.SVI(3), start={"a": 0.0, "a_dot": 0.0}, end={"a": 0.5, "a_dot": 0.0}, **known)
    held = sc.optimal_control(
        BOB,
        sc.SVI(3, "gauss-lobatto:4"),
        start={"x": 0.0, "y": (None, 0.0), "x_dot": 0.0},
        end={"x": float(np.sin(0.5)), "y": (None, 0.0), "x_dot": 0.0},
        guess={"x": np.sin(turn), "y": -np.cos(turn)},
        **known,
    )
    assert held.cost == pytest.approx(free.cost, rel=1e-5)
    assert_allclose(held.q, np.c_[np.sin(free.q[:, 0]), -np.cos(free.q[:, 0])], atol=1e-4)
    assert np.abs(np.hypot(*held.q.T) - 1.0).max() < 1e-10
    stepper = sc.compile_stepper(BOB, sc.SVI(3, "gauss-lobatto:4"), flags=QUICK_FLAGS)
    again = stepper.integrate(held.q[0], held.p[0], inputs=held.inputs, h=held.h, t_end=2.0)
    assert_allclose(again.q, held.q, atol=1e-9)


def test_constraint_that_depends_on_an_input_is_rejected():
    led = lagrange("led", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x = u"], forces={"y": "w"}, inputs="u w")
    with pytest.raises(sc.MethodError, match="a constraint depends on an input and would jump"):
        sc.optimal_control(led, sc.SVI(1, "gauss-lobatto:2"), steps=3, duration=1.0, start={}, end={})
