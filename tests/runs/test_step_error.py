"""The error estimate of a step compared with the error, also where a coefficient of the curve passes through zero."""

import math

import numpy as np
import pytest
from notation import lagrange
from springs import Puck, Spring

import scvi_codegen as sc

CATALOGUE = {name: sc.problem(name).system for name in ("planar-pendulum", "henon-heiles", "double-pendulum")}
OSCILLATORS = {
    "harmonic": "x_dot**2/2 - x**2/2",
    "quartic": "x_dot**2/2 - x**4/4",
    "of two wells": "x_dot**2/2 + x**2/2 - x**4/4",
    "quick": "sqrt(1 + x_dot**2) - x**2/2",
}
SYSTEMS = CATALOGUE | {name: lagrange(name, "x", lagrangian) for name, lagrangian in OSCILLATORS.items()}
PHASES = 60


def achieved_and_estimated(system, method, solver="auto"):
    """(2, PHASES) of single steps from states along a motion: |q - exact| relative as the estimate is, and that."""
    stepper, exact = sc.compile_stepper(system, method, solver=solver), sc.compile_stepper(system, sc.SVI(12))
    m = stepper.dimension
    q = np.linspace(0.3, 0.2, m)
    start = q, exact.momentum(q, np.linspace(0.2, 0.4, m))
    h = np.median(np.diff(stepper.integrate(*start, t_end=10.0, tolerance=1e-9).t))
    states = exact.integrate(*start, h=h / 3, steps=PHASES)
    found = []
    for q, p in zip(states.q[:-1], states.p[:-1], strict=True):
        run = stepper.integrate(q, p, h=h, steps=1)
        end = exact.integrate(q, p, h=h / 4, steps=4).q[-1]
        size = np.abs(q) + np.abs(end - q)
        found.append((np.abs(run.q[-1] - end).max() / (size.max() + np.abs(q).min()), run.step_error))
    return np.array(found).T


def check_all_phases(system, method, solver="auto"):
    achieved, estimated = achieved_and_estimated(system, method, solver)
    resolved = achieved > 1e-14
    assert resolved.sum() > 10
    assert np.all(achieved[resolved] < 5.0 * estimated[resolved])


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("method", [sc.SVI(4), pytest.param(sc.SVI(6), marks=pytest.mark.full)])
@pytest.mark.parametrize("name", SYSTEMS)
def test_error_estimate_is_independent_of_the_phase(name, method):
    check_all_phases(SYSTEMS[name], method)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("method", [sc.SVI(4), sc.SVI(6)])
def test_error_estimate_of_an_oscillator_hardly_varies_with_the_phase(method):
    """The leading coefficient of the curve passes through zero twice a period; the error per step does not."""
    stepper = sc.compile_stepper(SYSTEMS["harmonic"], method, flags=("-O0",))
    phases = np.linspace(0.0, np.pi, 17)
    estimates = [stepper.integrate([np.cos(x)], [-np.sin(x)], h=0.3, steps=1).step_error for x in phases]
    assert min(estimates) > np.median(estimates) / 20


@pytest.mark.rotated
def test_newton_and_fixed_point_error_estimates_agree_for_momentum_unknowns():
    vortices = sc.problem("point-vortices")
    steppers = [sc.compile_stepper(vortices.system, sc.SVI(4), solver=each) for each in ("auto", "newton")]
    errors = [each.integrate(vortices.q, vortices.p, h=0.1, steps=1).step_error for each in steppers]
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)
    with pytest.warns(sc.AccuracyWarning, match="too large"):
        assert steppers[0].integrate(vortices.q, vortices.p, h=0.5, steps=50).step_error > 1e-3  # iterations fail


@pytest.mark.rotated
@pytest.mark.parametrize("method", [sc.SVI(4), sc.SCVI(3), sc.Gauss(4)])
def test_newton_error_estimate_is_independent_of_the_phase(method):
    check_all_phases(SYSTEMS["quartic"], method, "newton")


def test_worst_step_starts_at_the_perihelion():
    """Half a period (pi, for a semi-major axis of 1) after the aphelion, wherever the run starts in time."""
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(3), flags=("-O0",))
    for start in (0.0, 7.25, -3.5):
        run = stepper.integrate([1.6, 0.0], [0.0, 0.5], h=0.05, steps=120, t=start)
        assert abs(run.worst_step_time - (start + np.pi)) < 2 * 0.05
        assert np.abs(run.t - run.worst_step_time).min() < 1e-12


def behind_wall(k: float, width: float, x: float, v: float, t: float) -> tuple[float, float]:
    """Return position and velocity of a particle that meets the potential k min(max(x, 0), width)^2/2 at x = 0."""
    omega, after, height = math.sqrt(k), t + x / v, k * width**2 / 2
    if after <= 0:
        return x + v * t, v
    passes = v * v / 2 > height
    inside = (math.asin(min(1.0, width * omega / v)) if passes else math.pi) / omega
    if after < inside:
        return v / omega * math.sin(omega * after), v * math.cos(omega * after)
    beyond = math.sqrt(v * v - 2 * height) if passes else -v
    return (width if passes else 0.0) + beyond * (after - inside), beyond


@pytest.mark.second
@pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:3", "svi:4"])
def test_parts_of_a_step_beside_kinks_are_judged(method: str) -> None:
    """100 thin stiff walls, of which some reflect what should pass: the error of a step is that of all its parts."""
    wall = lagrange("wall", "x", "x_dot**2/2 - k*max(0, min(x, width))**2/2", k=1e8, width=1e-4)
    stepper = sc.compile_stepper(wall, method)
    wrong = 0
    for number in range(100):
        random = np.random.default_rng([number])
        values = {"k": 10 ** random.uniform(3, 9), "width": 10 ** random.uniform(-4.5, -1.5)}
        x, v = -random.uniform(0.1, 1), random.uniform(0.2, 2)
        exact = behind_wall(values["k"], values["width"], x, v, 2.0)
        for h in (0.05, 0.25, 0.5):
            run = stepper.integrate([x], velocity=[v], h=h, t_end=2.0, parameters=values)
            error = max(abs(run.q[-1, 0] - exact[0]), abs(run.velocity[-1, 0] - exact[1]))
            wrong += error > 1e-2
            assert error < 1e-2 or run.step_error > 1e-3, (number, h)
    assert (wrong > 0) == (method != "svi:4")


@pytest.mark.second
@pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:4"])
def test_pulses_between_kinks_are_judged(method: str) -> None:
    """100 pulses J (1 - cos(2 pi (t - a)/w))/w from a to a + w on an oscillator, which points of a part may not see.

    The motion grows by them, up to 50 times: errors are relative to the motion after them.
    """
    force = "(1 - cos(2*pi*(t - a)/w))*J/w*unit_step(t - a)*unit_step(a + w - t)"
    stepper = sc.compile_stepper(
        lagrange("pulse", "x", "x_dot**2/2 - x**2/2", forces={"x": force}, J=1.0, a=0.5, w=0.1), method
    )
    wrong = 0
    for number in range(100):
        random = np.random.default_rng([97, number])
        J, a, w = random.uniform(0.2, 3), random.uniform(0.1, 1.2), 10 ** random.uniform(-4.5, -0.5)
        x, v = random.uniform(-1, 1, 2)
        rest, c = 2.0 - a - w, 1 / (1 - (2 * math.pi / w) ** 2)
        # from rest x'' + x = 1 has x = 1 - cos s, and x'' + x = cos(2 pi s/w) has x = c (cos(2 pi s/w) - cos s)
        ends = np.array([1 - math.cos(w) - c * (1 - math.cos(w)), math.sin(w) - c * math.sin(w)])
        ends = [
            ends[0] * math.cos(rest) + ends[1] * math.sin(rest),
            ends[1] * math.cos(rest) - ends[0] * math.sin(rest),
        ]
        exact = [
            x * math.cos(2) + v * math.sin(2) + J / w * ends[0],
            -x * math.sin(2) + v * math.cos(2) + J / w * ends[1],
        ]
        for h in (0.02, 0.05, 0.25, 0.5):
            run = stepper.integrate([x], velocity=[v], h=h, t_end=2.0, parameters={"J": J, "a": a, "w": w})
            error = max(abs(run.q[-1, 0] - exact[0]), abs(run.velocity[-1, 0] - exact[1]))
            wrong += error > 2e-2
            assert error < 2e-2 or run.step_error > error / 500, (number, h, error, run.step_error)
    assert (wrong > 0) == (method != "svi:4")


def test_parts_whose_halves_have_no_solution_have_an_unknown_error() -> None:
    """A force that is undefined at the point of a half, where a wall begins at t = 0.5, and at none of the run."""
    text, hole = "x_dot**2/2 - max(0, x)**2/2", {"x": "1e-9*sqrt((t - a)**2 - 1e-12)"}
    stepper = sc.compile_stepper(lagrange("hole", "x", text, forces=hole, a=-1.0), "svi:1")
    start = {"velocity": [1.0], "h": 0.4, "steps": 2}
    with pytest.warns(sc.AccuracyWarning, match=r"about 2\.3e-03"):
        known = stepper.integrate([-0.5], **start)
    with pytest.warns(sc.AccuracyWarning, match=r"t = 0\.5 is unknown: parts of it have no solution\. Reduce h"):
        run = stepper.integrate([-0.5], **start, parameters={"a": 0.725})
    assert run.q[-1] == pytest.approx(known.q[-1])
    assert run.step_error == math.inf
    assert run.worst_step_time == pytest.approx(0.5)


WALLS = [sc.contact(gap, restitution="e") for gap in ("x - low", "high - x", "y - low", "high - y")]


@pytest.mark.second
@pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:3", "svi:4"])
def test_steps_of_springs_between_walls_are_judged(method: str) -> None:
    """100 with dry friction and restitution, by large steps: n of them err by at most five times n step_error."""
    friction = sc.friction("x_dot", limit="sliding", static_limit="held")
    text, values = "x_dot**2/2 - w**2*x**2/2", dict.fromkeys(["sliding", "held", "low", "high", "e", "w"], 1.0)
    stepper = sc.compile_stepper(lagrange("spring", "x", text, **values), method, contacts=[friction, *WALLS[:2]])
    for number in range(100):
        random = np.random.default_rng([97, number])
        w, sliding = random.uniform(0.3, 3), random.choice([0, random.uniform(0, 0.5)])
        held = sliding * random.choice([1, random.uniform(1, 2)])
        low, high, e = -random.uniform(0.1, 2), random.uniform(0.1, 2), random.choice([1, random.uniform(0.3, 1)])
        x, v, t_end, n = (
            random.uniform(low, high),
            random.uniform(-2, 2),
            random.uniform(1, 8) / w,
            random.integers(3, 60),
        )
        spring = Spring(w, sliding, held, low, high, e)
        run = stepper.integrate([x], velocity=[v], h=t_end / n, t_end=t_end, parameters=spring._asdict())
        place, rate = spring.after(x, v, t_end)
        error = max(abs(run.q[-1, 0] - place), abs(run.velocity[-1, 0] - rate) / w) / (high - low)
        assert error <= 5 * n * run.step_error + 1e-12, (number, error, run.step_error)


@pytest.mark.second
@pytest.mark.parametrize("method", ["svi:1", "svi:3"])
def test_steps_of_pucks_between_walls_are_exact(method: str) -> None:
    """100 with dry friction in the plane, whose motion between impacts is quadratic in time, by large steps."""
    friction = sc.friction(["x_dot", "y_dot"], limit="sliding")
    values = dict.fromkeys(["sliding", "low", "high", "e"], 1.0)
    puck = lagrange("puck", "x y", "(x_dot**2 + y_dot**2)/2", **values)
    stepper = sc.compile_stepper(puck, method, contacts=[friction, *WALLS])
    for number in range(100):
        random = np.random.default_rng([98, number])
        sliding, e = random.choice([0, random.uniform(0, 0.5)]), random.choice([1, random.uniform(0.3, 1)])
        high, t_end, n = random.uniform(0.3, 2), random.uniform(1, 8), random.integers(3, 60)
        start, speed = high * random.uniform(-1, 1, 2), random.uniform(-2, 2, 2)
        values = {"sliding": sliding, "low": -high, "high": high, "e": e}
        run = stepper.integrate(start, velocity=speed, h=t_end / n, t_end=t_end, parameters=values)
        place, velocity = Puck(sliding, high, e).after(start, speed, t_end)
        assert np.abs(run.q[-1] - place).max() <= 1e-12, number
        assert np.abs(run.velocity[-1] - velocity).max() <= 1e-12, number
