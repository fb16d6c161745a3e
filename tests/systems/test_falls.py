"""Points that fall on a floor come to rest on it, in any units: 200 random falls, beside closed forms."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np
import pytest

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


@pytest.mark.xfail(raises=sc.StepFailedError, strict=True, reason="steps shrink with the impacts to none")
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
