"""Runs with contacts and error=: of random motions estimates are bounds of the errors, by closed forms and DOP853."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import scvi_codegen as sc

G, MEMBERS = 9.81, range(20)


def bounces(u: Any) -> Any:
    """A ball on a floor, in flights and at rest after infinitely many impacts."""
    start, v0, e = u(0.2, 2.0), u(-1.0, 1.0), u(0.0, 0.9)

    def exact(t: float) -> Any:
        y, v = start, v0
        while y or v > 1e-14:
            flight = (v + np.sqrt(v * v + 2 * G * y)) / G
            if t <= flight:
                return [y + v * t - G / 2 * t * t], [v - G * t]
            t, y, v = t - flight, 0.0, e * (G * flight - v)
        return [0.0], [0.0]

    return {"e": e}, [start], [v0], u(0.5, 6.0), exact


def oscillates(u: Any) -> Any:
    """An oscillator with dry friction, in half swings until it stops."""
    start, d = u(0.5, 2.0), u(0.05, 0.3)

    def exact(t: float) -> Any:
        x = start
        while abs(x) > d:
            centre = np.copysign(d, x)
            if t <= np.pi:
                return [centre + (x - centre) * np.cos(t)], [-(x - centre) * np.sin(t)]
            t, x = t - np.pi, 2 * centre - x
        return [x], [0.0]

    return {"d": d}, [start], [0.0], u(3.0, 25.0), exact


def rides(u: Any) -> Any:
    """An oscillator on a belt, which sticks up to the static limit and slips until it has the speed of the belt."""
    w, d, start = u(0.1, 0.5), u(0.1, 0.3), -u(0.0, 0.05)
    s = d + u(0.05, 0.2)

    def exact(t: float) -> Any:
        x, slip = start, 2 * np.pi - 2 * np.arctan((s - d) / w)
        while t > (s - x) / w:
            t -= (s - x) / w
            if t <= slip:
                return [d + (s - d) * np.cos(t) + w * np.sin(t)], [-(s - d) * np.sin(t) + w * np.cos(t)]
            t, x = t - slip, 2 * d - s
        return [x + w * t], [w]

    return {"w": w, "d": d, "s": s}, [start], [w], u(5.0, 30.0), exact


def rolls(u: Any) -> Any:
    """A ball of radius 1/2 that slides, then rolls."""
    v, mu = u(0.5, 5.0), u(0.1, 0.6)

    def exact(t: float) -> Any:
        s = min(t, 2 * v / (7 * mu * G))
        speed, spin = v - mu * G * s, 5 * mu * G * s
        place = [v * s - mu * G / 2 * s**2 + speed * (t - s), 0.5, 2.5 * mu * G * s**2 + spin * (t - s)]
        return place, [speed, 0.0, spin]

    return {"mu": mu}, [0.0, 0.5, 0.0], [v, 0.0, 0.0], u(0.2, 3.0), exact


def leaves(u: Any) -> Any:
    """A ladder of length 2 that slides down a wall and leaves it at sin a = 2/3 sin a0."""
    a0, options = u(0.9, 1.4), {"method": "DOP853", "rtol": 1e-13, "atol": 1e-15, "dense_output": True}
    departs = lambda _, z: np.sin(z[0]) - 2 / 3 * np.sin(a0)  # noqa: E731
    departs.terminal = True  # type: ignore[attr-defined]
    slides = solve_ivp(lambda _, z: [z[1], -0.75 * G * np.cos(z[0])], (0, 9), [a0, 0.0], events=departs, **options)
    t1, (a, w) = slides.t[-1], slides.y[:, -1]
    spin = lambda z: (np.sin(z[1]) * z[3] ** 2 - G) * np.cos(z[1]) / (np.cos(z[1]) ** 2 + 1 / 3)  # noqa: E731
    x = [np.cos(a), a, -np.sin(a) * w, w]
    falls = solve_ivp(lambda _, z: [z[2], z[3], 0.0, spin(z)], (t1, t1 + 1.0), x, **options)

    def exact(t: float) -> Any:
        a, w = slides.sol(t)
        x, a, v, w = (np.cos(a), a, -np.sin(a) * w, w) if t <= t1 else falls.sol(t)
        return [x, np.sin(a), a], [v, np.cos(a) * w, w]

    return {}, [np.cos(a0), np.sin(a0), a0], [0.0, 0.0, 0.0], t1 * u(0.5, 1.1), exact


PLANE = f"(x_dot**2 + y_dot**2)/2 + a_dot**2/J - {G}*y"
FAMILIES: dict[Any, tuple[str, str, list[Any]]] = {
    bounces: ("y", f"y_dot**2/2 - {G}*y", [sc.contact("y", restitution="e")]),
    oscillates: ("x", "x_dot**2/2 - x**2/2", [sc.friction("x_dot", limit="d")]),
    rides: ("x", "x_dot**2/2 - x**2/2", [sc.friction("x_dot - w", limit="d", static_limit="s")]),
    rolls: ("x y a", PLANE.replace("J", "20"), [sc.contact("y - 1/2", slip="x_dot - a_dot/2", friction="mu")]),
    leaves: ("x y a", PLANE.replace("J", "6"), [sc.contact("x - cos(a)"), sc.contact("y - sin(a)")]),
}


@pytest.mark.rotated
@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.__name__)
@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning", "ignore::scvi_codegen.SystemDefinitionWarning")
def test_estimates_are_bounds_and_no_motion_is_falsely_confirmed(family: Any) -> None:
    coordinates, lagrangian, contacts = FAMILIES[family]
    values = dict.fromkeys(family(np.random.default_rng(0).uniform)[0], 0.1)
    system = sc.LagrangianSystem.from_text("s", coordinates.split(), lagrangian, parameters=values, contacts=contacts)
    stepper, confirmed = sc.compile_stepper(system, "svi:3"), 0
    for seed in MEMBERS:
        random = np.random.default_rng([seed, len(family.__name__)])
        parameters, q, v, span, exact = family(random.uniform)
        error = 10.0 ** random.uniform(-10.0, -3.0)
        run = stepper.integrate(q, velocity=v, t_end=span, error=error, parameters=parameters)
        until = run.t <= run.confirmed_until
        rows, worst = until & ~np.isin(run.t, run.modes.t), 0.0  # velocities jump at impacts
        states = np.array([exact(t) for t in run.t])
        for k, found in enumerate((run.q, run.velocity)):
            sizes = np.ptp(states[until, k], axis=0)
            sizes = np.where(sizes > 0.0, sizes, sizes.max() or 1.0)
            worst = max(worst, (np.abs(found - states[:, k])[rows] / sizes).max(initial=0.0))
        assert worst <= error, (seed, error, worst)
        reference = 1e-11 if family is leaves else 0.0  # error of DOP853
        assert not run.confirmation.confirmed or worst <= run.global_error + reference
        confirmed += run.confirmation.confirmed
    assert confirmed >= len(MEMBERS) - 2


def test_a_run_with_several_consistent_modes_is_not_confirmed() -> None:
    """Painleve's rod that may slide or lift: all runs choose the same motion, which is not the only one."""
    rod = sc.LagrangianSystem.from_text("rod", ["x", "y", "a"], f"{PLANE}".replace("J", "6").replace(f"{G}", "1"))
    floor, a = sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction=1.5), np.arctan(0.5)
    stepper = sc.compile_stepper(rod, "svi:2", contacts=[floor])
    with (
        pytest.warns(sc.EventWarning, match="2 modes"),
        pytest.warns(sc.AccuracyWarning, match="2 modes of the contacts"),
    ):
        run = stepper.integrate([0, np.cos(a), a], velocity=[-3, 1.2 * np.sin(a), -1.2], t_end=0.05, error=1e-8)
    assert run.confirmed_until == 0.0
