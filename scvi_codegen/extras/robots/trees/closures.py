"""Closed loops of a tree of bodies: points and frames of two bodies that coincide, and relations between joints.

The frame (x, R) of a body in the nearest link that carries both bodies follows from that of its parent along the tree,
x + R p and R C A, with the rotation A and the displacement of its joint. Two frames coincide if x_1 = x_2 and the
antisymmetric part of R_1^T R_2 is zero, which has rank 3 where R_1 = R_2. Equations that are dependent at a random
state of the closed mechanism, as those across the plane of a planar one, are omitted.
"""

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from sympy import Add, Expr, Matrix, cos, eye, sin

from scvi_codegen.api.formulas import Intermediate, RotationNames, Tape, jacobian, mp, symbol
from scvi_codegen.common.errors import SystemDefinitionWarning, warn
from scvi_codegen.extras.robots.trees.energies import exact_matrix, exact_number, exact_vector, position_of, rotation_of
from scvi_codegen.extras.robots.trees.tree import SINGLE, Link, Pose, Vector, hat, rounded
from scvi_codegen.extras.robots.variables import matrix_of

ATTEMPTS, ITERATIONS = 4, 20
"""Random points, and iterations from each, for states of the loop; half turns of welds are states of lower rank."""
NEARLY_DEPENDENT = 1e-5
"""Equations are omitted if less of their derivatives is independent of the others: axes of CAD models are rounded."""


@dataclass(frozen=True, slots=True)
class Closure:
    """Two frames that coincide, each of a link (-1 is the world) with a pose in it, or only their origins."""

    ends: tuple[tuple[int, Pose], tuple[int, Pose]]
    turning: bool


@dataclass(frozen=True, slots=True)
class Coupling:
    """Relation l = offset + sum_k coefficients_k (l_other - zero)^k between the lengths of two joints or tendons."""

    length: Expr
    other: Expr | None
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
    """Return independent expressions that are 0."""
    groups = [_conditions(links, closure) for closure in closures]
    conditions = [*map(Intermediate.named, chain.from_iterable(chain.from_iterable(groups)))]
    sizes = [len(group) for parts in groups for group in parts]
    turning = [rotation_of(link.joint) for link in links if link.joint.kind in ("ball", "free")]
    in_coordinates = RotationNames(turning).in_coordinates
    return [conditions[k] for k in _independent([*map(in_coordinates, conditions)], sizes, _at_reference(links))]


def _at_reference(links: Sequence[Link]) -> dict[str, float]:
    """Return the coordinates of the reference configuration by name; those that are not listed are 0."""
    values: dict[str, float] = {}
    for joint in (link.joint for link in links):
        values |= {joint.name: joint.zero, f"{rotation_of(joint).name}_w": 1.0}
        values |= zip(position_of(joint), joint.pose.position, strict=True)
    return values


def _independent(conditions: Sequence[Expr], sizes: Sequence[int], reference: Mapping[str, float]) -> list[int]:
    """Return the indices of equations that are independent at a random point where all hold.

    The point is the limit of Gauss-Newton iterates q - G^+ g near the ``reference``, with g and G scaled by the largest
    row of each vector, of which ``sizes`` are the numbers of components. The rows of G are selected by Gram-Schmidt
    elimination with pivots: the first row whose remainder has at least half of the largest length, and so on.
    """
    if not conditions:
        return []
    variables = sorted(set().union(*(g.free_symbols for g in conditions)), key=str)
    entries, count = jacobian(conditions, variables), len(conditions)
    tape, generator = Tape([*conditions, *entries.values()], variables), random.Random(20250101)
    start = np.array([reference.get(q.name, 0.0) for q in variables])
    first = np.cumsum([0, *sizes[:-1]])

    def at(q: Vector) -> tuple[Vector, Vector]:
        values = tape([mp.mpf(x) for x in q.tolist()])
        rows: Vector = matrix_of(entries, values[count:], (count, len(variables)))
        lengths = np.maximum.reduceat(np.linalg.norm(rows, axis=1), first)
        scales = np.repeat(np.where(lengths > 0, lengths, 1.0), sizes)
        return np.array(values[:count], float) / scales, rows / scales[:, None]

    closed: list[Vector] = []
    for attempt in range(ATTEMPTS):
        q = start + np.array([generator.uniform(-0.5, 0.5) for _ in variables]) / 2**attempt
        for _ in range(ITERATIONS):
            g, rows = at(q)
            q = q - np.linalg.lstsq(rows, g, rcond=NEARLY_DEPENDENT)[0]
        closed += [rows] if np.abs(g).max() < NEARLY_DEPENDENT else []
    return sorted(_pivots(max(closed or [rows], key=lambda rows: np.linalg.matrix_rank(rows, NEARLY_DEPENDENT))))


def _pivots(rows: Vector) -> Iterator[int]:
    """Yield the indices of independent rows; warn of dependent ones that are not exactly so."""
    while (lengths := np.linalg.norm(rows, axis=1)).max() > NEARLY_DEPENDENT:
        pivot = int(np.argmax(lengths >= lengths.max() / 2))
        yield pivot
        unit = rows[pivot] / lengths[pivot]
        rows = rows - np.outer(rows @ unit, unit)
    if lengths.max() > NEARLY_DEPENDENT**2:  # of states that satisfy the conditions to NEARLY_DEPENDENT
        share = f"{lengths.max():.1e} of it is independent of the others, as by rounded axes"
        warn(f"an equation of a closed loop is omitted, although {share}", SystemDefinitionWarning)


def _conditions(links: Sequence[Link], closure: Closure | Coupling) -> list[list[Expr]]:
    """Return the equations of one closure or coupling, with dependent ones, as components of vectors."""
    if isinstance(closure, Coupling):
        relative = 0 if closure.other is None else closure.other - exact_number(closure.zero)
        terms = (a * relative**k for k, a in enumerate(map(exact_number, closure.coefficients)))
        return [[closure.length - exact_number(closure.offset) - Add(*terms)]]
    (position, axes), (other, others) = frames_in_common(links, closure.ends)
    equations = [[*(position - other)]]
    if closure.turning:
        relative = axes.T * others
        equations.append(
            [relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0], relative[1, 0] - relative[0, 1]]
        )
    return equations


def frames_in_common(links: Sequence[Link], ends: Sequence[tuple[int, Pose]]) -> list[tuple[Matrix, Matrix]]:
    """Return positions and axes of two frames, by link and pose in it, in the nearest link that carries both."""
    carriers = [[link] for link, _ in ends]
    for path in carriers:
        while path[-1] >= 0:
            path.append(links[path[-1]].parent)
    common = next(link for link in carriers[0] if link in carriers[1])
    return [_frame(links, link, pose, common) for link, pose in ends]


def _frame(links: Sequence[Link], link: int, pose: Pose, outer: int) -> tuple[Matrix, Matrix]:
    """Return position and axes, in the frame of a link ``outer``, of a frame with a pose in a link that it carries."""
    position, axes = exact_vector(pose.position), exact_matrix(rounded(pose.rotation))
    while link != outer:
        joint = links[link].joint
        origin, turn = exact_vector(joint.pose.position), exact_matrix(rounded(joint.pose.rotation))
        if joint.kind == "free":
            origin, turn = Matrix([symbol(name) for name in position_of(joint)]), eye(3)
        if joint.kind in ("ball", "free"):
            turn *= Matrix(3, 3, rotation_of(joint).entries)
        elif joint.kind in SINGLE:
            q = symbol(joint.name) - exact_number(joint.zero)
            across = exact_matrix(rounded(hat(joint.axis)))
            if joint.kind == "hinge":
                turn = turn * (eye(3) + sin(q) * across + (1 - cos(q)) * across * across)
            else:
                origin += turn * exact_vector(rounded(joint.axis)) * q
        position = (origin + turn * position).applyfunc(Intermediate.named)
        axes = (turn * axes).applyfunc(Intermediate.named)
        link = links[link].parent
    return position, axes
