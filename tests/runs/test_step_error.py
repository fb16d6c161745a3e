"""The error estimate of a step compared with the error, also where a coefficient of the curve passes through zero."""

import math

import numpy as np
import pytest
from notation import lagrange

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
@pytest.mark.parametrize("method", ["svi:2", "svi:3", "svi:4"])
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
    """100 pulses J (1 - cos(2 pi (t - a)/w))/w from a to a + w on an oscillator, which points of a part may not see."""
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
        for h in (0.02, 0.05):
            run = stepper.integrate([x], velocity=[v], h=h, t_end=2.0, parameters={"J": J, "a": a, "w": w})
            error = max(abs(run.q[-1, 0] - exact[0]), abs(run.velocity[-1, 0] - exact[1]))
            wrong += error > 2e-2
            assert error < 2e-2 or run.step_error > 1e-4, (number, h, error, run.step_error)
    assert (wrong > 0) == (method != "svi:4")
