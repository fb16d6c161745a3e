"""Kinetic energy of bodies, generalised forces of loads, and the terms of Kane's equations beyond Lagrange's.

Kane's equations are d'Alembert's principle, sum (m a - F) . dv/dq_dot_i = 0 over points (likewise for rotations). With
v(q, q_dot, t) linear in the rates and T = sum m v.v/2 they are

    d/dt T_v - T_q = f + N,        N_i = sum m v . (d/dt dv/dq_dot_i - dv/dq_i).

N is zero if velocities are the rates of positions. If velocity constraints are built into them, as for a rolling
wheel, it is not: N then contains the gyroscopic forces of Chaplygin's equations, which do no work.

Sources: T. R. Kane, D. A. Levinson, *Dynamics* (1985), chapters 2 to 6; Ju. I. Neimark, N. A. Fufaev, *Dynamics of
Nonholonomic Systems* (1972), chapter III.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import sympy
from sympy import Expr, Matrix

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import jacobian
from scvi_codegen.mechanics.multibody.potential import are_zero
from scvi_codegen.mechanics.multibody.variables import Variables

if TYPE_CHECKING:
    from sympy.physics.mechanics import Particle, ReferenceFrame, RigidBody


@dataclass(frozen=True, slots=True)
class BodyMotion:
    """Translation or rotation of a body.

    Attributes:
        rates: (3,) velocity in the inertial frame, or angular velocity in the frame of the inertia.
        inertia: (3, 3) mass times identity, or central inertia.
        axes: (3,) angular velocity of the frame in which these are expressed; 0 for translations.
    """

    rates: tuple[Expr, ...]
    inertia: Matrix
    axes: tuple[Expr, ...]

    @property
    def momentum(self) -> tuple[Expr, ...]:
        """Linear or angular momentum, inertia times rates, of shape (3,)."""
        return tuple(self.inertia * Matrix(self.rates))


def motions_of(
    bodies: Iterable[Particle | RigidBody], frame: ReferenceFrame, variables: Variables
) -> tuple[BodyMotion, ...]:
    """Return the translations and rotations of all bodies, without those that are at rest."""
    motions = [motion for body in bodies for motion in _motions(body, frame, variables)]
    return tuple(motion for motion in motions if any(motion.rates))


def _motions(body: Any, frame: ReferenceFrame, variables: Variables) -> Iterator[BodyMotion]:
    mass = variables.read(body.mass) * sympy.eye(3)
    yield BodyMotion(_components(body, body.masscenter.vel(frame), frame, variables), mass, (sympy.S.Zero,) * 3)
    if hasattr(body, "central_inertia"):
        axes = _frame_of(body.central_inertia, body.frame)
        inertia = body.central_inertia.to_matrix(axes).applyfunc(variables.read)
        rates = _components(body, body.frame.ang_vel_in(frame), axes, variables)
        yield BodyMotion(rates, inertia, _components(body, axes.ang_vel_in(frame), axes, variables))


def _frame_of(inertia: Any, frame: ReferenceFrame) -> ReferenceFrame:
    """Return the frame in which an inertia is written (it may differ from ``frame`` for round bodies)."""
    frames = {basis for _, *vectors in inertia.args for vector in vectors for _, basis in vector.args}
    return frames.pop() if len(frames) == 1 else frame


def _components(subject: Any, vector: Any, frame: ReferenceFrame, variables: Variables) -> tuple[Expr, ...]:
    """Return the components of a velocity, of shape (3,)."""
    components = tuple(variables.read(component) for component in vector.to_matrix(frame))
    for symbol in variables.other_functions:
        if any(component.has(symbol) for component in components):
            raise SystemDefinitionError(
                f"the velocity of '{subject}' depends on '{variables.write(symbol)}', which is neither "
                "a coordinate nor a generalised speed: add it to these, or replace it by a formula "
                "of time"
            )
    return components


def kinetic_energy(motions: Iterable[BodyMotion]) -> Expr:
    """Return the kinetic energy T, the sum of w . I w / 2."""
    terms = (w * p / 2 for motion in motions for w, p in zip(motion.rates, motion.momentum, strict=True))
    return sympy.Add(*terms)


def gyroscopic_forces(motions: Iterable[BodyMotion], variables: Variables) -> tuple[Expr, ...]:
    """Return N, m expressions; exact zeros where it is zero, that is, unless constraints are built into velocities."""
    terms: list[list[Expr]] = [[] for _ in variables.x]
    for motion in motions:
        for i, excess in _excess(motion, variables).items():
            terms[i] += [p * e for p, e in zip(motion.momentum, excess, strict=True)]
    forces = tuple(sympy.Add(*row) for row in terms)
    return tuple(sympy.S.Zero for _ in forces) if are_zero(forces) else forces


def _excess(motion: BodyMotion, variables: Variables) -> dict[int, tuple[Expr, ...]]:
    """Return d/dt dw/dq_dot_i - dw/dq_i by coordinate, minus dw/dq_dot_i x W if the axes rotate with W."""
    partial, pulls = jacobian(motion.rates, variables.v), jacobian(motion.rates, variables.x)
    result = {}
    for i in {column for _, column in (*partial, *pulls)}:
        partials = [partial.get((a, i), sympy.S.Zero) for a in range(3)]
        changes = [variables.rate(derivative) for derivative in partials]
        turned = Matrix(partials).cross(Matrix(motion.axes))
        result[i] = tuple(changes[a] - pulls.get((a, i), sympy.S.Zero) - turned[a] for a in range(3))
    return result


def load_forces(loads: Iterable[Any], frame: ReferenceFrame, variables: Variables) -> tuple[Expr, ...]:
    """Return the generalised forces of loads, f_i = sum F . dv/dq_dot_i over points; of torques over frames.

    Args:
        loads: pairs of a point and a force, or of a frame and a torque.
        frame: the inertial frame.
        variables: converts expressions to plain symbols.
    """
    terms: list[list[Expr]] = [[] for _ in variables.x]
    for point, vector in loads:
        velocity = point.vel(frame) if hasattr(point, "vel") else point.ang_vel_in(frame)
        force = [variables.read(component) for component in vector.to_matrix(frame)]
        for (a, i), derivative in jacobian(_components(point, velocity, frame, variables), variables.v).items():
            terms[i].append(force[a] * derivative)
    return tuple(sympy.Add(*row) for row in terms)
