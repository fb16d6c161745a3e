"""Events of arrays of run-time sizes: a function for each element of loops, without a limit of size."""

import warnings

import numpy as np
import pytest
from notation import lagrange
from rows_of_bodies import positions_after

import scvi_codegen as sc
from scvi_codegen.runs.events import detection

pytestmark = pytest.mark.rotated

FLAGS = ("-O1",)
GAS = lagrange("gas", ["r[N, 2]"], "sum(i in N, (r_dot[i, 0]**2 + r_dot[i, 1]**2)/2 + 0*d)", d=0.25)
CHAIN = sc.LagrangianSystem.from_text(
    name="chain",
    coordinates=["q[N]"],
    parameters={"m": 1.5, "e": 0.9, "b": 0.1},
    lagrangian="sum(i in N, m*q_dot[i]**2/2 + 0*(e+b)) - sum(i in N-1, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/20)",
)
BOX = [sc.impact("r[i, k] for i in N, k in 2"), sc.impact("1 - r[i, k] for i in N, k in 2")]


@pytest.fixture(scope="module")
def gas():
    return sc.compile_stepper(GAS, "svi:1", flags=FLAGS)


def folded(r, v, t):
    """Position between walls at 0 and 1 of a point that is reflected."""
    return np.abs((r + v * t + 1.0) % 2.0 - 1.0)


@pytest.mark.second
def test_a_box_of_particles(gas):
    """Each particle is reflected by itself; elements are numbered along the loops."""
    random = np.random.default_rng(2)
    r, v = random.random((40, 2)), random.normal(size=(40, 2))
    run = gas.integrate({"r": r}, velocity={"r": v}, h=0.05, steps=20, events=BOX)
    assert np.abs(run.q["r"][-1] - folded(r, v, 1.0)).max() < 1e-14
    low, high = np.floor(r + v).reshape(-1) < 0, np.floor(r + v).reshape(-1) > 0
    assert set(np.flatnonzero(low)) <= set(run.events[0].element)
    assert set(np.flatnonzero(high)) <= set(run.events[1].element)
    for each, wall in zip(run.events, (0.0, 1.0), strict=True):
        places = np.asarray(each.q)[np.arange(len(each)), each.element]
        assert np.abs(places - wall).max() < 1e-14
    assert abs(np.sum(run.p["r"][-1] ** 2) / np.sum(v**2) - 1.0) < 1e-14


@pytest.mark.second
def test_a_restored_run_continues_with_its_events(gas):
    run = gas.with_events(BOX).start({"r": [[0.3, 0.6], [0.8, 0.2]]}, velocity={"r": [[0.5, -0.3], [1.0, 0.7]]}, h=0.1)
    run.advance(20)
    restored = gas.with_events(BOX).from_checkpoint(run.checkpoint())
    one, two = run.record(20), restored.record(20)
    assert np.array_equal(one.q["r"], two.q["r"])
    assert sum(len(each) for each in two.events) == sum(len(each) for each in one.events) > 0


@pytest.mark.second
def test_discs_exchange_momentum_in_pairs(gas):
    """Hard discs: energy and momentum are those of the start, and every crossing is that of the pair it names."""
    random = np.random.default_rng(4)
    r, v = np.stack(np.meshgrid(*[np.arange(3.0) / 2] * 2), -1).reshape(-1, 2), random.normal(size=(9, 2))
    discs = sc.impact("(r[i, 0] - r[j, 0])**2 + (r[i, 1] - r[j, 1])**2 - d**2 for i < j in N")
    run = gas.integrate({"r": r}, velocity={"r": v}, h=0.03, steps=150, events=discs)
    (each,), pairs = run.events, np.transpose(np.triu_indices(9, 1))
    assert len(each) > 2
    q = np.asarray(each.q).reshape(-1, 9, 2)
    i, j = pairs[each.element].T
    gaps = q[np.arange(len(q)), i] - q[np.arange(len(q)), j]
    assert np.abs(np.hypot(*gaps.T) - 0.25).max() < 1e-13
    p = run.p["r"][-1]
    assert np.abs(p.sum(axis=0) - v.sum(axis=0)).max() < 1e-14
    assert abs(np.sum(p**2) / np.sum(v**2) - 1.0) < 1e-14


def test_impacts_pass_through_discs_that_touch(gas):
    """Newton's cradle: the first disc stops, the last one leaves with its velocity, in one step and at once."""
    r, v = np.array([[0.0, 0.5], [0.5, 0.5], [0.75, 0.5], [1.0, 0.5]]), np.array([[1.0, 0.0], *[[0.0, 0.0]] * 3])
    row = sc.impact("r[i+1, 0] - r[i, 0] - d for i in N-1")
    run = gas.integrate({"r": r}, velocity={"r": v}, h=0.3, steps=2, events=row)
    assert np.abs(run.p["r"][-1] - v[::-1]).max() < 1e-15
    assert sorted(run.events[0].element) == [0, 1, 2]
    assert np.ptp(run.events[0].t) == 0.0


@pytest.mark.second
def test_random_rows_of_bodies_that_touch_approach_and_stick():
    """Bodies that touch and approach at the start collide then; those that stick without restitution move together."""
    text = "sum(i in 5, m[i]*x_dot[i]**2)/2"
    system = sc.LagrangianSystem.from_text("row", ["x[5]"], text, parameters={"m[5]": [1.0] * 5, "e": 1.0})
    stepper = sc.compile_stepper(system, "svi:2", flags=FLAGS, events=[sc.impact("x[i+1]-x[i]-1 for i in 4", "e")])
    judged = 0
    for case in range(120):
        random = np.random.default_rng([94, case])
        m, e = 10.0 ** random.uniform(-1.0, 1.0, 5), (1.0, 0.0, random.uniform(0.3, 1.0))[case % 3]
        gaps = random.uniform(0.01, 0.5, 4) * (random.random(4) < random.choice([0.5, 1.0]))
        x, v = np.concatenate([[0.0], np.cumsum(1.0 + gaps)]), random.normal(size=5)
        plan = {"h": 10.0 ** random.uniform(-1.5, -0.5)} if case % 2 else {"tolerance": 1e-8}
        right, beside = (positions_after(x + nudge * np.arange(5), v, m, e, 2.0) for nudge in (0.0, 1e-12))
        if np.abs(right - beside).max() > 1e-9:
            continue  # where the order of impacts counts
        with warnings.catch_warnings(action="ignore", category=sc.EventWarning):
            run = stepper.integrate({"x": x}, velocity={"x": v}, parameters={"m": m, "e": e}, t_end=2.0, **plan)
        judged += run.t[-1] == 2.0  # impacts accumulate in some
        assert run.t[-1] < 2.0 or np.abs(run.q["x"][-1] - right).max() < 1e-9
    assert judged > 100


@pytest.mark.second
def test_more_impacts_in_a_step_than_memory_for_them(gas, monkeypatch):
    """A step whose crossings do not fit is repeated: 20 impacts at different times in one step, and memory for 8."""
    monkeypatch.setattr(detection, "INITIAL_CAPACITY", 8)
    r = np.column_stack([np.linspace(0.01, 0.4, 20), np.full(20, 0.5)])
    v = np.tile([-1.0, 0.0], (20, 1))
    run = gas.integrate({"r": r}, velocity={"r": v}, h=0.5, steps=2, save_every=2, events=BOX)
    assert len(run.events[0]) == 20
    assert np.abs(run.q["r"][-1] - folded(r, v, 1.0)).max() < 1e-14


def test_an_event_of_every_element_equals_events_of_entries():
    """Conditions, maps of velocities and restitution in loops, their derivatives, and adaptive steps."""
    stepper, n = sc.compile_stepper(CHAIN, "svi:4", flags=FLAGS), 4
    known = stepper.with_sizes(N=n)
    q, v = np.linspace(0.2, 1.0, n), np.cos(3.0 * np.arange(n))
    loops = [
        sc.impact("13/10 + b - q[i] for i in N", "e", where="q_dot[i] > q[0]/9"),
        sc.Event("q[i] + 1/2 for i in 1..N-1", -1, then={"q_dot[i]": "-e*q_dot[i] + q[i-1]/99"}, where="q[i] < 3"),
    ]
    single = [sc.impact(f"13/10 + b - q_{i}", "e", where=f"q_{i}_dot > q_0/9") for i in range(n)]
    single += [
        sc.Event(f"q_{i} + 1/2", -1, then={f"q_{i}_dot": f"-e*q_{i}_dot + q_{i - 1}/99"}, where=f"q_{i} < 3")
        for i in range(1, n)
    ]
    for plan in ({"h": 0.1, "steps": 60}, {"t_end": 6.0, "tolerance": 1e-11}):
        one = stepper.integrate(q, velocity=v, events=loops, **plan)
        two = known.integrate(q, velocity=v, events=single, **plan)
        assert [len(each) for each in one.events] == [sum(map(len, two.events[:n])), sum(map(len, two.events[n:]))]
        assert min(map(len, one.events)) > 0
        same = known.integrate(q, velocity=v, events=loops, **plan)
        assert np.array_equal(same.q["q"], two.q["q"])
        assert [each.element.tolist() for each in same.events] == [each.element.tolist() for each in one.events]
        assert np.abs(one.q["q"][-1] - np.asarray(two.q)[-1]).max() < (1e-13 if "h" in plan else 1e-8)
    runs = [
        stepper.integrate(q, velocity=v, h=0.1, steps=30, events=sc.impact("13/10 + b - q[i] for i in N", "e")),
        known.integrate(
            q, velocity=v, h=0.1, steps=30, events=[sc.impact(f"13/10 + b - q_{i}", "e") for i in range(n)]
        ),
    ]
    tangents = [np.asarray(run.tangent()[-1]) for run in runs]
    assert np.abs(tangents[0] - tangents[1]).max() < 1e-11 * np.abs(tangents[1]).max()


@pytest.mark.parametrize("of_known_sizes", [False, pytest.param(True, marks=pytest.mark.full)])
def test_gradients_through_events_of_elements(of_known_sizes):
    """The adjoint equals the tangents to round-off, and extrapolated differences of the run."""
    stepper, n = sc.compile_stepper(CHAIN, "svi:4", flags=FLAGS), 4
    stepper = stepper.with_sizes(N=n) if of_known_sizes else stepper
    loops = [
        sc.impact("13/10 + b - q[i] for i in N", "e"),
        sc.Event("q[i] + 1/2 for i in 1..N-1", -1, then={"p_q[i]": "-e*p_q[i] + q[i-1]/99"}),
    ]
    q, w = np.linspace(0.2, 1.0, n), np.cos(np.arange(2 * n) + 1.0)
    x = np.concatenate([q, 1.5 * np.cos(3.0 * np.arange(n)), [1.5, 0.9, 0.1]])

    def run_from(x):
        known = dict(zip(("m", "e", "b"), x[2 * n :], strict=True))
        return stepper.integrate(x[:n], p=x[n : 2 * n], parameters=known, events=loops, h=0.1, steps=50)

    def differences(d):
        ends = [
            np.hstack([each.q[-1], each.p[-1]]) for each in map(run_from, x + d * np.vstack([np.eye(11), -np.eye(11)]))
        ]
        return (np.array(ends[:11]) - ends[11:]) @ w / (2 * d)

    run = run_from(x)
    assert min(map(len, run.events)) > 0
    cotangents = np.zeros((len(run.t), 2 * n))
    cotangents[-1] = w
    gradient, sensitivity = run.pullback(cotangents), run.sensitivity()
    adjoint = np.concatenate([np.ravel(each) for each in (gradient.q, gradient.p, gradient.parameters)])
    tangent = w @ np.hstack([sensitivity.state[-1], sensitivity.parameters[-1]])
    assert np.abs(adjoint - tangent).max() < 1e-13 * np.abs(tangent).max()
    one, two, three = (differences(d) for d in (2e-4, 1e-4, 5e-5))
    extrapolated = (64 * three - 20 * two + one) / 45
    assert np.abs(adjoint - extrapolated).max() < 1e-8 * np.abs(tangent).max()


def test_memory_of_a_wall_has_all_its_entries(gas):
    """A wall that contains all coordinates, of more than 2000: a sphere around particles in 3000 dimensions."""
    r = np.full((1500, 2), 0.01)
    run = gas.integrate(
        {"r": r}, velocity={"r": r}, h=0.7, steps=3, events=sc.impact("1 - sum(i in N, r[i, 0]**2 + r[i, 1]**2)")
    )
    radius = np.linalg.norm(run.q["r"].reshape(len(run.t), -1), axis=1)
    assert len(run.events[0]) == 1
    assert abs(radius[-1] - (2.0 - np.linalg.norm(r) * (1.0 + 3 * 0.7))) < 1e-13


def test_states_of_crossings_have_a_limit_of_memory(gas, monkeypatch):
    """At most ``MOST_BYTES`` of states are kept; times and elements always are."""
    random = np.random.default_rng(5)
    r, v = random.random((1100, 2)), 0.02 * random.normal(size=(1100, 2))
    start, plan = ({"r": r}, {"velocity": {"r": v}}), {"h": 1e-2, "steps": 4, "save_every": 4, "events": BOX}
    saved = gas.integrate(*start[:1], **start[1], **plan)
    for each, wall in zip(saved.events, (0.0, 1.0), strict=True):
        places = each.q["r"].reshape(len(each), -1)[np.arange(len(each)), each.element]
        assert len(each) > 0
        assert np.abs(places - wall).max() < 1e-14
    monkeypatch.setattr(detection, "MOST_BYTES", 10_000)
    with pytest.warns(sc.EventWarning, match="are not kept: run.events has times and elements"):
        run = gas.integrate(*start[:1], **start[1], **plan)
    assert np.abs(run.q["r"][-1] - folded(r, v, 0.04)).max() < 1e-14
    assert [each.element.tolist() for each in run.events] == [each.element.tolist() for each in saved.events]
    assert np.isnan(run.events[0].q["r"]).all()


def test_a_recorded_run_has_its_events(gas, tmp_path):
    r, v = np.array([[0.3, 0.6]]), np.array([[0.5, -0.3]])
    run = gas.with_events(BOX).start({"r": r}, velocity={"r": v}, h=0.1)
    recorded = sc.record_run(run, tmp_path / "run", steps=25)
    assert np.abs(recorded.q[-1] - folded(r, v, 2.5)).max() < 1e-14
    assert [each.element.tolist() for each in recorded.events] == [[1], [0]]
