"""Chain of equal masses m on rods of length l: in the angles of the rods, and in the positions of the masses.

Accelerations of the angles are computed from the tensions T of the rods, whose equations are tridiagonal: with
unit vectors e along a rod and n across, and torques C on the rods (forces C n / l at lower, -C n / l at upper ends)

    m x''_k = m g - T_k e_k + T_(k+1) e_(k+1) + (C_k n_k - C_(k+1) n_(k+1)) / l,

l e_k = x_k - x_(k-1) has the acceleration -l a_k'^2 along the rod, which gives T, and l a_k'' across. That is O(n);
solving with the mass matrix of the angles is O(n^3). No faster algorithm in angles is known to us.

Forced cases have friction in all joints and a motor in the first, which sustains the motion over the whole span. In
constrained cases this package integrates positions with holonomic constraints as well. All start from rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Case, Vector, hand_solved, scaled
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

UNITS = {"m": 1.0, "l": 1.0, "g": 1.0}
DRIVEN = {"c": 0.02, "F": 0.1, "w": 0.7}
"""Friction of a joint; amplitude and frequency of the torque of the motor."""


def rods_in_angles(name: str, n: int, start: float, *, span: float, fine: float, driven: bool = False) -> Case:
    """Return the case in the angles a0, a1, .. from the vertical, without constraints."""
    terms = []
    for last in range(1, n + 1):
        speeds = (" + ".join(f"{turn}(a{k})*a{k}_dot" for k in range(last)) for turn in ("cos", "sin"))
        terms.append("m*l**2/2*(" + " + ".join(f"({speed})**2" for speed in speeds) + ")")
    terms += [f"{n - k}*m*g*l*cos(a{k})" for k in range(n)]
    friction = " + ".join(["c*a0_dot**2/2", *(f"c*(a{k}_dot - a{k - 1}_dot)**2/2" for k in range(1, n))])
    system = LagrangianSystem.from_text(
        name=f"{n} rods in angles",
        coordinates=[f"a{k}" for k in range(n)],
        lagrangian=" + ".join(terms),
        parameters=UNITS | DRIVEN if driven else UNITS,
        forces={"a0": "F*cos(w*t)"} if driven else None,
        dissipation=friction if driven else None,
    )
    q = scaled((start,) * n, 0.05)
    return Case(
        name=name,
        system=system,
        formulations=hand_solved(driven_rods if driven else rod_accelerations),
        q=q,
        velocity=0.0 * q,
        span=span,
        step=fine,
        fine=fine,
    )


def rods_in_positions(n: int) -> LagrangianSystem:
    """Return the system in the positions (x0, y0, x1, ..) of the masses, with distance constraints."""
    kinetic = " + ".join(f"x{k}_dot**2 + y{k}_dot**2" for k in range(n))
    rods = [f"(x{k} - x{k - 1})**2 + (y{k} - y{k - 1})**2 = l**2" for k in range(1, n)]
    return LagrangianSystem.from_text(
        name=f"{n} rods",
        coordinates=[f"{axis}{k}" for k in range(n) for axis in "xy"],
        lagrangian=f"m*({kinetic})/2 - m*g*({' + '.join(f'y{k}' for k in range(n))})",
        parameters=UNITS,
        constraints=["x0**2 + y0**2 = l**2", *rods],
    )


def rod_accelerations(
    q: Vector, v: Vector, of: Mapping[str, Any], functions: Any, couples: Sequence[Any] = ()
) -> list[Any]:
    """Return the accelerations of the angles from the tensions over m; ``couples`` are torques on the rods."""
    n, length, g = len(q), of["l"], of["g"]
    sines = [functions.sin(after - before) for before, after in pairwise(q)]
    cosines = [functions.cos(after - before) for before, after in pairwise(q)]
    turning = [couple / (of["m"] * length) for couple in couples]
    along = [length * (speed * speed) for speed in v]
    across = [0.0 * angle for angle in q] if not turning else [2.0 * couple for couple in turning]
    along[0] = along[0] + g * functions.cos(q[0])
    across[0] = (turning[0] if turning else 0.0) - g * functions.sin(q[0])
    for k, (sine, cosine) in enumerate(zip(sines, cosines, strict=True) if turning else ()):
        along[k], along[k + 1] = along[k] + turning[k + 1] * sine, along[k + 1] - turning[k] * sine
        across[k] = across[k] - turning[k + 1] * cosine
        across[k + 1] = across[k + 1] - turning[k] * cosine
    tensions = _tridiagonal([1.0] + [2.0] * (n - 1), cosines, along)
    for k, sine in enumerate(sines):
        across[k] = across[k] + tensions[k + 1] * sine
        across[k + 1] = across[k + 1] - tensions[k] * sine
    return [each / length for each in across]


def _tridiagonal(diagonal: Sequence[float], off_diagonal: Vector, right: Vector) -> list[Any]:
    """Solve diagonal_k x_k - beside_k x_(k+1) - beside_(k-1) x_(k-1) = right_k by elimination from the end."""
    pivots, values = [diagonal[-1]], [right[-1]]
    for d, b, r in zip(diagonal[-2::-1], reversed(off_diagonal), right[-2::-1], strict=True):
        share = b / pivots[-1]
        pivots.append(d - share * b)
        values.append(r + share * values[-1])
    x = [values.pop() / pivots.pop()]
    for b, pivot, value in zip(off_diagonal, reversed(pivots), reversed(values), strict=True):
        x.append((value + b * x[-1]) / pivot)
    return x


def positions_of(angles: Array, length: float = 1.0) -> Array:
    """Return (.., 2 n) positions of (.., n) angles."""
    steps = length * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    return np.cumsum(steps, axis=-2).reshape(*angles.shape[:-1], -1)


def angles_of(positions: Array) -> Array:
    """Return the (.., n) angles, between -pi and pi, of (.., 2 n) positions."""
    x, y = (np.diff(positions[..., axis::2], axis=-1, prepend=0.0) for axis in (0, 1))
    return np.arctan2(x, -y)


def driven_rods(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return accelerations with friction c times the rate of each joint, and a torque of the motor on the first rod."""
    turns = [v[0], *(after - before for before, after in pairwise(v))]
    joints = [-of["c"] * turn for turn in turns]
    joints[0] = joints[0] + of["F"] * functions.cos(of["w"] * functions.time)
    couples = [torque - after for torque, after in zip(joints, [*joints[1:], 0.0], strict=True)]
    return rod_accelerations(q, v, of, functions, couples)


FORCED_CASES: Mapping[str, Callable[[], Case]] = {
    f"forced:{name}": partial(rods_in_angles, f"forced:{name}", n, 0.3, span=span, fine=0.125, driven=True)
    for name, n, span in (("double-pendulum", 2, 200.0), ("chain:5", 5, 100.0))
}
CONSTRAINED_CASES: Mapping[str, Callable[[], Case]] = {
    f"constrained:{name}": partial(rods_in_angles, f"constrained:{name}", n, start, span=span, fine=fine)
    for name, n, start, span, fine in (
        ("pendulum", 1, 0.5, 1000.0, 0.25),
        ("double-pendulum", 2, 0.5, 200.0, 0.125),
        ("chain:5", 5, 0.3, 100.0, 0.125),
    )
}
"""Functions that build a case, by its name."""
