"""Runs with contacts and error=: random motions, whose estimates are bounds of the true errors, by closed forms."""

import warnings
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import scvi_codegen as sc

G = 9.81
MEMBERS, ACCURACY = range(20), (0.0, 1e-11)
"""Motions of each family; errors of closed forms and of DOP853."""
Exact = Callable[[float], tuple[list[float], list[float]]]
"""Positions and velocities at a time."""


def bounces(u: Any) -> tuple[dict[str, float], list[float], list[float], float, Exact]:
    """A ball on a floor, in flights and at rest after infinitely many impacts."""
    y0, v0, e, span = u(0.2, 2.0), u(-1.0, 1.0), u(0.0, 0.9), u(0.5, 6.0)

    def exact(t: float) -> tuple[list[float], list[float]]:
        y, v = y0, v0
        for _ in range(2000):
            flight = (v + np.sqrt(v * v + 2 * G * y)) / G
            if t <= flight:
                return [y + v * t - G / 2 * t * t], [v - G * t]
            t, y, v = t - flight, 0.0, e * (G * flight - v)
            if v < 1e-14:
                break
        return [0.0], [0.0]

    return {"e": e}, [y0], [v0], span, exact


def oscillates(u: Any) -> tuple[dict[str, float], list[float], list[float], float, Exact]:
    """An oscillator with dry friction, in half swings until it stops."""
    x0, d, span = u(0.5, 2.0), u(0.05, 0.3), u(3.0, 25.0)

    def exact(t: float) -> tuple[list[float], list[float]]:
        x = x0
        while abs(x) > d:
            centre = np.copysign(d, x)
            if t <= np.pi:
                return [centre + (x - centre) * np.cos(t)], [-(x - centre) * np.sin(t)]
            t, x = t - np.pi, 2 * centre - x
        return [x], [0.0]

    return {"d": d}, [x0], [0.0], span, exact


def rides(u: Any) -> tuple[dict[str, float], list[float], list[float], float, Exact]:
    """An oscillator on a belt, which sticks up to the static limit and slips until it has the speed of the belt."""
    w, d, span = u(0.1, 0.5), u(0.1, 0.3), u(5.0, 30.0)
    s, x0 = d + u(0.05, 0.2), -u(0.0, 0.05)

    def exact(t: float) -> tuple[list[float], list[float]]:
        x = x0
        while t > (s - x) / w:
            t, slip = t - (s - x) / w, 2 * np.pi - 2 * np.arctan((s - d) / w)
            if t <= slip:
                there = d + (s - d) * np.cos(t) + w * np.sin(t)
                return [there], [-(s - d) * np.sin(t) + w * np.cos(t)]
            t, x = t - slip, 2 * d - s
        return [x + w * t], [w]

    return {"w": w, "d": d, "s": s}, [x0], [w], span, exact


def rolls(u: Any) -> tuple[dict[str, float], list[float], list[float], float, Exact]:
    """A ball that slides, then rolls."""
    v, mu, span = u(0.5, 5.0), u(0.1, 0.6), u(0.2, 3.0)

    def exact(t: float) -> tuple[list[float], list[float]]:
        slide = min(t, 2 * v / (7 * mu * G))
        rolling, speed, spin = t - slide, v - mu * G * slide, 5 * mu * G * slide  # of a radius of 1/2
        x, a = v * slide - mu * G / 2 * slide**2, 2.5 * mu * G * slide**2
        return [x + speed * rolling, 0.5, a + spin * rolling], [speed, 0.0, spin]

    return {"mu": mu}, [0.0, 0.5, 0.0], [v, 0.0, 0.0], span, exact


def leaves(u: Any) -> tuple[dict[str, float], list[float], list[float], float, Exact]:
    """A ladder of length 2 that slides down a wall and leaves it at sin a = 2/3 sin a0; DOP853, restarted there."""
    a0, part = u(0.9, 1.4), u(0.5, 1.3)
    options: dict[str, Any] = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15, "dense_output": True}

    def free(_: float, z: Any) -> list[float]:
        x, a, v, w = z
        return [v, w, 0.0, (np.sin(a) * w * w - G) * np.cos(a) / (np.cos(a) ** 2 + 1 / 3)]

    def departs(_: float, z: Any) -> float:
        return float(np.sin(z[0]) - 2 / 3 * np.sin(a0))

    departs.terminal = True  # type: ignore[attr-defined]
    slides = solve_ivp(lambda _, z: [z[1], -0.75 * G * np.cos(z[0])], (0, 9), [a0, 0.0], events=departs, **options)
    t1, (a, w) = slides.t[-1], slides.y[:, -1]
    falls = solve_ivp(free, (t1, t1 + 1.0), [np.cos(a), a, -np.sin(a) * w, w], **options)
    hits = falls.t[np.argmax(falls.y[1] < 0.1)] - t1

    def exact(t: float) -> tuple[list[float], list[float]]:
        if t <= t1:
            a, w = slides.sol(t)
            x, v = np.cos(a), -np.sin(a) * w
        else:
            x, a, v, w = falls.sol(t)
        return [x, np.sin(a), a], [v, np.cos(a) * w, w]

    return {}, [np.cos(a0), np.sin(a0), a0], [0.0, 0.0, 0.0], part * t1 if part < 1 else t1 + hits * (part - 1), exact


PLANE = f"(x_dot**2 + y_dot**2)/2 + a_dot**2/J - {G}*y"
FAMILIES: dict[Any, tuple[str, str, list[Any]]] = {
    bounces: ("y", f"y_dot**2/2 - {G}*y", [sc.contact("y", restitution="e")]),
    oscillates: ("x", "x_dot**2/2 - x**2/2", [sc.friction("x_dot", limit="d")]),
    rides: ("x", "x_dot**2/2 - x**2/2", [sc.friction("x_dot - w", limit="d", static_limit="s")]),
    rolls: ("x y a", PLANE.replace("J", "20"), [sc.contact("y - 1/2", slip="x_dot - a_dot/2", friction="mu")]),
    leaves: ("x y a", PLANE.replace("J", "6"), [sc.contact("x - cos(a)"), sc.contact("y - sin(a)")]),
}


@cache
def stepper_of(family: Any) -> Any:
    coordinates, lagrangian, contacts = FAMILIES[family]
    parameters = dict.fromkeys(family(lambda low, high: (low + high) / 2)[0], 0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sc.SystemDefinitionWarning)  # of parameters that contacts contain
        system = sc.LagrangianSystem.from_text(
            family.__name__, coordinates.split(), lagrangian, parameters=parameters, contacts=contacts
        )
    return sc.compile_stepper(system, "svi:3")


@pytest.mark.rotated
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_estimates_are_bounds_and_no_motion_is_falsely_confirmed(family: Any) -> None:
    confirmed = 0
    for seed in MEMBERS:
        random = np.random.default_rng([seed, len(family.__name__)])
        parameters, q, v, span, exact = family(random.uniform)
        error = 10.0 ** random.uniform(-10.0, -3.0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", sc.AccuracyWarning)
            run = stepper_of(family).integrate(q, velocity=v, t_end=span, error=error, parameters=parameters)
        until = run.t <= run.confirmed_until
        rows = until & ~np.isin(run.t, run.modes.t)  # velocities jump at impacts
        states = np.array([exact(t) for t in run.t])
        worst = 0.0
        for k, found in enumerate((run.q, run.velocity)):
            sizes = np.ptp(states[until, k], axis=0)
            sizes = np.where(sizes > 0.0, sizes, sizes.max() or 1.0)
            worst = max(worst, (np.abs(found - states[:, k])[rows] / sizes).max(initial=0.0))
        assert worst <= error, (seed, error, worst)
        assert not run.confirmation.confirmed or worst <= run.global_error + ACCURACY[family is leaves]
        confirmed += run.confirmation.confirmed
    assert confirmed >= len(MEMBERS) - 2
