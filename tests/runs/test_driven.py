"""Inputs given as data: exact where the motion is, in order between breakpoints, held by a sampled controller."""

import pickle

import numpy as np
import pytest
import sympy
from counting import at_most
from notation import lagrange
from numpy.testing import assert_allclose
from samples import pushed_pendulum
from scipy.integrate import solve_ivp
from scipy.interpolate import Akima1DInterpolator, BPoly, CubicSpline, PPoly, make_interp_spline

import scvi_codegen as sc
from scvi_codegen.runs.driver.largest_step import largest_step

KNOTS = np.array([0.0, 0.37, 0.9, 1.41, 2.05, 2.6])
VALUES = np.array([0.0, 1.2, -0.7, 0.4, 1.9, -1.0])


@pytest.fixture(scope="module")
def pendulum():
    return pushed_pendulum()


def reference(u, w, t_end):
    """Integrate with DOP853, piece by piece."""
    state, ends = [0.3, 0.1], [*KNOTS[(KNOTS > 0.0) & (t_end > KNOTS)], t_end]
    for start, end in zip([0.0, *ends], ends, strict=False):
        inner = (start + end) / 2

        def motion(t, y, inner=inner):
            return [y[1], u(t, inner) - 0.2 * y[1] - (1 + w(t, inner)) * np.sin(y[0])]

        state = solve_ivp(motion, (start, end), state, method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return state


def zero_order_hold(t, inner):
    return VALUES[np.searchsorted(KNOTS, inner, side="right") - 1]


def sloped(t, inner):
    return np.interp(t, KNOTS, VALUES)


@pytest.mark.tiers(5, 5)
@pytest.mark.parametrize(
    ("kind", "exact"),
    [("constant", zero_order_hold), ("linear", sloped), ("cubic", lambda t, _: CubicSpline(KNOTS, VALUES)(t))],
)
@pytest.mark.parametrize("method", [sc.SVI(2), sc.StoermerVerlet(), sc.Gauss(3)], ids=lambda method: method.name)
def test_order_is_preserved_across_breakpoints(pendulum, kind, exact, method):
    stepper, expected = sc.compile_stepper(pendulum, method), reference(exact, lambda t, _: 0.1 * t, 2.3)
    inputs, errors = {"u": (KNOTS, VALUES, kind), "w": ([0.0, 3.0], [0.0, 0.3])}, []
    for h in (0.1, 0.02):
        run = stepper.integrate([0.3], velocity=[0.1], inputs=inputs, h=h, t_end=2.3)
        assert run.t[-1] == pytest.approx(2.3, abs=1e-15)
        assert set(np.round(KNOTS[1:5], 12)) <= set(np.round(run.t, 12))
        assert np.diff(run.t).max() < 1.000001 * h
        errors.append(np.hypot(run.q[-1, 0] - expected[0], run.velocity[-1, 0] - expected[1]))
    assert errors[1] < 1e-12 or np.log(errors[0] / errors[1]) / np.log(5.0) > method.order - 0.4


@pytest.mark.second
def test_sampled_controller_continues_bitwise(pendulum):
    """Between samples an input is held; the same from a saved run, and by the parameters themselves."""
    stepper = sc.compile_stepper(pendulum, sc.SVI(3))
    run = stepper.start([0.3], [0.0], h=0.01)
    states = []
    for _ in range(50):
        run.set_inputs(u=-2.0 * run.q[0] - 0.5 * run.p[0], w=0.0)
        run.advance(4)
        states.append((run.q[0], run.p[0]))
    assert abs(run.q[0]) < 0.2
    again = stepper.start([0.3], [0.0], h=0.01)
    for k in range(50):
        again.update(parameters={"u_0": -2.0 * again.q[0] - 0.5 * again.p[0], "w_0": 0.0})
        again = stepper.from_checkpoint(again.checkpoint(), parameters=again.parameters)
        again.advance(4)
        assert (again.q[0], again.p[0]) == states[k]
    sloped = {"u_0": 1.0, "u_1": 2.0, "u_2": -1.0, "u_3": 0.5, "u_t": 0.3, "w_0": 0.0}
    after, plain = (stepper.start([0.3], [0.0], h=0.01, parameters=given) for given in (sloped, {"w_0": 0.0}))
    for one in (after, plain):
        one.set_inputs(u=0.4)
        one.advance(10)
    assert after.q == plain.q
    with at_most(100_000):  # microseconds each, where a new run would be compiled and checked
        for _ in range(1000):
            run.set_inputs(u=0.1)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("precision", ["double", "double-double"])
@pytest.mark.parametrize("method", ["stoermer-verlet", "composition:4", "svi:2"])
def test_first_kick_after_a_jump_is_that_of_the_new_input(method, precision):
    """Explicit steps reuse their last force, which is that of the former input; new runs have none."""
    formula, levels = "x_dot**2/2 - x**4/4 + u*x", [0.0, 1.0, -2.0, 3.0]
    driven, constant = (
        sc.compile_stepper(sc.LagrangianSystem.from_text("driven", ["x"], formula, **role), method, precision=precision)
        for role in ({"inputs": ["u"]}, {"parameters": {"u": 0.0}})
    )
    if precision == "double":  # within a segment the last force is reused, as without inputs
        held = driven.integrate([1.0], [0.0], inputs={"u": 0.3}, h=0.1, steps=300)
        same = constant.integrate([1.0], [0.0], parameters={"u": 0.3}, h=0.1, steps=300)
        assert np.array_equal(held.q, same.q)
    q, p = np.array([1.0]), np.array([0.0])
    for level in levels:
        part = constant.integrate(q, p, h=0.1, steps=5, parameters={"u": level})
        q, p = part.q[-1], part.p[-1]
    whole = driven.integrate(
        [1.0], [0.0], inputs={"u": ([0.0, 0.5, 1.0, 1.5, 2.0], [*levels, 0.0], "constant")}, h=0.1, t_end=2.0
    )
    sampled, changed = driven.start([1.0], [0.0], h=0.1), constant.start([1.0], [0.0], h=0.1)
    for level in levels:
        sampled.set_inputs(u=level)
        sampled.advance(5)
        changed.update(parameters={"u": level})
        changed.advance(5)
    for found in (whole.q[-1], sampled.q, changed.q):
        assert_allclose(found, q, rtol=0, atol=1e-14)


@pytest.mark.tiers(0, 1)
def test_inputs_from_sympy_and_scipy():
    q, v, u = sympy.symbols("q q_dot u")
    system = sc.LagrangianSystem.from_sympy(
        name="pushed", lagrangian=v**2 / 2, coordinates=[q], forces={"q": u}, inputs=[u]
    )
    stepper = sc.compile_stepper(system, sc.SVI(3))
    of_knots = PPoly.from_spline(make_interp_spline(KNOTS, VALUES))  # with pieces of no length
    for given in (CubicSpline(KNOTS, VALUES), Akima1DInterpolator(KNOTS, VALUES), of_knots):
        run = stepper.integrate([0.0], [0.0], inputs={"u": given}, h=0.13, t_end=2.6)
        assert_allclose(run.q[-1, 0], given.antiderivative(2)(2.6), rtol=0, atol=1e-14)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("t_end", [2.3, 2.05])
def test_states_at_breakpoints_are_saved_for_any_save_every(pendulum, t_end):
    """Dense output, work and iterations do not depend on the stride."""
    stepper = sc.compile_stepper(pendulum, sc.SVI(3))
    given = {"inputs": {"u": (KNOTS, VALUES), "w": ([0.0, 3.0], [0.0, 0.3])}, "h": 0.1, "t_end": t_end}
    reported = []
    full = stepper.integrate([0.3], [0.1], **given, progress=reported.append)
    assert reported[-1] == full.steps == sum(map(len, full.pieces)) - len(full.pieces)
    assert reported == sorted(reported)
    fewer = stepper.integrate([0.3], [0.1], **given, save_every=3)
    assert {0.0, *KNOTS[1:5][KNOTS[1:5] <= t_end].tolist(), t_end} <= set(np.round(fewer.t, 14))
    assert len(fewer) < len(full) / 1.5
    saved = np.isin(full.t, fewer.t)
    assert saved.sum() == len(fewer)
    assert (fewer.q == full.q[saved]).all()
    assert_allclose(fewer.at(full.t)[0], full.q, rtol=0, atol=1e-13)
    assert_allclose(fewer.work(), full.work()[saved], rtol=0, atol=1e-13)
    watched = stepper.integrate([0.3], [0.1], **given, save_every=3, events="q")
    assert (watched.iterations == fewer.iterations).all()
    assert (np.diff(np.cumsum(full.iterations)[saved]) == fewer.iterations[1:]).all()
    assert len(stepper.integrate([0.3], [0.1], **{**given, "t_end": 0.0})) == 1
    with pytest.raises(sc.StateError, match=r"t = 3 is outside the trajectory from t = 0 to 2\."):
        full.at(3.0)


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"u": np.sin, "w": (KNOTS, VALUES)}, "C code cannot call"),
        ({"u": (KNOTS, 1j * VALUES), "w": (KNOTS, VALUES)}, "real numbers, not complex128"),
        ({"u": BPoly([[1.0], [2.0]], [0.0, 3.0]), "w": (KNOTS, VALUES)}, "from_bernstein_basis"),
        ({"u": PPoly([[1j]], [0.0, 3.0]), "w": (KNOTS, VALUES)}, "real numbers, not complex128"),
        ({"u": PPoly([[1.0, 2.0]], [3.0, 1.0, 0.0]), "w": (KNOTS, VALUES)}, "must be ascending: 1 follows 3"),
    ],
)
def test_invalid_inputs_are_rejected(pendulum, inputs, message):
    with pytest.raises(sc.StateError, match=message):
        sc.compile_stepper(pendulum, sc.SVI(2)).integrate([0.3], [0.0], inputs=inputs, h=0.1, t_end=2.3)


@pytest.mark.tiers(0, 1)
def test_velocities_at_a_breakpoint_use_the_following_segment():
    """Also on the way back, in the first state of runs of all kinds."""
    system = lagrange("drawn", "q", "q_dot**2/2 + u*q_dot - q**2/2", inputs="u")
    stepper, inputs = sc.compile_stepper(system, sc.SVI(3)), {"u": ([0.0, 1.0, 2.0], [5.0, 7.0, 7.0], "constant")}
    for t_end, u in ((0.0, 5.0), (2.0, 7.0)):
        for h in (t_end - 1.0, None):
            run = stepper.integrate([0.2], velocity=[0.5], inputs=inputs, h=h, t=1.0, t_end=t_end)
            assert (run.velocity[0, 0], run.p[0, 0]) == (0.5, 0.5 + u)
        many = stepper.integrate_ensemble([[0.2]], velocity=[[0.5]], inputs=inputs, h=t_end - 1.0, t=1.0, t_end=t_end)
        assert many.p[0, 0, 0] == 0.5 + u


@pytest.mark.tiers(0, 1)
def test_missing_input_is_not_zero(pendulum):
    """Wherever a step would be taken; what is given by a name, in order, or held, is taken."""
    stepper, state = sc.compile_stepper(pendulum, sc.SVI(2)), ([0.3], [0.0])
    for step in (
        lambda: stepper.step(*state, 0.1),
        lambda: stepper.jacobian(*state, 0.1),
        lambda: stepper.work_and_impulses(*state, 0.1),
        lambda: stepper.integrate(*state, h=0.1, steps=2, parameters={"u_0": 1.0}),
        lambda: stepper.integrate(*state, h=0.1, steps=1, observe=lambda run: run.q),
        lambda: stepper.start(*state, h=0.1).record(1),
        lambda: stepper.integrate(*state, t_end=1.0, parameters={"w_0": 1.0}),
        lambda: stepper.integrate_ensemble([[0.3]], [[0.0]], h=0.1, steps=2),
        lambda: sc.periodic_orbit(stepper, *state, period=6.0, steps=20),
        lambda: largest_step(sc.compile_stepper(pendulum, sc.SVI(2), time_transformation="1 + q**2"), *state, 1.0),
        lambda: stepper.integrate_ensemble([[0.3]], [[0.0]], t_end=1.0),
    ):
        with pytest.raises(sc.StateError, match=r"the input '[uw]' is not set"):
            step()
    given = stepper.integrate(*state, h=0.1, steps=2, parameters={"u_0": 0.7, "w_0": 0.0})
    run = stepper.start(*state, h=0.1)
    run.set_inputs(w=0.0)
    run = pickle.loads(pickle.dumps(run))
    with pytest.raises(sc.StateError, match="the input 'u'"):
        run.advance(1)
    run.set_inputs(u=0.7)
    assert np.array_equal(run.record(2).q, given.q)
    lanes = stepper.integrate_ensemble([[0.3]], [[0.0]], h=0.1, steps=2, parameters=given.parameters)
    assert_allclose(lanes.q[:, 0], given.q, rtol=1e-15)


@pytest.mark.tiers(0, 1)
def test_events_and_time_transformations_use_inputs_by_name(pendulum):
    """A crossing of the torque with a number, and of the angle with a line that is data."""
    inputs = {"u": (KNOTS, VALUES), "w": ([0.0, 3.0], [0.0, 0.3])}
    stepper = sc.compile_stepper(pendulum, sc.SVI(4))
    run = stepper.integrate([0.3], [0.1], inputs=inputs, t_end=2.3, events=["u - 1/2", "q - w - 1/3"])
    torque, line = run.events
    assert torque.t[0] == pytest.approx(0.5 / 1.2 * 0.37, rel=1e-14)
    assert_allclose(np.interp(torque.t, KNOTS, VALUES), 0.5, rtol=1e-13)
    assert_allclose(line.q[:, 0], 0.1 * line.t + 1 / 3, rtol=1e-12)
    assert len(line.t)
    slowed = sc.compile_stepper(pendulum, sc.SVI(4), time_transformation="1/(2 + q**2 + w)")
    same = slowed.integrate([0.3], [0.1], inputs=inputs, h=0.1, t_end=2.3)
    assert_allclose(same.q[-1], run.q[-1], rtol=0, atol=1e-8)
    by_hand = 1 / (2 + same.q[:, 0] ** 2 + 0.1 * same.t)
    lengths = np.concatenate([piece.step_sizes[:-1] for piece in same.pieces])
    ratio = lengths / (0.1 * by_hand[:-1])
    assert np.median(np.abs(ratio - 1)) < 0.05
    with pytest.raises(sc.ExpressionError, match=r"Known here: .* u, w"):
        stepper.with_events("v - 1")


@pytest.mark.tiers(0, 1)
def test_failed_run_with_inputs_ends_with_the_last_state():
    edge = sc.LagrangianSystem.from_text("edge", ["q"], "q_dot**2/2 + sqrt(1 - q)", forces={"q": "u"}, inputs=["u"])
    stepper = sc.compile_stepper(edge, sc.SVI(2))
    runs = []
    for save_every in (1, 1000):
        with pytest.raises(sc.StepFailedError) as caught:
            stepper.integrate(
                [0.0], [1.0], inputs={"u": ([0.0, 0.3, 9.0], [2.0, 2.0, 2.0])}, h=0.01, t_end=9.0, save_every=save_every
            )
        runs.append(caught.value.trajectory)
    every, few = runs
    assert len(every) > 60
    assert len(few) == 3  # the start, the breakpoint, the end
    assert (every.t[-1], every.q[-1], every.p[-1]) == (few.t[-1], few.q[-1], few.p[-1])
