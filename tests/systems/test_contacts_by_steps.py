"""Contacts by steps: what rests does not creep, gaps stay, friction has its angle; random bodies and units."""

import math
import pickle
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy

import scvi_codegen as sc

CREEPS, PENETRATES, RESTS = 1e-12, 1e-10, 1e-10
"""Motion of what rests in 10 s and depth of a gap, of the size of the motion; kinetic energy at rest, of its range."""
BY_STEPS: dict[str, Any] = {"transitions": "by steps"}
WIDTH, HEIGHT = 0.5, 0.2


@cache
def box_system() -> Any:
    """Return a box on its corners, on a slope s; its reference point is off its centre: M(q)."""
    names = {
        "m": 1.0,
        "J": 0.1,
        "g": 9.81,
        "s": 0.0,
        "w": WIDTH,
        "d": HEIGHT,
        "o": 0.1,
        "mu": 0.5,
        "mus": 0.5,
        "e": 0.0,
    }
    speeds = "(x_dot - o*sin(a)*a_dot)**2 + (y_dot + o*cos(a)*a_dot)**2"
    height, along = "y + o*sin(a)", "x + o*cos(a)"
    corners = [(f"({i}*w + o)", f"({j}*d)") for i in (-1, 1) for j in (-1, 1)]
    contacts = [
        sc.contact(
            f"y + {u}*sin(a) + {v}*cos(a)",
            slip=f"x_dot - ({u}*sin(a) + {v}*cos(a))*a_dot",
            friction="mu",
            static_friction="mus",
            restitution="e",
        )
        for u, v in corners
    ]
    return sc.LagrangianSystem.from_text(
        "box",
        ["x", "y", "a"],
        f"m*({speeds})/2 + J*a_dot**2/2 - m*g*(({height})*cos(s) - ({along})*sin(s))",
        parameters=names,
        contacts=contacts,
    )


@cache
def box() -> Any:
    """Return the stepper of the box."""
    return sc.compile_stepper(box_system(), "svi:1")


@cache
def by_steps(system: Any) -> Any:
    """Return the stepper of a system whose contacts act in steps alone."""
    return sc.compile_stepper(system, "svi:1", **BY_STEPS)


class Box:
    """A random box in units of length and mass: parameters, times relative to sqrt(length / g)."""

    def __init__(self, number: int) -> None:
        self.random = np.random.default_rng(number)
        self.unit = float(10.0 ** self.random.integers(-6, 7))
        m = float(10.0 ** self.random.uniform(-2, 2))
        w, d, o = (self.unit * self.random.uniform(*ends) for ends in ((0.3, 0.6), (0.1, 0.3), (-0.1, 0.1)))
        self.values = {"m": m, "w": w, "d": d, "o": o, "J": m * (w**2 + d**2) / 3}
        self.time = float(np.sqrt(self.unit / 9.81))
        self.flat = np.array([-o, d, 0.0])

    def run(self, q: Any, v: Any, times: float, part: float = 5e-3, *, strict: bool = False, **further: Any) -> Any:
        """Return a run by steps of a part of the unit of time."""
        h = part * self.time
        way = BY_STEPS | {"strict_energy": strict, "parameters": self.values | further}
        return box().integrate(q, velocity=v, h=h, t_end=times * self.time, **way)

    def gaps(self, q: np.ndarray) -> np.ndarray:
        """Return the heights of the corners, relative to the unit."""
        w, d, o = (self.values[name] for name in "wdo")
        corners = [(i * w + o, j * d) for i in (-1, 1) for j in (-1, 1)]
        return np.array([q[:, 1] + u * np.sin(q[:, 2]) + v * np.cos(q[:, 2]) for u, v in corners]) / self.unit


@pytest.mark.tiers(2, 8)
@pytest.mark.parametrize("number", range(8))
def test_static_friction_holds_to_its_angle_and_sliding_has_its_acceleration(number: int) -> None:
    """A tenth of a degree below its angle a box at rest stays, a tenth above it slides with g (sin s - mu cos s)."""
    of = Box(number)
    mus = of.random.uniform(0.1, 0.6)
    mu, angle = mus * of.random.uniform(0.5, 0.9), np.arctan(mus)
    held, slides = (of.run(of.flat, [0, 0, 0], 30, mu=mu, mus=mus, s=angle + np.deg2rad(by)) for by in (-0.1, 0.1))
    assert (abs(held.q - held.q[0]) / [of.unit, of.unit, 1.0]).max() < CREEPS
    assert held.contact_modes[-1][1].count("stick") == 2
    t = slides.t[-1]
    s = angle + np.deg2rad(0.1)
    way = 9.81 * (np.sin(s) - mu * np.cos(s)) * t**2 / 2
    assert slides.q[-1, 0] - slides.q[0, 0] == pytest.approx(way, rel=1e-3)


@cache
def puck() -> Any:
    """Return the stepper of a body of mass m (1 + a sin^2 x) on a spring above a table that swings, with drag, curl."""
    names = dict.fromkeys(["m", "a", "k", "c", "d", "w", "mu", "e"], 1.0)
    system = sc.LagrangianSystem.from_text(
        "puck",
        ["x", "y"],
        "m*(1 + a*sin(x)**2)*(x_dot**2 + y_dot**2)/2 - 9.81*m*y - k*x**2/2",
        parameters=names,
        forces={"x": "-c*x_dot - d*y", "y": "-c*y_dot + d*x"},
        contacts=[sc.contact("y - 0.02*sin(w*t)", slip="x_dot", friction="mu", restitution="e")],
    )
    return sc.compile_stepper(system, "svi:1", **BY_STEPS)


def unbalanced(number: int, part: float) -> float:
    """Return E(0) - E(end) + work of the forces - lost_energy of a random puck, relative to the range of E."""
    random = np.random.default_rng(number)
    m, of = 10.0 ** random.uniform(-2, 2), random.uniform
    values = {"m": m, "a": of(0, 2), "w": of(3, 12), "e": of(0, 0.9), "mu": of(0, 1)}
    values |= {"k": m * of(0, 9), "c": m * of(0, 0.5), "d": m * of(0, 2)}
    start, v = [random.normal(), of(0.1, 1)], random.normal(size=2)
    run = puck().integrate(start, velocity=v, h=part, t_end=6.0, parameters=values)
    way, middle = np.diff(run.q, axis=0), (run.q[1:] + run.q[:-1]) / 2
    drag, curl = -values["c"] * way / np.diff(run.t)[:, np.newaxis], values["d"] * middle[:, ::-1] * [-1, 1]
    energy = run.energy()
    return (energy[0] - energy[-1] + ((drag + curl) * way).sum() - run.lost_energy) / np.ptp(energy)


def unbalanced_box(number: int, part: float) -> float:
    """Return E(0) - E(end) - lost_energy of a random box on a slope, relative to the range of E."""
    of = Box(1000 + number)
    q, v = np.array([0.0, 0.0, of.random.uniform(-np.pi, np.pi)]), of.random.normal(size=3)
    q[1] -= of.unit * (of.gaps(q[np.newaxis]).min() - 0.1)
    mu, (e, more, s) = of.random.uniform(0, 0.8), of.random.uniform([0, 1, 0], [0.9, 1.5, 0.3])
    run = of.run(q, v * [of.unit, of.unit, 1.0] / of.time, 20, part, e=e, mu=mu, mus=more * mu, s=s)
    energy = run.energy()
    return (energy[0] - energy[-1] - run.lost_energy) / np.ptp(energy)


@pytest.mark.parametrize("unbalanced_of", [unbalanced, unbalanced_box])
def test_lost_energy_is_the_change_of_energy_with_the_work_of_forces_at_second_order(unbalanced_of: Any) -> None:
    """Of 20 random bodies with impacts, friction, drag, a curl, a table that moves: what is left is that of a step."""
    coarse, fine = (np.abs([unbalanced_of(number, part) for number in range(20)]) for part in (0.01, 0.005))
    assert coarse.max() < 5e-4
    assert np.median(coarse / fine) == pytest.approx(4.0, abs=0.3)


@pytest.mark.tiers(1, 4)
@pytest.mark.parametrize("e", [0.9, 0.0, 0.5, 1.0])
def test_rebounds_have_their_restitution_and_gain_no_energy(e: float) -> None:
    of = Box(3)
    height = of.unit
    run = of.run(of.flat + np.array([0, height, 0]), [0, 0, 0], 4.2 if e else 3, 1e-3, e=e, mu=0.0, mus=0.0)
    lands = np.sqrt(2.0)
    later = run.t > (1 + 1e-2) * lands * of.time
    apex = (run.q[later, 1].max() - of.flat[1]) / height
    assert apex == pytest.approx(e**2, abs=5e-3)
    energy = run.energy()
    assert np.diff(energy).max() < 1e-9 * np.ptp(run.q[:, 1]) * of.values["m"] * 9.81


def test_order_is_two_in_flight_and_on_a_contact_that_slips() -> None:
    """Between transitions: a box that tumbles, and one that slides on a corner, whose rows turn."""
    of = Box(5)
    v = np.array([of.unit, 2 * of.unit, 3.0]) / of.time
    flight = [of.run([0, 3 * of.unit, 0.3], v, 1.0, part).q[-1] for part in (0.04, 0.02, 0.01)]
    corner = of.flat * [1, 0, 0] + [0, 0, 0.5]
    corner[1] -= of.unit * of.gaps(corner[np.newaxis]).min()
    tips = [of.run(corner, [0, 0, 0], 0.25, part, mu=0.05, mus=0.05).q[-1] for part in (0.05, 0.025, 0.0125)]
    for ends in (flight, tips):
        coarse, fine = (abs(ends[k] - ends[k + 1])[2] for k in range(2))
        assert np.log2(coarse / fine) == pytest.approx(2.0, abs=0.2)


def test_runs_continue_from_checkpoints_and_end_at_events() -> None:
    of = Box(2)
    q, v = of.flat + np.array([0, of.unit, 0.4]), np.array([of.unit, 0.0, 1.0]) / of.time
    stepper, settings = box().by_transitions("by steps"), {"h": 5e-3 * of.time, "parameters": of.values}
    run = stepper.start(q, velocity=v, **settings)
    run.advance(400)
    saved = run.checkpoint()
    run.advance(400)
    again = pickle.loads(pickle.dumps(stepper)).from_checkpoint(saved)
    again.advance(400)
    assert np.array_equal(run.q, again.q)
    assert np.array_equal(run.p, again.p)
    whole = of.run(q, v, 4.0)
    assert np.array_equal(run.q, whole.q[-1])
    times = np.array([0.5, 0.5025, 3.1]) * of.time
    sparse = box().integrate(q, velocity=v, t_end=4 * of.time, t_eval=times, **settings, **BY_STEPS)
    for k in range(3):
        assert np.allclose(sparse.q[:, k], np.interp(times, whole.t, whole.q[:, k]), rtol=0, atol=1e-13 * of.unit)
    end = sc.Event("a", terminal=True)
    turned = box().integrate(q, velocity=-v, t_end=4 * of.time, events=end, **settings, **BY_STEPS)
    assert abs(turned.q[-1, 2]) < 1e-14
    assert turned.ended_by == end


def test_a_ball_that_no_step_may_give_energy_slides_to_rest() -> None:
    """At rest, the energy that is left for velocities may be below 0 by rounding."""
    lagrangian = "m*(x_dot**2 + y_dot**2)/2 - m*9.81*y"
    ball = sc.LagrangianSystem.from_text("ball", ["x", "y"], lagrangian, parameters={"m": 1.0})
    floor = sc.contact("y", slip="x_dot", friction=0.3)
    settings = BY_STEPS | {"h": 2e-3, "t_end": 3.0, "strict_energy": True}
    run = sc.compile_stepper(ball, "svi:1", contacts=[floor]).integrate([0, 1], velocity=[1, 0], **settings)
    assert run.q[-1] == pytest.approx([math.sqrt(2 / 9.81), 0], abs=2e-3)
    assert abs(run.velocity[-1]).max() < 1e-14


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "adaptive": ({"t_end": 1.0}, "adaptive step size"),
    "error": ({"t_end": 1.0, "error": 1e-3}, "error="),
    "kind": ({"h": 0.1, "steps": 1, "transitions": "stepped"}, "unknown transitions 'stepped'"),
    "impact": ({"h": 0.1, "steps": 1, "events": sc.impact("x")}, "events that change the state"),
    "strict": ({"h": 0.1, "steps": 1, "transitions": None, "strict_energy": True}, "requires contacts by steps"),
    "behind": ({"h": 0.1, "steps": 1, "q": [0.0, -1.0, 0.0]}, "must not be negative"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_runs_by_steps_lack_is_refused_by_name(name: str) -> None:
    arguments, words = REFUSED[name]
    settings = {"q": [0.0, 1.0, 0.0], "velocity": [0.0, 0.0, 0.0]} | BY_STEPS | arguments
    with pytest.raises((sc.MethodError, sc.StateError, sc.ContactError, sc.EventError), match=words):
        box().integrate(**settings)


@pytest.mark.second
def test_quantities_of_located_runs_are_refused_after_steps() -> None:
    run = box().integrate([0.0, 1.0, 0.0], velocity=[0, 0, 0], h=0.01, t_end=1.0, **BY_STEPS)
    for ask in (run.work, run.energy_error, lambda: run.error, lambda: run.crossings("a")):
        with pytest.raises((sc.MethodError, sc.StateError)):
            ask()
    with pytest.raises(sc.MethodError, match="stepper by steps"):
        puck().integrate([0.0, 1.0], velocity=[0, 0], h=0.01, t_end=0.1, transitions="located")
    with pytest.raises(sc.StateError, match="by steps"):
        _ = box().integrate([0.0, 1.0, 0.0], velocity=[0, 0, 0], h=0.01, t_end=0.1).compliance


@pytest.mark.second
def test_rods_on_constraints_belts_and_moving_tables() -> None:
    """Constraints hold to round-off, a belt sticks and slips in turn as located, a table throws what it carries."""
    rod = sc.LagrangianSystem.from_text(
        "rod",
        ["x", "y", "u", "w"],
        "(x_dot**2 + y_dot**2 + u_dot**2 + w_dot**2)/2 - 9.81*(y + w)",
        constraints=["(x - u)**2 + (y - w)**2 = 1"],
    )
    floor = [
        sc.contact(y, slip=f"{x}_dot", friction=0.4, restitution=e) for x, y, e in (("x", "y", 0), ("u", "w", 0.5))
    ]
    thrown: dict[str, Any] = {"q": [0, 0.5, 0.6, 1.3], "velocity": [0.3, 0, 0.3, 0], "h": 2e-3, "t_end": 6.0}
    run = sc.compile_stepper(rod, "svi:1", contacts=floor).integrate(**thrown, **BY_STEPS)
    alone = sc.compile_stepper(rod, "svi:1", contacts=floor, **BY_STEPS).integrate(**thrown)
    assert np.array_equal(run.q, alone.q)  # without the equations of located steps
    x, y, u, w = run.q.T
    assert abs((x - u) ** 2 + (y - w) ** 2 - 1).max() < 1e-13
    assert min(y.min(), w.min()) > -1e-13
    assert abs(run.velocity[-1]).max() < 1e-12
    oscillator = sc.LagrangianSystem.from_text("oscillator", ["x"], "x_dot**2/2 - x**2/2")
    belt = sc.compile_stepper(oscillator, "svi:1", contacts=[sc.friction("x_dot - 0.3", limit=0.25, static_limit=0.4)])
    located, stepped = (belt.integrate([0.0], velocity=[0.3], h=2e-3, t_end=30.0, **way) for way in ({}, BY_STEPS))
    for (t, modes), (at, same) in zip(located.contact_modes, stepped.contact_modes, strict=True):
        assert modes == same
        assert t == pytest.approx(at, abs=5e-3)
    body = sc.LagrangianSystem.from_text("body", ["y"], "y_dot**2/2 - 9.81*y", parameters={"w": 20.0})
    table = sc.compile_stepper(body, "svi:1", contacts=[sc.contact("y - 0.02*sin(w*t)")])
    carried, tossed = (
        table.integrate([0.0], velocity=[0.02 * w], h=1e-3, t_end=1.0, parameters={"w": w}, **BY_STEPS)
        for w in (10.0, 30.0)
    )
    assert abs(carried.q[:, 0] - 0.02 * np.sin(10 * carried.t)).max() < 1e-13
    assert max(tossed.q[:, 0] - 0.02 * np.sin(30 * tossed.t)) > 0.01


Way = list[tuple[int, float, float]]
"""Way from the hip (x, y) to a point: components (c, d) along and across links of angles a_k."""


@cache
def walker(pairs: int) -> tuple[Any, Any]:
    """Return a trunk on pairs of legs, with thighs, shins and feet, 3 + 4 pairs degrees of freedom; its lowest height.

    The trunk of one pair stands on its hip, that of two lies between both hips; all feet, knees and ends of the trunk
    may touch the floor.
    """
    half, leg, foot = 0.25, 0.4, ((0.4, -0.06), (0.4, 0.12))
    legs = 2 * pairs
    hips: list[Way] = [[] if k < 2 else [(0, 2 * half, 0.0)] for k in range(legs)]
    thighs: list[Way] = [[*hip, (k + 1, leg / 2, 0.0)] for k, hip in enumerate(hips)]
    knees: list[Way] = [[*hip, (k + 1, leg, 0.0)] for k, hip in enumerate(hips)]
    shins: list[Way] = [[*knee, (k + 1 + legs, leg / 2, 0.0)] for k, knee in enumerate(knees)]
    links = [(10.0, 0.3, 0, [(0, half, 0.0)])]
    links += [(3.0, 0.05, k + 1, path) for k, path in enumerate(thighs)]
    links += [(2.0, 0.03, k + 1 + legs, path) for k, path in enumerate(shins)]
    feet = [[*knee, (k + 1 + legs, *arm)] for k, knee in enumerate(knees) for arm in foot]
    points: list[Way] = [*feet, *knees, [], [(0, 2 * half, 0.0)]]

    def place(path: Way) -> tuple[str, str]:
        return (
            "x" + "".join(f" + {c}*cos(a{k}) - {d}*sin(a{k})" for k, c, d in path),
            "y" + "".join(f" + {c}*sin(a{k}) + {d}*cos(a{k})" for k, c, d in path),
        )

    def speed(path: Way) -> tuple[str, str]:
        return (
            "x_dot" + "".join(f" - ({c}*sin(a{k}) + {d}*cos(a{k}))*a{k}_dot" for k, c, d in path),
            "y_dot" + "".join(f" + ({c}*cos(a{k}) - {d}*sin(a{k}))*a{k}_dot" for k, c, d in path),
        )

    terms = [
        f"{m}*(({speed(path)[0]})**2 + ({speed(path)[1]})**2)/2 + {inertia}*a{k}_dot**2/2 - {m}*9.81*({place(path)[1]})"
        for m, inertia, k, path in links
    ]
    contacts = [sc.contact(place(path)[1], slip=speed(path)[0], friction=0.5) for path in points]
    names = ["x", "y", *(f"a{k}" for k in range(1 + 2 * legs))]
    system = sc.LagrangianSystem.from_text("walker", names, " + ".join(terms), contacts=contacts)

    def lowest(q: Any) -> Any:
        angles = np.atleast_2d(q)[:, 2:].T
        rows = [sum((c * np.sin(angles[k]) + d * np.cos(angles[k]) for k, c, d in path), 0.0) for path in points]
        return np.atleast_2d(q)[:, 1] + np.min([np.broadcast_to(row, len(np.atleast_2d(q))) for row in rows], axis=0)

    return system, lowest


@dataclass
class Thrown:
    """Run of a thrown body: gaps relative to it, sizes of coordinates, time from which it rests, rise of a step."""

    system: Any
    run: Any
    gaps: np.ndarray
    sizes: Any
    rests: float
    rise: float = 1e-4


def thrown_box(number: int) -> Thrown:
    """From any pose and velocity, anywhere on the floor; in turns of strict energy."""
    of, strict = Box(number), number % 2 > 0
    q = np.array([of.unit * of.random.choice([0.0, 1e4]), 0.0, of.random.uniform(-np.pi, np.pi)])
    q[1] -= of.unit * (of.gaps(q[np.newaxis]).min() - 0.1)
    v = of.random.normal(size=3) * [of.unit, of.unit, 1.0] / of.time
    laws = {"e": of.random.choice([0.0, 0.4]), "mu": 0.4, "mus": of.random.choice([0.4, 0.5])}
    run = of.run(q, v, 60, strict=strict, **laws)
    sizes = np.array([max(of.unit, q[0]), of.unit, 1.0])
    return Thrown(box_system(), run, of.gaps(run.q), sizes, 50 * of.time, 1e-13 if strict else 1e-4)


@cache
def stack() -> Any:
    """Return three slabs above each other, with friction between them and the floor."""
    slabs = range(3)
    energy = " + ".join(f"m{k}*(x{k}_dot**2 + y{k}_dot**2)/2 - m{k}*g*y{k}" for k in slabs)
    below = {k: (f"y{k} - y{k - 1} - d", f"x{k}_dot - x{k - 1}_dot") if k else ("y0", "x0_dot") for k in slabs}
    contacts = [sc.contact(gap, slip=slip, friction="mu", restitution="e") for gap, slip in below.values()]
    named = {f"m{k}": 1.0 for k in slabs} | {"g": 9.81, "d": 1.0, "mu": 0.5, "e": 0.0}
    names = [f"{name}{k}" for k in slabs for name in "xy"]
    return sc.LagrangianSystem.from_text("stack", names, energy, parameters=named, contacts=contacts)


def thrown_stack(number: int) -> Thrown:
    """Each mass over four decades, in any unit of length."""
    random = np.random.default_rng(number)
    unit = float(10.0 ** random.integers(-6, 7))
    time, values = float(np.sqrt(unit / 9.81)), {f"m{k}": 10.0 ** random.uniform(-2, 2) for k in range(3)}
    y = unit * (np.arange(3) + np.cumsum(random.uniform(0.0, 0.5, size=3)))
    q = np.stack([np.zeros(3), y], axis=1).ravel()
    v = random.normal(size=6) * unit / time
    h, values = 5e-3 * time, values | {"d": unit, "e": random.choice([0.0, 0.5])}
    run = by_steps(stack()).integrate(q, velocity=v, h=h, t_end=60 * time, parameters=values)
    heights = run.q[:, 1::2]
    gaps = np.concatenate([heights[:, :1], np.diff(heights, axis=1) - unit], axis=1) / unit
    return Thrown(stack(), run, gaps, unit, 50 * time)


def thrown_walker(number: int, pairs: int) -> Thrown:
    random, (system, lowest) = np.random.default_rng(7 + number), walker(pairs)
    upright = [1.6 if pairs == 1 else 0.0, *(4.7,) * 4 * pairs]
    q, v = np.r_[0, 0, random.normal(size=len(upright)) * 0.5 + upright], random.normal(size=2 + len(upright))
    q[1] += 0.1 - lowest(q)[0]
    run = by_steps(system).integrate(q, velocity=v, h=5e-3, t_end=10.0)
    return Thrown(system, run, lowest(run.q), 1.0, 9.0, 1e-3)


def thrown_biped(number: int) -> Thrown:
    return thrown_walker(number, 1)


def thrown_quadruped(number: int) -> Thrown:
    return thrown_walker(number, 2)


@cache
def derivatives(system: Any) -> Any:
    """Return the function of (q, v) in columns and parameters with L_v, L_q and V, by SymPy alone."""
    q, v, L = (*system.coordinates,), (*system.velocities,), system.lagrangian
    terms = [*(L.diff(x) for x in (*v, *q)), -L.subs(dict.fromkeys(v, 0))]
    return sympy.lambdify([*q, *v, *system.parameters], terms, "numpy", cse=True)


def raised(of: Thrown) -> tuple[float, float]:
    """Return by how much impulses on velocities raise T most, beyond what E(q0, p0) - V(q1) leaves for a rebound.

    Before them the momenta are D2 Ld(q0, q1), without rebounds T may not exceed theirs. The bound is 1e-14 of the range
    of energy, with the rounding of the positions in (q1 - q0)/h.
    """
    system, run = of.system, of.run
    m, named = system.dimension, dict(zip(run.stepper.parameters, run.parameters, strict=False))
    values = [named[str(symbol)] for symbol in system.parameters]

    def terms(q: Any, v: Any) -> tuple[Any, Any, Any]:
        rows = [np.broadcast_to(row, len(q)) for row in derivatives(system)(*q.T, *v.T, *values)]
        return np.array(rows[:m]).T, np.array(rows[m:-1]).T, rows[-1]

    q0, q1, h = run.q[:-1], run.q[1:], np.diff(run.t)[:, np.newaxis]
    v = (q1 - q0) / h
    (first, _, _), (last, forces, potential) = terms(q0, v), terms(q1, v)
    p = (first + last + h * forces) / 2
    still = np.zeros_like(q1)
    unit = [terms(q1, still + row)[0] for row in np.eye(m)]  # L_v is linear in v here
    masses = np.array(unit).transpose(1, 0, 2)
    before, after = (
        np.einsum("ki,ki->k", x, np.linalg.solve(masses, x[..., np.newaxis])[..., 0]) / 2 for x in (p, run.p[1:])
    )
    energy = run.energy()
    bounces = named.get("e", 0.0) > 0.0
    allowed = np.maximum(before, energy[:-1] - potential) if bounces else before
    rounding = 8 * np.finfo(float).eps * (abs(p * q0).sum(axis=1) / h[:, 0])
    return float((after - allowed - rounding).max()), 1e-14 * float(np.ptp(energy))


def creep(of: Thrown) -> float:
    rests = abs(of.run.t - of.rests).argmin()
    return float((abs(of.run.q[rests:] - of.run.q[-1]) / of.sizes).max())


PROPERTIES: dict[str, Callable[[Thrown], tuple[float, float]]] = {
    "it is finite": lambda of: (float(not np.isfinite(of.run.q + of.run.p).all()), 0.5),
    "it does not creep": lambda of: (creep(of), CREEPS),
    "it does not penetrate": lambda of: (-float(of.gaps.min()), PENETRATES),
    "it rests": lambda of: (of.run.p[-1] @ of.run.velocity[-1], RESTS * np.ptp(of.run.energy())),
    "steps raise little energy": lambda of: (np.diff(of.run.energy()).max(), of.rise * np.ptp(of.run.energy())),
    "impulses on velocities raise no T": raised,
    "problems are solved": lambda of: (of.run.contact_residual, 1e-10),
    "it keeps its modes at rest": lambda of: (of.run.contact_modes[-1][0], of.rests),
}
"""Statements on a body that was thrown: a quantity, and its bound."""


@pytest.mark.tiers(4, 24)
@pytest.mark.parametrize("number", range(40))
@pytest.mark.parametrize(
    "throw",
    [
        thrown_box,
        thrown_stack,
        pytest.param(thrown_biped, marks=pytest.mark.second),
        pytest.param(thrown_quadruped, marks=pytest.mark.rotated(4)),
    ],
)
def test_what_is_thrown_rests_without_creep_and_penetration(throw: Callable[[int], Thrown], number: int) -> None:
    of = throw(number)
    values = {name: quantity(of) for name, quantity in PROPERTIES.items()}
    assert {name: (value, bound) for name, (value, bound) in values.items() if not value <= bound} == {}


@cache
def bead() -> Any:
    """Return the stepper of a bead of mass m (1 + a sin^2 x) on a spring in a bowl."""
    names = dict.fromkeys(["m", "a", "k", "b"], 1.0)
    lagrangian = "m*(1 + a*sin(x)**2)*(x_dot**2 + y_dot**2)/2 - 9.81*m*y - k*x**2/2"
    bowl = sc.contact("y - b*x**2/2")
    return by_steps(sc.LagrangianSystem.from_text("bead", ["x", "y"], lagrangian, parameters=names, contacts=[bowl]))


@pytest.mark.tiers(2, 12)
@pytest.mark.parametrize("number", range(24))
def test_rises_of_energy_in_kept_contact_are_of_third_order(number: int) -> None:
    random = np.random.default_rng(number)
    m, x, v = 10.0 ** random.uniform(-2, 2), *random.uniform(-1, 1, size=2)
    b, values = random.uniform(0.2, 2), {"m": m, "a": random.uniform(0, 2), "k": m * random.uniform(0, 9)}
    runs = [
        bead().integrate([x, b * x * x / 2], velocity=[v, b * x * v], h=h, t_end=4.0, parameters=values | {"b": b})
        for h in (4e-3, 2e-3)
    ]
    coarse, fine = (np.diff(run.energy()).max() for run in runs)
    assert np.log2(coarse / fine) == pytest.approx(3.0, abs=0.01)
    assert coarse < 1e-5 * np.ptp(runs[0].p ** 2 / m)


@cache
def rods() -> Any:
    """Return the stepper of two rods on a hinge, far above a floor."""
    swing = "(1 + M)*l**2*a_dot**2/2 + M*b_dot**2/2 + M*l*cos(a - b)*a_dot*b_dot"
    lagrangian = f"{swing} + 9.81*((1 + M)*l*cos(a) + M*cos(b))"
    settings: dict[str, Any] = {"parameters": {"M": 1.0, "l": 1.0}, "contacts": [sc.contact("9 - l*cos(a) - cos(b)")]}
    return by_steps(sc.LagrangianSystem.from_text("rods", ["a", "b"], lagrangian, **settings))


@pytest.mark.parametrize(
    "steps", [pytest.param(100_000, marks=pytest.mark.second), pytest.param(1_000_000, marks=pytest.mark.full)]
)
@pytest.mark.parametrize("part", [0.05, 0.1])
def test_energy_has_no_trend_without_contact(steps: int, part: float) -> None:
    """Of steps h w = .05 and .1, w the larger frequency at rest; a line has less than a tenth of the band."""
    trends = []
    for number in range(12 if steps > 100_000 else 4):
        random = np.random.default_rng(number)
        M, length = 10.0 ** random.uniform(-1, 1), random.uniform(0.5, 2)
        masses = np.array([[(1 + M) * length**2, M * length], [M * length, M]])
        fastest = np.sqrt(np.linalg.eigvals(np.linalg.solve(masses, 9.81 * np.diag([(1 + M) * length, M]))).max())
        q, v = random.uniform(-1, 1, size=2), random.normal(size=2)
        way: dict[str, Any] = {"steps": steps, "save_every": 100, "parameters": {"M": M, "l": length}}
        run = rods().integrate(q, velocity=v, h=part / fastest, **way)
        energy, t = run.energy(), run.t
        trends.append(np.polyfit(t, energy, 1)[0] * (t[-1] - t[0]) / np.ptp(energy))
    assert np.abs(trends).max() < 0.1


@pytest.mark.parametrize(
    "runs", [pytest.param(10, marks=pytest.mark.second), pytest.param(340, marks=pytest.mark.full)]
)
def test_steps_from_random_states_are_solved(runs: int) -> None:
    """Of 100 steps each of boxes and walkers in any pose, with steps over a decade and a half: in all 1.02e5."""
    unsolved = 0
    for number in range(runs):
        of, v = Box(number), np.random.default_rng(number).normal(size=3)
        random = of.random
        q = np.array([0.0, 0.0, random.uniform(-np.pi, np.pi)])
        q[1] -= of.unit * (of.gaps(q[np.newaxis]).min() - random.choice([0.0, 0.05]))
        mu, e, s = random.uniform(0, [2, 1, 0.5])
        laws = of.values | {"mu": mu, "mus": mu * random.uniform(1, 1.5), "e": e, "s": s}
        speed = 10.0 ** random.uniform(-2, 0.7)
        starts = [(by_steps(box_system()), q, v * speed * [of.unit, of.unit, 1.0] / of.time, of.time, laws)]
        for pairs in (1, 2) if runs > 10 else (1,):  # those of two legs are compiled there for other tests
            system, lowest = walker(pairs)
            q = np.r_[0, 0, random.uniform(-np.pi, np.pi, size=system.dimension - 2)]
            q[1] -= lowest(q)[0] - random.choice([0.0, 0.02])
            starts.append((by_steps(system), q, speed * random.normal(size=len(q)), 0.3, {}))
        for stepper, start, velocity, time, values in starts:
            h = time * 10.0 ** random.uniform(-2.5, -1)
            try:
                run = stepper.integrate(start, velocity=velocity, h=h, steps=100, parameters=values)
                assert run.contact_residual < 1e-11
            except sc.StepFailedError:
                unsolved += 1
    assert unsolved <= 1


@pytest.mark.rotated
def test_spheres_roll_whose_attitude_is_a_rotation() -> None:
    """Rolling has the velocity (5 v + 2 r w)/7; quaternions keep their length."""
    sphere = sc.LagrangianSystem.from_text(
        "sphere",
        ["x", "y", "z"],
        "x_dot**2 + y_dot**2 + z_dot**2 + (omega_1**2 + omega_2**2 + omega_3**2)/10 - 19.62*z",
        rotations={"R": "omega"},
    )
    wx, wy = (f"rotate_{k}(R, omega_1, omega_2, omega_3)" for k in (1, 2))
    plane = sc.contact("z - 0.5", slip=[f"x_dot - {wy}/2", f"y_dot + {wx}/2"], friction=0.3)
    run = sc.compile_stepper(sphere, "svi:1", contacts=[plane], **BY_STEPS).integrate(
        {"x": 0, "y": 0, "z": 0.5, "R": [1, 0, 0, 0]},
        velocity={"x": 3, "y": 1, "z": 0, "omega": [-2, 4, 5]},
        h=2e-3,
        t_end=1.0,
    )
    assert run.contact_modes[-1][1] == ("stick",)
    assert np.allclose(run.velocity[-1, :3], [(5 * 3 + 4) / 7, (5 * 1 + 2) / 7, 0], rtol=0, atol=1e-6)
    assert abs(np.linalg.norm(run.q[:, 3:], axis=1) - 1).max() < 1e-11


ROBOT = """
<mujoco model="hopper">
  <default> <joint axis="0 1 0"/> <geom type="capsule" size="0.04" friction="0.7"/> </default>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="trunk" pos="0 0 0.6">
      <joint name="x" type="slide" axis="1 0 0"/> <joint name="z" type="slide" axis="0 0 1"/> <joint name="pitch"/>
      <geom fromto="-0.2 0 0 0.2 0 0" mass="6"/>
      <body name="leg"> <joint name="hip" damping="1" range="-60 60"/> <geom fromto="0 0 0 0 0 -0.4" mass="1"/> </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.rotated
def test_robots_of_files_rest_on_their_limits(tmp_path: Path) -> None:
    (tmp_path / "hopper.xml").write_text(ROBOT)
    robot = sc.LagrangianSystem.from_mjcf(tmp_path / "hopper.xml", limits="contact", contacts="planes")
    stepper = sc.compile_stepper(robot, "svi:1", **BY_STEPS)
    random = np.random.default_rng(4)
    for _ in range(4):
        start = {"x": 0.0, "z": 0.0, "pitch": random.uniform(-0.5, 0.5), "hip": random.uniform(-1, 1)}
        run = stepper.integrate(start, velocity=dict.fromkeys(start, 0.0) | {"x": random.normal()}, h=2e-3, t_end=10.0)
        assert run.p[-1] @ run.velocity[-1] < RESTS * np.ptp(run.energy())
        assert abs(run["hip"]).max() < np.pi / 3 + PENETRATES
        assert run.contact_residual < 1e-6


@pytest.mark.second
def test_problems_have_the_near_contacts_alone() -> None:
    """In a bowl of 120 planes as in its three nearest ones; 240 rows are too many for located transitions."""
    point = sc.LagrangianSystem.from_text("point", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - 9.81*y")
    normals = [(np.sin(a), np.cos(a)) for a in np.arange(-60, 60) * np.deg2rad(3)]
    planes = [
        sc.contact(f"1 + {s}*x + {c}*y", slip=f"{c}*x_dot - {s}*y_dot", friction=0.3, restitution=0.5)
        for s, c in normals
    ]
    settings: dict[str, Any] = {"q": [0.01, 0.0], "velocity": [0.1, 0.0], "h": 0.01, "t_end": 3.0}
    all_of_them, near = (
        sc.compile_stepper(point, "svi:1", contacts=some, **BY_STEPS).integrate(**settings)
        for some in (planes, planes[57:64])
    )
    assert np.allclose(all_of_them.q, near.q, rtol=0, atol=1e-12)
    assert abs(near.velocity[-1]).max() < 1e-12
    with pytest.raises(sc.MethodError, match="240 gaps and slips"):
        sc.compile_stepper(point, "svi:1", contacts=planes)


def test_a_step_that_fails_leaves_the_run_as_it_was() -> None:
    """Forces end at x = 1: the first halves of the step beyond are solved, the last ones are not."""
    slide = sc.LagrangianSystem.from_text(
        "slide", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - 9.81*y + sqrt(1 - x)/9", contacts=[sc.contact("y")]
    )
    stepper = sc.compile_stepper(slide, "svi:1").by_transitions("by steps")
    run = stepper.start([0.0, 0.0], velocity=[1.0, 0.0], h=0.03)
    with pytest.raises(sc.StepFailedError):
        run.advance(100)
    t, x = run.t, float(run.q[0])
    assert 0.9 < x < 1.0
    with pytest.raises(sc.StepFailedError):
        run.advance(1)
    assert (run.t, float(run.q[0])) == (t, x)
    again = stepper.start(run.q, run.p, t=t, h=0.03)
    assert again.velocity == pytest.approx(run.velocity)
