"""Runs with contacts and error=: of random motions estimates are bounds of the errors, by closed forms and DOP853."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import scvi_codegen as sc

G = 9.81


def bounces(t: float, y: float, v: float, e: float) -> Any:
    while y or v > 1e-14:
        flight = (v + np.sqrt(v * v + 2 * G * y)) / G
        if t <= flight:
            return [y + v * t - G / 2 * t * t], [v - G * t]
        t, y, v = t - flight, 0.0, e * (G * flight - v)
    return [0.0], [0.0]


def oscillates(t: float, x: float, d: float) -> Any:
    while abs(x) > d and t > np.pi:
        t, x = t - np.pi, 2 * np.copysign(d, x) - x
    centre = np.copysign(min(d, abs(x)), x)
    return [centre + (x - centre) * np.cos(t)], [-(x - centre) * np.sin(t)]


def rides(t: float, x: float, w: float, d: float, s: float) -> Any:
    s, slip = s + d, 2 * np.pi - 2 * np.arctan(s / w)
    while t > (s - x) / w:
        t -= (s - x) / w
        if t <= slip:
            return [d + (s - d) * np.cos(t) + w * np.sin(t)], [-(s - d) * np.sin(t) + w * np.cos(t)]
        t, x = t - slip, 2 * d - s
    return [x + w * t], [w]


def rolls(t: float, v: float, mu: float) -> Any:
    s = min(t, 2 * v / (7 * mu * G))
    speed, spin = v - mu * G * s, 5 * mu * G * s
    return [v * s - mu * G / 2 * s**2 + speed * (t - s), 0.5, spin * (t - s / 2)], [speed, 0.0, spin]


@cache
def ladder(start: float) -> Any:
    """A ladder of length 2 leaves the wall at sin a = 2/3 sin a0."""
    options: Any = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15, "dense_output": True}
    leaves = lambda _, z: np.sin(z[0]) - 2 / 3 * np.sin(start)  # noqa: E731
    leaves.terminal = True  # type: ignore[attr-defined]
    slides = solve_ivp(lambda _, z: [z[1], -0.75 * G * np.cos(z[0])], (0, 9), [start, 0.0], events=leaves, **options)
    t, (a, w) = slides.t[-1], slides.y[:, -1]
    spin = lambda z: (np.sin(z[1]) * z[3] ** 2 - G) * np.cos(z[1]) / (np.cos(z[1]) ** 2 + 1 / 3)  # noqa: E731
    x = [np.cos(a), a, -np.sin(a) * w, w]
    return t, slides.sol, solve_ivp(lambda _, z: [z[2], z[3], 0.0, spin(z)], (t, t + 1), x, **options).sol


def falls(t: float, start: float) -> Any:
    end, slides, free = ladder(start)
    a, w = slides(t)
    x, a, v, w = (np.cos(a), a, -np.sin(a) * w, w) if t <= end else free(t)
    return [x, np.sin(a), a], [v, np.cos(a) * w, w]


PLANE = f"(x_dot**2 + y_dot**2)/2 + a_dot**2/J - {G}*y"
WALL, FLOOR = sc.contact("x - cos(a)"), sc.contact("y - sin(a)")
ROLLS = sc.contact("y - 1/2", slip="x_dot - a_dot/2", friction="mu")
FAMILIES: dict[Any, tuple[str, str, tuple[Any, ...], dict[str, tuple[float, float]]]] = {
    bounces: (
        "y", f"y_dot**2/2 - {G}*y", (sc.contact("y", restitution="e"),), {"y": (0.2, 2), "v": (-1, 1), "e": (0, 0.9)},
    ),
    oscillates: ("x", "x_dot**2/2 - x**2/2", (sc.friction("x_dot", limit="d"),), {"x": (0.5, 2), "d": (0.05, 0.3)}),
    rides: (
        "x", "x_dot**2/2 - x**2/2", (sc.friction("x_dot - w", limit="d", static_limit="d + s"),),
        {"x": (-0.05, 0), "w": (0.1, 0.5), "d": (0.1, 0.3), "s": (0.05, 0.2)},
    ),
    rolls: ("x y a", PLANE.replace("J", "20"), (ROLLS,), {"v": (0.5, 5), "mu": (0.1, 0.6)}),
    falls: ("x y a", PLANE.replace("J", "6"), (WALL, FLOOR), {"start": (0.9, 1.4)}),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning", "ignore::scvi_codegen.SystemDefinitionWarning")
@pytest.mark.rotated
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
def test_estimates_are_right_and_no_motion_is_falsely_confirmed(family: Any) -> None:
    coordinates, lagrangian, contacts, ranges = FAMILIES[family]
    parameters = dict.fromkeys({*ranges} & {"e", "d", "w", "s", "mu"}, 0.1)
    system = sc.LagrangianSystem.from_text(
        "s", coordinates.split(), lagrangian, parameters=parameters, contacts=contacts
    )
    stepper, confirmed, random = sc.compile_stepper(system, "svi:3"), 0, np.random.default_rng(len(ranges))
    for _ in range(20):
        values = {name: random.uniform(*bounds) for name, bounds in ranges.items()}
        (q, velocity), error = family(0.0, **values), 10.0 ** random.uniform(-10.0, -3.0)
        span = random.uniform(0.5, 1.1) * ladder(**values)[0] if family is falls else random.uniform(0.5, 15.0)
        parameters = {name: values[name] for name in parameters}
        run = stepper.integrate(q, velocity=velocity, t_end=span, error=error, parameters=parameters)
        until, worst = run.t <= run.confirmed_until, 0.0
        states = np.array([family(t, **values) for t in run.t])
        for k, found in enumerate((run.q, run.velocity)):
            sizes = np.ptp(states[until, k], axis=0)
            errors = np.abs(found - states[:, k]) / np.where(sizes > 0.0, sizes, sizes.max() or 1.0)
            worst = max(worst, errors[until & ~np.isin(run.t, run.modes.t)].max(initial=0.0))  # away from impacts
        assert worst <= error, (values, error, worst)
        of_judge = 1e-11 if family is falls else 2e-15  # DOP853; rounding of closed forms
        assert not run.confirmation.confirmed or worst <= 1.05 * run.global_error + of_judge
        confirmed += run.confirmation.confirmed
    assert confirmed >= 18


@pytest.mark.second
def test_a_run_with_several_consistent_modes_is_not_confirmed() -> None:
    """Painleve's rod, which may slide or lift: all runs choose the same one of two motions."""
    lagrangian, a = "(x_dot**2 + y_dot**2)/2 + a_dot**2/6 - y", np.arctan(0.5)
    rod = sc.LagrangianSystem.from_text("rod", ["x", "y", "a"], lagrangian)
    floor = sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction=1.5)
    stepper = sc.compile_stepper(rod, "svi:2", contacts=[floor])
    several, remedy = "several motions", r"; reduce the friction, or change the geometry\)\.$"
    with pytest.warns(sc.EventWarning, match=several), pytest.warns(sc.AccuracyWarning, match=f"{several} .*{remedy}"):
        run = stepper.integrate([0, np.cos(a), a], velocity=[-3, 1.2 * np.sin(a), -1.2], t_end=0.05, error=1e-8)
    assert run.confirmed_until == 0.0
