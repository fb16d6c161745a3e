"""Dry friction is what forces mean, however they are written: random oscillators beside DOP853 from stop to stop."""

import math

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import quad, solve_ivp
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


@pytest.mark.second
def test_limits_that_depend_on_the_slip_are_finite_far_from_rest():
    """x = integral of v dv / F(v) to the stop, of Stribeck friction with a narrow peak."""
    forces = {"x": "-(a + b*exp(-(x_dot/w)**2))*sign(x_dot)"}
    stepper = sc.compile_stepper(lagrange("stribeck", "x", "x_dot**2/2", forces=forces, a=0.1, b=0.4, w=0.01))
    for number in range(10):
        random = np.random.default_rng([3, number])
        a, w, v = random.uniform(0.05, 1), 10 ** random.uniform(-3.2, 0), random.uniform(0.3, 2)
        b = a * 10 ** random.uniform(-1, 1)
        peak = [min(k * w, v) for k in (1, 2, 3, 4, 6)]
        exact = quad(lambda v, a=a, b=b, w=w: v / (a + b * math.exp(-((v / w) ** 2))), 0, v, points=peak, epsabs=1e-14)[
            0
        ]
        values = {"a": a, "b": b, "w": w}
        run = stepper.integrate([0.0], velocity=[v], t_end=2 * v / a + 1, parameters=values, tolerance=1e-6)
        assert run.q[-1, 0] == pytest.approx(exact, rel=1e-4), number
