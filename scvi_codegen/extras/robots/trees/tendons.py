"""Tendons: springs, dampers and rotors on linear combinations of coordinates or on paths through points of links."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice, pairwise
from typing import Any

import numpy as np
from sympy import Abs, Add, Expr, Matrix, S, sqrt

from scvi_codegen.api.formulas import DOT, Intermediate, Tape, jacobian, mp, symbol
from scvi_codegen.extras.robots.trees.closures import frames_in_common
from scvi_codegen.extras.robots.trees.energies import (
    Tree,
    dual_energy,
    exact_number,
    integral,
    limits_of,
    position_of,
    positive_part,
    rotation_of,
)
from scvi_codegen.extras.robots.trees.tree import SINGLE, Joint, Link, Pose
from scvi_codegen.systems.contact import Contact, Friction, friction


@dataclass(frozen=True, slots=True)
class Tendon:
    """Spring, relaxed at lengths in ``slack`` or as those of joints, damper and rotor on a combination or a path.

    ``pull``: range of the forces of actuators; ``limits``: range of the length.
    """

    joints: tuple[tuple[str, float], ...]
    points: tuple[tuple[int, Pose], ...] = ()
    stiffness: tuple[float, ...] = ()
    damping: tuple[float, ...] = ()
    armature: float = 0.0
    slack: tuple[float, float] | None = None
    name: str = ""
    pull: tuple[float, float] | None = None
    limits: tuple[float, float] | None = None
    dry_friction: float = 0.0


def energies_of(links: Sequence[Link], tendons: Iterable[Tendon]) -> tuple[Expr, Expr, Expr]:
    """Return kinetic energy, potential energy, and Rayleigh's function of the damping of tendons."""
    kinetic, potential, dissipated = S.Zero, S.Zero, S.Zero
    for tendon in tendons:
        length = length_of(links, tendon)
        rate = Intermediate.named(rate_of(links, length)) if tendon.armature or tendon.damping else S.Zero
        kinetic += exact_number(tendon.armature) * rate**2 / 2
        dissipated += integral(tendon.damping, Abs(rate))
        if any(tendon.stiffness):
            low, high = map(exact_number, tendon.slack or [_relaxed(links, length)] * 2)
            extension = length - low if low == high else positive_part(length - high) - positive_part(low - length)
            potential += integral(tendon.stiffness, extension)
    return kinetic, potential, dissipated


def contacts_of_tendons(
    links: Sequence[Link], tendons: Iterable[Tendon], law: Mapping[str, Any]
) -> list[Contact | Friction]:
    """Return the contacts of tendons with limits, where ``law`` is that of impacts, and their dry friction."""
    contacts: list[Contact | Friction] = []
    for tendon in tendons:
        length, of = length_of(links, tendon), f"of tendon '{tendon.name}'"
        if tendon.limits:
            low, high = tendon.limits
            gaps = limits_of(length, low, high, f"limit {of} of the range {low:g} to {high:g}", law)
            contacts += islice(gaps, 1 if tendon.points and low <= 0 else 0, None)  # paths are not shorter than 0
        if tendon.dry_friction:
            limit = exact_number(tendon.dry_friction)
            contacts.append(friction(rate_of(links, length), limit=limit, name=f"dry friction {of}"))
    return contacts


def length_of(links: Sequence[Link], tendon: Tendon) -> Expr:
    """Return the combination of coordinates, or the length of the path."""
    length = Add(*(exact_number(factor) * symbol(name) for name, factor in tendon.joints))
    for ends in pairwise(tendon.points):
        (start, _), (end, _) = frames_in_common(links, ends)
        length += sqrt(Intermediate.named((end - start).dot(end - start)))
    return length


def _numbers_of(joint: Joint) -> list[str]:
    """Return the names of the coordinates of a joint that are no rotation."""
    if joint.kind in SINGLE:
        return [joint.name]
    return [*position_of(joint)] if joint.kind == "free" else []


def rate_of(links: Sequence[Link], length: Expr) -> Expr:
    """Return the derivative in time of a function of coordinates and rotations."""
    rate = S.Zero
    for joint in (link.joint for link in links if link.joint.kind != "fixed"):
        names = _numbers_of(joint)
        slopes = jacobian([length], [*map(symbol, names)])
        rate += Add(*(slope * symbol(names[k] + DOT) for (_, k), slope in slopes.items()))
        if joint.kind not in SINGLE:
            turn = rotation_of(joint)
            slopes = jacobian([length], turn.entries)
            rate += turn.torque([slopes.get((0, k), S.Zero) for k in range(9)]).dot(Matrix(turn.rates))
    return rate


def reference_length(links: Sequence[Link], length: Expr) -> float:
    """Return the length in the reference configuration."""
    return _evaluated(links, length, {symbol(link.joint.name): link.joint.zero for link in links})


def _relaxed(links: Sequence[Link], length: Expr) -> float:
    """Return the length where the springs of joints are relaxed."""
    return _evaluated(links, length, {symbol(link.joint.name): link.joint.rest for link in links})


def mean_inverses(links: Sequence[Link], labels: Collection[str]) -> Iterator[tuple[int, float]]:
    """Yield links, and the means of the diagonal of M^-1 over the rates of their joints, of these labels.

    They are those at the pose of the file. An entry is twice the energy T(q, p) of a momentum of 1.
    """
    energy = dual_energy(Tree(links, np.zeros(3))) if labels else S.Zero
    values = {symbol(link.joint.name): link.joint.zero for link in links}
    for k, joint in enumerate(link.joint for link in links if energy != 0):
        names = _numbers_of(joint)
        momenta = [
            *(symbol(f"p_{name}") for name in names),
            *(() if joint.kind in SINGLE else rotation_of(joint).rates),
        ]
        if joint.kind != "fixed" and joint.label in labels:
            yield k, 2 * sum(_evaluated(links, energy, values | {p: 1.0}) for p in momenta) / len(momenta)


def _evaluated(links: Sequence[Link], expression: Expr, values: dict[Expr, float]) -> float:
    """Return the value of an expression at the pose of the file of rotations and free bodies; other symbols are 0."""
    for joint in (link.joint for link in links):
        turn = joint.pose.rotation.flat if joint.kind == "free" else Pose().rotation.flat
        values = values | dict(zip(rotation_of(joint).entries, turn, strict=True))
        values |= zip(map(symbol, position_of(joint)), joint.pose.position, strict=True)
    symbols = [*expression.free_symbols]
    return float(Tape([expression], symbols)([mp.mpf(float(values.get(x, 0))) for x in symbols])[0])
