"""Rigid bodies: Euler's equations with quaternions, derived by hand, and the same bodies as a model of MuJoCo.

    free-top     three different moments of inertia, no torque
    heavy-top    Lagrange's top, fast
    dumbbell     two masses on a rod in the field of a fixed centre: orbit and attitude influence each other
    bodies       1000 free bodies that tumble in different ways

States of the hand-derived equations are quaternions (w, x, y, z) and angular velocities in the body frame.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.cases.unforced import STATES, SYSTEMS, Case, Formulation, Vector, scaled
from scvi_codegen.systems.lagrangian import LagrangianSystem

BODIES, FEW_BODIES = 1000, 24
SEED = 20261123


def moments(of: Mapping[str, Any]) -> list[Any]:
    """Return the principal moments of inertia; that of the second axis is the first one for a symmetric body."""
    return [of["A"], of.get("B", of["A"]), of["C"]]


def attitude_rates(q: Vector, w: Vector, of: Mapping[str, Any], torque: Vector = ()) -> list[Any]:
    """Return q' = q w / 2, a quaternion product, and Euler's equations I w' = (I w) x w + torque, 0 where absent."""
    a, b, c = moments(of)
    turning = [
        -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]),
        0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]),
        0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]),
        0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]),
    ]
    torques = [(b - c) * (w[1] * w[2]), (c - a) * (w[2] * w[0]), (a - b) * (w[0] * w[1])]
    for k, each in enumerate(torque):
        torques[k] = torques[k] + each
    return [*turning, *(each / inertia for each, inertia in zip(torques, (a, b, c), strict=True))]


def matrix(q: Vector) -> list[list[Any]]:
    """Return the rotation matrix of a unit quaternion, from the body frame to the space frame."""
    w, x, y, z = q
    return [
        [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]


def _velocities(q: Any, inertia: Sequence[float], momenta: Any) -> Any:
    """Return velocities, (I w) = E(q)^T p / 2 of the momenta p of quaternions q, after unit masses' momenta."""
    (w, x, y, z), (a, b, c, d) = (np.moveaxis(part[..., -4:].astype(np.longdouble), -1, 0) for part in (q, momenta))
    turning = [w * b - x * a + z * c - y * d, w * c - y * a + x * d - z * b, w * d - z * a + y * b - x * c]
    body = np.stack([each / (2 * np.longdouble(moment)) for each, moment in zip(turning, inertia, strict=True)], -1)
    return np.concatenate([momenta[..., :-4], body], axis=-1)


def free_top(x: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the rates of a body without torque."""
    return attitude_rates(x[:4], x[4:], of)


def heavy_top(x: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the rates of a top with the potential w R_33."""
    q = x[:4]
    double = 2.0 * of["w"]
    return attitude_rates(q, x[4:], of, [double * (q[2] * q[3] + q[0] * q[1]), double * (q[0] * q[2] - q[1] * q[3])])


def dumbbell(x: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the rates of masses of 1/2 at distances l and -l along the first body axis, attracted by the origin."""
    position, q, velocity, w = x[:3], x[3:7], x[7:10], x[10:]
    rotation, length = matrix(q), of["l"]
    arm = [length * row[0] for row in rotation]
    pulls = []
    for sign in (1.0, -1.0):
        r = [p + sign * each for p, each in zip(position, arm, strict=True)]
        strength = -0.5 * (r[0] * r[0] + r[1] * r[1] + r[2] * r[2]) ** -1.5
        pulls.append([strength * each for each in r])
    force = [one + other for one, other in zip(*pulls, strict=True)]
    couple = [one - other for one, other in zip(*pulls, strict=True)]
    across = [rotation[0][j] * couple[0] + rotation[1][j] * couple[1] + rotation[2][j] * couple[2] for j in (1, 2)]
    rates = attitude_rates(q, w, of, [0.0 * length, -length * across[1], length * across[0]])
    return [*velocity, *rates[:4], *force, *rates[4:]]


def rotation_case(name: str, rates: Callable[..., list[Any]]) -> Case:
    """Return the case of a body with the rates derived by hand."""
    table = SYSTEMS["rotations"][name]
    system = LagrangianSystem.from_text(name=name, rotations={"R": "omega"}, **table["system"])
    positions = np.tile(table["q"], (STATES, 1))
    return Case(
        name=f"rotations:{name}",
        system=system,
        formulations=(Formulation(name="quaternion and angular velocity", rates=rates),),
        q=positions,
        velocity=scaled(table["velocity"], 0.05),
        span=table["span"],
        step=table["step"],
        fine=table["step"],
        velocity_of=partial(_velocities, positions, moments(table["system"]["parameters"])),
    )


def tumbling(count: int) -> Case:
    """Return free bodies of one shape: the trajectories of one system, which MuJoCo integrates as one model."""
    plain = rotation_case("bodies", free_top)
    numbers = np.random.default_rng(SEED)
    q, velocity = numbers.normal(size=(count, 4)), numbers.normal(size=(count, 3))
    inertia = " ".join(map(repr, plain.system.defaults))
    body = f'<body><joint type="ball"/><inertial pos="0 0 0" mass="1" diaginertia="{inertia}"/></body>'
    mjcf = f'<mujoco><option gravity="0 0 0"/><worldbody>{body * count}</worldbody></mujoco>'
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return replace(plain, q=q, velocity=velocity, mjcf=mjcf, velocity_of=None)


ROTATIONS: Mapping[str, Callable[[], Case]] = {
    name: partial(rotation_case, name, rates)
    for name, rates in (("free-top", free_top), ("heavy-top", heavy_top), ("dumbbell", dumbbell))
}
"""Functions that build a case of one body, by the name after ``rotations:``."""
