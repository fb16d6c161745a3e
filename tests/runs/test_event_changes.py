"""Events that change the state: impacts, impulses, corners, accumulation, derivatives through them."""

import math
import pickle
import warnings
from dataclasses import replace
from fractions import Fraction
from subprocess import check_output

import mpmath as mp
import numpy as np
import pytest
import sympy
from commands import error_of, invoke
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.ir.variants import WithEvents
from scvi_codegen.codegen.rendering.events import with_events
from scvi_codegen.extras.derivation.page.document import derivation_html
from scvi_codegen.extras.verification.certificate import Outcome
from scvi_codegen.extras.verification.impacts import impact_checks
from scvi_codegen.extras.verification.system_under_test import State, SystemUnderTest
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.runs.stepping.compiled_method import Variants

pytestmark = pytest.mark.rotated

FLAGS = ("-O1",)
BALL = lagrange("ball", "y", "y_dot**2/2 - g*y", g=1.0)
POINT = sc.LagrangianSystem.from_text(name="point", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2")
FREE = sc.LagrangianSystem.from_text(name="free", coordinates=["y"], lagrangian="y_dot**2/2")
BOUNCES = {
    "momentum": sc.Event("y", direction=-1, then={"p_y": "-4*p_y/5"}),
    "velocity": sc.Event("y", direction=-1, then={"y_dot": "-4*y_dot/5"}),
    "impact": sc.impact("y", 0.8),
    "sympy": sc.impact(sympy.Symbol("y"), sympy.Rational(4, 5)),
}
STADIUM = [
    sc.impact("1 - y", where=["x > -1", "x < 1"]),
    sc.impact("1 + y", where=["x > -1", "x < 1"]),
    sc.impact("1 - (x - 1)**2 - y**2", where="x > 1"),
    sc.impact("1 - (x + 1)**2 - y**2", where="x < -1"),
]


@pytest.fixture(scope="module")
def ball() -> sc.Stepper:
    return sc.compile_stepper(BALL, "svi:2", flags=FLAGS)


@pytest.fixture(scope="module")
def point() -> sc.Stepper:
    return sc.compile_stepper(POINT, "svi:1", flags=FLAGS)


def folded(start: float, v: float, t: float) -> float:
    """Position between walls at 0 and 1 of a point that is reflected."""
    return abs((start + v * t + 1.0) % 2.0 - 1.0)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", BOUNCES)
def test_bounces_of_a_ball_form_a_geometric_series(ball, kind):
    run = ball.integrate([1.0], [0.0], h=0.1, t_end=12.72, events=BOUNCES[kind])
    (bounces,) = run.events
    fall = math.sqrt(2.0)
    exact = fall + 2.0 * fall * 0.8 * (1.0 - 0.8 ** np.arange(len(bounces))) / 0.2
    assert len(bounces) > 30
    assert np.abs(bounces.t - exact).max() < 1e-14
    assert np.abs(bounces.p[:, 0] / (-fall * 0.8 ** np.arange(len(bounces))) - 1.0).max() < 1e-11
    assert run.q.min() > -1e-14
    assert run.t[-1] == 12.72


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("e", [0.5, 0.8, 0.95])
def test_accumulation_ends_the_run_and_is_named(ball, e):
    """The ball does not fall through the floor where infinitely many bounces take a finite time."""
    exact = math.sqrt(2.0) * (1.0 + e) / (1.0 - e)
    with pytest.warns(sc.EventWarning, match="accumulate at t = ") as warned:
        run = ball.integrate([1.0], [0.0], h=0.1, t_end=exact + 10.0, events=sc.impact("y", e))
    named = float(str(warned[0].message).split("t = ")[1].split(" ")[0])
    assert abs(named - exact) < 2e-12
    assert exact - 1e-6 < run.t[-1] < exact
    assert run.q.min() > -1e-14


@pytest.mark.quick
def test_time_is_one_double_where_impacts_accumulate(ball):
    """The sum of steps of 0.1 has a low word, the time of the last impact has none."""
    run = ball.with_events(sc.impact("y", 0.5)).start([1.0], [0.0], h=0.1)
    run.advance(30)
    assert run.left_to(run.t) != 0.0
    with pytest.warns(sc.EventWarning, match="accumulate at t = "):
        run.advance(30)
    assert run.t < 3.0 * math.sqrt(2.0) < run.t + 1e-6
    assert run.left_to(run.t) == 0.0


def test_start_behind_a_wall(ball):
    """A start on the wall, up to rounding, and one behind a wall of finite size are inside the region."""
    for arguments in ({"t_end": 4.0}, {"h": 0.1, "steps": 3}):
        with pytest.raises(
            sc.EventError, match=r"behind the wall 'y', which is -0\.5 at t = 3 and must not be negative"
        ):
            ball.integrate([-0.5], [0.0], t=3.0, events=BOUNCES["impact"], **arguments)
    for y in (0.0, -1e-17):
        run = ball.integrate([y], [1.0], h=0.1, t_end=1.5, events=BOUNCES["impact"])
        assert not run.events[0]
    open_at_first = sc.impact("y", where="t > 2")
    run = ball.integrate([-0.5], [1.5], h=0.1, t_end=4.0, events=open_at_first)
    assert abs(run.events[0].t[0] - (1.5 + math.sqrt(1.25))) < 1e-14


@pytest.mark.covering
@pytest.mark.parametrize("t0", [0.0, 7e4])
@pytest.mark.parametrize("h", [50.0, 5.0, 0.5])
def test_corners_of_a_square_are_met_exactly(point, h, t0):
    """Both walls of a corner act, up to 40 bounces occur in a step."""
    walls = [sc.impact(g) for g in ("x", "y", "1 - x", "1 - y")]
    run = point.integrate([0.5, 0.5], velocity=[0.5, 0.3], t=t0, h=h, t_end=t0 + 400.0, events=walls)
    q = np.array([[folded(0.5, v, t - t0) for v in (0.5, 0.3)] for t in run.t])
    assert sum(map(len, run.events)) == 320
    assert sum(np.isin(run.events[0].t, np.concatenate([run.events[1].t, run.events[3].t]))) > 5
    assert np.abs(run.q - q).max() < (1e-13 if t0 == 0.0 else 2e-11)
    assert np.abs(run.q[-1] - [folded(0.5, v, 400.0) for v in (0.5, 0.3)]).max() < 1e-14


def test_moving_wall_accelerates_a_point():
    """Fermi-Ulam: times of impacts against a map iterated in 60 digits."""
    amplitude = 0.05
    walls = [sc.impact("y - sin(t)/20"), sc.impact("1 - y")]
    run = sc.compile_stepper(FREE, "svi:1", flags=FLAGS).integrate(
        [0.5], velocity=[0.3], h=0.05, t_end=190.0, events=walls
    )
    t = np.sort(np.concatenate([each.t for each in run.events]))
    with mp.workdps(60):
        y, v, now, a = mp.mpf("0.5"), mp.mpf(0.3), mp.mpf(0), mp.mpf(1) / 20
        for k in range(60):
            high, s = float(now + (1 - y) / v) if v > 0 else math.inf, float(now) + 1e-9
            while s < high and float(y) + float(v) * (s - float(now)) > amplitude * math.sin(s):
                s += 1e-3
            gap = lambda x, y=y, v=v, now=now: y + v * (x - now) - a * mp.sin(x)  # noqa: E731
            met = mp.findroot(gap, (s - 1e-3, s), solver="anderson", tol=1e-50) if s < high else now + (1 - y) / v
            y, v, now = y + v * (met - now), (2 * a * mp.cos(met) if s < high else 0) - v, met
            assert abs(t[k] - float(now)) < 3e-13


def test_energy_of_a_double_pendulum_at_a_wall():
    """The mass matrix depends on the state; impulses conserve energy to round-off, trajectories have order 16."""
    system = lagrange("double pendulum", "a b", "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)")
    stepper = sc.compile_stepper(system, "svi:8")
    wall = sc.impact("3/10 - sin(a) - sin(b)", terminal=60)
    run = stepper.integrate([-1.0, -0.5], [0.0, 0.0], h=0.2, t_end=1e4, events=wall)
    assert len(run.events[0]) == 60
    assert np.ptp(run.energy()) < 3e-14
    assert abs(run.events[0].t[20] - 97.0188870109503) < 1e-11
    adaptive = stepper.integrate([-1.0, -0.5], [0.0, 0.0], t_end=100.0, events=sc.impact("3/10 - sin(a) - sin(b)"))
    assert abs(adaptive.events[0].t[20] - 97.0188870109503) < 1e-10


def test_impulses_at_given_times_and_states_within_steps(ball):
    """A kick at t = 0.35 within a step; dense output and t_eval on both sides of it."""
    kick = sc.Event("t - 0.35", then={"p_y": "p_y + 2"})
    run = ball.integrate([0.0], [1.0], h=0.1, steps=10, events=kick)
    exact = lambda t: t - t * t / 2 + 2 * np.maximum(t - 0.35, 0.0)  # noqa: E731
    assert run.t.tolist() == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.35, *(0.1 * np.arange(4, 11))])
    assert np.abs(run.q[:, 0] - exact(run.t)).max() < 1e-15
    times = np.linspace(0.0, 1.0, 41)
    assert np.abs(run.at(times)[0][:, 0] - exact(times)).max() < 1e-15
    sparse = ball.integrate([0.0], [1.0], h=0.1, steps=10, events=kick, t_eval=times)
    assert np.abs(sparse.q[:, 0] - exact(times)).max() < 1e-15
    every = ball.integrate([0.0], [1.0], h=0.1, steps=10, events=kick, save_every=5)
    assert np.allclose(every.t, [0.0, 0.5, 1.0])
    assert np.array_equal(every.q[:, 0], run.q[[0, 6, 11], 0])
    last = ball.integrate([0.0], [1.0], h=0.1, t_end=0.97, events=kick)
    assert last.t[-1] == 0.97
    assert abs(last.q[-1, 0] - exact(0.97)) < 1e-15


def test_run_in_parts_equals_a_whole_one(ball):
    watched = ball.with_events(BOUNCES["impact"])
    whole = watched.integrate([1.0], [0.0], h=0.1, steps=60)
    run = watched.start([1.0], [0.0], h=0.1)
    run.advance(17)
    first = run.record(20)
    saved = run.snapshot
    run.record(30)
    run.rollback(saved)
    run = watched.from_checkpoint(run.checkpoint())
    run.advance(23)
    assert run.steps == 60
    assert first.t[0] == pytest.approx(1.7)
    assert np.array_equal(run.q, whole.q[-1])
    assert pickle.loads(pickle.dumps(watched)).events == watched.events
    some = watched.integrate([1.0], [0.0], h=0.1, steps=60, save_every=10)
    assert some.at(1.73)[0] == pytest.approx(whole.at(1.73)[0], abs=1e-15)
    third = ball.with_events(sc.impact("y", 0.8, terminal=3)).start([1.0], [0.0], h=0.1)
    assert [len(third.record(20).events[0]) for _ in range(3)] == [1, 1, 1]
    assert third.ended


def test_a_checkpoint_with_numbers_of_other_events_is_rejected(ball):
    run = ball.with_events(sc.impact("y", 0.9)).start([1.0], [0.0], h=0.1)
    run.advance(20)
    run._watch.accumulated = 2
    with pytest.raises(sc.StateError, match=r"invalid saved run: accumulated is 2, not a whole number from 0 to 1"):
        run.stepper.from_checkpoint(run.checkpoint())


def test_runs_backward_undo_impacts(ball):
    forth = ball.integrate([1.0], [0.0], h=0.1, t_end=8.0, events=BOUNCES["impact"])
    back = ball.integrate(forth.q[-1], forth.p[-1], t=8.0, h=-0.1, t_end=0.0, events=BOUNCES["impact"])
    assert len(back.events[0]) == len(forth.events[0]) == 4
    assert abs(back.q[-1, 0] - 1.0) < 1e-13


def test_maps_in_both_directions_act_once_at_each_crossing(ball):
    """Rounding leaves the new state on either side of the zero that it departs from."""
    one = ball.integrate([1.0], [0.0], h=0.1, t_end=60.0, events=sc.Event("y", then={"y_dot": "-y_dot"}))
    assert np.abs(one.events[0].t - math.sqrt(2.0) * (1 + 2 * np.arange(21))).max() < 1e-12
    event = sc.Event("y", then={"y_dot": "-0.01*y_dot"}, terminal=3)
    slow = ball.integrate([0.7], [0.0], h=1.0, steps=2, events=event)
    assert np.abs(slow.events[0].t - math.sqrt(1.4) * np.array([1.0, 1.02, 1.0202])).max() < 1e-12


@pytest.mark.parametrize(("y0", "e", "h"), [(1.0, 0.01, 0.3), (0.4875, 0.1545, 0.0562), (1.9522, 0.00775, 0.1552)])
def test_slow_departures_from_zeros_located_at_high_speed(ball, y0, e, h):
    """The residual of a located zero is that of the fast arrival, not of the slow departure after the map."""
    reverse = sc.Event("y", then={"y_dot": f"-{e}*y_dot"})
    fall = math.sqrt(2 * y0)
    t = fall * (1 + 2 * e + e * e)  # at the top of the second flight
    for steps in ({"h": h}, {}):
        run = ball.integrate([y0], velocity=[0.0], t_end=t, events=reverse, **steps)
        assert len(run.events[0]) == 2
        assert abs(run.q[-1, 0] - (fall * e * e) ** 2 / 2) < 1e-13


DROP = lagrange("drop", "x y", "(1 + x**2/9)*(x_dot**2 + y_dot**2)/2 - g*y - x**2*y/5", g=0.7)
FAULTS = {
    "impacts": ("lambda *= 0.5 * (1.0 + restitution);", "lambda *= 0.5000001 * (1.0 + restitution);"),
    "event surfaces": ("crossing->t = at.t;", "crossing->t = at.t; crossing->q[0] += 1e-9; at.q[0] += 1e-9;"),
    "none": ("", ""),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_certificates_measure_impacts(fault):
    """A planted error of 1e-7 of the impulse, or of 1e-9 of the state, is noticed."""
    events = (sc.impact("y + x**2/9 - sin(t)/40"), sc.impact("2 - x", where="y > 0"))
    plain = sc.compile_stepper(DROP, "svi:2", flags=FLAGS)
    source = with_events(plain.source, plain.interface, events)
    old, new = FAULTS[fault]
    texts = tuple((name, text.replace(old, new) if old else text) for name, text in source.beside.support)
    faulty = {WithEvents(events): replace(source, beside=replace(source.beside, support=texts))}
    variants = Variants(faulty, plain._variants.__getitem__, plain._variants.lacks)
    stepper = sc.Stepper(plain.source, plain.interface, flags=FLAGS, events=events, variants=variants)
    start = State(np.array([0.1, 1.0]), np.array([0.2, 0.0]), 0.0, 0.05)
    checks = list(impact_checks(SystemUnderTest(DROP, sc.SVI(2), stepper, None, start), stepper))
    names = {"event surfaces", "saltation", "impacts", "symplecticity, impacts", "reversal, impacts"}
    assert {each.name for each in checks} == names
    violated = {each.name for each in checks if each.outcome is not Outcome.SATISFIED}
    assert fault in violated if fault != "none" else not violated


@pytest.mark.sampled(2)
@pytest.mark.parametrize("flags", [("-O0",), ("-O3",)], ids=" ".join)
@pytest.mark.parametrize("restitution", [1.0, 0.9])
@pytest.mark.parametrize(
    "wall", ["y - cos(x)/3 - sin(3*t)/5", "y - x**2/4 - sin(2*t)/10", "(2 + sin(t)/5)**2 - x**2 - (y-2)**2"]
)
def test_impacts_on_moving_curved_walls_are_satisfied(wall, restitution, flags):
    """Bounds are from rounding alone, so that they hold for every optimisation and every approach speed."""
    ball = sc.LagrangianSystem.from_text("ball", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - y - x**2/8")
    stepper = sc.compile_stepper(ball, "svi:4", flags=flags, events=sc.impact(wall, restitution=restitution))
    start = State(np.array([0.3, 1.2]), np.array([0.4, -0.2]), 0.0, 0.05)
    with warnings.catch_warnings(action="ignore", category=sc.EventWarning):
        checks = list(impact_checks(SystemUnderTest(ball, sc.SVI(4), stepper, None, start), stepper))
    assert {each.outcome for each in checks} == {Outcome.SATISFIED}, checks
    (impacts,) = (each for each in checks if each.name == "impacts")
    assert impacts.measured < 2.0


def stiffness_changes(t: float) -> float:
    """Position of an oscillator that starts at 1 and whose stiffness is 4 for x < 0, 1 for x > 0."""
    t += np.pi / 2  # since x = 0
    t %= 1.5 * np.pi
    return np.sin(t) if t < np.pi else -np.sin(2 * (t - np.pi)) / 2


@pytest.mark.parametrize("plan", [{"h": 0.05}, {}])
def test_events_set_parameters(plan):
    system = sc.LagrangianSystem.from_text("gear", ["x"], "x_dot**2/2 - k*x**2/2", parameters={"k": 1.0})
    gears = [sc.Event("x", direction, then={"k": k}) for direction, k in ((-1, "4*k"), (1, 1))]
    stepper = sc.compile_stepper(system, "svi:4", events=gears)
    run = stepper.integrate([1.0], [0.0], t_end=10.0, **plan)
    np.testing.assert_allclose(run.q[:, 0], [stiffness_changes(t) for t in run.t], atol=2e-14)
    assert np.array_equal(run.modes.values, [[1], [4], [1], [4], [1]])
    times = np.linspace(0, 10, 77)
    np.testing.assert_allclose(run.at(times)[0][:, 0], [stiffness_changes(t) for t in times], atol=2e-14)
    np.testing.assert_allclose(run.energy(), 0.5, atol=1e-14)
    assert run[:5].modes.values.tolist() == [[1]]
    ensemble = stepper.integrate_ensemble([[0.5], [1.0]], [[0.0], [0.0]], t_end=10.0, **plan)
    assert np.array_equal(ensemble[1].q[-1], run.q[-1])
    part = stepper.start([1.0], [0.0], **(plan or {"t_end": 10.0}))
    part.advance(50)
    again = stepper.from_checkpoint(part.checkpoint(), **({} if plan else {"t_end": 10.0}))
    assert np.array_equal(again.record(60).q, part.record(60).q)
    assert part.parameters == run.modes.at(part.t, 1.0)
    with pytest.raises(sc.MethodError, match="sensitivity"):
        run.sensitivity()


def test_conditions_select_crossings(point):
    """A plate of finite length: a point that passes beside it is not reflected."""
    plate = sc.Event("y", then={"p_y": "-p_y"}, where=("x > 0", sympy.Symbol("x") < 1))
    for x, end in ((0.5, 0.5), (1.5, -0.5), (-0.5, -0.5)):
        run = point.integrate([x, 0.5], velocity=[0.0, -1.0], h=0.3, t_end=1.0, events=plate)
        assert run.q[-1, 1] == pytest.approx(end, abs=1e-15)
        assert len(run.events[0]) == (end > 0)


@pytest.mark.quick
@pytest.mark.parametrize("save_every", [1, 7])
def test_terminal_event_ends_a_run_after_the_change(ball, save_every):
    run = ball.integrate([1.0], [0.0], h=0.1, t_end=9.0, events=sc.impact("y", 0.8, terminal=3), save_every=save_every)
    assert run.steps == math.floor(run.t[-1] / 0.1)  # whole ones
    assert run.ended_by == sc.impact("y", 0.8, terminal=3)
    assert len(run.events[0]) == 3
    assert run.t[-1] == run.events[0].t[-1]
    assert run.p[-1, 0] == pytest.approx(-0.8 * run.events[0].p[-1, 0])


@pytest.mark.quick
def test_states_after_impacts_count_as_ends_of_adaptive_steps(ball):
    given = {"t_end": 7.0, "tolerance": 1e-3, "events": sc.impact("y", 0.8)}
    every, some = (ball.integrate([1.0], [0.0], save_every=k, **given) for k in (1, 3))
    rows = [*range(0, len(every), 3), *([len(every) - 1] if (len(every) - 1) % 3 else [])]
    assert len(every.events[0]) > 2
    assert np.array_equal(some.t, every.t[rows])
    assert np.array_equal(some.q, every.q[rows])


def test_energy_of_a_billiard_stays_at_round_off():
    """Rounding errors of 20,000 impulses of circular walls have the mean 0; without correction 2e-17 each adds up."""
    stepper = sc.compile_stepper(POINT, "svi:1", flags=FLAGS, events=STADIUM)
    run = stepper.integrate([0.3, -0.2], velocity=[0.8, 0.6], h=2.0, steps=22_000, save_every=2000)
    assert sum(map(len, run.events)) > 19_000
    energies = [(Fraction(x) ** 2 + Fraction(y) ** 2) / 2 for x, y in run.p.tolist()]
    assert max(abs(energy - energies[0]) for energy in energies) < 2e-14


CHAIN = sc.LagrangianSystem.from_text(
    name="chain",
    coordinates=["q[N]"],
    parameters={"m": 1.5, "e": 0.9, "b": 0.1},
    lagrangian="sum(i in N, m*q_dot[i]**2/2) - sum(i in N-1, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/20) + 0*(e+b)",
)


@pytest.mark.full
def test_wall_of_a_long_chain():
    """The reflected wave returns as that of a short chain: 10^4 coordinates are not compiled one by one."""
    stepper, ends = sc.compile_stepper(CHAIN, "svi:4", flags=FLAGS), []
    for n in (100, 10_000):
        q = np.exp(-(((np.arange(n) - 10.0) / 3.0) ** 2))
        run = stepper.integrate(q, velocity=0 * q, h=0.5, steps=40, save_every=40, events=sc.impact("1/2 - q[0]"))
        ends.append((run.events[0].t, run.q["q"][-1, :50]))
    assert len(ends[0][0]) > 0
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-13
    assert np.abs(ends[0][1] - ends[1][1]).max() < 1e-13


ROD = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["(x - b*sin(t))**2 + y**2 - 1"], b=0.0, e=1.0)
ANGLE = lagrange("angle", "a", "a_dot**2/2 + b*a_dot*cos(a)*cos(t) + cos(a)", b=0.0, e=1.0)


def chart(x, t):
    """Derivative of (q, p, b, e) of the rod by (a, p_a, b, e) of the angle, from the imaginary part of the function."""
    columns = []
    for k in range(4):
        a, p, b, e = np.array(x) + 1e-30j * (np.arange(4) == k)
        w = p - b * np.cos(a) * np.cos(t)
        state = b * np.sin(t) + np.sin(a), -np.cos(a), b * np.cos(t) + w * np.cos(a), w * np.sin(a), b, e
        columns.append(np.imag(state) / 1e-30)
    return np.array(columns).T


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("b", "e"), [(0.0, 1.0), (0.0, 0.8), (0.2, 1.0), (0.2, 0.7)])
def test_impacts_of_constrained_systems_equal_those_of_free_coordinates(b, e):
    """A pendulum as a point on a rod, also with a moving pivot, hits a moving wall and is kicked."""
    rod, angle = sc.compile_stepper(ROD, "svi:6"), sc.compile_stepper(ANGLE, "svi:6")
    y, x = ("y_dot", "a_dot") if e == 1.0 else ("p_y", "p_a")
    kicks = sc.Event("t - 7.7", then={y: f"{y} + 1/5"}), sc.Event("t - 7.7", then={x: f"{x} + sin(a)/5"})
    walls = sc.impact("3/10 + sin(2*t)/20 - x", "e"), sc.impact("3/10 + sin(2*t)/20 - b*sin(t) - sin(a)", "e")
    plan = {"h": 0.05, "t_end": 20.0, "parameters": {"b": b, "e": e}}
    a, w = -0.8, 0.9
    one = rod.integrate(
        [np.sin(a), -np.cos(a)], velocity=[b + w * np.cos(a), w * np.sin(a)], events=[walls[0], kicks[0]], **plan
    )
    two = angle.integrate([a], velocity=[w], events=[walls[1], kicks[1]], **plan)
    assert len(one.events[0]) == len(two.events[0]) > 3
    assert np.abs(one.events[0].t - two.events[0].t).max() < 1e-11
    end = two.q[-1, 0]
    assert np.abs(one.q[-1] - [b * np.sin(20.0) + np.sin(end), -np.cos(end)]).max() < 1e-11
    assert max(np.abs(each).max() for each in rod.constraint_values(one.q, one.p, one.t, plan["parameters"])) < 5e-15
    if e < 1.0:  # tangent vectors of the rod are images of those of the angle, at the start and at the end
        initial = chart((a, w + b * np.cos(a), b, e), 0.0)
        tangents = one.tangent(np.concatenate([initial, np.zeros((2, 4))]))
        found, row = tangents[-1], np.searchsorted(one.t, one.events[0].t[0])
        radius = one.q[row] - [b * np.sin(one.t[row]), 0.0]
        assert np.abs(radius @ tangents[row, :2, :2]).max() < 1e-11  # also after a change, within a step
        by_angle = np.concatenate([two.tangent(np.eye(6)[:, :4])[-1], np.eye(4)[2:]])
        expected = chart((end, two.p[-1, 0], b, e), 20.0)[:4] @ by_angle
        assert np.abs(found - expected).max() < 2e-11 * np.abs(expected).max()
        cotangents = np.zeros((len(one), 4))
        cotangents[-1] = 1.0, 2.0, 3.0, 4.0
        gradient = one.pullback(cotangents)
        adjoint = np.concatenate([gradient.q, gradient.p, gradient.parameters]) @ initial
        assert np.abs(adjoint - cotangents[-1] @ found).max() < 4e-13 * np.abs(found).max()


def test_impacts_with_a_time_transformation():
    """Reversible steps through close encounters, against adaptive ones."""
    kepler = lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2) + 0*e", e=0.97)
    arguments = {"velocity": [0.0, 0.5], "t_end": 6.0, "events": sc.impact("1/10 + x - y/5", "e")}
    plain = sc.compile_stepper(kepler, "svi:6").integrate([1.0, 0.0], **arguments)
    stepper = sc.compile_stepper(kepler, "svi:6", time_transformation="sqrt(x**2 + y**2)**(3/2)")
    run = stepper.integrate([1.0, 0.0], h=0.05, **arguments)
    assert len(run.events[0]) == len(plain.events[0]) > 5
    assert np.abs(run.events[0].t - plain.events[0].t).max() < 1e-11
    assert np.abs(run.q[-1] - plain.q[-1]).max() < 1e-10
    elastic = stepper.integrate([1.0, 0.0], h=0.05, parameters={"e": 1.0}, **arguments)
    assert np.ptp(elastic.energy()) < 1e-11
    tangents = [
        each.integrate(
            [1.0, 0.0], velocity=[0.0, 0.7], t_end=2.0, events=sc.impact("1/5 + x - y/5", "e"), **plan
        ).tangent()
        for each, plan in ((sc.compile_stepper(kepler, "svi:6"), {}), (stepper, {"h": 0.05}))
    ]
    assert np.abs(tangents[1][-1] - tangents[0][-1]).max() < 1e-8 * np.abs(tangents[0][-1]).max()


BODY = sc.LagrangianSystem.from_text(
    "body",
    coordinates=["x", "y", "z"],
    rotations={"R": "omega"},
    parameters={"A": 0.3, "B": 0.4, "C": 0.2},
    lagrangian="(x_dot**2 + y_dot**2 + z_dot**2)/2 + (A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2 - z",
)


def test_corners_of_a_rigid_body_hit_the_floor():
    """Energy and what the floor does not change are conserved; momenta stay tangent to the unit quaternions."""
    stepper = sc.compile_stepper(BODY, "svi:6")
    corners = [(0.5, 0.6, 0.2), (-0.5, 0.4, -0.3), (0.1, -0.6, 0.2)]
    run = stepper.integrate(
        {"x": 0.0, "y": 0.0, "z": 1.5, "R": [1, 0.2, 0.1, 0]},
        velocity={"x": 0.1, "y": 0.0, "z": 0.0, "omega": [0.3, 0.2, 0.5]},
        h=0.05,
        t_end=30.0,
        events=[sc.impact(f"z + {a}*R_31 + {b}*R_32 + {c}*R_33") for a, b, c in corners],
    )
    assert sum(map(len, run.events)) > 15
    assert np.ptp(run.energy()) < 1e-14
    spread = dict(zip(stepper.momentum_map_names, np.ptp(run.momentum_maps(), axis=0), strict=True))
    assert max(spread[name] for name in ("momentum of x", "momentum of y", "angular momentum z of R")) < 2e-15
    assert spread["angular momentum x of R"] > 0.1
    q, p = np.asarray(run.q)[:, 3:], np.asarray(run.p)[:, 3:]
    assert np.abs((q * p).sum(axis=1)).max() < 4e-15
    assert np.abs((q * q).sum(axis=1) - 1.0).max() < 2e-15
    lowest = [run.q[:, 2] + run.rotation("R")[:, 2] @ np.array(corner) for corner in corners]
    assert min(map(np.min, lowest)) > -1e-14


# Derivatives.

BOX = sc.LagrangianSystem.from_text(
    name="box",
    coordinates=["x", "y"],
    lagrangian="(x_dot**2 + y_dot**2)/2 - k*y - x**2*y**2/4 + 0*(e + b + c + a + w)",
    parameters={"k": 0.5, "e": 0.8, "b": 1.0, "c": 1.0, "a": 0.1, "w": 2.0},
)
ELLIPSE, FLOOR = sc.impact("1 - (x/2)**2 - (y - b)**2/c", "e"), sc.impact("y + 1 - a*sin(w*t) - x**2/5", "e")
SHIFT = sc.Event("y + b", -1, then={"p_y": "-e*p_y", "p_x": "p_x*(1 + a)", "x": "x + a*k"})
FORM = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])


def differences(run, z, values):
    """Derivatives of the end of a run by its initial state and parameters, by differences of sixth order."""
    columns = []
    for c in range(len(z) + len(values)):

        def end(u, c=c):
            state, others = z.copy(), dict(values)
            if c < len(z):
                state[c] += u
            else:
                others[list(others)[c - len(z)]] += u
            last = run(state, others)
            return np.concatenate([last.q[-1], last.p[-1]])

        halves = [(end(d) - end(-d)) / (2 * d) for d in (2.5e-5, 5e-5, 1e-4)]
        columns.append((64 * halves[0] - 20 * halves[1] + halves[2]) / 45)
    return np.array(columns).T


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("event", "method", "e", "tolerance"),
    [
        (ELLIPSE, "svi:2", 1.0, None),
        (ELLIPSE, "svi:8", 0.8, None),
        (ELLIPSE, "svi:8", 1.0, 1e-10),
        (FLOOR, "svi:8", 1.0, None),
        (SHIFT, "svi:4", 0.9, None),
    ],
    ids=["ellipse-2", "restitution", "adaptive", "moving", "map"],
)
def test_derivatives_are_those_of_the_computed_run(event, method, e, tolerance):
    stepper = sc.compile_stepper(BOX, method)
    values = dict(zip(stepper.parameters, stepper.defaults, strict=True)) | {"e": e}
    plan = {"h": 0.1 if method != "svi:8" else 0.2} if tolerance is None else {"tolerance": tolerance}

    def run(z, parameters):
        return stepper.integrate(z[:2], z[2:], t_end=12.0, events=event, parameters=parameters, **plan)

    z = np.array([0.3, 1.2, 0.8, 0.6])
    motion = run(z, values)
    assert len(motion.events[0]) >= 2
    derivatives = motion.sensitivity()
    found = np.hstack([derivatives.state[-1], derivatives.parameters[-1]])
    size = np.abs(found).max()
    assert np.abs(found - differences(run, z, values)).max() < 6e-11 * size
    cotangents = np.zeros((len(motion), 4))
    cotangents[-1] = 1.0, 2.0, 3.0, 4.0
    gradient = motion.pullback(cotangents)
    adjoint = np.concatenate([gradient.q, gradient.p, gradient.parameters])
    assert np.abs(adjoint - cotangents[-1] @ found).max() < 1e-13 * size
    matrix = derivatives.state[-1]
    if event is not SHIFT:
        assert np.linalg.det(matrix) == pytest.approx(e ** (2 * len(motion.events[0])), rel=1e-6)
    if e == 1.0 and method == "svi:8":
        assert np.abs(matrix.T @ FORM @ matrix - FORM).max() < 1e-10 * size


@pytest.mark.parametrize(
    "seed", [0, pytest.param(1, marks=pytest.mark.rotated), pytest.param(2, marks=pytest.mark.full)]
)
def test_derivatives_of_maps_of_velocities_are_those_of_the_computed_run(seed):
    """Masses depend on positions; the event, too, contains a velocity."""
    c = np.random.default_rng(seed).uniform(0.1, 0.4, 4)
    system = sc.LagrangianSystem.from_text(
        "coupled", ["x", "y"], "(1 + x**2/3)*x_dot**2/2 + y_dot**2/2 + c*x_dot*y_dot*cos(y) - x**2/2 - y**2 + 0*e",
        parameters={"c": c[0], "e": 0.8},
    )  # fmt: skip
    turn = sc.Event(f"y - {c[1]}*x_dot", then={"y_dot": f"e*y_dot + {c[2]}*x_dot", "x": f"x + {c[3]}*c*y_dot"})
    stepper = sc.compile_stepper(system, "svi:4")

    def run(z, parameters):
        return stepper.integrate(z[:2], z[2:], h=0.1, t_end=6.0, events=turn, parameters=parameters)

    z, values = np.array([0.7, 0.9, 0.2, 0.5]), {"c": float(c[0]), "e": 0.8}
    motion = run(z, values)
    assert len(motion.events[0]) >= 2
    derivatives = motion.sensitivity()
    computed = np.hstack([derivatives.state[-1], derivatives.parameters[-1]])
    assert np.abs(computed - differences(run, z, values)).max() < 1e-9 * np.abs(computed).max()


def test_derivatives_are_refused_where_they_do_not_exist(point, ball):
    grazing = point.integrate(
        [-3.0, 1.0 - 1e-14], velocity=[1.0, 0.0], h=0.37, t_end=6.0, events=sc.impact("x**2 + y**2 - 1")
    )
    assert len(grazing.events[0]) == 1
    with pytest.raises(sc.StateError, match="grazing"):
        grazing.tangent()
    corner = point.integrate(
        [0.5, 0.5], velocity=[1.0, 1.0], h=0.3, t_end=1.0, events=[sc.impact("1 - x"), sc.impact("1 - y")]
    )
    with pytest.raises(sc.StateError, match="corner"):
        corner.tangent()
    with pytest.raises(sc.StateError, match="save_every=1"):
        ball.integrate([1.0], [0.0], h=0.1, steps=20, save_every=5, events=BOUNCES["impact"]).tangent()
    with pytest.raises(sc.MethodError, match="hessian_product is not available with events"):
        corner.hessian_product(np.zeros((len(corner), 4)), np.eye(4))


@pytest.mark.parametrize("depth", [1e-2, 1e-6, 1e-10])
def test_grazing_impacts_are_found(point, depth):
    run = point.integrate(
        [-3.0, 1.0 - depth], velocity=[1.0, 0.0], h=0.37, t_end=6.0, events=sc.impact("x**2 + y**2 - 1")
    )
    assert len(run.events[0]) == 1
    assert abs(math.atan2(run.p[-1, 1], run.p[-1, 0]) - 2 * math.acos(1 - depth)) < 1e-16 / math.sqrt(depth) + 1e-15


# Messages.


def test_values_of_unknown_symbols_are_refused(ball):
    with pytest.raises(sc.EventError, match="'z' in the value 'z' of 'p_y'"):
        ball.integrate([1.0], [0.0], h=0.1, steps=30, events=sc.Event("y", then={"p_y": sympy.Symbol("z")}))
    ball.integrate([1.0], [0.0], h=0.1, steps=30, events=sc.Event("y", then={"p_y": "p_y"}, where="y > 1 - 1"))


def test_no_accuracy_warnings_of_energies_that_impacts_change(ball):
    with warnings.catch_warnings(action="error", category=sc.AccuracyWarning):
        sc.compile_stepper(BALL, "svi:4", flags=FLAGS).integrate(
            [1.0], [0.0], t_end=5.0, events=sc.impact("y", 0.5, terminal=3)
        )


# Model files and the command line.

MODEL = """
[system]
name = "ball"
coordinates = ["x", "y"]
lagrangian = "(x_dot**2 + y_dot**2)/2 - g*y"
[parameters]
g = 1.0
e = 0.8
[initial]
q = [0.0, 1.0]
q_dot = [1.0, 0.0]
[[events]]
function = "y"
restitution = "e"
[[events]]
function = "x - 3"
direction = 1
then = { p_x = "-p_x" }
where = "y >= 0"
[method]
method = "svi:2"
[run]
step = 0.1
span = 8.03
"""


def test_model_files_contain_events(tmp_path):
    model = parse_model(MODEL)
    assert parse_model(dump_model(model)) == model
    assert model.events == (sc.impact("y", "e"), sc.Event("x - 3", 1, then={"p_x": "-p_x"}, where="y >= 0"))
    run = model.integrate()
    assert [len(each) for each in run.events] == [4, 1]
    assert run.q[-1, 0] == pytest.approx(3.0 - 5.03, abs=1e-14)
    with pytest.raises(sc.ModelFileError, match=r"'were'.*did you mean 'where'"):
        parse_model(MODEL.replace("where", "were"))


@pytest.mark.parametrize("steps", ["step = 0.1\n", pytest.param("", marks=pytest.mark.full)])
def test_generated_programs_print_events(tmp_path, steps):
    """The C program and the Python package of a folder have the events of a run of the model."""
    model = parse_model(MODEL.replace("step = 0.1\n", steps).replace("8.03", "8.0"))
    run, folder = model.integrate(), sc.generate_package(model, tmp_path / "ball_c")
    printed = check_output(["make", "-s", "-C", folder, "run", "CFLAGS=-O1 -std=c99"], text=True).splitlines()
    found = [[float(line.split()[-1]) for line in printed if f"event {e.function} " in line] for e in model.events]
    last = [float(x) for x in [line for line in printed if line[0] != "#"][-1].split()[:5]]
    package, plan = sc.load_package(folder), {"t_end": 8.0} | ({"h": 0.1} if steps else {})
    assert package.events[0] == sc.impact("y", "e")
    for made in (run, package.integrate(model.q, velocity=model.velocity, **plan)):
        for times, each in zip(found, made.events, strict=True):
            assert np.abs(times - each.t).max() < 1e-13
        assert np.abs(last - np.hstack([made.t[-1], made.q[-1], made.p[-1]])).max() < 1e-13


def test_events_of_the_command_line_add_to_those_of_the_file(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(MODEL)
    derived = invoke("derive", path, "--event", "y - x**2 + t; restitution=1/2")
    assert "g = y = 0\n    p := p + (1 + e)/2 lambda n, H(q, p + lambda n) - H(q, p)" in derived.output
    assert "n = (0, 1), g_t = 0\n    e = e" in derived.output
    assert "n = (-2*x, 1), g_t = 1\n    e = 1/2" in derived.output
    assert "g = x - 3 = 0, y >= 0\n    p_x := -p_x" in derived.output
    assert "dz := R_z (dz + X- dt) + R_t dt - X+ dt" in derived.output
    page = derivation_html(parse_model(MODEL).system, sc.SVI(1), events=parse_model(MODEL).events)
    assert "lambda g_t = 0\n    n = (0, 1), g_t = 0" in page
    assert "--advise is not available with events that change the state" in error_of("run", path, "--advise", "1e-6")
    command = ["run", str(path), "--event", "t - 6; terminal=1", "--event", "y - 1/2; direction=1; p_y=p_y/2"]
    result = invoke(*command)
    assert "event y: 3 crossings" in result.output
    assert "to t = 6;" in result.output
    assert "event y - 1/2:" in result.output
    assert "NOT conserved" not in result.output


@pytest.mark.quick
def test_backward_runs_invert_impacts_and_apply_changes_as_written():
    """A run backward in time returns through an impact to its start; ``then=`` is no inverse of itself."""
    returned = []
    for event in (sc.impact("y", 0.8), sc.Event("y", direction=-1, then={"p_y": "-4*p_y/5"})):
        ball = sc.compile_stepper(BALL, "svi:2", flags=FLAGS, events=[event])
        there = ball.integrate([1.0], [0.0], t_end=2.0)
        back = ball.integrate(there.q[-1], there.p[-1], t=2.0, t_end=0.0)
        assert [len(run.events[0]) for run in (there, back)] == [1, 1]
        returned.append(float(back.q[-1, 0]))
    assert returned[0] == pytest.approx(1.0, abs=1e-12)
    assert abs(returned[1] - 1.0) > 0.1


@pytest.mark.second
@pytest.mark.parametrize(
    "event",
    [
        sc.impact("x + 1/2 - sin(t)/9", restitution="4/5 + x*y/10"),
        sc.Event("y - t/50", then={"p_x": "p_x + y*x/9 + x"}),
    ],
    ids=["impact", "change"],
)
def test_derivatives_of_runs_backward_are_differences_and_those_of_impacts_the_inverse(event: sc.Event) -> None:
    """A moving wall whose restitution depends on the state, and a change of momentum, with a mass matrix."""
    system = lagrange("w", "x y", "x_dot**2*(1 + y**2)/2 + y_dot**2/2 - x**2 - y**2/2 - x*y/3")
    stepper, start = sc.compile_stepper(system, "svi:6", events=event), np.array([1.0, 0.4, 0.3, -0.2])

    def run(state: np.ndarray, t: float, t_end: float) -> sc.Trajectory:
        return stepper.integrate(state[:2], state[2:], t=t, t_end=t_end, check_growth=False)

    def end(state: np.ndarray, t: float, t_end: float) -> np.ndarray:
        return np.concatenate(run(state, t, t_end)[-1][1:])

    there, late = run(start, 0.0, 5.0), end(start, 0.0, 5.0)
    back = run(late, 5.0, 0.0)
    assert min(len(each.events[0]) for each in (there, back)) >= 1
    matrix, moves = back.tangent(np.eye(4))[-1], 1e-6 * np.eye(4)
    columns = [(end(late + move, 5.0, 0.0) - end(late - move, 5.0, 0.0)) / 2e-6 for move in moves]
    assert matrix == pytest.approx(np.array(columns).T, rel=1e-6, abs=1e-7)
    if event.is_wall:
        assert matrix @ there.tangent(np.eye(4))[-1] == pytest.approx(np.eye(4), abs=1e-8)


@pytest.mark.second
@pytest.mark.parametrize("steps", [{"h": 0.1}, {"tolerance": 1e-8}], ids=["fixed", "adaptive"])
def test_walls_that_a_start_touches_have_derivatives(steps: dict[str, float]) -> None:
    """A free body from a wall that it approaches: x = e (x0 + v t) behind it, as from beside it."""
    body = sc.LagrangianSystem.from_text("body", ["x"], "x_dot**2/2")
    stepper = sc.compile_stepper(body, "svi:2", events=[sc.Event("x", direction=-1, restitution=0.5)])
    run = stepper.integrate([0.0], velocity=[-1.0], t_end=1.0, **steps)
    assert run.q[-1, 0] == pytest.approx(0.5, rel=1e-14)
    assert run.tangent(np.eye(2))[-1] == pytest.approx(np.array([[-0.5, -0.5], [0.0, -0.5]]), abs=1e-9)


@pytest.mark.parametrize("length", [1e-3, 1.0, 1e3])
def test_errors_of_rebounds_to_rest_are_rounding(length):
    """Flights are parabolas, which each degree has exactly; what is left of a velocity is no size."""
    ball = sc.LagrangianSystem.from_text("ball", ["z"], "z_dot**2/2 - g*z", parameters={"g": 9.81 * length})
    stepper = sc.compile_stepper(ball, "svi:2", contacts=[sc.contact("z", restitution=0.5)])
    run = stepper.integrate([length], velocity=[0.0], h=0.013, t_end=3.0)
    assert run.step_error < 1e-14
    assert abs(run.q[-1, 0]) < 1e-15 * length
