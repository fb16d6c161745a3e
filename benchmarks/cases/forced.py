"""Double pendulum with friction in both joints and a motor in the first, which moves it from rest over the span."""

from collections.abc import Mapping
from typing import Any

from benchmarks.cases.unforced import Case, Vector, double_pendulum, hand_solved, scaled
from scvi_codegen.systems.lagrangian import LagrangianSystem

PARAMETERS = dict.fromkeys(("m1", "m2", "l1", "l2", "g"), 1.0) | {"c": 0.02, "F": 0.1, "w": 0.7}
"""Units; friction of a joint; amplitude and frequency of the torque of the motor."""


def driven_pendulum() -> Case:
    """Return the case in the angles of the rods from the vertical."""
    system = LagrangianSystem.from_text(
        name="driven double pendulum",
        coordinates=["a0", "a1"],
        lagrangian="(m1 + m2)*l1**2*a0_dot**2/2 + m2*l2**2*a1_dot**2/2 + m2*l1*l2*a0_dot*a1_dot*cos(a0 - a1)"
        "+ (m1 + m2)*g*l1*cos(a0) + m2*g*l2*cos(a1)",
        parameters=PARAMETERS,
        forces={"a0": "F*cos(w*t)"},
        dissipation="c*a0_dot**2/2 + c*(a1_dot - a0_dot)**2/2",
    )
    q = scaled((0.3, 0.3), 0.05)
    return Case(
        name="forced:double-pendulum",
        system=system,
        formulations=hand_solved(driven_accelerations),
        q=q,
        velocity=0.0 * q,
        span=200.0,
        step=0.125,
        fine=0.125,
    )


def driven_accelerations(q: Vector, v: Vector, of: Mapping[str, Any], functions: Any) -> list[Any]:
    """Return the accelerations of the double pendulum with the torques of friction and motor on its rods."""
    free = double_pendulum(q, v, of, functions)
    joint = of["c"] * (v[1] - v[0])
    first = (of["F"] * functions.cos(of["w"] * functions.time) - of["c"] * v[0] + joint) / of["l1"]
    second = -joint / of["l2"]
    sine, cosine = functions.sin(q[0] - q[1]), functions.cos(q[0] - q[1])
    denominator, ratio = of["m1"] + of["m2"] * (sine * sine), (of["m1"] + of["m2"]) / of["m2"]
    return [
        free[0] + (first - cosine * second) / (of["l1"] * denominator),
        free[1] + (ratio * second - cosine * first) / (of["l2"] * denominator),
    ]
