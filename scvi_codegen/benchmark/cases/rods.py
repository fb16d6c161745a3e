"""Chain of equal masses m on rods of length l in the angles of the rods, with friction and a motor.

Accelerations of the angles are computed from the tensions T of the rods, whose equations are tridiagonal: with
unit vectors e along a rod and n across, and torques C on the rods (forces C n / l at lower, -C n / l at upper ends)

    m x''_k = m g - T_k e_k + T_(k+1) e_(k+1) + (C_k n_k - C_(k+1) n_(k+1)) / l,

l e_k = x_k - x_(k-1) has the acceleration -l a_k'^2 along the rod, which gives T, and l a_k'' across. That is O(n);
solving with the mass matrix of the angles is O(n^3). No faster algorithm in angles is known to us.

All joints have friction; a motor in the first sustains the motion over the whole span, from rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from scvi_codegen.benchmark.cases.unforced import Case, Vector, hand_solved, scaled
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

PARAMETERS = {"m": 1.0, "l": 1.0, "g": 1.0, "c": 0.02, "F": 0.1, "w": 0.7}
"""Units; friction of a joint; amplitude and frequency of the torque of the motor."""


def rods(name: str, n: int, *, span: float) -> Case:
    """Return the case in the angles a0, a1, .. from the vertical."""
    terms = []
    for last in range(1, n + 1):
        speeds = (" + ".join(f"{turn}(a{k})*a{k}_dot" for k in range(last)) for turn in ("cos", "sin"))
        terms.append("m*l**2/2*(" + " + ".join(f"({speed})**2" for speed in speeds) + ")")
    terms += [f"{n - k}*m*g*l*cos(a{k})" for k in range(n)]
    system = LagrangianSystem.from_text(
        name=f"{n} rods in angles",
        coordinates=[f"a{k}" for k in range(n)],
        lagrangian=" + ".join(terms),
        parameters=PARAMETERS,
        forces={"a0": "F*cos(w*t)"},
        dissipation=" + ".join(["c*a0_dot**2/2", *(f"c*(a{k}_dot - a{k - 1}_dot)**2/2" for k in range(1, n))]),
    )
    q = scaled((0.3,) * n, 0.05)
    return Case(
        name=name,
        system=system,
        formulations=hand_solved(driven_rods),
        q=q,
        velocity=0.0 * q,
        span=span,
        step=0.125,
        fine=0.125,
    )


def rod_accelerations(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any, couples: Sequence[Any]) -> list[Any]:
    """Return the accelerations of the angles from the tensions over m; ``couples`` are torques on the rods."""
    n, length, g = len(q), of["l"], of["g"]
    sines = [functions.sin(after - before) for before, after in pairwise(q)]
    cosines = [functions.cos(after - before) for before, after in pairwise(q)]
    turning = [couple / (of["m"] * length) for couple in couples]
    along = [length * (speed * speed) for speed in v]
    across = [2.0 * couple for couple in turning]
    along[0] = along[0] + g * functions.cos(q[0])
    across[0] = turning[0] - g * functions.sin(q[0])
    for k, (sine, cosine) in enumerate(zip(sines, cosines, strict=True)):
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


def driven_rods(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return accelerations with friction c times the rate of each joint, and a torque of the motor on the first rod."""
    turns = [v[0], *(after - before for before, after in pairwise(v))]
    joints = [-of["c"] * turn for turn in turns]
    joints[0] = joints[0] + of["F"] * functions.cos(of["w"] * functions.time)
    couples = [torque - after for torque, after in zip(joints, [*joints[1:], 0.0], strict=True)]
    return rod_accelerations(q, v, of, functions, couples)


FORCED_CASES: Mapping[str, Callable[[], Case]] = {
    "forced:double-pendulum": partial(rods, "forced:double-pendulum", 2, span=200.0),
    "forced:chain:5": partial(rods, "forced:chain:5", 5, span=100.0),
}
"""Functions that build a case, by its name."""
