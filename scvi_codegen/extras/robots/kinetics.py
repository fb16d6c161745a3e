"""Kinetic energy of bodies, generalised forces of loads, and the terms of Kane's equations beyond Lagrange's.

Kane's equations are d'Alembert's principle, sum (m a - F) . dv/dq_dot_i = 0 over points (likewise for rotations). With
v(q, q_dot, t) linear in the rates and T = sum m v.v/2 they are

    d/dt T_v - T_q = f + N,        N_i = sum m v . (d/dt dv/dq_dot_i - dv/dq_i).

N is zero if velocities are the rates of positions. If velocity constraints are built into them, as for a rolling
wheel, it is not: N then contains the gyroscopic forces of Chaplygin's equations, which do no work. Of a rotation
R_dot = R hat(w), with the derivatives X_k about its axes in place of d/dq_i, N contains the commutators of the axes,

    N_k = sum m v . (d/dt dv/dw_k - X_k v - (dv/dw x w)_k).

Sources: T. R. Kane, D. A. Levinson, *Dynamics* (1985), chapters 2 to 6; Ju. I. Neimark, N. A. Fufaev, *Dynamics of
Nonholonomic Systems* (1972), chapter III.

**Potential energy** of forces, if they have one: f = -V_q.
One coordinate after the other is integrated: the part of its force that V does not yet account for, term by term.
Terms c s**e with roots or denominators are integrated by the chain rule if c/s_q is constant (weights, springs,
gravitation); products of powers, sines and exponentials by SymPy. The result is accepted if -V_q equals f at random
points in 60 digits.

Identities are tested probabilistically: expressions are evaluated at random points in 60 digits.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any

import sympy
from sympy import Add, Dummy, Expr, Matrix, Pow, Symbol
from sympy.integrals.manualintegrate import manualintegrate

from scvi_codegen.api.formulas import RotationNames, Tape, jacobian, mp
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.robots.variables import Variables

if TYPE_CHECKING:
    from sympy.physics.mechanics import Particle, ReferenceFrame, RigidBody

POINTS = 2


def are_zero(expressions: Iterable[Expr]) -> bool:
    """Return whether all expressions are zero at two random points; false if fewer points of definition are found."""
    unlike = [expression for expression in expressions if expression != 0]
    with suppress(SystemDefinitionError):
        values = list(islice(Tape.samples(unlike), POINTS))
        return len(values) == POINTS and all(abs(value) <= mp.sqrt(mp.eps) for at in values for value in at)
    return False


def potential_of(forces: Sequence[Expr], coordinates: Sequence[Symbol]) -> Expr | None:
    """Return V(q), or ``None`` if there is none, or none was found.

    >>> x, y, k = sympy.symbols("x y k")
    >>> potential_of([-k*x*y**2 - x/sympy.sqrt(x**2 + y**2), -k*x**2*y - y/sympy.sqrt(x**2 + y**2)], [x, y])
    k*x**2*y**2/2 + sqrt(x**2 + y**2)
    >>> potential_of([y, -x], [x, y])
    """
    potential: Expr = sympy.S.Zero
    for q, force in zip(coordinates, forces, strict=True):
        part = _antiderivative(force + potential.diff(q), q)
        if part is None:
            return None
        potential -= part
    return potential if are_zero(f + potential.diff(q) for q, f in zip(coordinates, forces, strict=True)) else None


def _antiderivative(expression: Expr, q: Symbol) -> Expr | None:
    """Return the antiderivative with respect to ``q``, or ``None`` if no rule applies."""
    powers = [x for x in expression.atoms(Pow) if x.base.has(q) and not (x.exp.is_Integer and x.exp.is_positive)]
    bases = {power.base: Dummy(positive=True) for power in powers}
    hidden = expression.xreplace({power: bases[power.base] ** power.exp for power in powers})
    coefficients: dict[Expr, Expr] = {}
    for term in Add.make_args(sympy.expand(hidden)):
        coefficient, power = term.as_independent(*bases.values(), as_Add=False)
        coefficients[power] = coefficients.get(power, sympy.S.Zero) + coefficient
    plain = manualintegrate(coefficients.pop(sympy.S.One, sympy.S.Zero), q)
    plain = plain.replace(sympy.Piecewise, lambda generic, *special: generic[0])
    behind = {symbol: base for base, symbol in bases.items()}
    parts = [_by_chain_rule(factor, power, behind, q) for power, factor in coefficients.items() if factor != 0]
    if plain.has(sympy.Integral) or None in parts:
        return None
    return Add(plain, *parts)


def _by_chain_rule(factor: Expr, power: Expr, behind: dict[Symbol, Expr], q: Symbol) -> Expr | None:
    """Return the integral of c s**e if c/s_q does not depend on ``q``, else ``None``."""
    symbol, exponent = power.as_base_exp()
    if symbol not in behind or exponent.has(*behind, q):
        return None
    base = behind[symbol]
    constant = sympy.cancel(factor.xreplace(behind) / base.diff(q))
    if constant.has(q):
        return None
    return constant * (sympy.log(base) if exponent == -1 else base ** (exponent + 1) / (exponent + 1))


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
        frames = {basis for _, *vectors in body.central_inertia.args for vector in vectors for _, basis in vector.args}
        axes = frames.pop() if len(frames) == 1 else body.frame  # of round bodies another one
        inertia = body.central_inertia.to_matrix(axes).applyfunc(variables.read)
        rates = _components(body, body.frame.ang_vel_in(frame), axes, variables)
        yield BodyMotion(rates, inertia, _components(body, axes.ang_vel_in(frame), axes, variables))


def _components(subject: Any, vector: Any, frame: ReferenceFrame, variables: Variables) -> tuple[Expr, ...]:
    """Return the components of a velocity in a frame, which must be functions of the variables."""
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
    """Return N, one expression for each rate; exact zeros unless constraints are built into velocities."""
    terms: list[list[Expr]] = [[] for _ in variables.rates]
    for motion in motions:
        for i, excess in _excess(motion, variables).items():
            terms[i] += [p * e for p, e in zip(motion.momentum, excess, strict=True)]
    forces = tuple(sympy.Add(*row) for row in terms)
    in_coordinates = RotationNames(variables.rotations).in_coordinates  # matrices of quaternions are orthogonal
    return tuple(sympy.S.Zero for _ in forces) if are_zero(map(in_coordinates, forces)) else forces


def _excess(motion: BodyMotion, variables: Variables) -> dict[int, tuple[Expr, ...]]:
    """Return d/dt dw/dq_dot_i - dw/dq_i by coordinate, minus dw/dq_dot_i x W if the axes rotate with W."""
    partial, pulls = jacobian(motion.rates, variables.rates), variables.pulls(motion.rates)
    for k in range(len(variables.x), len(variables.rates), 3):  # commutators of the axes of rotations
        w = Matrix(variables.rates[k : k + 3])
        for a in range(3):
            across = Matrix([partial.get((a, k + axis), 0) for axis in range(3)]).cross(w)
            pulls |= {(a, k + axis): pulls.get((a, k + axis), sympy.S.Zero) + c for axis, c in enumerate(across)}
    result = {}
    for i in {column for _, column in (*partial, *pulls)}:
        partials = [partial.get((a, i), sympy.S.Zero) for a in range(3)]
        changes = [variables.rate(derivative) for derivative in partials]
        turned = Matrix(partials).cross(Matrix(motion.axes))
        result[i] = tuple(changes[a] - pulls.get((a, i), sympy.S.Zero) - turned[a] for a in range(3))
    return result


def load_forces(
    loads: Iterable[Any], frame: ReferenceFrame, variables: Variables, origin: Any = None
) -> tuple[Expr, ...]:
    """Return the generalised forces of loads, f_i = sum F . dv/dq_dot_i over points; of torques over frames.

    With rotations, forces at points r(q, R) whose velocities are the rates of r act on coordinates and on the entries
    of rotations, F . dr/dR, which have a potential more often than torques.

    Args:
        loads: pairs of a point and a force, or of a frame and a torque.
        frame: the inertial frame.
        variables: converts expressions to plain symbols.
        origin: point at rest, from which positions are measured.

    Returns:
        Forces on the rates, and on the entries of rotations.
    """
    m, n = len(variables.x), len(variables.rates)
    terms: list[list[Expr]] = [[] for _ in range(n + len(variables.entries))]
    for point, vector in loads:
        velocity = point.vel(frame) if hasattr(point, "vel") else point.ang_vel_in(frame)
        force = [variables.read(component) for component in vector.to_matrix(frame)]
        rates = _components(point, velocity, frame, variables)
        position = _position(point, rates, frame, variables, origin)
        if position is None:
            arms = jacobian(rates, variables.rates)
        else:
            along = jacobian(position, (*variables.x, *variables.entries))
            arms = {(a, i if i < m else i - m + n): derivative for (a, i), derivative in along.items()}
        for (a, i), derivative in arms.items():
            terms[i].append(force[a] * derivative)
    return tuple(sympy.Add(*row) for row in terms)


def _position(
    point: Any, rates: Sequence[Expr], frame: ReferenceFrame, variables: Variables, origin: Any
) -> list[Expr] | None:
    """Return the position of a point in a system with rotations; ``None`` if its velocity is not the rate of it."""
    if not variables.rotations or not hasattr(point, "vel"):
        return None
    position = [variables.read(component) for component in point.pos_from(origin).to_matrix(frame)]
    in_coordinates = RotationNames(variables.rotations).in_coordinates
    excess = (in_coordinates(variables.rate(r) - v) for r, v in zip(position, rates, strict=True))
    return position if are_zero(excess) else None
