"""Problems with friction and driving forces, from rest; peers have the same forces in hand-derived right-hand sides.

    duffing           damped and driven in one of its wells
    cart-pole         a crane: friction of the cart and of the hinge, a force on the cart
    double-pendulum   friction in both joints, a motor in the first
    chain:5           the same for five rods

The driving forces sustain the motion over the whole span.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

from scvi_codegen.benchmark.cases import Case, Formulation, Vector, scaled, second_order
from scvi_codegen.benchmark.hanging_rods import rod_accelerations, rods_in_angles
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

__all__ = ["FORCED_CASES"]


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
        formulations=(Formulation(name="hand-solved accelerations", rates=second_order(accelerations)),),
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
