"""Problems of public benchmark suites, with the initial state, parameters and time span that these publish.

    sciml:henon-heiles, :quadrupole-boson, :pendulum     SciMLBenchmarks.jl, DynamicalODE
    sciml:pleiades, :three-body                          SciMLBenchmarks.jl, NonStiffODE
    heyoka:restricted, :three-bodies                     heyoka, benchmark/pcr3bp.cpp and ss_3bp.cpp
    heyoka:mascons                                       the equations of heyoka, benchmark/mascon_models.hpp

The formulas are written here anew. Each has one initial state. The span of SciML's Henon-Heiles
(100 to 50,000) is the shortest; those of its quadrupole boson and of heyoka's restricted problem (100 to 20,000; 2000)
are shortened, because their motions are chaotic.
The end of heyoka's three bodies is its published state of quadruple precision. The shape of the mascons is synthetic,
two spheres in contact, where heyoka has tables of measured asteroids; their number, rotation and orbit are chosen here.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations
from typing import Any

import numpy as np

from benchmarks.cases.references import Reference
from benchmarks.cases.unforced import (
    SYSTEMS,
    Array,
    Bodies,
    Case,
    Vector,
    gravitating,
    hand_solved,
    henon_heiles,
    pendulum,
)
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.systems.lagrangian import LagrangianSystem

SUITES: Mapping[str, Any] = SYSTEMS["suites"]


def suite_case(name: str) -> Case:
    """Return one of :data:`SUITE_CASES`."""
    return replace(SUITE_CASES[name](), name=name)


def _one(vector: Sequence[float] | Array) -> Array:
    return np.array([vector], dtype=float)


def _case(accelerations: Callable[..., list[Any]], data: Mapping[str, Any], **others: Any) -> Case:
    system = data.get("system")
    return Case(
        name="",
        system=LagrangianSystem.from_text(**system) if system else problem(data["problem"]).system,
        formulations=hand_solved(accelerations),
        q=_one(data["q"]),
        velocity=_one(data["velocity"]),
        span=data["span"],
        **{"step": 0.1} | others,
    )


def quadrupole(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations in A r^2/2 + B x (3 y^2 - x^2)/sqrt(2) + D r^4/4, for A = 1."""
    x, y = q
    square, strength = x * x + y * y, 3.0 * of["B"] / functions.sqrt(2.0 + 0.0 * of["B"])
    return [
        -of["A"] * x - strength * (y * y - x * x) - of["D"] * x * square,
        -y * (of["A"] + 2.0 * strength * x + of["D"] * square),
    ]


def restricted(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations in the rotating frame of bodies of mass 1 - mu and mu at x = a and x = b."""
    x, y = q
    one = (1.0 - of["mu"]) * ((x - of["a"]) * (x - of["a"]) + y * y) ** -1.5
    two = of["mu"] * ((x - of["b"]) * (x - of["b"]) + y * y) ** -1.5
    return [x + 2.0 * v[1] - one * (x - of["a"]) - two * (x - of["b"]), y - 2.0 * v[0] - (one + two) * y]


def planar_gravitation(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations of bodies of masses m_1, m_2, .. in the plane for G = 1."""
    masses = [value for name, value in of.items() if name.startswith("m_")]
    result: list[Any] = [0.0] * len(q)
    for i, j in combinations(range(len(masses)), 2):
        d = [q[2 * i + axis] - q[2 * j + axis] for axis in range(2)]
        pull = (d[0] * d[0] + d[1] * d[1]) ** -1.5
        for axis in range(2):
            result[2 * i + axis] = result[2 * i + axis] - masses[j] * (pull * d[axis])
            result[2 * j + axis] = result[2 * j + axis] + masses[i] * (pull * d[axis])
    return result


def _pleiades() -> Case:
    """Return seven stars of masses 1 to 7 in the plane."""
    masses = [float(k) for k in range(1, 8)]
    kinetic = [f"m_{k}*(x{k}_dot**2 + y{k}_dot**2)/2" for k in range(1, 8)]
    potential = [f"m_{i}*m_{j}/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i, j in combinations(range(1, 8), 2)]
    system = {
        "name": "pleiades",
        "coordinates": [f"{axis}{k}" for k in range(1, 8) for axis in "xy"],
        "lagrangian": " + ".join([*kinetic, *potential]),
        "parameters": {f"m_{k}": mass for k, mass in enumerate(masses, 1)},
    }
    data = SUITES["pleiades"]
    states = {name: np.array([data[f"{name}_{axis}"] for axis in "xy"]).T.ravel() for name in ("q", "velocity")}
    bodies = Bodies(masses=tuple(masses), gravity=1.0, fixed_centre=False, axes=2)
    return _case(planar_gravitation, {"system": system, "span": data["span"], **states}, bodies=bodies)


def _rotating(q: Array, momenta: Any, rate: float = 1.0) -> Any:
    """Return velocities from momenta in a frame that rotates about z: p = v + rate (-y, x, 0)."""
    across = [-q[:, 1], q[:, 0], *(0 * z for z in q.T[2:])]
    return momenta - np.longdouble(rate) * np.stack(across, axis=1).astype(np.longdouble)


def _restricted(name: str) -> Case:
    made = _case(restricted, {**SUITES[name], "system": SUITES["restricted"]["system"] | SUITES[name]["values"]})
    return replace(made, velocity_of=partial(_rotating, made.q))


def mascon_points() -> Array:
    """Return equal point masses on golden spirals of two spheres in contact, about their centre of mass."""
    lobes = []
    for sphere in SUITES["mascons"]["lobes"]:
        k = np.arange(sphere["points"])
        z, angle = 1.0 - (2.0 * k + 1.0) / len(k), math.pi * (3.0 - math.sqrt(5.0)) * k
        across = np.sqrt(1.0 - z * z)
        directions = np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1)
        lobes.append([sphere["x"], 0.0, 0.0] + sphere["radius"] * directions)
    points: Array = np.concatenate(lobes)
    points -= points.mean(axis=0)
    return points


def mascons(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations about the point masses, in the frame that rotates with them about z."""
    result: list[Any] = [of["w"] ** 2 * q[0] + 2 * of["w"] * v[1], of["w"] ** 2 * q[1] - 2 * of["w"] * v[0], 0.0]
    for point in mascon_points().tolist():
        d = [x - a for x, a in zip(q, point, strict=True)]
        pull = of["mu"] * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]) ** -1.5
        result = [a - pull * x for a, x in zip(result, d, strict=True)]
    return result


def _mascons() -> Case:
    """Return a satellite of an irregular body, whose field is that of point masses."""
    data, points = SUITES["mascons"], mascon_points().tolist()
    potential = [f"mu/sqrt((x - ({a!r}))**2 + (y - ({b!r}))**2 + (z - ({c!r}))**2)" for a, b, c in points]
    system = {
        "name": "mascons",
        "coordinates": ["x", "y", "z"],
        "lagrangian": "((x_dot - w*y)**2 + (y_dot + w*x)**2 + z_dot**2)/2 + " + " + ".join(potential),
        "parameters": {"mu": 1.0 / len(points), "w": data["rate"]},
    }
    made = _case(mascons, {**data, "system": system})
    return replace(made, velocity_of=partial(_rotating, made.q, rate=data["rate"]))


def _three_bodies() -> Case:
    """Return Sun, Jupiter and Saturn over 100,000 years."""
    data = SUITES["three-bodies"]
    states = np.array(data["states"])
    q, velocity = states[:, :3].ravel(), states[:, 3:].ravel()
    gravity = (0.01720209895 * 365) ** 2
    how = {"name": "three bodies", "gravity": gravity, "span": data["span"], "step": 1.0}
    made = gravitating(data["masses"], q.tolist(), velocity.tolist(), **how)
    return replace(made, q=_one(q), velocity=_one(velocity))


def _three_bodies_end(case: Case, _: Array | None) -> Reference:
    """Return the final positions of quadruple precision that heyoka publishes."""
    return Reference(positions=_one(np.ravel(SUITES["three-bodies"]["end"])), accuracy=math.ulp(1.0))


SUITE_CASES: Mapping[str, Callable[[], Case]] = {
    "sciml:henon-heiles": lambda: _case(henon_heiles, SUITES["henon-heiles"]),
    "sciml:quadrupole-boson": lambda: _case(quadrupole, SUITES["quadrupole-boson"]),
    "sciml:pendulum": lambda: _case(pendulum, SUITES["pendulum"]),
    "sciml:pleiades": _pleiades,
    "sciml:three-body": partial(_restricted, "three-body"),
    "heyoka:restricted": partial(_restricted, "pcr3bp"),
    "heyoka:three-bodies": _three_bodies,
    "heyoka:mascons": _mascons,
}
"""Functions that build a case, by the name of its section."""
SUITE_ENDS = {"heyoka:three-bodies": _three_bodies_end}
"""Published final states."""
