"""``run.error``: the signed global error of a run, compared with closed forms, records of 30 digits and other runs."""

import math
import re
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, output_of
from exact_orbits import motion_stepper, on_an_ellipse
from motions import MOTIONS, recorded
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.runs.accuracy.run_error import with_uncertainty

PAGE = Path(__file__).parents[2] / "docs" / "theory" / "steps.md"


@cache
def kepler(method="svi:4", **options):
    """Return the stepper of Kepler's problem with mass and centre as parameters."""
    system = lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + mu/sqrt((x - c)**2 + y**2)", mu=1.0, c=0.0)
    return sc.compile_stepper(system, method, **options)


def start_of(e, length=1.0, time=1.0, c=0.0):
    """Return arguments of an orbit of eccentricity e from its pericentre, in units of length and time."""
    q, v = [length * (1.0 - e) + c, 0.0], [0.0, length / time * math.sqrt((1.0 + e) / (1.0 - e))]
    return {"q": q, "velocity": v, "parameters": {"mu": length**3 / time**2, "c": c}, "check_growth": False}


def truth(run, rows, length=1.0, time=1.0, c=0.0):
    """Return (rows, 4) exact errors of states, in units of length and velocity."""
    q = (np.asarray(run.q) - [c, 0.0]) / length
    p = np.asarray(run.p) * time / length
    times = np.r_[run.t[0], run.t[rows]] / time
    exact = on_an_ellipse(q[0], p[0], times)[1:]
    return np.asarray(np.concatenate([q, p], axis=1)[rows] - exact, float)


def estimate(run, rows, length=1.0, time=1.0):
    """Return the same by ``run.error``."""
    return np.concatenate([run.error.q / length, run.error.p * time / length], axis=1)[rows]


@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_errors_have_sign_and_size(method):
    """Random orbits, tolerances, units, origins and directions: to 1 % of the largest error."""
    random = np.random.default_rng(8)
    for _ in range(12):
        e, tolerance = random.uniform(0.0, 0.7), 10.0 ** random.uniform(-10.0, -4.0)
        length, time = 10.0 ** random.uniform(-6.0, 6.0, 2)
        c = length * random.choice([0.0, 3.0, -40.0])
        span = time * random.uniform(5.0, 30.0) * random.choice([-1.0, 1.0])
        run = kepler(method).integrate(**start_of(e, length, time, c), t_end=span, tolerance=tolerance)
        rows = [len(run) // 2, -1]
        true, error = truth(run, rows, length, time, c), estimate(run, rows, length, time)
        size, rounding = np.abs(true).max(), 1e-14 * (1.0 + abs(c) / length)
        assert np.abs(error - true).max() <= max(0.01 * size, 100.0 * rounding), (e, tolerance)
        assert run.error.relative[-1] >= 0.5 * np.abs(true).max() / 8.0
        corrected = run.corrected
        off = np.abs((np.asarray(corrected.q)[-1] - np.asarray(run.q)[-1]) + run.error.q[-1]).max()
        assert off <= 4e-16 * (abs(c) + length) * 4.0


POWERS = {
    "inertia": (-2, 0),
    "coupling": (0, 0),
    "field": (0, -1),
    "loss": (0, -1),
    "push": (1, -2),
    "rate": (0, -1),
    "a": (0, -2),
    "b": (0, -2),
    "d": (-2, -2),
    "f": (-2, -2),
    "g": (-1, -2),
}
"""Powers of the units of length and time that the parameters of ``random_system`` have, for masses of 1."""


@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_bounds_of_default_runs_contain_rounding(method):
    """Random orbits in units that are powers of two: no bound is below the error, half of them within 40 times it."""
    random, ratios = np.random.default_rng(4), []
    for _ in range(12):
        e, (length, time) = random.uniform(0.0, 0.9), 2.0 ** random.integers(-10, 10, 2)
        run = kepler(method).integrate(**start_of(e, length, time), t_end=time * random.uniform(3.0, 60.0))
        sizes = run.error.sizes / [[length], [length / time]]
        true = np.abs(truth(run, np.arange(1, len(run)), length, time) / sizes.ravel()).max()
        ratios.append(run.error.relative[-1] / true)
    assert min(ratios) >= 1.0
    assert np.median(ratios) < 40.0


def test_errors_are_known_at_rest_and_unknown_without_states_between_events():
    spring = sc.compile_stepper(lagrange("spring", "x", "x_dot**2/2 - 50*(x - 1000)**2"), "svi:6")
    assert spring.integrate([1000.0], velocity=[0.0], t_end=20.0, h=0.5).error.relative[-1] < 1e-13
    ball, floor = sc.compile_stepper(lagrange("ball", "y", "y_dot**2/2 - 9.81*y")), sc.impact("y", restitution=0.8)
    start = {"q": [1.0], "velocity": [0.0], "t_end": math.sqrt(2.0 / 9.81), "events": [floor]}
    unknown, known = ball.integrate(**start), ball.integrate(**start, max_step=0.1)
    assert "max_step" in unknown.error.reason or np.isfinite(unknown.error.q[1:]).any()
    assert known.error.relative[-1] < 1e-12


@cache
def random_system(method):
    """Return the stepper of a mass matrix, a magnetic field, a potential, damping and a force, all by parameters."""
    formula = (
        "x_dot**2/2 + (1 + inertia*x**2)*y_dot**2/2 + coupling*x_dot*y_dot + field*(x*y_dot - y*x_dot)/2"
        " - (a*x**2 + b*y**2)/2 - (d*x**4 + f*y**4)/4 - g*x**2*y + push*x*cos(rate*t)"
    )
    damped = {"dissipation": "loss*(x_dot**2 + y_dot**2)/2"}
    return sc.compile_stepper(lagrange("random", "x y", formula, **damped, **dict.fromkeys(POWERS, 0.0)), method)


def end_by_hand(q, v, end, of):
    """Return positions and momenta at the end, by DOP853 of the equations of ``random_system``, to about 1e-12."""

    def rates(t, z):
        x, y, u, w = z
        force = [
            of["inertia"] * x * w**2 + of["field"] * w - of["loss"] * u + of["push"] * math.cos(of["rate"] * t),
            -2.0 * of["inertia"] * x * u * w - of["field"] * u - of["loss"] * w,
        ]
        force[0] -= of["a"] * x + of["d"] * x**3 + 2.0 * of["g"] * x * y
        force[1] -= of["b"] * y + of["f"] * y**3 + of["g"] * x**2
        return [u, w, *np.linalg.solve([[1.0, of["coupling"]], [of["coupling"], 1.0 + of["inertia"] * x**2]], force)]

    x, y, u, w = solve_ivp(rates, (0.0, end), [*q, *v], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    p_x = u + of["coupling"] * w - of["field"] * y / 2.0
    return np.array([x, y, p_x, (1.0 + of["inertia"] * x**2) * w + of["coupling"] * u + of["field"] * x / 2.0])


@pytest.mark.second
@pytest.mark.parametrize("method", ["svi:4", "svi:8", "gauss:3"])
def test_statements_on_errors_hold_for_random_systems(method):
    """Random systems, states, tolerances, units and directions: sign and size, bounds, corrections, rows, ``error=``.

    Errors to 1 %, their bounds at least half of the truth, corrected states a hundred times as accurate, the same
    errors where states are saved seldom, and ``error=`` in at most two runs, whose error it bounds.
    """
    random, stepper = np.random.default_rng(91), random_system(method)
    for _ in range(8):
        of = {name: random.uniform(0.0, 0.9) for name in POWERS} | {"g": random.uniform(0.0, 0.3)}
        q, v = random.uniform(-1.0, 1.0, (2, 2))
        end, tolerance = random.choice([-12.0, 12.0]), 10.0 ** random.uniform(-8.0, -4.0)
        of["loss"] *= 0.1 if end < 0.0 else 1.0  # else growth backward is that of the truth, too
        exact, (length, time) = end_by_hand(q, v, end, of), 10.0 ** random.uniform(-6.0, 6.0, 2)
        values = {name: of[name] * length**i * time**j for name, (i, j) in POWERS.items()}
        motion = {"velocity": v * length / time, "parameters": values, "t_end": end * time}
        runs = [
            stepper.integrate(q * length, **motion, tolerance=tolerance, save_every=k, check_growth=False)
            for k in (1, 7, 10**6)
        ]
        confirmed = stepper.integrate(q * length, **motion, error=1e-9)
        units = np.array([length, length, length / time, length / time])
        sizes = runs[0].error.sizes.ravel() / units

        def at_end(states, units=units):
            return np.r_[np.asarray(states.q)[-1], np.asarray(states.p)[-1]] / units

        true, (error, *seldom) = at_end(runs[0]) - exact, (at_end(run.error) for run in runs)
        size = np.abs(true / sizes).max()
        assert np.abs((error - true) / sizes).max() <= 1e-2 * size + 1e-11, (of, tolerance)
        assert 0.5 * size <= runs[0].error.relative[-1], (of, tolerance)
        assert np.abs((at_end(runs[0].corrected) - exact) / sizes).max() <= 1e-2 * size + 1e-11, (of, tolerance)
        assert np.abs((np.array(seldom) - error) / sizes).max() <= 1e-3 * size + 1e-13, (of, tolerance)
        assert confirmed.confirmation.runs <= 2
        assert np.abs((at_end(confirmed) - exact) / sizes).max() <= confirmed.global_error + 1e-11 <= 2e-9


def rod(random):
    """A pendulum on a rod, beside DOP853 of the equation of its angle; forward or backward."""
    (g, length), (angle, rate), end = random.uniform(0.5, 2.0, 2), random.uniform(-1.0, 1.0, 2), random.choice([-6, 6])
    formula, constraints = "(x_dot**2 + y_dot**2)/2 - g*y", ["x**2 + y**2 - l**2"]
    system = lagrange("rod", "x y", formula, constraints=constraints, g=1.0, l=1.0)

    def state(angle, rate):
        along, across = np.array([math.sin(angle), -math.cos(angle)]), np.array([math.cos(angle), math.sin(angle)])
        return length * np.concatenate([along, rate * across])

    def rates(_, z):
        return [z[1], -g / length * math.sin(z[0])]

    late = solve_ivp(rates, (0.0, end), [angle, rate], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return system, {}, {"g": g, "l": length}, state(angle, rate), end, state(*late)


def oscillation(x, v, rate, t):
    """Return position and velocity of x'' = -rate^2 x after the time t."""
    size, phase = math.hypot(x, v / rate), math.atan2(-v / rate, x) + rate * t
    return size * math.cos(phase), -size * rate * math.sin(phase)


def wall(random):
    """An oscillator that bounces off a wall at x = -d, in closed form; forward, or backward with 1/e."""
    k, d, e, v = *random.uniform([0.5, 0.1, 0.5], [2.0, 0.6, 0.95]), random.uniform(-1.0, 1.0)
    sign = random.choice([-1.0, 1.0])
    rate, left, start, (x, speed) = math.sqrt(k), 8.0, np.array([1.0, v]), (1.0, sign * v)
    while (size := math.hypot(x, speed / rate)) > d:
        phase = math.atan2(-speed / rate, x)
        wait = (math.acos(-d / size) - phase) % (2.0 * math.pi) / rate
        if wait >= left:
            break
        left, x, speed = left - wait, -d, -(e**sign) * oscillation(x, speed, rate, wait)[1]
    system = lagrange("wall", "x", "x_dot**2/2 - k*x**2/2 + 0*d*e", k=1.0, d=0.5, e=0.9)
    events = {"events": sc.impact("x + d", restitution="e")}
    x, speed = oscillation(x, speed, rate, left)
    return system, events, {"k": k, "d": d, "e": e}, start, 8.0 * sign, np.array([x, sign * speed])


def kink(random):
    """An oscillator of two stiffnesses, in closed form; forward or backward."""
    (k, s), v, end = random.uniform(0.5, 4.0, 2), random.uniform(-1.0, 1.0), random.choice([-8.0, 8.0])
    sign, left, x, speed, side = math.copysign(1.0, end), 8.0, 1.0, math.copysign(1.0, end) * v, 1.0
    while True:
        rate = math.sqrt(k if side > 0.0 else s)
        wait = (0.5 * math.pi - math.atan2(-speed / rate, x)) % math.pi / rate if x else math.pi / rate
        if wait >= left:
            break
        left, speed, x, side = left - wait, oscillation(x, speed, rate, wait)[1], 0.0, -side
    x, speed = oscillation(x, speed, rate, left)
    system = lagrange("kink", "x", "x_dot**2/2 - k*max(x, 0)**2/2 - s*min(x, 0)**2/2", k=1.0, s=2.0)
    return system, {}, {"k": k, "s": s}, np.array([1.0, v]), end, np.array([x, sign * speed])


@pytest.mark.second
@pytest.mark.parametrize("motion", [rod, wall, kink])
def test_errors_through_constraints_impacts_and_kinks_have_sign_and_size(motion):
    """Twelve random motions of each kind: errors to 1 %, and states minus them a hundred times as accurate."""
    random, stepper = np.random.default_rng(7), None
    for _ in range(12):
        system, events, parameters, start, end, exact = motion(random)
        stepper = stepper or sc.compile_stepper(system, "svi:4", **events)
        (q, v), tolerance = np.split(start, 2), 10.0 ** random.uniform(-8.0, -4.0)
        run = stepper.integrate(q, velocity=v, parameters=parameters, t_end=end, tolerance=tolerance)
        true, sizes = np.r_[run.q[-1], run.p[-1]] - exact, run.error.sizes.ravel()
        error, corrected = np.r_[run.error.q[-1], run.error.p[-1]], np.r_[run.corrected.q[-1], run.corrected.p[-1]]
        size = np.abs(true / sizes).max()
        assert np.abs((error - true) / sizes).max() <= 1e-2 * size + 1e-12, (parameters, end, tolerance)
        assert 0.5 * size <= run.error.relative[-1]
        assert np.abs((corrected - exact) / sizes).max() <= 1e-2 * size + 1e-12, (parameters, end, tolerance)


@pytest.mark.second
def test_what_iterations_leave_does_not_grow_at_pericentres():
    """Nine orbits of eccentricity 0.99: with 1e-3 of transported errors left by iterations they are half too large."""
    run = kepler("svi:4").integrate(**start_of(0.99), t_end=60.0, tolerance=1e-9)
    rows = np.arange(len(run) - 1, 0, -50)
    true = truth(run, rows)
    assert 1e-3 < run.error.relative[-1] < 0.1
    assert np.abs(estimate(run, rows) - true).max() <= 0.05 * np.abs(true).max()


@pytest.mark.rotated
def test_errors_in_transformed_time_contain_the_rounding_of_the_energy():
    """Orbits of e = 0.5 to 0.99 from both apsides: bounds of their errors, from apocentres thirty times as large."""
    system = lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
    stepper = sc.compile_stepper(sc.reparametrise(system, "frequency"), "svi:8")
    for e in (0.5, 0.99, -0.99):
        run = stepper.integrate([1.0 - e, 0.0], velocity=[0.0, math.sqrt((1.0 + e) / (1.0 - e))], h=0.5, t_end=60.0)
        error, exact = run.error, on_an_ellipse(run.q[0], run.p[0], run.t)
        true = np.asarray(np.concatenate([run.q, run.p], axis=1) - exact, float)
        assert np.abs(true / error.sizes.ravel()).max() <= error.relative[-1]
        assert e > 0.0 or error.relative[-1] <= 30.0 * np.abs(true / error.sizes.ravel()).max()


@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_saving_seldom_and_output_times_do_not_change_the_errors(method):
    """Random orbits, tolerances and directions, up to errors and roundings of the finer steps; in ensembles, too."""
    random = np.random.default_rng(5)
    for _ in range(3):
        start, tolerance = start_of(random.uniform(0.3, 0.7)), 10.0 ** random.uniform(-9.0, -7.0)
        end = {"t_end": random.choice([-20.0, 20.0]), "tolerance": tolerance}
        runs = [kepler(method).integrate(**start, **end, save_every=k) for k in (1, 7, 10**6)]
        late = {**end, "t_eval": [0.2 * end["t_end"], end["t_end"]]}
        runs.append(kepler(method).integrate(**start, **late))
        ends = np.array([np.r_[run.error.q[-1], run.error.p[-1]] for run in runs])
        assert np.abs(ends - ends[0]).max() <= 3e-4 * np.abs(ends).max() + 200.0 * np.finfo(float).eps, tolerance
        assert runs[-1].error.q[0].any()  # the error since the initial state, which is not among the times
    two = {"q": [start["q"]] * 2, "velocity": [start["velocity"]] * 2, "parameters": start["parameters"]}
    member = kepler(method).integrate_ensemble(**two, **late)[1]
    assert np.array_equal(member.error.q, runs[-1].error.q)
    assert member.initial[0] == runs[-1].initial[0] == runs[0].initial[0] == 0.0
    assert not member[:].error.q[0].any()
    assert member[:].initial[0] == late["t_eval"][0]


def test_a_changed_state_changes_later_errors_by_the_tangent_map():
    """A kick e is an error e; none is left in the states after it, up to e^2, if these do not continue the changed one.

    If they do, later errors change by its image under the tangent map, up to e^2.
    """
    random = np.random.default_rng(3)
    run = kepler().integrate(**start_of(0.3), h=0.1, steps=120)
    plain, k = estimate(run, slice(None)), 40
    direction = random.normal(size=4)
    later, moved = [], []
    for size in (1e-4, 1e-5):
        e = size * direction
        changed = replace(run, q=run.q.copy(), p=run.p.copy())
        changed.q[k] += e[:2]
        changed.p[k] += e[2:]
        apart = estimate(changed, slice(None)) - plain
        assert np.abs(apart[:k]).max() == 0.0
        assert np.abs(apart[k] - e).max() <= 1e-9 * size
        later.append(np.abs(apart[k + 1 :]).max() / size)
        rest = kepler().integrate(changed.q[k], changed.p[k], t=run.t[k], h=0.1, steps=120 - k, check_growth=False)
        changed.q[k:], changed.p[k:] = rest.q, rest.p
        apart = estimate(replace(changed), slice(k, None)) - plain[k:]
        image = run[k:].tangent(e[:, None])[..., 0]
        moved.append(np.abs(apart - image).max() / np.abs(image).max())
    for first, second in (later, moved):
        assert first < 0.1
        assert second <= 0.2 * first + 1e-6


def test_error_of_a_slice_is_that_since_its_first_state():
    run = kepler().integrate(**start_of(0.2), t_end=12.0, tolerance=1e-6)
    assert not run[5:].error.q[0].any()
    assert np.array_equal(run[:6].error.q, run.error.q[:6])


def test_a_call_that_is_made_again_has_the_same_options(monkeypatch):
    """Where Newton's method is loaded, a call is made twice; the options that it refers to are those of the caller."""
    kept, function_of = {}, Binding.call

    def call(self, name, call):
        function, before = function_of(self, name, call), call.options

        def checked(*arguments):
            status = function(*arguments)
            kept[name] = call.options == before
            return status

        return checked

    monkeypatch.setattr(Binding, "call", call)
    run = kepler().integrate(**start_of(0.2), t_end=2.0, tolerance=1e-6)
    assert run.error.q[-1].any()
    assert kept["errors"]
    assert all(kept.values())


def test_uncertain_digits():
    cases = {
        (0.5123451, 1.15e-5): "0.512345(12)",
        (-3.0, 0.0121): "-3.000(13)",
        (1234.5, 56.0): "1234(56)",
        (1.5e-9, 2.4e-12): "1.5000(24)e-09",
        (2.0, 0.0): "2.0",
        (7e-6, 1.15e-5): "0.7(12)e-05",
        (-2.0, 355.0): "-0.0(36)e+02",
        (1.0, 3.3e78): "0.0(33)e+78",
        (0.1, math.inf): "0.1(lost)",
    }
    assert {key: with_uncertainty(*key) for key in cases} == cases
    run = kepler().integrate(**start_of(0.2), t_end=12.0, tolerance=1e-6)
    lines = str(run.error).split("\n")
    assert re.fullmatch(r"t = 12: relative error \d\.\de-0\d", lines[0])
    assert [line.split(" = ")[0] for line in lines[1:]] == ["x", "y", "p_x", "p_y"]
    assert re.fullmatch(r"x = -?0\.\d+\(\d\d\)", lines[1])


def test_files_pictures_and_the_command_line_show_errors(tmp_path):
    run = kepler().integrate(**start_of(0.2), t_end=12.0, tolerance=1e-6)
    run.save(tmp_path / "orbit.npz", error=True)
    with np.load(tmp_path / "orbit.npz") as file:
        assert np.array_equal(file["q_error"], run.error.q)
        assert np.array_equal(file["p_rounding"], run.error.rounding_p)
    with pytest.raises(sc.StateError, match=r"\.csv has no errors"):
        run.save(tmp_path / "orbit.csv", error=True)
    printed = output_of(
        "run", "kepler", "--span", "20", "--tolerance", "1e-7", "--error-bars", "-o", tmp_path / "k.npz"
    )
    assert re.search(r"^p_q1 = -?\d\.\d+\(\d\d\)$", printed, re.M)
    with np.load(tmp_path / "k.npz") as file:
        assert file["q_error"].shape == file["q"].shape
    assert "is not available" in error_of("run", "kepler", "--error-bars", "-o", tmp_path / "k.run", status=2)


@pytest.mark.second
def test_errors_of_steps_that_no_method_resolves_are_right_or_lost():
    """Pendulums that turn by up to 60 rad a step: single steps of any degree see nothing of the force."""
    system = sc.LagrangianSystem.from_text("turning", ["x"], "m*(x_dot**2/2 + cos(x))", parameters={"m": 1.0})
    stepper, random = sc.compile_stepper(system, "svi:4"), np.random.default_rng(0)
    for _ in range(12):
        h, x, turn = random.uniform([0.1, -3, 1], [1, 3, 60])
        m = 2.0 ** random.choice([0, 600, -600])  # squares of momenta overflow
        run = stepper.integrate([x], velocity=[turn / h], h=h, steps=30, parameters={"m": m})
        args = (0, run.t[-1]), [x, turn / h], "DOP853"
        exact = solve_ivp(lambda t, y: [y[1], -np.sin(y[0])], *args, rtol=1e-13, atol=1e-13).y[0, -1]
        error, lost = run.q[-1, 0] - exact, run.error.lost
        assert lost is not None or abs(run.error.q[-1, 0] - error) < abs(error) / 2 + 1e-9, f"{h}, {x}, {turn}, {m}"


def test_lost_digits_are_reported_and_not_corrected():
    """exp(-t) on a saddle, whose errors grow by exp(t)."""
    saddle = sc.compile_stepper(lagrange("saddle", "q", "q_dot**2/2 + q**2/2"), "svi:4")
    run = saddle.integrate([1.0], [-1.0], t_end=42.0, check_growth=False)
    lost = run.error.lost
    assert 30.0 < lost < 42.0
    corrected, known = run.corrected.q[:, 0], run.error.relative < 0.1
    assert np.isnan(corrected[~known]).all()
    assert np.abs(corrected[known] - np.exp(-run.t[known])).max() < 0.05
    known = run.error.relative < 1e-3
    assert np.abs(corrected[known] - np.exp(-run.t[known])).max() < 1e-4


@pytest.mark.full
def test_recorded_motions():
    """All recorded motions at tolerances from 1e-4 to 1e-12: 5 % of the truth, and bounds of it everywhere."""
    ratios, bounds, worse = [], [], []
    for name in MOTIONS:
        stepper, start = motion_stepper(name)
        _, high, low = recorded(name)
        for tolerance in (1e-4, 1e-6, 1e-8, 1e-10, 1e-12):
            run = stepper.integrate(**start, tolerance=tolerance, check_growth=False)
            error = run.error
            states = np.concatenate([run.q, run.p], axis=1)[-1]
            true = (states - high[-1]) - low[-1]
            sizes, m = error.sizes.ravel(), run.q.shape[1]
            found = np.r_[error.q[-1], error.p[-1]]
            rounding = np.r_[error.rounding_q[-1], error.rounding_p[-1]]
            i = int(np.argmax(np.abs(true) / sizes))
            bounds.append(abs(true[i]) / sizes[i] / error.relative[-1])
            if 30.0 * (np.abs(rounding) / sizes).max() < error.relative[-1] < 1e-3:
                ratios.append(found[i] / true[i])
                worse.append(np.abs(true - found).max() > np.abs(true).max())
            assert len(sizes) == 2 * m
    ratios = np.array(ratios)
    assert len(ratios) > 60
    assert np.mean((ratios > 0.95) & (ratios < 1.05)) >= 0.95, ratios
    assert ((ratios > 0.5) & (ratios < 2.0)).all(), ratios
    assert max(bounds) <= 2.0, bounds
    assert not any(worse)


def oscillator(method="svi:4", **options):
    return sc.compile_stepper(lagrange("oscillator", "x", "x_dot**2/2 - x**2/2"), method, **options)


ORBIT = {"t_end": 9.0, "tolerance": 1e-6, "check_growth": False}
FLOOR = "y_dot**2/2 - 9.8*y - 1e5*positive_part(-y)**2"
KINDS = {
    "fixed steps": lambda: oscillator().integrate([1.0], [0.0], h=0.3, steps=30),
    "adaptive steps": lambda: oscillator().integrate([1.0], [0.0], **ORBIT),
    "explicit methods and compositions": lambda: oscillator("composition:4").integrate([1.0], [0.0], h=0.1, steps=90),
    "`save_every`, `t_eval`": lambda: oscillator().integrate([1.0], [0.0], **ORBIT, save_every=5),
    "inputs": lambda: sc.compile_stepper(
        sc.LagrangianSystem.from_text("i", ["x"], "x_dot**2/2 - x**2/2 + u*x", inputs=["u"]), "svi:4"
    ).integrate([1.0], [0.0], **ORBIT, inputs={"u": ([0.0, 4.0, 9.0], [0.0, 1.0, 0.5])}),
    "impacts and other events that change the state": lambda: sc.compile_stepper(
        lagrange("ball", "x y", "(x_dot**2 + y_dot**2)/2 - y"), "svi:4", events=sc.impact("y", restitution="0.8")
    ).integrate([0.0, 1.0], [1.0, 0.0], t_end=4.0, check_growth=False),
    "located kinks and jumps": lambda: sc.compile_stepper(lagrange("floor", "y", FLOOR), "svi:4").integrate(
        [1.0], [0.0], t_end=1.5, tolerance=1e-6, check_growth=False
    ),
    "contacts and dry friction": lambda: sc.compile_stepper(
        lagrange("o", "x", "x_dot**2/2 - x**2/2"), "svi:3", contacts=[sc.friction("x_dot - 0.3", limit=0.25)]
    ).integrate([0.0], velocity=[0.3], t_end=9.0, tolerance=1e-6),
    "constraints": lambda: sc.compile_stepper(
        lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 - 1"]), "svi:3"
    ).integrate([0.6, -0.8], velocity=[0.8, 0.6], **ORBIT),
    "rotations": lambda: sc.compile_stepper(
        lagrange("top", [], "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2", rotations={"R": "omega"}), "svi:3"
    ).integrate({"R": [1, 0, 0, 0]}, velocity={"omega": [1.0, 0.1, 0.2]}, **ORBIT),
    "Hamiltonians": lambda: sc.compile_stepper(
        sc.HamiltonianSystem.from_text(
            name="h", coordinates=["q"], momenta=["p"], hamiltonian="(q**2 + 1)*(p**2 + 1)/2"
        ),
        "svi:4",
    ).integrate([-1.0], [0.3], **ORBIT),
    "trajectories of ensembles": lambda: oscillator().integrate_ensemble([[1.0]], [[0.0]], t_end=9.0, tolerance=1e-6)[
        0
    ],
    "time transformation by a controller": lambda: oscillator(time_transformation="1 + x**2").integrate(
        [1.0], [0.0], h=0.1, t_end=5.0
    ),
    "systems in transformed time (`reparametrise`)": lambda: sc.compile_stepper(
        sc.reparametrise(lagrange("o", "x", "x_dot**2/2 - x**2/2"), "1 + x**2"), "svi:4"
    ).integrate([1.0], [0.0], h=0.1, t_end=5.0),
    "double-double arithmetic": lambda: oscillator("svi:8", precision="double-double").integrate(
        [1.0], [0.0], t_end=5.0, tolerance=1e-20
    ),
    "arrays of run-time sizes": lambda: sc.compile_stepper(
        lagrange("a", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)"), "svi:4"
    ).integrate([1.0, 0.5], [0.0, 0.1], **ORBIT),
    "kinks that steps do not locate": lambda: sc.compile_stepper(
        lagrange("motor", "x", "x_dot**2/2", forces={"x": "rint((t - 3)/100 + 1/2)"}), "svi:4"
    ).integrate([0.0], [1.0], t_end=9.0, tolerance=1e-6),
    "heat baths": lambda: sc.compile_stepper(
        sc.LagrangianSystem.from_text("bath", ["x"], "x_dot**2/2 - x**2/2", damping=0.1, temperature=1.0), "svi:2"
    ).integrate([1.0], [0.0], h=0.1, steps=10),
    "runs with `observe`": lambda: oscillator().integrate([1.0], [0.0], h=0.1, steps=10, observe="extremes"),
}


def table_of_kinds():
    rows = re.findall(r"^\| (.+?) \| (signed|refused) \|", PAGE.read_text("utf-8"), re.M)
    return {kind: judge for names, judge in rows for kind in names.split("; ")}


def test_the_page_lists_the_kinds_of_runs():
    assert [*table_of_kinds()] == [*KINDS]


@pytest.mark.rotated
@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_runs(kind):
    judge = table_of_kinds()[kind]
    with warnings.catch_warnings(action="ignore"):
        run = KINDS[kind]()
        if judge == "refused":
            with pytest.raises((sc.StateError, sc.MethodError), match=r"run\.error is not available"):
                _ = run.error
            return
    error = run.error
    assert 0.0 < error.relative[-1] < 1e-2
    assert error.lost is None
    assert not error.reason


def test_runs_by_six_points_know_their_error():
    """The number of points of a step is no status of C, of which 6 requires Newton's method."""
    run = sc.compile_stepper(sc.problem("harmonic-oscillator").system, "svi:6").integrate([1.0], [0.0], h=1.0, steps=9)
    assert run.error.q[-1, 0] == pytest.approx(run.q[-1, 0] - np.cos(run.t[-1]), rel=0.05)
