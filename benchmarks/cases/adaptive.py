"""Problems with close encounters for adaptive step size: eight initial states each."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import (
    SYSTEMS,
    Array,
    Case,
    Vector,
    case,
    gravitating,
    hand_solved,
    kepler_case,
    outer_planets,
    rotated,
    scaled,
)
from scvi_codegen.systems.lagrangian import LagrangianSystem

ECCENTRICITIES = (0.0, 0.2, 0.5, 0.9, 0.99, 0.999)
KEPLER_SPAN = 2000.0
MERCURY = {"axis": 0.387098, "eccentricity": 0.205630, "mass": 1.66e-7, "inclination": math.radians(7.0)}
"""Orbit of Mercury, in astronomical units and solar masses."""
COMET = {"axis": 10.0, "eccentricity": 0.97, "mass": 1e-15, "inclination": math.radians(20.0)}
ORBITS = 2922.0, 12000.0
"""Spans in days: eight years with Mercury, a revolution of the comet."""

PYTHAGOREAN = (3.0, 4.0, 5.0), ((1.0, 3.0), (-2.0, -1.0), (1.0, -1.0))
"""Burrau's problem: masses, and their positions at rest in the corners opposite to sides of these lengths."""
FIGURE_EIGHT = (0.97000436, -0.24308753), (-0.93240737, -0.86473146)
"""Initial position and velocity (Chenciner & Montgomery, Annals of Mathematics 152, 2000): a body, and the velocity
of the central one."""


def adaptive_case(name: str) -> Case:
    """Return one of :data:`ADAPTIVE_CASES`."""
    return replace(ADAPTIVE_CASES[name](), name=f"adaptive:{name}", fine=None)


def _kepler_case(eccentricity: float) -> Case:
    """Return the Kepler problem started at the apocentre, where the velocity is small."""
    speed = math.sqrt((1.0 - eccentricity) / (1.0 + eccentricity))
    q, velocity = rotated((1.0 + eccentricity, 0.0), 2), rotated((0.0, speed), 2)
    plain = kepler_case(eccentricity, step=0.1, fine=0.1)
    return replace(plain, name="kepler", q=q, velocity=velocity, span=KEPLER_SPAN)


def _double_pendulum_case() -> Case:
    """Return a tumbling double pendulum: both rods rotate over the top."""
    plain = case("double-pendulum")
    return replace(plain, q=scaled((2.2, 2.8), 0.01), velocity=scaled((0.5, 0.5), 0.01), span=20.0)


def _pythagorean_case() -> Case:
    masses, positions = PYTHAGOREAN
    return gravitating(
        masses, [x for position in positions for x in (*position, 0.0)], [0.0] * 9, name="pythagorean", span=65.0
    )


def _figure_eight_case() -> Case:
    (x, y), (u, v) = FIGURE_EIGHT
    positions, speeds = (x, y, 0, -x, -y, 0, 0, 0, 0), (-u / 2, -v / 2, 0, -u / 2, -v / 2, 0, u, v, 0)
    return gravitating((1.0, 1.0, 1.0), positions, speeds, name="figure-eight", span=100.0)


def hill(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return x'' = 2 y' + 3 x - x/r^3, y'' = -2 x' - y/r^3."""
    pull = (q[0] * q[0] + q[1] * q[1]) ** -1.5
    return [2.0 * v[1] + 3.0 * q[0] - pull * q[0], -2.0 * v[0] - pull * q[1]]


def swinging_atwood(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return (mu + 1) r'' = r theta'^2 - g (mu - cos theta), r theta'' = -2 r' theta' - g sin theta."""
    fall = of["g"] * (of["mu"] - functions.cos(q[1]))
    return [(q[0] * v[1] * v[1] - fall) / (of["mu"] + 1.0), -(2.0 * v[0] * v[1] + of["g"] * functions.sin(q[1])) / q[0]]


def _rotating(q: Array, momenta: Any) -> Any:
    """Return velocities from momenta in a rotating frame: p = v + (-y, x)."""
    return momenta - np.stack([-q[:, 1], q[:, 0]], axis=1).astype(np.longdouble)


def _defined_case(name: str, accelerations: Callable[..., list[Any]], spread: float) -> Case:
    given: Mapping[str, Any] = SYSTEMS["adaptive"][name]
    q, velocity = (scaled(given[part], spread) for part in ("q", "velocity"))
    return Case(
        name=name,
        system=LagrangianSystem.from_text(name=name, **given["system"]),
        formulations=hand_solved(accelerations),
        q=q,
        velocity=velocity,
        span=given["span"],
        step=0.1,
        velocity_of=partial(_rotating, q) if name == "hill" else None,
    )


def _solar_case(name: str, body: Mapping[str, float], span: float, *, part: float) -> Case:
    """Return the outer solar system with a body on an ellipse, started at perihelion (part 1) or aphelion (-1)."""
    masses, positions, velocities, gravity = outer_planets()
    e, mu = part * body["eccentricity"], gravity * masses[0]
    distance, speed = body["axis"] * (1.0 - e), math.sqrt(mu * (1.0 + e) / (1.0 - e) / body["axis"])
    tilt = math.cos(body["inclination"]), math.sin(body["inclination"])
    position, velocity = positions[:3] + np.array([distance, 0.0, 0.0]), velocities[:3] + speed * np.array([0.0, *tilt])
    state = [*masses, body["mass"]], [*positions, *position], [*velocities, *velocity]
    return gravitating(*state, name=name, gravity=gravity, span=span)


ADAPTIVE_CASES: Mapping[str, Callable[[], Case]] = {
    **{f"kepler:{e}": partial(_kepler_case, e) for e in ECCENTRICITIES},
    "double-pendulum": _double_pendulum_case,
    "pythagorean": _pythagorean_case,
    "mercury": partial(_solar_case, "mercury", MERCURY, ORBITS[0], part=1.0),
    "henon-heiles": partial(case, "henon-heiles"),
    "comet": partial(_solar_case, "comet", COMET, ORBITS[1], part=-1.0),
    "figure-eight": _figure_eight_case,
    "hill": partial(_defined_case, "hill", hill, 0.01),
    "swinging-atwood": partial(_defined_case, "swinging-atwood", swinging_atwood, 0.01),
}
"""Functions that build a case, by the name after ``adaptive:``."""
