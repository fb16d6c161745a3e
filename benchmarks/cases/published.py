"""Problems of M. Antonana, J. Makazaga, A. Murua, arXiv:2511.03655, with eight initial states about theirs each.

Equations, parameters and initial states are those of the authors' repository
mikelehu/Implicit_symplectic_can_outperform_explicit_symplectic; spans are shortened to those of the other cases.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import (
    SYSTEMS,
    Array,
    Case,
    Formulation,
    Vector,
    gravitating,
    hand_solved,
    henon_heiles,
    scaled,
)
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.systems.lagrangian import LagrangianSystem

EPHEMERIS: Mapping[str, Any] = SYSTEMS["published"]["outer-solar-system"]
BLACK_HOLE: Mapping[str, Any] = SYSTEMS["published"]["black-hole"]


def published_case(name: str) -> Case:
    """Return one of :data:`PUBLISHED_CASES`."""
    return replace(PUBLISHED_CASES[name](), name=f"published:{name}")


def henon_heiles_state() -> tuple[Array, Array]:
    """Return the position and the velocity, of energy 1/12 (Hairer, Lubich & Wanner, section I.3)."""
    q, p = 0.3, 0.2
    return np.array([0.0, q]), np.array([np.sqrt(1.0 / 6.0 - q * q + 2.0 / 3.0 * q**3 - p * p), p])


def _henon_heiles() -> Case:
    q, velocity = henon_heiles_state()
    return Case(
        name="henon-heiles",
        system=problem("henon-heiles").system,
        formulations=hand_solved(henon_heiles),
        q=scaled(q.tolist(), 0.05),
        velocity=scaled(velocity.tolist(), 0.05),
        span=1000.0,
        step=1.0,
        fine=0.375,
    )


def six_bodies() -> tuple[Array, Array, Array]:
    """Return G m, positions and velocities of the inner solar system as one body, of the outer planets and of Pluto.

    Positions and velocities are relative to the centre of mass.
    """
    mass = np.array(EPHEMERIS["mass"])
    states = [np.array(EPHEMERIS[name]).reshape(-1, 3) for name in ("q", "velocity")]
    q, v = (x - mass @ x / mass.sum() for x in states)
    inner = slice(EPHEMERIS["inner"])
    joined = mass[inner].sum()
    one, two = (np.vstack([mass[inner] @ x[inner] / joined, x[inner.stop :]]) for x in (q, v))
    return np.array([joined, *mass[inner.stop :]]), one, two


def _outer_solar_system() -> Case:
    mass, q, velocity = six_bodies()
    how = {"name": "outer-solar-system", "span": 200_000.0, "step": 500.0, "fine": 256.0}
    return gravitating(mass.tolist(), q.ravel().tolist(), velocity.ravel().tolist(), **how)


def _radial(q: Vector, of: Mapping[str, Any], functions: Any) -> tuple[Any, Any, Any]:
    """Return 1 - 2/r and the derivatives of the potential by r and theta."""
    r, sine, cosine = q[0], functions.sin(q[1]), functions.cos(q[1])
    energy, momentum, field = of["E"], of["L"], of["beta"]
    by_r = 0.25 * field * field * r * (sine * sine) + energy * energy / ((r - 2.0) * (r - 2.0))
    by_r = by_r - momentum * momentum / (sine * sine * r * r * r)
    by_theta = (0.25 * field * field * r * r - momentum * momentum / (sine**4 * (r * r))) * sine * cosine
    return 1.0 - 2.0 / r, by_r, by_theta


def black_hole(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations of a charged particle near a magnetised Schwarzschild black hole."""
    r, factor, by_r, by_theta = q[0], *_radial(q, of, functions)
    return [
        v[0] * v[0] / (r * r * factor) + factor * (r * v[1] * v[1] - by_r),
        (-by_theta - 2.0 * r * v[0] * v[1]) / (r * r),
    ]


def black_hole_in_momenta(x: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q' = dH/dp, p' = -dH/dq."""
    r, radial, polar = x[0], x[2], x[3]
    factor, by_r, by_theta = _radial(x, of, functions)
    cube = 1.0 / (r * r * r)
    return [factor * radial, polar / (r * r), polar * polar * cube - radial * radial / (r * r) - by_r, -by_theta]


def _velocity(mass: Array, momenta: Any) -> Any:
    return momenta / mass.astype(np.longdouble)


def black_hole_momentum(q: Array, energy: float, momentum: float, field: float) -> Any:
    """Return the polar momentum at which H = -1/2, for a radial momentum of zero."""
    r = q[..., 0]
    potential = 0.5 * ((momentum - 0.5 * field * r * r) / r) ** 2 - 0.5 * r / (r - 2.0) * energy**2
    return r * np.sqrt(-1.0 - 2.0 * potential)


def _black_hole() -> Case:
    system = LagrangianSystem.from_text(name="black-hole", **BLACK_HOLE["system"])
    q = np.array(BLACK_HOLE["q"]) * np.array([scaled([1.0], 0.05)[:, 0], np.ones(8)]).T
    polar = black_hole_momentum(q, *system.defaults)
    mass = np.array([q[:, 0] / (q[:, 0] - 2.0), q[:, 0] ** 2]).T
    momenta = np.array([0.0 * polar, polar]).T
    return Case(
        name="black-hole",
        system=system,
        formulations=(
            *hand_solved(black_hole),
            Formulation(name="Hamilton's equations", rates=black_hole_in_momenta, momenta=True),
        ),
        q=q,
        velocity=momenta / mass,
        momenta=momenta,
        velocity_of=partial(_velocity, mass),
        span=20_000.0,
        step=24.0,
        fine=8.0,
    )


PUBLISHED_CASES: Mapping[str, Callable[[], Case]] = {
    "henon-heiles": _henon_heiles,
    "outer-solar-system": _outer_solar_system,
    "black-hole": _black_hole,
}
"""Functions that build a case, by the name after ``published:``."""
