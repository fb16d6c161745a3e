"""Tree of rigid bodies connected by joints, in numbers."""

from __future__ import annotations

import math
import re
import unicodedata
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, count
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import DOT, check_names
from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning

Vector = NDArray[np.float64]

KINDS = ("fixed", "hinge", "slide", "ball", "free")
SINGLE = ("hinge", "slide")
"""Kinds of joints with one coordinate."""
ROUNDED = 1e-9
"""Entries of rotation matrices that differ less from 0, 1 or -1 are these numbers."""
LOST = 1e-15
"""Entries of turned vectors and matrices that are smaller, relative to the largest one, are rounding errors."""
ROUGH, POINT = 0.05, 1e-6
"""Tolerance of moments of inertia that were identified or printed with few digits, relative to the largest one and, for
bodies that are nearly points, to the mass."""


@dataclass(frozen=True, slots=True)
class Pose:
    """Position and rotation of a frame in another: x_outer = position + rotation x_inner."""

    position: Vector = field(default_factory=lambda: np.zeros(3))
    rotation: Vector = field(default_factory=lambda: np.eye(3))

    def __matmul__(self, inner: Pose) -> Pose:
        return Pose(self.position + times(self.rotation, inner.position), times(self.rotation, inner.rotation))

    @property
    def inverse(self) -> Pose:
        """Pose of the outer frame in the inner one."""
        return Pose(-times(self.rotation.T, self.position), self.rotation.T)


@dataclass(frozen=True, slots=True)
class Inertia:
    """Mass, center of mass and inertia matrix about the center of mass, in the axes of the link.

    Attributes:
        lift: mass whose weight is compensated, and its first moment.
        drag: poses of bodies in a medium, and their torque and force as functions of angular velocity and velocity, in
            their axes (:mod:`fluid`).
    """

    mass: float = 0.0
    center: Vector = field(default_factory=lambda: np.zeros(3))
    matrix: Vector = field(default_factory=lambda: np.zeros((3, 3)))
    lift: tuple[float, Vector] = field(default_factory=lambda: (0.0, np.zeros(3)))
    drag: tuple[tuple[Pose, Any], ...] = ()

    def seen_from(self, pose: Pose) -> Inertia:
        """Return the inertia in the frame in which its own frame has the given pose."""
        turned = times(times(pose.rotation, self.matrix), pose.rotation.T)
        lift = self.lift[0], self.lift[0] * pose.position + times(pose.rotation, self.lift[1])
        drag = tuple((pose @ at, law) for at, law in self.drag)
        return Inertia(self.mass, pose.position + times(pose.rotation, self.center), turned, lift, drag)

    def scaled(self, factor: float) -> Inertia:
        """Return the inertia of a body of another density."""
        lift = self.lift[0] * factor, self.lift[1] * factor
        return replace(self, mass=self.mass * factor, matrix=self.matrix * factor, lift=lift)

    def __add__(self, other: Inertia) -> Inertia:
        mass = self.mass + other.mass
        center = (self.mass * self.center + other.mass * other.center) / mass if mass else self.center
        lift = self.lift[0] + other.lift[0], self.lift[1] + other.lift[1]
        return Inertia(mass, center, self.about(center) + other.about(center), lift, self.drag + other.drag)

    def about(self, point: Vector) -> Vector:
        """Return the inertia matrix about a point (parallel axis theorem)."""
        arm = self.center - point
        return np.asarray(self.matrix + self.mass * (times(arm, arm) * np.eye(3) - np.outer(arm, arm)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Joint:
    """Joint between a link and its parent.

    Attributes:
        name, label: its name, which is that of the coordinate, and its name in the file.
        kind: one of ``KINDS``.
        pose: pose of the link in the parent's frame where the coordinate is 0.
        axis: unit vector of a hinge or slide, in the frame of the link.
        damping, stiffness, rest: torque or force -(b1 v + b2 |v| v + b3 v^3) - (k1 x + k2 x^2 + k3 x^3) of each rate v
            and the displacement x from ``rest``, of a rotation the angle, of a free body from its pose as well.
        armature: inertia of the rotor, which adds armature q_dot^2/2 to the kinetic energy.
        zero: value of the coordinate at ``pose``.
        limits: smallest and largest value of the coordinate, or none; of the angle of a ball joint only the second.
        dry_friction: torque or force of dry friction of each rate.
        pull: smallest and largest force of all actuators together, or none.
        follows: name of another joint, factor and offset: q = factor q_other + offset, without a coordinate of its own.
    """

    name: str
    kind: str
    pose: Pose
    axis: Vector = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    damping: tuple[float, ...] = ()
    stiffness: tuple[float, ...] = ()
    rest: float = 0.0
    armature: float = 0.0
    zero: float = 0.0
    limits: tuple[float, float] | None = None
    dry_friction: float = 0.0
    pull: tuple[float, float] | None = None
    follows: tuple[str, float, float] | None = None
    label: str = ""


@dataclass(frozen=True, slots=True)
class Link:
    """Rigid body.

    Attributes:
        name: its name.
        parent: position of the parent among the links of the tree, which is smaller than its own; -1 is the world.
        joint: joint to the parent.
        inertia, frames: of the link and of all that is fixed to it; the latter of links and sites, by name.
    """

    name: str
    parent: int
    joint: Joint
    inertia: Inertia
    frames: tuple[tuple[str, Pose], ...] = ()


@dataclass(frozen=True, slots=True)
class DrawnLink:
    """Geometry of a link in plain numbers: see :class:`Link` and :class:`Joint`; frames have position and rotation."""

    parent: int
    name: str
    kind: str
    position: tuple[float, ...]
    rotation: tuple[tuple[float, ...], ...]
    center: tuple[float, ...]
    zero: float
    follows: tuple[str, float, float] | None
    label: str
    frames: tuple[tuple[Any, ...], ...]

    @classmethod
    def of(cls, link: Link, leader: Any) -> DrawnLink:
        """Return the geometry of a link whose frame is that of its formulas, :func:`aligned`; it follows ``leader``."""
        joint = link.joint
        follows = None if joint.follows is None else (leader[0], float(leader[1]), float(leader[2]))
        rotation = tuple(tuple(row) for row in link.joint.pose.rotation.tolist())
        position, center = (tuple(vector.tolist()) for vector in (joint.pose.position, link.inertia.center))
        frames = tuple((name, pose.position.tolist(), pose.rotation.tolist()) for name, pose in link.frames)
        rest = joint.zero, follows, joint.label, frames
        return cls(link.parent, joint.name, joint.kind, position, rotation, center, *rest)


def without_fixed(links: Sequence[Link]) -> list[Link]:
    """Return the links with those of fixed joints merged into their parents."""
    moving: list[Link] = []
    places: list[tuple[int, Pose]] = []  # of each link: the moving link that carries it, and the pose there
    for link in links:
        carrier, at = places[link.parent] if link.parent >= 0 else (-1, Pose())
        pose = at @ link.joint.pose
        frames = (link.name, Pose()), *link.frames
        if link.joint.kind == "fixed":
            places.append((carrier, pose))
            if carrier >= 0:
                base = moving[carrier]
                frames = *base.frames, *((name, pose @ inner) for name, inner in frames)
                moving[carrier] = replace(base, inertia=base.inertia + link.inertia.seen_from(pose), frames=frames)
        else:
            places.append((len(moving), Pose()))
            moving.append(replace(link, parent=carrier, joint=replace(link.joint, pose=pose), frames=frames))
    if not moving:
        raise SystemDefinitionError(
            "no body has a joint that moves: add one, or free the base (from_urdf: floating=True, MJCF: <freejoint>)"
        )
    return moving


def impossible_inertias(links: Sequence[Link]) -> Iterator[str]:
    """Yield what is wrong with moments of inertia that no body has."""
    for link in links:
        mass, matrix = link.inertia.mass, link.inertia.matrix
        moments = np.linalg.eigvalsh(matrix) if np.isfinite(matrix).all() else np.full(3, np.nan)
        excess, allowed = moments[2] - moments[1] - moments[0], ROUGH * moments[2] + POINT * mass
        if not (moments[0] >= -1e-9 * abs(moments).max() - 1e-12 * mass and excess <= allowed):
            yield (
                f"link '{link.name}', with the links fixed to it, has the mass {mass:g} and the moments of inertia "
                f"{moments}, which no body has: none is < 0 or exceeds the sum of the others; correct its <inertial>"
            )


def aligned(links: Sequence[Link]) -> list[Link]:
    """Return the links in frames whose z axis is the axis of their hinge or slide, turned about it to make zeros.

    The rotation C from the frame of a link to that of its parent at q = 0 becomes Rz(phi) Rx(alpha), as by Denavit and
    Hartenberg's convention, and the rotation of a hinge C Rz(q), which keeps the formulas of deep trees short.
    """
    turned: list[Link] = []
    turns: list[Vector] = []
    for link in links:
        outer = turns[link.parent] if link.parent >= 0 else np.eye(3)
        joint = link.joint
        turn = np.eye(3) if joint.kind not in SINGLE else axes_of(joint.axis)
        constant = times(times(outer.T, joint.pose.rotation), turn)
        if joint.kind in SINGLE:
            along, across = constant[2, 1], constant[2, 0]
            if math.hypot(along, across) > ROUNDED:
                by = about(np.array([0.0, 0.0, 1.0]), math.atan2(across, along))
                turn, constant = times(turn, by), times(constant, by)
        pose = Pose(without_rounding(times(outer.T, joint.pose.position)), rounded(constant))
        turns.append(turn)
        inertia = link.inertia.seen_from(Pose(rotation=turn.T))
        center, matrix = without_rounding(inertia.center), without_rounding(inertia.matrix)
        inertia = replace(inertia, center=center, matrix=matrix)
        frames = tuple((name, Pose(rotation=turn.T) @ inner) for name, inner in link.frames)
        turned.append(Link(link.name, link.parent, replace(joint, pose=pose), inertia, frames))
    return turned


def rounded(rotation: Vector) -> Vector:
    """Return a rotation matrix with entries that are nearly 0, 1 or -1 replaced by these."""
    nearest = np.round(rotation)
    return np.where(np.abs(rotation - nearest) < ROUNDED, nearest, rotation)


def without_rounding(values: Vector) -> Vector:
    """Return turned values with 0 in place of entries that are rounding errors of others."""
    return np.where(np.abs(values) < LOST * np.abs(values).max(), 0.0, values)


def about(axis: Vector, angle: float) -> Vector:
    """Return the rotation matrix about a unit vector (Rodrigues)."""
    across = hat(axis)
    rotation: Vector = np.eye(3) + math.sin(angle) * across + (1 - math.cos(angle)) * times(across, across)
    return rotation


def rotation_by(q: Vector) -> Vector:
    """Return the rotation matrix of a quaternion of any length but 0."""
    w, *vector = q / math.hypot(*q)
    v = np.array(vector)
    return np.asarray((w * w - times(v, v)) * np.eye(3) + 2.0 * (np.outer(v, v) + w * hat(v)))


def times(a: Vector, b: Vector) -> Any:
    """Return the product of matrices and vectors, whose sums are rounded once: the same on every processor.

    BLAS and vectors of sines round otherwise from one processor to the next, so that files would have other programs.
    """
    if a.ndim > 1:
        return np.array([times(row, b) for row in a])
    if b.ndim > 1:
        return np.array([times(a, column) for column in b.T])
    return math.fsum(x * y for x, y in zip(a.tolist(), b.tolist(), strict=True))


def hat(v: Vector) -> Vector:
    """Return the matrix of the cross product with a vector."""
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def axes_of(axis: Vector) -> Vector:
    """Return a rotation matrix with the given third column."""
    if abs(axis[2]) > 1 - ROUNDED:
        return np.diag([1.0, np.sign(axis[2]), np.sign(axis[2])])
    x = np.cross([0.0, 0.0, 1.0], axis)
    x /= math.hypot(*x)
    return np.column_stack([x, np.cross(axis, x), axis])


def named(links: Sequence[Link]) -> list[Link]:
    """Return the links with names of joints that are valid in formulas.

    A name whose symbols are those of an earlier joint is followed by ``_2``, ``_3``, ..
    """
    names: dict[str, str] = {}
    taken, renamed = set[str](), []
    for link in links:
        joint = link.joint
        plain = identifier(joint.name)
        name = next(name for name in numbered(plain) if taken.isdisjoint(symbols_of(joint.kind, name)))
        if joint.kind != "fixed":
            taken |= symbols_of(joint.kind, name)
            names.setdefault(joint.name, name)
        renamed.append(replace(joint, name=name, label=joint.name))
    for i, joint in enumerate(renamed):
        if joint.follows:
            renamed[i] = replace(joint, follows=(names.get(joint.follows[0], joint.follows[0]), *joint.follows[1:]))
    return [replace(link, joint=joint) for link, joint in zip(links, renamed, strict=True)]


def numbered(name: str) -> Iterator[str]:
    """Yield NAME, NAME_2, NAME_3, .."""
    return chain([name], (f"{name}_{k}" for k in count(2)))


def symbols_of(kind: str, name: str) -> set[str]:
    """Return the names of the symbols of a joint."""
    if kind in SINGLE:
        return {name, f"{name}{DOT}", f"p_{name}", f"tau_{name}"}
    return {f"{part}_{name}" for part in ("R", "omega", *"xyz")} | {f"R_{name}_{part}" for part in "wxyz"}


def identifier(name: str) -> str:
    """Return a name that is valid in formulas.

    Greek letters are spelled out, accents omitted, other characters replaced by ``_``. ``joint_`` precedes names that
    do not begin with a letter, and ``_`` follows words of C and of formulas.
    """
    letters = unicodedata.normalize("NFKD", "".join(map(_spelled, name.strip())))
    plain = re.sub(r"\W", "_", "".join(x for x in letters if not unicodedata.combining(x)), flags=re.ASCII)
    plain = plain if plain[:1].isalpha() else f"joint_{plain.lstrip('_')}"
    return plain if _is_free(plain) else f"{plain}_"


def _spelled(character: str) -> str:
    """Return the name of a Greek letter, other characters as they are."""
    words = unicodedata.name(character, "").split()
    if words[:1] != ["GREEK"] or words[2:3] != ["LETTER"] or len(words) != 4:
        return character
    letter = words[3].replace("LAMDA", "LAMBDA")
    return letter.lower() if words[1] == "SMALL" else letter.capitalize()


def _is_free(name: str) -> bool:
    """Return whether a name is neither a word of C nor one of formulas."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            check_names([name], ())
        except (SystemDefinitionError, SystemDefinitionWarning):
            return False
    return True
