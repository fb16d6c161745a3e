"""Sequence of Lagrangians, each with one more effect, as compiled steppers with initial states at the epoch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import asteroids
import ephemeris
import figures
import libration
import numpy as np
import point_masses
from ephemeris import BODIES, constant
from tides import tide

import scvi_codegen as sc

DEGREE = 8  # order 16
TURN = "moon_turn"
"""Name of the last coordinate, if the Moon has a figure."""


@dataclass(frozen=True)
class Model:
    """L and forces of the solar system, as text; ``asteroids`` act on the other bodies, too."""

    name: str
    lagrangian: str
    forces: dict[str, str] | None = None
    asteroids: tuple[str, ...] = ()

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies."""
        return BODIES + self.asteroids

    def with_term(self, name: str, term: str) -> Model:
        """Return the model with one more effect."""
        return replace(self, name=name, lagrangian=f"{self.lagrangian} + {term}")

    @cached_property
    def stepper(self) -> sc.Stepper:
        """Compiled stepper."""
        gm = ephemeris.masses() | asteroids.masses(self.asteroids)
        parameters = {f"gm_{body}": mass for body, mass in gm.items()}
        if "c**2" in self.lagrangian:
            parameters["c"] = ephemeris.LIGHT
        system = sc.LagrangianSystem.from_text(
            name="solar system",
            coordinates=[*point_masses.coordinates(self.bodies), *([TURN] if self.turns else [])],
            lagrangian=self.lagrangian,
            parameters=parameters,
            forces=self.forces,
        )
        return sc.compile_stepper(system, sc.SVI(DEGREE))

    @property
    def turns(self) -> bool:
        """True if the rotation of the Moon is a coordinate."""
        return TURN in self.lagrangian

    @cached_property
    def start(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities at the epoch; asteroids are integrated back to it from that of their elements."""
        if not self.asteroids:
            return self.state(0.0, np.zeros((2, 0, 3)))
        then = asteroids.EPOCH
        sun = np.array(ephemeris.states(np.array([then])))[:, 0, :1]
        seen = np.stack([asteroids.heliocentric(name) for name in self.asteroids], axis=1)
        q, v = self.state(then, sun + seen)
        steps = int(then / 2.0)
        run = self.stepper.integrate(q, velocity=v, t=then, h=-2.0, steps=steps, save_every=steps)
        return self.state(0.0, np.array([self.places(each[-1])[len(BODIES) :] for each in (run.q, run.velocity)]))

    def state(self, t: float, small: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return coordinates and velocities of DE421, with those of asteroids, (2, asteroids, 3)."""
        large = np.array(ephemeris.states(np.array([t])))[:, 0]
        both = np.concatenate([large, small], axis=1).reshape(2, -1)
        q, v = np.column_stack([both, libration.state(t)]) if self.turns else both
        return q, v

    def places(self, q: np.ndarray) -> np.ndarray:
        """Return coordinates by bodies: (..., bodies, 3)."""
        return q[..., : 3 * len(self.bodies)].reshape(*q.shape[:-1], -1, 3)

    def runs(self, h: float, save_every: int) -> tuple[sc.Trajectory, sc.Trajectory]:
        """Return trajectories backward and forward from the epoch, to the ends of the ephemeris, by steps of h days."""
        q, v = self.start
        spans = ((-h, -ephemeris.FIRST), (h, ephemeris.LAST))
        back, forth = (
            self.stepper.integrate(
                q, velocity=v, h=step, steps=int(days / h / save_every) * save_every, save_every=save_every
            )
            for step, days in spans
        )
        return back, forth

    def motion(self, h: float, save_every: int) -> tuple[np.ndarray, np.ndarray]:
        """Return times in ascending order, and positions (times, bodies, 3)."""
        back, forth = self.runs(h, save_every)
        q = np.concatenate([back.q[:0:-1], forth.q])
        return np.concatenate([back.t[:0:-1], forth.t]), self.places(q)


def ladder(counts: Sequence[int] = (3,)) -> Iterator[Model]:
    """Return the models, the last of them with ``asteroids`` asteroids."""
    century = f"((t - ({ephemeris.YEAR_2000!r}))/36525)"
    yield (model := Model("Newton", point_masses.newton(BODIES)))
    yield (model := model.with_term("+ Einstein, Infeld, Hoffmann", point_masses.relativity(BODIES)))
    sun = figures.zonal("sun", BODIES[1:], figures.of_the_sun(), ephemeris.SUN_RADIUS, {2: constant("J2SUN")})
    yield (model := model.with_term("+ the Sun's J2", sun))
    zonal = {n: constant(f"J{n}E") for n in (2, 3, 4)}
    earth = figures.zonal("earth", ("moon", "sun"), figures.of_the_earth(century), ephemeris.EARTH_RADIUS, zonal)
    yield (model := model.with_term("+ the Earth's J2, J3, J4", earth))
    axes = figures.of_the_moon(century, turn=f"({TURN} - {libration.DRIFT!r}*t)")
    moon = figures.moon(*axes, ephemeris.MOON_RADIUS, constant("J2M"), constant("C22M"))
    turning = figures.turning_moon(ephemeris.MOON_RADIUS, 4.0 * constant("C22M") / constant("LGAM"))
    yield (model := model.with_term("+ the Moon's J2, C22, libration", f"{moon} + {turning}"))
    love, lag = ([constant(f"{name}{order}") for order in range(3)] for name in ("K2E", "TAUE"))
    yield (model := replace(model, name="+ tides on the Earth", forces=tide(ephemeris.EARTH_RADIUS, love, lag)))
    for number in counts:
        names = tuple(asteroids.ELEMENTS)[:number]
        term = asteroids.lagrangian(names)
        yield replace(model.with_term(f"+ {number} asteroids", term), asteroids=names)
