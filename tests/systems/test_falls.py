"""Bodies that fall on a plane slide or come to rest on it, in any units: 300 random falls, beside closed forms."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from slides import Slide

import scvi_codegen as sc

FALLS = 50
"""Falls of each stepper."""
RESTS = 1e-10
"""Rates at rest, relative to those of the fall."""
TAIL = 1e-7
"""Error of the place by the last of many impacts, relative to the way: contacts close before them."""


@cache
def stepper(degree: int) -> Any:
    """Return the stepper of a point that falls along a line or, by an odd degree, in a plane with dry friction."""
    numbers = {"m": 1.0, "g": 1.0, "e": 0.0}
    if degree % 2:
        floor = sc.contact("y", slip="x_dot", friction="mu", restitution="e")
        text, names, numbers["mu"] = "m*(x_dot**2 + y_dot**2)/2 - m*g*y", ["x", "y"], 0.0
    else:
        floor, text, names = sc.contact("y", restitution="e"), "m*y_dot**2/2 - m*g*y", ["y"]
    falls = sc.LagrangianSystem.from_text("falls", names, text, parameters=numbers)
    return sc.compile_stepper(falls, f"svi:{degree}", contacts=[floor])


class Fall(NamedTuple):
    """A fall from rest at a height, which may be 0, with a horizontal velocity u; lengths are of the size `unit`."""

    m: float
    g: float
    e: float
    mu: float
    unit: float
    height: float
    u: float

    @property
    def duration(self) -> float:
        return float(np.sqrt(2 * (self.height or self.unit) / self.g))

    @property
    def settles(self) -> float:
        """Time from which the point rests, slides with constant velocity, or has stopped."""
        return self.duration * (1 + self.e) / (1 - self.e) + (self.u / (self.mu * self.g) if self.mu else 0.0)

    def after(self, t: float) -> tuple[float, float]:
        """Return x and its rate at a time after the last impact: impulses of friction and flights, then a slide."""
        speeds = self.g * self.duration * (self.height > 0) * self.e ** np.arange(1000)
        flights, brake = 2 * self.e * speeds / self.g, self.mu * self.g
        rates = np.maximum(self.u - self.mu * (1 + self.e) * np.cumsum(speeds), 0)
        left, u = t - speeds[0] / self.g - flights.sum(), rates[-1]
        slides = min(left, u / brake) if brake else left
        return self.u * speeds[0] / self.g + rates @ flights + (u - brake * slides / 2) * slides, u - brake * slides


def draw(random: np.random.Generator, in_plane: bool) -> Fall:
    """Return a random fall: a sixth begins at rest at the origin; halves have restitution, friction, a velocity."""
    unit, g, m = 10 ** random.uniform(-6, 6), 10 ** random.uniform(-2, 2), 10 ** random.uniform(-3, 3)
    height = unit * random.uniform(0.3, 3) * (random.random() > 1 / 6)
    e, mu, u = random.uniform([0, 0.05, 0.1], [0.9, 1, 3]) * random.integers(2, size=3) * [1, in_plane, in_plane]
    return Fall(m, g, e, mu, unit, height, u * np.sqrt(g * unit))


@pytest.mark.parametrize("degree", [1, 2, 3, 8])
def test_points_that_fall_come_to_rest(degree: int) -> None:
    random = np.random.default_rng(degree)
    falls, in_plane = stepper(degree), degree % 2 == 1
    for k in range(FALLS):
        fall = draw(random, in_plane)
        t_end = 1.2 * fall.settles
        h = fall.duration / random.uniform(2, 12)
        by = {"t_end": t_end} if degree > 1 and k % 3 else {"h": h, "steps": int(t_end / h) + 1}
        numbers = {name: getattr(fall, name) for name in ("m", "g", "e", *["mu"] * in_plane)}
        q, velocity = [0.0] * in_plane + [fall.height], [fall.u] * in_plane + [0.0]
        run = falls.integrate(q, velocity=velocity, parameters=numbers, **by)
        fastest, case = fall.g * fall.duration + fall.u, f"{fall}, {by}"
        assert abs(run.q[-1, -1]) <= RESTS * fall.unit, case
        assert abs(run.velocity[-1, -1]) <= RESTS * fastest, case
        assert run.contact_forces()[-1, 0, 0] == pytest.approx(fall.m * fall.g), case
        if in_plane:
            x, rate = fall.after(run.t[-1])
            assert run.q[-1, 0] == pytest.approx(x, rel=TAIL, abs=TAIL * fall.unit), case
            assert abs(run.velocity[-1, 0] - rate) <= RESTS * fastest, case
        on = falls.integrate(run.q[-1], run.p[-1], t=run.t[-1], parameters=numbers, h=h, steps=3)
        assert abs(on.q[-1, -1]) <= RESTS * fall.unit, case


def test_motion_at_rest_is_below_the_rounding_of_the_forces_that_cancel() -> None:
    """At the origin, where positions have no size: errors are none, and the last state is one at rest."""
    random, falls = np.random.default_rng(0), stepper(2)
    for _ in range(20):
        m, g, t_end = 10 ** random.uniform([-3, -4, -3], [3, 5, 5])
        numbers = {"m": m, "g": g}
        run = falls.integrate([0], velocity=[0], parameters=numbers, t_end=t_end, tolerance=1e-6)
        assert run.error.relative[-1] < 1e-12, f"{numbers}, {t_end}"
        bounded = falls.integrate(run.q[-1], run.p[-1], t=t_end, t_end=1.01 * t_end, parameters=numbers, error=1e-9)
        assert bounded.confirmation.confirmed, f"{numbers}, {t_end}"
        assert bounded.steps < 9


@pytest.mark.xfail(raises=sc.StepFailedError, strict=False, reason="steps shrink with the impacts to none")
def test_many_impacts_in_adaptive_steps_of_svi_1_come_to_rest() -> None:
    run = stepper(1).integrate([0, 1], velocity=[0, 0], parameters={"e": 0.1}, t_end=3, tolerance=1e-10)
    assert abs(run.velocity[-1]).max() <= RESTS


@cache
def rod() -> Any:
    """Return the stepper of a rod with ends on a floor without friction."""
    rod = sc.LagrangianSystem.from_text("rod", ["y", "a"], "y_dot**2/2 + a_dot**2/24 - 9.81*y")
    return sc.compile_stepper(rod, "svi:3", contacts=[sc.contact(f"y {sign} sin(a)/2") for sign in "+-"])


@pytest.mark.parametrize("by", [{"t_end": 4}, {"h": 0.05, "steps": 80}])
@pytest.mark.parametrize("start", [(0.7, 0.3), (0, 0)])
def test_rods_that_fall_flat_without_friction_come_to_rest(start: tuple[float, float], by: dict[str, float]) -> None:
    run = rod().integrate(start, velocity=[0, 0], **by)
    assert abs(run.q[-1]).max() <= RESTS
    assert abs(run.velocity[-1]).max() <= RESTS


POINTS = {1: 8, 2: 1, 3: 2, 8: 3}
"""Points of a body that touch together, by the degree of the method."""
CLEAR = 1e-9
"""Change of a motion, relative to its size, by a change of 1e-12 of its numbers, above which it is not compared."""


@cache
def sliding_stepper(degree: int) -> Any:
    """Return the stepper of a body that does not turn, above a plane at o + w t, which moves along itself with u."""
    contacts = [
        sc.contact(f"y + d{k} - o - w*t", slip="x_dot - u", friction="mu", static_friction="held", restitution="e")
        for k in range(POINTS[degree])
    ]
    parts = {f"d{k}": 0.0 for k in range(POINTS[degree])}
    numbers = dict.fromkeys(("o", "w", "u", "mu", "held", "e", "pull"), 0.0) | {"m": 1.0, "g": 1.0} | parts
    text = "m*(x_dot**2 + y_dot**2)/2 - m*g*y + m*pull*x"
    body = sc.LagrangianSystem.from_text("body", ["x", "y"], text, parameters=numbers, contacts=contacts)
    return sc.compile_stepper(body, f"svi:{degree}")


class Drawn(NamedTuple):
    """A slide with its unit of length, the mass of the body, the place of the plane and its velocity."""

    slide: Slide
    unit: float
    m: float
    o: float
    u: float
    w: float


def draw_slide(random: np.random.Generator) -> Drawn:
    """Return a random slide: a third begins on the plane and rests there, or slides; two thirds have it far away."""
    unit, g, m = 10 ** random.uniform(-6, 6), 10 ** random.uniform(-2, 2), 10 ** random.uniform(-2, 2)
    speed, lands = np.sqrt(g * unit), random.random() > 1 / 3
    e, mu = random.choice([0, 1, random.uniform(0, 0.9)], p=[0.3, 0.1, 0.6]), random.uniform(0, 1.5)
    static = mu * random.choice([1, random.uniform(1, 1.5)])
    pull = g * random.choice([0, random.uniform(-1.5, 1.5), random.uniform(-mu, mu), random.uniform(mu, static)])
    rate, slip, u, w = speed * random.uniform(-1, 1, 4) * random.integers(2, size=4) * [lands, 1, 1, 1]
    o = unit * random.choice([0, 1, -1]) * 10 ** random.uniform(0, 6)
    slide = Slide(g, pull, mu, static, e, unit * random.uniform(0.3, 3) * lands, rate, slip)
    return Drawn(slide, unit, m, o, u, w)


@pytest.mark.second
@pytest.mark.filterwarnings("ignore:the contacts depend")
@pytest.mark.parametrize("degree", POINTS)
def test_bodies_fall_slide_and_rest_on_planes_that_move(degree: int) -> None:
    """25 each, fixed steps and adaptive ones (not of svi:1), in ensembles too, from any origin, beside closed forms."""
    random, stepper, compared = np.random.default_rng(degree), sliding_stepper(degree), 0
    for k in range(25):
        drawn = draw_slide(random)
        slide, unit, m, o, u, w = drawn
        duration = np.sqrt(2 * unit / slide.g) * random.uniform(1, 8)
        numbers = {"g": slide.g, "pull": slide.pull, "mu": slide.mu, "held": slide.static, "e": slide.e}
        numbers |= {"m": m, "o": o, "u": u, "w": w}
        start = {"q": [0.0, o + slide.height], "velocity": [slide.slip + u, slide.rate + w]}
        slide = slide._replace(height=start["q"][1] - o)
        by = {"h": duration / random.integers(5, 40)} if degree == 1 or k % 2 else {}
        run = stepper.integrate(**start, parameters=numbers, t_end=duration, **by)
        x, rate, height = slide.after(duration)
        way = abs(slide.slip + u) * duration + slide.g * duration**2 + unit
        nudged = slide._replace(**{name: value * (1 + 1e-12) for name, value in slide._asdict().items()})
        case = f"{drawn}, {by}, {duration}"
        lowest = np.min(run.q[:, 1] - o - w * run.t)
        within = TAIL * np.sqrt(1 + (abs(o) + abs(w) * duration) / unit)
        assert lowest >= -within * unit, case
        assert len(run) < 1e5, case
        if np.max(np.abs(np.subtract(nudged.after(duration), (x, rate, height)))) > CLEAR * way:
            continue
        compared += 1
        assert abs(run.q[-1, 0] - x - u * duration) <= within * way, case
        assert abs(run.q[-1, 1] - o - w * duration - height) <= within * way, case
        if k % 5 == 0:
            member = stepper.integrate_ensemble(
                [start["q"]], velocity=[start["velocity"]], parameters=numbers, t_end=duration, **by
            )[0]
            assert np.array_equal(member.q[-1], run.q[-1]), case
    assert compared >= 0.7 * 25
