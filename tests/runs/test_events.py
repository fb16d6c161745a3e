"""Zero crossings: none missed, none twice, at exact times, in the order of the run."""

import math
import pickle

import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from notation import hamilton, lagrange
from sympy.physics.mechanics import dynamicsymbols

import scvi_codegen as sc
from scvi_codegen.methods.method import Method
from scvi_codegen.runs.stepping import compiled_method
from scvi_codegen.systems.event import as_events
from scvi_codegen.systems.system import MechanicalSystem

pytestmark = pytest.mark.rotated

FLAGS = ("-O0",)
FREE = sc.LagrangianSystem.from_text(name="free particle", coordinates=["q"], lagrangian="q_dot**2/2")


def compiled_plainly(system: MechanicalSystem, method: Method) -> sc.Stepper:
    """Most of the time of these tests is the compiler's: each list of events is compiled."""
    return sc.compile_stepper(system, method, flags=FLAGS)


@pytest.fixture(scope="module")
def pendulum() -> sc.Stepper:
    return compiled_plainly(sc.problem("planar-pendulum").system, sc.SVI(8))


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return compiled_plainly(sc.problem("kepler").system, sc.SVI(8))


def at_perihelion(e: float) -> dict[str, list[float]]:
    return {"q": [1 - e, 0.0], "p": [0.0, math.sqrt((1 + e) / (1 - e))]}


# None missed.


@pytest.fixture(scope="module")
def polynomials() -> sc.Stepper:
    """Functions of time whose roots are parameters, of degree 1 to 4, 8, and one with two roots near each other."""
    names = "abcdefgh"
    factors = [f"(t - {name})" for name in names]
    system = lagrange("free particle", "q", "q_dot**2/2", parameters=dict.fromkeys([*names, "s"], 1.0))
    functions = ["s*" + "*".join(factors[:degree]) for degree in (1, 2, 3, 4, 8)]
    near = "s*((t - a)**2 - b**2)*(2 + t)*(3 - t)"
    return sc.compile_stepper(system, sc.StoermerVerlet(), flags=FLAGS, events=[*functions, near])


@settings(max_examples=300, deadline=None)
@given(
    st.lists(st.integers(1, 199), min_size=4, max_size=4, unique=True),
    st.sampled_from([1.0, -7.0, 1e-30]),
    st.sampled_from([1.0, -1.0]),
)
def test_all_roots_of_polynomials_of_degree_four_are_found(polynomials, numbers, scale, h):
    roots = h * np.array(numbers) / 200
    values = dict(zip("abcd", roots, strict=True)) | {"s": scale}
    run = polynomials.integrate([0.0], [1.0], h=h, steps=1, parameters=values)
    for degree, found in enumerate(run.events[:4], 1):
        assert len(found) == degree
        assert np.abs(found.t - h * np.sort(np.abs(roots[:degree]))).max() < 1e-9


def test_few_roots_of_polynomials_of_degree_eight_are_missed(polynomials):
    """Polynomials of degree 4 cannot resolve all of eight roots in one step: a measured share is found."""
    generator = np.random.default_rng(8)
    found = 0
    for _ in range(500):
        roots = dict(zip("abcdefgh", generator.choice(np.arange(1, 200), 8, replace=False) / 200, strict=True))
        count = len(polynomials.integrate([0.0], [1.0], h=1.0, steps=1, parameters=roots).events[4])
        assert count % 2 == 0
        found += count
    assert found > 0.98 * 500 * 8


@pytest.mark.rotated
@settings(max_examples=200, deadline=None)
@given(st.floats(0.15, 0.85), st.integers(1, 7), st.sampled_from([1.0, -1.0]))
def test_pairs_of_close_roots_are_found(polynomials, middle, exponent, sign):
    distance = 10.0**-exponent
    values = {"a": middle, "b": distance, "s": sign}
    found = polynomials.integrate([0.0], [1.0], h=1.0, steps=1, parameters=values).events[5]
    assert np.abs(found.t - [middle - distance, middle + distance]).max() < 1e-15 / distance


def test_tangency_gives_two_crossings_or_none():
    """The angle just below and just above its amplitude, which lies within a step."""
    system = lagrange("pendulum", "q", "q_dot**2/2 + cos(q)", level=0.0)
    stepper = sc.compile_stepper(system, sc.SVI(8), flags=FLAGS, events=["p_q", "q - level"])
    start = {"q": [0.0], "p": [1.0], "h": 0.37, "steps": 5}
    (turn, _) = stepper.integrate(**start).events
    top = float(turn.q[0, 0])
    for depth in (1e-4, 1e-8, 1e-12):
        below, above = (
            stepper.integrate(**start, parameters={"level": top + side * depth}).events[1].t for side in (-1, 1)
        )
        assert (len(below), len(above)) == (2, 0)
        assert np.abs(below - turn.t[0]).max() == pytest.approx(math.sqrt(2 * depth / math.sin(top)), 1e-3)


def test_several_events_of_one_step_are_ordered_without_duplicates():
    functions = ["t - 0.25", "t - 0.5", "t - 0.75", "(t - 0.5)*(t - 1)"]
    run = sc.compile_stepper(FREE, sc.SVI(2), flags=FLAGS).integrate([0.0], [1.0], h=0.25, steps=8, events=functions)
    expected = ([0.25], [0.5], [0.75], [0.5, 1.0])
    for found, times in zip(run.events, expected, strict=True):
        assert found.t.tolist() == pytest.approx(times, rel=4e-16)


def test_root_at_the_start_is_ignored_and_one_at_the_end_is_found():
    stepper = sc.compile_stepper(FREE, sc.SVI(2), flags=FLAGS)
    run = stepper.integrate([0.0], [1.0], h=0.25, steps=8, events=["q", "q - 2", "t"])
    assert [found.t.tolist() for found in run.events] == [[], [2.0], []]


def test_more_crossings_than_the_buffer_of_one_call(pendulum):
    run = pendulum.integrate([0.1], [0.0], h=0.5, steps=3000, events=["sin(8*t)", "cos(8*t)"])
    for found, first in zip(run.events, (0.0, 0.5), strict=True):
        expected = math.pi / 8 * np.arange(first, 1500 * 8 / math.pi)
        expected = expected[expected > 0]
        assert np.abs(found.t - expected).max() < 1e-11


# Directions, ends, restarts.


@pytest.mark.parametrize("save_every", [1, 7, 1000])
def test_a_terminal_event_ends_the_run_at_its_crossing(pendulum, save_every):
    plain = pendulum.integrate([0.5], [0.0], h=0.1, steps=400)
    run = pendulum.integrate(
        [0.5], [0.0], h=0.1, steps=400, save_every=save_every, events=["p_q", sc.Event("q", terminal=3)]
    )
    last = run.events[1]
    assert len(last) == 3
    assert run.t[-1] == last.t[-1]
    assert np.array_equal(run.q[-1], last.q[-1])
    assert run.ended_by == sc.Event("q", terminal=3)
    assert np.array_equal(run.q[:-1], plain.q[: len(run) * save_every : save_every][: len(run) - 1])
    assert run.t[-2] < run.t[-1] < run.t[-2] + 0.1 * save_every
    assert run.events[0].t[-1] < last.t[-1]


@pytest.mark.quick
def test_run_ends_before_the_step_of_the_terminal_event(pendulum):
    run = pendulum.with_events(sc.Event("q", terminal=True)).start([0.5], [0.0], h=0.1)
    first = run.record(400)
    assert run.t == first.t[-2]
    assert run.record(400).t.tolist() == [first.t[-2], first.t[-1]]


def test_run_from_a_crossing_does_not_repeat_it(pendulum):
    q, p, t, found = [0.5], [0.0], 0.0, []
    whole = pendulum.integrate(q, p, h=0.1, steps=400, events="q").events[0].t
    for _ in whole:
        run = pendulum.integrate(q, p, h=0.1, steps=400, t=t, events=sc.Event("q", terminal=True))
        q, p, t = run.q[-1], run.p[-1], run.t[-1]
        found.append(t)
    assert np.abs(found - whole).max() < 1e-11


def test_terminal_event_before_a_failing_step_is_found():
    runaway = sc.LagrangianSystem.from_text(name="runaway", coordinates=["q"], lagrangian="q_dot**2/2 + q**3/3")
    stepper = compiled_plainly(runaway, sc.SVI(3))
    with pytest.raises(sc.StepFailedError) as failure:
        stepper.integrate([1.0], [1.0], h=0.1, steps=100, events="q - 5")
    assert len(failure.value.trajectory.events[0]) == 1
    run = stepper.integrate([1.0], [1.0], h=0.1, steps=100, events=sc.Event("q - 5", terminal=True))
    assert run.q[-1, 0] == pytest.approx(5, abs=1e-14)


def test_events_do_not_change_the_states(kepler):
    start = at_perihelion(0.5) | {"h": 0.1, "steps": 10_000}
    plain, watched = kepler.integrate(**start), kepler.integrate(**start, events="q1")
    for name in ("t", "q", "p", "iterations"):
        assert np.array_equal(getattr(plain, name), getattr(watched, name))
    sparse = kepler.integrate(**start, save_every=9), kepler.integrate(**start, save_every=9, events="q1")
    for name in ("t", "q", "p", "iterations"):
        assert np.array_equal(getattr(sparse[0], name), getattr(sparse[1], name))
    assert np.array_equal(plain.crossings("q1")[0].t, watched.events[0].t)
    with pytest.raises(sc.StateError, match="save_every > 1"):
        sparse[0].crossings("q1")


def test_crossings_are_found_afterwards_up_to_the_terminal_event(kepler):
    run = kepler.integrate(**at_perihelion(0.5), h=0.3, steps=100, events=["q1", sc.Event("q2 + q1/9", terminal=3)])
    again = run.crossings(["q1", "q2 + q1/9"])
    for found, expected in zip(again, run.events, strict=True):
        assert np.abs(found.t - expected.t).max() < 1e-13


def test_momenta_of_hamiltonians_have_user_defined_names():
    system = hamilton("pendulum", "q", "J**2/2 - cos(q)", momenta="J")
    run = compiled_plainly(system, sc.SVI(4)).integrate([1.0], [0.0], h=0.1, steps=100, events=["J", "q_dot", "q"])
    twin = compiled_plainly(sc.problem("planar-pendulum").system, sc.SVI(4)).with_events(["p_q", "q"])
    expected = twin.integrate([1.0], [0.0], h=0.1, steps=100).events
    assert np.array_equal(run.events[0].t, run.events[1].t)
    assert np.abs(run.events[0].t - expected[0].t).max() < 1e-12
    assert np.abs(run.events[2].t - expected[1].t).max() < 1e-12


def test_point_vortices_have_no_velocity_kernel():
    vortices = sc.problem("point-vortices")
    stepper = compiled_plainly(vortices.system, sc.SVI(3))
    name = stepper.coordinates[0]
    run = stepper.integrate(vortices.q, vortices.p, h=0.05, steps=200, events=[f"{name}_dot", name])
    q, p = run.events[0].q, run.events[0].p
    rates = [stepper.velocity(*state)[0] for state in zip(q, p, strict=True)]
    assert len(rates) > 0
    assert np.abs(rates).max() < 1e-12


def test_events_from_sympy_functions_of_time():
    theta, t = dynamicsymbols("theta"), dynamicsymbols._t
    system = sc.LagrangianSystem.from_sympy(
        name="pendulum", lagrangian=theta.diff(t) ** 2 / 2 + sympy.cos(theta), coordinates=[theta]
    )
    events = [theta.diff(t) * theta, "theta_dot*theta", sympy.Symbol("theta") - 0.1]
    run = compiled_plainly(system, sc.SVI(4)).integrate([1.0], [0.0], h=0.1, steps=100, events=events)
    assert np.array_equal(run.events[0].t, run.events[1].t)
    assert np.abs(run.events[2].q - 0.1).max() < 1e-14


@pytest.mark.tiers(6, 6)
@pytest.mark.parametrize(
    ("event", "error", "words"),
    [
        ("qq", sc.ExpressionError, "did you mean 'q'"),
        ("q - ", sc.ExpressionError, "column"),
        (sympy.Symbol("z"), sc.EventError, "'z'"),
        ("2*m - m - m", sc.EventError, "constant"),
        (sympy.Mod(sympy.Symbol("q"), 2), sc.EventError, "Mod.*not supported"),
        (3.0, sc.EventError, "not 3.0"),
        ("log(q)", sc.EventError, "not finite"),
    ],
)
def test_errors_name_the_symbol_or_function(pendulum, event, error, words):
    with pytest.raises(error, match=words):
        pendulum.integrate([0.5], [0.0], h=0.1, steps=100, events=event)


def test_stepper_with_events_is_pickled(pendulum):
    watched = pickle.loads(pickle.dumps(pendulum.with_events([sc.Event("q", 1), "p_q"])))
    assert watched.events == (sc.Event("q", 1), sc.Event("p_q"))
    assert [len(found) for found in watched.integrate([0.5], [0.0], h=0.1, steps=200).events] == [3, 6]
    assert pendulum.events == ()
    assert watched.with_events(()).source == pendulum.source


def test_a_stepper_may_be_compiled_with_events():
    stepper = sc.compile_stepper(FREE, sc.SVI(2), flags=FLAGS, events=sc.Event("q - 1", terminal=True))
    assert "free_particle" in stepper.source.prefix
    assert stepper.integrate([0.0], [1.0], h=0.3, steps=10).t[-1] == pytest.approx(1.0, abs=1e-15)
    assert stepper.integrate([0.0], [1.0], h=0.3, steps=10, events=()).t[-1] == pytest.approx(3.0)


def test_simultaneous_crossings_are_ordered_within_the_step():
    """An ulp of t = 1e12 is 1.2e-4 long: the wall behind the other is met 1e-6 later."""
    stepper = compiled_plainly(FREE, sc.SVI(2))
    events = [sc.Event("q - 1.000001", terminal=True), sc.Event("q - 1", terminal=True)]
    run = stepper.integrate([0.5], [1.0], t=1e12, h=1.0, steps=1, events=events)
    assert [len(found) for found in run.events] == [0, 1]
    assert abs(run.q[-1, 0] - 1.0) < 1e-15


def test_equal_events_are_parsed_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Events of many calls do not exhaust the memory."""
    system = sc.LagrangianSystem.from_text(name="falling", coordinates=["q"], lagrangian="q_dot**2/2 - q")
    stepper = sc.compile_stepper(system, "svi:2")
    first = stepper.with_events("q - 1")
    assert stepper.with_events(["q - 1"]) is first
    assert stepper.with_events(sc.Event("q - 1", terminal=True)) is not first
    monkeypatch.setattr("scvi_codegen.codegen.rendering.events.with_events", lambda source, *_: source)
    for k in range(40):
        stepper.with_events(f"q - {k}")
    assert len(stepper._event_variants) == compiled_method.MOST_EVENT_SETS


@pytest.mark.quick
def test_tuples_of_events_and_conditions_are_those_of_lists():
    inner = sc.Event("x", where="where(y > 0, 1, x) >= max(x, where(x < y, 2, 3))")
    assert inner.conditions == ("(where(y > 0, 1, x)) - (max(x, where(x < y, 2, 3)))",)
    wall, where = sc.Event("x", where=["y > 0", "y < 2"]), ("y > 0", "y < 2")
    assert wall.where == sc.Event("x", where=where).where == where
    assert [each.function for each in as_events(("x", wall))] == [each.function for each in as_events(["x", wall])]
    assert as_events(wall) == (wall,)
