"""Chain of equal masses m on rods of length l: in the angles of the rods, and in the positions of the masses.

Accelerations of the angles are computed from the tensions T of the rods, whose equations are tridiagonal: with
unit vectors e along a rod and n across, and torques C on the rods (forces C n / l at lower, -C n / l at upper ends)

    m x''_k = m g - T_k e_k + T_(k+1) e_(k+1) + (C_k n_k - C_(k+1) n_(k+1)) / l,

l e_k = x_k - x_(k-1) has the acceleration -l a_k'^2 along the rod, which gives T, and l a_k'' across. That is O(n);
solving with the mass matrix of the angles is O(n^3). No faster algorithm in angles is known to us.

Problems with friction and driving forces, from rest; peers have the same forces in hand-derived right-hand sides.

    duffing           damped and driven in one of its wells
    cart-pole         a crane: friction of the cart and of the hinge, a force on the cart
    double-pendulum   friction in both joints, a motor in the first
    chain:5           the same for five rods

The driving forces sustain the motion over the whole span.

Masses on rods, from rest: as holonomic constraints, and for peers in the angles of the rods.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Case, Formulation, Vector, hand_solved, scaled, second_order
from scvi_codegen.benchmark.contenders.ours import our_contenders
from scvi_codegen.benchmark.report import Contender
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import as_method

UNITS = {"m": 1.0, "l": 1.0, "g": 1.0}


def rods_in_angles(
    n: int,
    *,
    parameters: Mapping[str, float] | None = None,
    forces: Mapping[str, str] | None = None,
    dissipation: str | None = None,
) -> LagrangianSystem:
    """Return the system in the angles a0, a1, .. from the vertical, without constraints, optionally with forces."""
    terms = []
    for last in range(1, n + 1):
        speeds = (" + ".join(f"{turn}(a{k})*a{k}_dot" for k in range(last)) for turn in ("cos", "sin"))
        terms.append("m*l**2/2*(" + " + ".join(f"({speed})**2" for speed in speeds) + ")")
    terms += [f"{n - k}*m*g*l*cos(a{k})" for k in range(n)]
    return LagrangianSystem.from_text(
        name=f"{n} rods in angles",
        coordinates=[f"a{k}" for k in range(n)],
        lagrangian=" + ".join(terms),
        parameters={**UNITS, **(parameters or {})},
        forces=forces,
        dissipation=dissipation,
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


def duffing(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return q'' = -delta q' - alpha q - beta q^3 + F cos(w t)."""
    drive = of["F"] * functions.cos(of["w"] * functions.time)
    return [drive - of["delta"] * v[0] - (of["alpha"] + of["beta"] * (q[0] * q[0])) * q[0]]


def _duffing_case() -> Case:
    """Return the weakly driven oscillator of J. Guckenheimer, P. Holmes, Nonlinear Oscillations (1983), section 2.2."""
    system = LagrangianSystem.from_text(
        name="damped and driven Duffing oscillator",
        coordinates=["q"],
        lagrangian="q_dot**2/2 - alpha*q**2/2 - beta*q**4/4",
        parameters={"alpha": -1.0, "beta": 1.0, "delta": 0.25, "F": 0.2, "w": 1.0},
        forces={"q": "F*cos(w*t)"},
        dissipation="delta*q_dot**2/2",
    )
    return _from_rest("duffing", system, duffing, (0.75,), span=1000.0, fine=0.25)


def crane(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations, with the 2 x 2 mass matrix of a cart and its pendulum inverted by hand."""
    cart, mass, length = (of[name] for name in ("M", "m", "l"))
    sine, cosine = functions.sin(q[1]), functions.cos(q[1])
    drive = of["F"] * functions.cos(of["w"] * functions.time) - of["b"] * v[0]
    swing = (of["c"] / (mass * length)) * v[1] + of["g"] * sine
    x = (drive + mass * sine * (length * (v[1] * v[1])) + mass * cosine * swing) / (cart + mass * (sine * sine))
    return [x, -(swing + cosine * x) / length]


def _crane_case() -> Case:
    system = LagrangianSystem.from_text(
        name="crane",
        coordinates=["x", "theta"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*theta_dot*cos(theta) + m*l**2*theta_dot**2/2 + m*g*l*cos(theta)",
        parameters={"M": 2.0, "m": 1.0, "l": 1.0, "g": 9.81, "b": 0.1, "c": 0.05, "F": 1.0, "w": 2.0},
        forces={"x": "F*cos(w*t)"},
        dissipation="b*x_dot**2/2 + c*theta_dot**2/2",
    )
    return _from_rest("cart-pole", system, crane, (0.1, 0.5), span=200.0, fine=0.0625)


def driven_rods(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return accelerations with friction c times the rate of each joint, and a torque of the motor on the first rod."""
    turns = [v[0], *(after - before for before, after in pairwise(v))]
    joints = [-of["c"] * turn for turn in turns]
    joints[0] = joints[0] + of["F"] * functions.cos(of["w"] * functions.time)
    couples = [torque - after for torque, after in zip(joints, [*joints[1:], 0.0], strict=True)]
    return rod_accelerations(q, v, of, functions, couples)


def _rods_case(name: str, n: int, *, span: float, fine: float) -> Case:
    system = rods_in_angles(
        n,
        parameters={"c": 0.02, "F": 0.1, "w": 0.7},
        forces={"a0": "F*cos(w*t)"},
        dissipation=" + ".join(["c*a0_dot**2/2", *(f"c*(a{k}_dot - a{k - 1}_dot)**2/2" for k in range(1, n))]),
    )
    return _from_rest(name, system, driven_rods, (0.3,) * n, span=span, fine=fine)


def _from_rest(
    name: str,
    system: LagrangianSystem,
    accelerations: Callable[..., list[Any]],
    q: Sequence[float],
    *,
    span: float,
    fine: float,
) -> Case:
    return Case(
        name=f"forced:{name}",
        system=system,
        formulations=hand_solved(accelerations),
        q=scaled(q, 0.05),
        velocity=scaled(q, 0.05) * 0.0,
        span=span,
        step=fine,
        fine=fine,
    )


FORCED_CASES: Mapping[str, Callable[[], Case]] = {
    "duffing": _duffing_case,
    "cart-pole": _crane_case,
    "double-pendulum": partial(_rods_case, "double-pendulum", 2, span=200.0, fine=0.125),
    "chain:5": partial(_rods_case, "chain:5", 5, span=100.0, fine=0.125),
}
"""Functions that build a case, by the name after ``forced:``."""

LARGEST_IN_ANGLES = 8
"""Largest number of rods in angles for this package: the full mass matrix has n^2 terms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstrainedCase:
    """Problem in two formulations.

    Attributes:
        angles: case for peers; errors are measured in its final q.
        positions: case with constraints.
        methods: methods for the constraints.
    """

    angles: Case
    positions: Case
    methods: tuple[str, ...]

    def shortened(self, share: float) -> ConstrainedCase:
        """Return the cases with a part of the span."""
        span = share * self.angles.span
        return replace(self, angles=replace(self.angles, span=span), positions=replace(self.positions, span=span))


def constrained_contenders(both: ConstrainedCase, *, quick: bool) -> list[Contender]:
    """Return contenders with constraints and, for few rods, in angles."""
    methods = [as_method(name, both.positions.system) for name in both.methods[: 1 if quick else None]]
    constrained = [_converted_to_angles(each) for each in our_contenders(both.positions, methods=methods, quick=quick)]
    few = both.angles.dimension <= LARGEST_IN_ANGLES
    return [*constrained, *(_named_angles(each) for each in our_contenders(both.angles, quick=quick) if few)]


def _converted_to_angles(contender: Contender) -> Contender:
    """Return the contender with final positions converted to angles, untimed."""

    def prepare(index: int) -> Callable[[], Array]:
        integrate = contender.prepare(index)
        return lambda: angles_of(integrate())

    return replace(contender, prepare=prepare, momenta=None)


def _named_angles(contender: Contender) -> Contender:
    return replace(contender, method=f"{contender.method}, angles", momenta=None)


def _rods(name: str, n: int, start: float, *, methods: tuple[str, ...], span: float, fine: float) -> ConstrainedCase:
    q = scaled((start,) * n, 0.05)
    angles = Case(
        name=f"constrained:{name}",
        system=rods_in_angles(n),
        formulations=(Formulation(name="tensions of the rods", rates=second_order(rod_accelerations)),),
        q=q,
        velocity=0.0 * q,
        span=span,
        step=fine,
        fine=fine,
    )
    positions = replace(
        angles, system=rods_in_positions(n), formulations=(), q=positions_of(q), velocity=0.0 * positions_of(q)
    )
    return ConstrainedCase(angles=angles, positions=positions, methods=methods)


CONSTRAINED_CASES: Mapping[str, Callable[[], ConstrainedCase]] = {
    "pendulum": partial(_rods, "pendulum", 1, 0.5, methods=("svi:6", "svi:8"), span=1000.0, fine=0.25),
    "double-pendulum": partial(_rods, "double-pendulum", 2, 0.5, methods=("svi:6", "svi:8"), span=200.0, fine=0.125),
    "chain:5": partial(_rods, "chain:5", 5, 0.3, methods=("svi:6",), span=100.0, fine=0.125),
    "chain:20": partial(_rods, "chain:20", 20, 0.3, methods=("svi:6",), span=50.0, fine=0.0625),
}
"""Functions that build a case, by the name after ``constrained:``."""
