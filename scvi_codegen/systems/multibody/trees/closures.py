"""Closed loops of a tree of bodies: points and frames of two bodies that coincide, and relations between joints.

The frame (x, R) of a body in the world follows from that of its parent along the tree, x + R p and R C A, with the
rotation A and the displacement of its joint. Two frames coincide if x_1 = x_2 and the antisymmetric part of R_1^T R_2
is zero, which has rank 3 where R_1 = R_2. Equations that are dependent at a random state, as those across the plane of
a planar mechanism, are omitted.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from sympy import Add, Dummy, Expr, Matrix, cos, eye, sin

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.formulas.expressions import derivative_along
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.rotations import RotationNames
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.multibody.trees.energies import (
    exact_matrix,
    exact_number,
    exact_vector,
    position_of,
    rotation_of,
)
from scvi_codegen.systems.multibody.trees.tree import SINGLE, Link, Pose, hat, identifier, rounded
from scvi_codegen.systems.multibody.variables import independent_of


@dataclass(frozen=True, slots=True)
class Closure:
    """Two frames that coincide, each of a link (-1 is the world) with a pose in it, or only their origins."""

    links: tuple[int, int]
    poses: tuple[Pose, Pose]
    turning: bool


@dataclass(frozen=True, slots=True)
class Coupling:
    """Relation q = offset + sum_k coefficients_k (q_other - zero)^k between the coordinates of two joints."""

    joint: str
    other: str | None
    coefficients: tuple[float, ...]
    offset: float
    zero: float


def at_reference(links: Sequence[Link], link: int) -> Pose:
    """Return the pose of a link in the world where all coordinates are at their reference values."""
    pose = Pose()
    while link >= 0:
        pose, link = links[link].joint.pose @ pose, links[link].parent
    return pose


def conditions_of(links: Sequence[Link], closures: Iterable[Closure | Coupling]) -> list[Expr]:
    """Return independent expressions that are 0.

    Raises:
        SystemDefinitionError: if a joint does not exist or has no coordinate of its own.
    """
    conditions = [intermediate(g) for closure in closures for g in _conditions(links, closure)]
    turning = [rotation_of(link.joint) for link in links if link.joint.kind in ("ball", "free")]
    in_coordinates = RotationNames(turning).in_coordinates
    rates: dict[Expr, Dummy] = {}
    rows = []
    for g in map(in_coordinates, conditions):
        coordinates = sorted(g.free_symbols, key=str)
        rates |= {q: Dummy() for q in coordinates if q not in rates}
        rows.append(derivative_along(g, coordinates, [rates[q] for q in coordinates]))
    return [conditions[k] for k in independent_of((), rows, tuple(rates.values()))] if rows else []


def _conditions(links: Sequence[Link], closure: Closure | Coupling) -> Iterator[Expr]:
    """Yield the equations of one closure or coupling, with dependent ones."""
    if isinstance(closure, Coupling):
        relative = _coordinate(links, closure.other) - exact_number(closure.zero) if closure.other else 0
        terms = (a * relative**k for k, a in enumerate(map(exact_number, closure.coefficients)))
        yield _coordinate(links, closure.joint) - exact_number(closure.offset) - Add(*terms)
        return
    (position, axes), (other, others) = map(_frame, (links, links), closure.links, closure.poses)
    yield from position - other
    if closure.turning:
        relative = axes.T * others
        yield from (relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1])


def _coordinate(links: Sequence[Link], name: str) -> Expr:
    joints = {link.joint.name: link.joint for link in links if link.joint.kind in SINGLE}
    if name not in joints:
        raise SystemDefinitionError(f"an equality names '{name}', which is no hinge or slide{closest(name, joints)}")
    return symbol(identifier(name))


def _frame(links: Sequence[Link], link: int, pose: Pose) -> tuple[Matrix, Matrix]:
    """Return position and axes in the world of a frame with a pose in a link."""
    position, axes = exact_vector(pose.position), exact_matrix(rounded(pose.rotation))
    while link >= 0:
        joint = links[link].joint
        origin, turn = exact_vector(joint.pose.position), exact_matrix(rounded(joint.pose.rotation))
        if joint.kind == "free":
            origin, turn = Matrix([symbol(name) for name in position_of(joint)]), eye(3)
        if joint.kind in ("ball", "free"):
            turn *= Matrix(3, 3, rotation_of(joint).entries)
        elif joint.kind in SINGLE:
            q = symbol(identifier(joint.name)) - exact_number(joint.zero)
            across = exact_matrix(rounded(hat(joint.axis)))
            if joint.kind == "hinge":
                turn = turn * (eye(3) + sin(q) * across + (1 - cos(q)) * across * across)
            else:
                origin += turn * exact_vector(rounded(joint.axis)) * q
        position = (origin + turn * position).applyfunc(intermediate)
        axes = (turn * axes).applyfunc(intermediate)
        link = links[link].parent
    return position, axes
