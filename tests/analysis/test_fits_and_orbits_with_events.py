"""Fits and periodic orbits of systems whose events change the state, of coordinates and of arrays."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

FLAGS = ("-O1",)
E = 0.8
"""Restitution of the table."""


@pytest.fixture(scope="module")
def table() -> sc.Stepper:
    """Ball on the table A sin t: y is the distance from it."""
    system = lagrange("table", "y", "y_dot**2/2 - (1 - A*sin(t))*y", A=0.8)
    return sc.compile_stepper(system, "svi:6", flags=FLAGS, events=sc.impact("y", E))


def start_of_period_one(amplitude: float) -> tuple[float, float]:
    """Phase of the impacts and velocity after them."""
    return np.arccos(np.pi * (1 - E) / (1 + E) / amplitude), 2 * np.pi * E / (1 + E)


def multipliers_of_flights(orbit, amplitude):
    """Multipliers from the exact map (time, velocity) of one impact to the next."""
    (hits,), matrix = orbit.run().events, np.eye(2)
    times, speeds = np.append(hits.t, hits.t[0] + orbit.period), -E * hits.p[:, 0]
    for (t0, t1), u in zip(np.stack([times[:-1], times[1:]], axis=1), speeds, strict=True):
        (g0, g1), s = 1 - amplitude * np.sin([t0, t1]), t1 - t0
        arrival = u - s + amplitude * (np.cos(t0) - np.cos(t1))
        later = -np.array([g0 * s - u, s]) / arrival
        matrix = np.array([later, -E * (np.array([g0, 1.0]) - g1 * later)]) @ matrix
    return len(speeds), matrix


def test_ball_on_a_vibrating_table_has_orbits_of_period_one_and_two(table):
    """Period one against its closed formula, tr M = (1 + e)^2 (1 - A sin phase) - 2 e; period two by its flights."""
    phase, speed = start_of_period_one(0.8)
    orbit = sc.periodic_orbit(table, [3.5], [-2.7], period=2 * np.pi, fixed_period=True, h=0.1)
    flight = table.integrate([0.0], [np.pi * (1 + (E - 1) / (1 + E))], t=phase, h=0.1, t_end=2 * np.pi)
    assert abs(orbit.q - flight.q[-1]).max() < 1e-13
    assert abs(orbit.multipliers.sum() - ((1 + E) ** 2 * (1 - 0.8 * np.sin(phase)) - 2 * E)) < 1e-12
    assert abs(orbit.multipliers.prod() - E**2) < 1e-13
    assert orbit.stable
    adaptive = sc.periodic_orbit(table, [3.5], [-2.7], period=2 * np.pi, fixed_period=True)
    assert adaptive.steps < 20
    assert abs(adaptive.q - orbit.q).max() < 1e-12
    assert abs(adaptive.monodromy - orbit.monodromy).max() < 1e-11
    known = {"A": 1.15}
    phase, speed = start_of_period_one(1.15)
    late = table.integrate([0.1], [speed], t=phase, h=0.1, t_end=60 * np.pi, parameters=known)
    at = {"fixed_period": True, "h": 0.1, "parameters": known}
    one = sc.periodic_orbit(table, late.q[-1], late.p[-1], period=2 * np.pi, **at)
    two = sc.periodic_orbit(table, late.q[-1], late.p[-1], period=4 * np.pi, **at)
    assert (one.stable, two.stable) == (False, True)
    assert abs(one.multipliers.sum() - ((1 + E) ** 2 * (1 - 1.15 * np.sin(phase)) - 2 * E)) < 1e-12
    count, matrix = multipliers_of_flights(two, 1.15)
    assert count == 2
    assert abs(two.multipliers.sum() - np.trace(matrix)) < 1e-12


def test_orbits_of_billiards_have_the_multipliers_of_mirrors():
    """Two mirrors of radius R at distance L: half the trace of the round trip is 2 g^2 - 1, g = 1 - L/R."""
    point = sc.compile_stepper(lagrange("point", "x y", "(x_dot**2 + y_dot**2)/2"), "svi:1", flags=FLAGS)
    ellipse = point.with_events(sc.impact("1 - (x/1.5)**2 - y**2"))
    discs = point.with_events([sc.impact("(x - 3/2)**2 + y**2 - 1"), sc.impact("(x + 3/2)**2 + y**2 - 1")])
    for stepper, velocity, ratio, period in ((ellipse, [0.01, 1.0], 2 / 2.25, 4.0), (discs, [1.0, 0.01], -1.0, 2.0)):
        orbit = sc.periodic_orbit(stepper, [0.02, 0.03], velocity=velocity, period=period + 0.05, steps=9, energy=0.5)
        half = 2 * (1 - ratio) ** 2 - 1
        assert abs(orbit.period - period) < 1e-12
        assert min(abs(orbit.stability_indices - half)) < 1e-12
        assert min(abs(orbit.stability_indices - 1)) < 1e-12
        run = orbit.run()
        by_h = run.tangent(np.eye(6)[:, 5])[-1]  # with respect to the size of 9 steps
        assert abs(by_h - [*(9 * run.p[-1]), 0.0, 0.0]).max() < 1e-12


def test_fit_of_restitution_and_wall_from_bounces():
    """Exact parameters from exact heights, and parameters within their errors from noisy ones."""
    with pytest.warns(sc.SystemDefinitionWarning, match="'e' does not occur"):
        ball = lagrange("ball", "y", "y_dot**2/2 - g*y", g=1.0, e=0.8, w=0.1)
    stepper = sc.compile_stepper(ball, "svi:2", flags=FLAGS, events=sc.impact("y - w", "e"))
    exact, t = {"g": 1.05, "e": 0.77, "w": 0.12}, np.linspace(0.05, 6.3, 40)
    heights = stepper.integrate([1.0], [0.0], h=0.1, t_end=6.4, parameters=exact, t_eval=t).q[:, 0]
    given = {"q": [1.0], "p": [0.0], "h": 0.2, "start": 0.0, "fit_initial_state": False}
    assert abs(sc.fit(stepper, t, heights, **given).values - list(exact.values())).max() < 1e-12
    noisy = sc.fit(stepper, t, heights + 0.01 * np.random.default_rng(3).normal(size=40), **given)
    errors = np.array(list(noisy.standard_errors.values()))
    assert (abs(noisy.values - list(exact.values())) < 4 * errors).all()
    assert (errors < 0.02).all()
    ended = stepper.with_events(sc.impact("y - w", "e", terminal=2))
    with pytest.raises(sc.EventError, match="end the run at t = 3"):
        sc.fit(ended, t, heights, **given)


@pytest.fixture(scope="module")
def billiard() -> sc.Stepper:
    """Point without forces in a plane."""
    system = lagrange("billiard", "x y", "(x_dot**2 + y_dot**2)/2 + 0*w", w=0.5)
    return sc.compile_stepper(system, "svi:1", flags=FLAGS)


def test_derivatives_through_impacts_at_the_ends_of_steps(billiard):
    """Impacts within roundings of the end of a step: x(T) = 2 w - x - v T, T = 12 h, by (x, y, v), w, t and h."""
    walled = billiard.with_events(sc.impact("w - x"))
    for v, h, n in ((1.0, 0.1, 7), (1.0, 1 / 3, 2), (0.99, 0.1, 10), (0.49, 0.37, 11)):
        x = billiard.integrate([0.0, 0.0], [v, 0.3], h=h, steps=n).q[-1, 0]
        for k in range(-6, 7):
            known = {"w": x + k * np.spacing(x)}
            run = walled.integrate([0.0, 0.0], [v, 0.3], h=h, steps=12, parameters=known)
            s = run.sensitivity()
            by = np.concatenate([np.ravel(each[-1][0]) for each in (s.state, s.parameters, s.t, s.h)])
            assert abs(by - [-1, 0, -12 * h, 0, 2, 0, -12 * v]).max() < 1e-12
