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

from scvi_codegen.benchmark.cases.unforced import STATES, Case, Formulation, Vector, scaled
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

BODIES, FEW_BODIES = 1000, 24
SEED = 20261123
TILT = (np.cos(0.3), np.sin(0.3), 0.0, 0.0)
"""Initial attitude of the tops."""
KINETIC = "(A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2"


def attitude_rates(q: Vector, w: Vector, of: Mapping[str, Any], torque: Vector = ()) -> list[Any]:
    """Return q' = q w / 2, a quaternion product, and Euler's equations I w' = (I w) x w + torque, 0 where absent."""
    a, b, c = of["A"], of["B"], of["C"]
    turning = [
        -0.5 * (q[1] * w[0] + q[2] * w[1] + q[3] * w[2]),
        0.5 * (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]),
        0.5 * (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]),
        0.5 * (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]),
    ]
    moments = [(b - c) * (w[1] * w[2]), (c - a) * (w[2] * w[0]), (a - b) * (w[0] * w[1])]
    for k, each in enumerate(torque):
        moments[k] = moments[k] + each
    return [*turning, *(moment / inertia for moment, inertia in zip(moments, (a, b, c), strict=True))]


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


def _case(
    name: str,
    lagrangian: str,
    rates: Callable[..., list[Any]],
    parameters: Mapping[str, float],
    q: Sequence[float],
    velocity: Sequence[float],
    *,
    span: float,
    fine: float,
) -> Case:
    system = LagrangianSystem.from_text(
        name=name,
        coordinates=["x", "y", "z"][: len(q) - 4],
        rotations={"R": "omega"},
        parameters=parameters,
        lagrangian=lagrangian,
    )
    positions = np.tile(np.asarray(q, dtype=float), (STATES, 1))
    return Case(
        name=f"rotations:{name}",
        system=system,
        formulations=(Formulation(name="quaternion and angular velocity", rates=rates),),
        q=positions,
        velocity=scaled(velocity, 0.05),
        span=span,
        step=fine,
        fine=fine,
        velocity_of=partial(_velocities, positions, [parameters[name] for name in "ABC"]),
    )


_top = partial(_case, q=TILT)


def _dumbbell() -> Case:
    distances = [
        "sqrt(" + " + ".join(f"({x} {sign} l*R_{k}1)**2" for k, x in enumerate("xyz", 1)) + ")" for sign in "+-"
    ]
    kinetic = f"(x_dot**2 + y_dot**2 + z_dot**2)/2 + {KINETIC}"
    return _case(
        "dumbbell",
        " + ".join([kinetic, *(f"1/(2*{distance})" for distance in distances)]),
        dumbbell,
        {"A": 0.02, "B": 0.026, "C": 0.03, "l": 0.03},
        (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0),
        (0.0, 1.1, 0.1, 0.3, 0.5, 2.0),
        span=314.0,
        fine=0.125,
    )


def tumbling(count: int) -> Case:
    """Return free bodies of one shape: the trajectories of one system, which MuJoCo integrates as one model."""
    parameters = {"A": 1.0, "B": 2.0, "C": 2.5}
    plain = _case("bodies", KINETIC, free_top, parameters, TILT, (0.0, 0.0, 1.0), span=10.0, fine=0.0625)
    numbers = np.random.default_rng(SEED)
    q, velocity = numbers.normal(size=(count, 4)), numbers.normal(size=(count, 3))
    inertia = " ".join(map(repr, parameters.values()))
    body = f'<body><joint type="ball"/><inertial pos="0 0 0" mass="1" diaginertia="{inertia}"/></body>'
    mjcf = f'<mujoco><option gravity="0 0 0"/><worldbody>{body * count}</worldbody></mujoco>'
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return replace(plain, q=q, velocity=velocity, mjcf=mjcf, velocity_of=None)


ROTATIONS: Mapping[str, Callable[[], Case]] = {
    "free-top": partial(
        _top,
        "free-top",
        KINETIC,
        free_top,
        {"A": 1.0, "B": 2.0, "C": 2.5},
        velocity=(0.3, -0.5, 2.0),
        span=1000.0,
        fine=0.25,
    ),
    "heavy-top": partial(
        _top,
        "heavy-top",
        f"{KINETIC} - w*R_33",
        heavy_top,
        {"A": 1.0, "B": 1.0, "C": 0.5, "w": 1.0},
        velocity=(0.1, 0.0, 10.0),
        span=300.0,
        fine=0.125,
    ),
    "dumbbell": _dumbbell,
}
"""Functions that build a case of one body, by the name after ``rotations:``."""
