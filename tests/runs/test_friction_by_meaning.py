"""Dry friction is what forces mean, however they are written: random oscillators beside DOP853 from stop to stop."""

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import scvi_codegen as sc

SPAN, ACCURACY = 10.0, {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15}
LIMIT = "c0 + c1*unit_step(x) + c2*abs(x) + c3*abs(2 - 3*x) + c4*max(0, 1 - x)"
EDGES = 0.0, 2.0 / 3.0, 1.0
"""Positions at which the limit is not smooth."""


def limit(x, c):
    return c[0] + c[1] * (x > 0) + c[2] * abs(x) + c[3] * abs(2 - 3 * x) + c[4] * max(0.0, 1 - x)


def position_after(k, amplitude, w, c, x, v):
    """Return the position after ``SPAN`` of a driven oscillator with friction, from one stop or edge to the next."""
    t, force = 0.0, lambda t, x: amplitude * math.cos(w * t) - k * x
    while t < SPAN:
        if v == 0.0 and abs(force(t, x)) <= limit(x, c) * (1 + 1e-12):

            def excess(s, x=x):
                return abs(force(s, x)) - limit(x, c)

            times = np.linspace(t, SPAN, 2000)
            above = np.flatnonzero([excess(s) > 0 for s in times[1:]])
            if not len(above):
                return x
            t = brentq(excess, times[above[0]], times[above[0] + 1], xtol=1e-15) if above[0] else times[1]
        d = math.copysign(1.0, v or force(t, x))

        def rates(t, y, d=d):
            return [y[1], force(t, y[0]) - d * limit(y[0], c)]

        first = solve_ivp(rates, (t, min(t + 1e-6, SPAN)), [x, v], **ACCURACY)  # away from the stop
        t, (x, v) = first.t[-1], first.y[:, -1]
        ends = [lambda t, y: y[1], *(lambda t, y, edge=edge: y[0] - edge for edge in EDGES)]
        for end in ends:
            end.terminal = True
        smooth = solve_ivp(rates, (t, SPAN), [x, v], events=ends, **ACCURACY) if v * d > 0 and t < SPAN else first
        t, (x, v) = smooth.t[-1], smooth.y[:, -1]
        v = 0.0 if v * d <= 0 or (smooth is not first and len(smooth.t_events[0])) else v
    return x


@pytest.mark.second
def test_forces_with_a_jump_against_a_slip_are_friction():
    """The limit is a formula with kinks and no known sign, the slip that of an odd power; parts of it may be 0."""
    oscillator = lagrange(
        "oscillator", "x", "x_dot**2/2 - k*x**2/2", forces={"x": f"A*cos(w*t) - ({LIMIT})*sign(x_dot**3)"},
        k=1.0, A=1.0, w=1.0, **{f"c{i}": 0.2 for i in range(5)},
    )  # fmt: skip
    stepper = sc.compile_stepper(oscillator)
    for number in range(12):
        random = np.random.default_rng([7, number])
        k, amplitude, w = random.uniform(0.2, 3), random.uniform(0, 2), random.uniform(0.3, 2)
        c = random.uniform(0, 0.3, 5) * (random.random(5) < 0.6)
        x, v = random.uniform(-2, 2), random.choice([0.0, random.uniform(-2, 2)])
        values = {"k": k, "A": amplitude, "w": w, **{f"c{i}": value for i, value in enumerate(c)}}
        exact = position_after(k, amplitude, w, c, x, v)
        for steps in ({"tolerance": 1e-10}, {"h": 0.02}):
            run = stepper.integrate([x], velocity=[v], t_end=SPAN, parameters=values, **steps)
            assert run.q[-1, 0] == pytest.approx(exact, abs=1e-8), (number, steps)


PEAKS = {
    name: f"({a} + {b}*exp(-({name}_dot/{w})**2))" for name, a, b, w in zip("xyu", "ace", "bdf", "wsr", strict=True)
}
"""Stribeck friction of each slip."""


@cache
def sliders(order, method):
    """Return a stepper of sliders with friction by a limit, a gap and a formula, and a free companion."""
    contacts = [sc.friction("x_dot", limit=PEAKS["x"]), sc.contact("h", slip="y_dot", friction=f"{PEAKS['y']}/g")]
    system = lagrange(
        "sliders", "x y u z h", "(x_dot**2 + y_dot**2 + u_dot**2 + z_dot**2 + h_dot**2)/2 - k*x**2/2 - g*h",
        forces={"u": f"-{PEAKS['u']}*sign(u_dot)"}, g=9.81, k=0.0,
        **dict.fromkeys("acbdef", 0.1), **dict.fromkeys("wsr", 0.1),
    )  # fmt: skip
    return sc.compile_stepper(system, method, contacts=contacts[::order])


def stop_of(a, b, w, v, k=0.0):
    """Return place and time of the stop of a slider with a spring, by DOP853 with its velocity in place of time."""
    rates = lambda v, y: [-v / (resists := a + b * math.exp(-((v / w) ** 2)) + k * y[0]), -1 / resists]  # noqa: E731
    state = [0.0, 0.0]
    ends = sorted({min(part * w, v) for part in (0, 0.5, 1, 2, 3, 4, 6)} | {v}, reverse=True)
    for span in pairwise(ends):
        state = solve_ivp(rates, span, state, method="DOP853", rtol=3e-14, atol=1e-18).y[:, -1]
    return state


@pytest.mark.second
@pytest.mark.parametrize(
    ("method", "tolerance"), [("svi:2", 1e-10), ("svi:3", 1e-4), ("svi:3", 1e-7), ("svi:3", 1e-10)]
)
def test_friction_that_varies_along_slips_is_judged(method, tolerance):
    """Peaks of a width from 6e-4 to 1 of the first slip, of which most lie behind the last point of a step."""
    for number in range(12):
        random = np.random.default_rng([97, number])
        a, v = random.uniform(0.05, 1, 3), random.uniform(0.3, 2, 3)
        b, w = a * 10 ** random.uniform(-1, 1, 3), v * 10 ** random.uniform(np.log10(6e-4), 0, 3)
        k = random.choice([0.0, random.uniform(0.02, 0.5)]) * a[0] ** 2 / v[0] ** 2
        values = dict(zip(["a", "c", "e", "b", "d", "f", "w", "s", "r", "k"], [*a, *b, *w, k], strict=True))
        stops = [stop_of(*data, k * (i == 0)) for i, data in enumerate(zip(a, b, w, v, strict=True))]
        start = {"velocity": [*v, 1.0, 0.0], "t_end": 1.1 * max(t for _, t in stops), "parameters": values}
        run, permuted = (sliders(order, method).integrate([0.0] * 5, **start, tolerance=tolerance) for order in (1, -1))
        for i, (place, t) in enumerate(stops):
            stop = np.flatnonzero(np.abs(run.velocity[:, i]) < 1e-13)[0]
            assert run.q[stop, i] == pytest.approx(place, rel=10 * tolerance), (number, i)
            assert run.t[stop] == pytest.approx(t, rel=10 * tolerance), (number, i)
        assert np.array_equal(run.q, permuted.q), number
        assert np.array_equal(run.t, permuted.t), number
