"""Tendons: springs, dampers and rotors on linear combinations of coordinates or on paths through points of links."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from sympy import Abs, Add, Expr, Matrix, S, sqrt

from scvi_codegen.systems.formulas.expressions import derivative_along, evaluate, gradient
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.kinks import positive_part
from scvi_codegen.systems.formulas.symbols import DOT, symbol
from scvi_codegen.systems.multibody.trees.closures import frames_in_common
from scvi_codegen.systems.multibody.trees.energies import exact_number, integral, position_of, rotation_of
from scvi_codegen.systems.multibody.trees.tree import SINGLE, Link, Pose
from scvi_codegen.systems.rotations.points import torque_of


@dataclass(frozen=True, slots=True)
class Tendon:
    """Spring, relaxed at lengths in ``slack`` or as those of joints, damper and rotor on a combination or a path.

    ``pull``: range of the forces of actuators.
    """

    joints: tuple[tuple[str, float], ...]
    points: tuple[tuple[int, Pose], ...] = ()
    stiffness: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    armature: float = 0.0
    slack: tuple[float, float] | None = None
    name: str = ""
    pull: tuple[float, float] | None = None


def energies_of(links: Sequence[Link], tendons: Iterable[Tendon]) -> tuple[Expr, Expr, Expr]:
    """Return kinetic energy, potential energy, and Rayleigh's function of the damping of tendons."""
    kinetic, potential, dissipated = S.Zero, S.Zero, S.Zero
    for tendon in tendons:
        length = length_of(links, tendon)
        rate = intermediate(rate_of(links, length)) if tendon.armature or tendon.damping else S.Zero
        kinetic += exact_number(tendon.armature) * rate**2 / 2
        dissipated += integral(tendon.damping, Abs(rate))
        if any(tendon.stiffness):
            low, high = map(exact_number, tendon.slack or [_relaxed(links, length)] * 2)
            extension = length - low if low == high else positive_part(length - high) - positive_part(low - length)
            potential += integral(tendon.stiffness, extension)
    return kinetic, potential, dissipated


def length_of(links: Sequence[Link], tendon: Tendon) -> Expr:
    """Return the combination of coordinates, or the length of the path."""
    length = Add(*(exact_number(factor) * symbol(name) for name, factor in tendon.joints))
    for ends in pairwise(tendon.points):
        (start, _), (end, _) = frames_in_common(links, ends)
        length += sqrt(intermediate((end - start).dot(end - start)))
    return length


def rate_of(links: Sequence[Link], length: Expr) -> Expr:
    """Return the derivative in time of a function of coordinates and rotations."""
    rate = S.Zero
    for joint in (link.joint for link in links if link.joint.kind != "fixed"):
        names = [joint.name] if joint.kind in SINGLE else position_of(joint) if joint.kind == "free" else []
        rate += derivative_along(length, [*map(symbol, names)], [symbol(name + DOT) for name in names])
        if joint.kind not in SINGLE:
            turn = rotation_of(joint)
            slopes = gradient(length, turn.entries)
            torque = torque_of(Matrix(3, 3, turn.entries), Matrix(3, 3, [slopes.get(k, S.Zero) for k in range(9)]))
            rate += torque.dot(Matrix(turn.rates))
    return rate


def _relaxed(links: Sequence[Link], length: Expr) -> float:
    """Return the length where the springs of joints are relaxed."""
    values: dict[Expr, float] = {}
    for joint in (link.joint for link in links):
        turn = joint.pose.rotation.flat if joint.kind == "free" else Pose().rotation.flat
        values |= {symbol(joint.name): joint.rest} | dict(zip(rotation_of(joint).entries, turn, strict=True))
        values |= zip(map(symbol, position_of(joint)), joint.pose.position, strict=True)
    return float(evaluate(length, {each: float(values[each]) for each in length.free_symbols}))
