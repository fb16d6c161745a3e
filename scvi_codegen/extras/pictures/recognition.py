"""Recognition of what a system looks like, from the names of its coordinates and parameters and from its energy."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import sympy
from sympy import Expr, Matrix

from scvi_codegen.api.formulas import Intermediate, Rotation, RotationNames, parse_expression, symbol
from scvi_codegen.api.program import Interface
from scvi_codegen.common.errors import ExpressionError, StateError
from scvi_codegen.extras.pictures.shape import DrawnSystem, MovingShape, PointProgram, graph_of

NUMBERED = re.compile(r"(.*?)_?(\d+)")
LENGTHS = ("l", "L", "length")
"""Names of parameters that are rod lengths, alone or followed by a number."""
MAX_RODS = 6
GENERIC = 0.3, 0.17
"""First angle, and difference between angles, of a state without accidental symmetry."""
SPACING = 1.5
"""Distance between the centers of bodies without positions."""
DOTS = 100
"""Number of nodes up to which those of a chain are drawn as dots."""


def shape_of(system: DrawnSystem) -> MovingShape:
    """Return the shape of a system: links, bodies by names, pendulums and curvilinear coordinates by energy, a chain.

    Without any of these, one coordinate is drawn in the phase plane, two in their plane.
    """
    names = system.coordinates
    m = len(names)
    if system.links:
        return _robot(system)
    if system.mesh is not None and len(system.mesh.axes) < 3:
        return graph_of(system.nodes, system.mesh.field_system.fields)
    if system.rotations:
        return _solids(system)
    if body_columns := Interface.bodies(names) or Interface.bodies([*names, *system.momenta]):
        return _bodies(system, body_columns)
    if (sign := hanging(system)) is not None:
        return _pendulum(system, sign)
    if system.shapes and (shape := _of_arrays(system)):
        return shape
    if m in EMBEDDINGS and (shape := _curvilinear(system)):
        return shape
    if m <= 2:
        labels = (*names, *system.momenta)[:2]
        marks = [{"kind": "body", "points": [0]}]
        return MovingShape(points=[[1, 2]], marks=marks, trails=[0], movable=[0], labels=labels, equal=m == 2)
    return graph_of({"number of the coordinate": range(1, m + 1)}, ["q"], dots=True)


def _of_arrays(system: DrawnSystem) -> MovingShape | None:
    """Return the shape of the first array: particles r[N, 2] or r[N, 3], a chain q[N], a lattice u[N, M]."""
    (name, shape), *_ = system.shapes.items()
    if len(shape) == 2 and shape[1] in (2, 3):
        return _particles(system, shape)
    if len(shape) not in (1, 2):
        return None
    axes = {letter: range(size) for letter, size in zip("ij", shape, strict=False)}
    return graph_of(axes, [name], dots=math.prod(shape) <= DOTS)


def _particles(system: DrawnSystem, shape: tuple[int, ...]) -> MovingShape:
    """Return a point for each row of an array of positions, in their periodic box, and lines of a table ``bonds``."""
    count, dimension = shape
    points = (1 + np.arange(count * dimension).reshape(shape)).tolist()
    marks: list[dict[str, Any]] = [{"kind": "particles", "points": list(range(count))}]
    bonds = np.asarray(system.tables.get("bonds", ()))
    if bonds.ndim == 2 and bonds.shape[1] == 2 and bonds.size and bonds.max() < count:
        marks.insert(0, {"kind": "bonds", "points": bonds.ravel().tolist()})
    program, parameters = PointProgram(system.names), {name: symbol(name) for name in system.parameters}
    periods = [parse_expression(text, parameters) for _, kind, text in system.lengths if kind == "box"]
    box = program.point(periods[:dimension])
    return MovingShape(dimension=dimension, points=points, program=program.entries, marks=marks, box=box)


def _bodies(system: DrawnSystem, members: Sequence[Any]) -> MovingShape:
    """Return a point for each body, and rods of constraints on distances."""
    marks = [
        {"kind": "body", "points": [k], "mass": system.parameter(("m",), body.name), "name": body.name}
        for k, body in enumerate(members)
    ]
    program, numbers = PointProgram(system.names), list(range(len(members)))
    points = [[1 + column for column in body.columns] for body in members]
    rods = _rods(system, members, points, program)
    return MovingShape(
        dimension=len(points[0]), points=points, program=program.entries, marks=rods + marks, trails=numbers,
        movable=numbers,
    )  # fmt: skip


def _rods(
    system: DrawnSystem, members: Sequence[Any], points: list[list[int]], program: PointProgram
) -> list[dict[str, Any]]:
    """Return rods of constraints on the distance of two bodies, or of one from a fixed point, which is added."""
    rods: list[dict[str, Any]] = []
    symbols = {name: symbol(name) for name in system.names}
    names = [[system.names[1 + column] for column in body.columns] for body in members]
    for text in system.constraints:
        try:
            constraint = parse_expression(text, symbols)
        except ExpressionError:
            continue
        used = {variable.name for variable in constraint.free_symbols}
        ends = [k for k, coordinates in enumerate(names) if used & {*coordinates}]
        if len(ends) == 2:
            rods.append({"kind": "rod", "points": ends})
        elif len(ends) == 1:
            place = [symbols[name] for name in names[ends[0]]]
            centre: Any = sympy.solve([constraint.diff(x) for x in place], place)
            values: list[Any] = [centre.get(x) if isinstance(centre, dict) else None for x in place]
            if all(value is not None and (value.is_Symbol or value.is_number) for value in values):
                rods.append({"kind": "rod", "points": [len(points), ends[0]]})
                rods.append({"kind": "pivot", "points": [len(points)]})
                points.append(program.point(values))
    return rods


def _pendulum(system: DrawnSystem, sign: float) -> MovingShape:
    """Return a chain of rods, each hanging from (sign 1) or standing on (-1) the end of the previous one."""
    names, program = system.coordinates, PointProgram(system.names)
    numbers = numbers_of(names) or ("",) * len(names)
    ends: list[Any] = [(sympy.S.Zero, sympy.S.Zero)]
    marks: list[dict[str, Any]] = [{"kind": "pivot", "points": [0]}]
    for k, (name, number) in enumerate(zip(names, numbers, strict=True), 1):
        length, q = _formula(system.parameter(LENGTHS, number)), symbol(name)
        x, y = ends[-1]
        ends.append(
            (Intermediate.named(x + length * sympy.sin(q)), Intermediate.named(y - sign * length * sympy.cos(q)))
        )
        marks.append({"kind": "bob", "points": [k], "mass": system.parameter(("m",), number)})
    numbered = list(range(1, len(ends)))
    rod = {"kind": "rod", "points": [0, *numbered]}
    return MovingShape(
        points=[program.point(end) for end in ends], program=program.entries, marks=[rod, *marks],
        trails=numbered[-1:], movable=numbered, angles=range(len(names)),
    )  # fmt: skip


def _formula(value: str | float) -> Expr:
    """Return a parameter or a number as an expression."""
    return symbol(value) if isinstance(value, str) else sympy.Float(value)


def hanging(system: DrawnSystem) -> float | None:
    """Return 1 if the coordinates are angles of pendulums that hang at 0, -1 if upright there, else ``None``."""
    # V = sum a_i (1 - cos q_i), all a_i of one sign; T of two neighbouring momenta is not the sum of that of each.
    names = system.coordinates
    m = len(names)
    if system.energy is None or m > MAX_RODS or (m > 1 and numbers_of(names) is None):
        return None
    generic = GENERIC[0] + GENERIC[1] * np.arange(m)
    try:
        at_rest = system.potential(np.zeros(m), *math.pi * np.eye(m), generic)
        a = (at_rest[1:-1] - at_rest[0]) / 2
        expected = at_rest[0] + a @ (1.0 - np.cos(generic))
        alone, both = np.eye(m), np.eye(m)[:-1] + np.eye(m)[1:]
        kinetic = system.energy(np.zeros_like(alone), alone) - at_rest[0]
        coupled = system.energy(np.zeros_like(both), both) - at_rest[0] - kinetic[:-1] - kinetic[1:]
    except StateError:
        return None
    close = math.isclose(at_rest[-1], expected, rel_tol=0.0, abs_tol=1e-9 * float(np.abs(a).max()))
    one_sign = bool((a > 0.0).all() or (a < 0.0).all())
    together = bool((np.abs(coupled) > 1e-9 * np.abs(kinetic).max()).all())
    return float(np.sign(a[0])) if close and one_sign and together else None


def numbers_of(names: Sequence[str]) -> tuple[int, ...] | None:
    """Return the numbers of theta_1, theta_2, .. or theta1, theta2, ..; ``None`` for other names."""
    result = [NUMBERED.fullmatch(name) for name in names]
    if not all(result) or len({match[1] for match in result if match}) > 1:
        return None
    return tuple(int(match[2]) for match in result if match)


EMBEDDINGS: Mapping[int, Mapping[str, Callable[..., tuple[Any, ...]]]] = {
    2: {"plane": lambda r, u: (1.0, r**2), "sphere": lambda u, v: (1.0, np.sin(u) ** 2)},
    3: {"space": lambda r, u, v: (1.0, r**2, r**2 * np.sin(u) ** 2), "cylinder": lambda r, u, z: (1.0, r**2, 1.0)},
}
"""Diagonals of the metrics of polar coordinates of the plane, and spherical and cylindrical ones, by their number."""


def _curvilinear(system: DrawnSystem) -> MovingShape | None:
    """Return a body at its position if the kinetic energy is that of a particle in curvilinear coordinates."""
    if system.energy is None:
        return None
    m = len(system.coordinates)
    states = np.array([[0.7, 0.9, 0.4], [1.1, 0.5, 1.3], [0.6, 1.2, 2.0]])[:, :m]
    pairs = [a + b for a, b in combinations(np.eye(m), 2)]
    try:
        rest = system.potential(*states)
        alone = np.array([system.energy(states, np.tile(e, (3, 1))) - rest for e in np.eye(m)])
        both = np.array([system.energy(states, np.tile(e, (3, 1))) - rest for e in pairs])
    except StateError:
        return None
    sums = np.array([alone[i] + alone[j] for i, j in combinations(range(m), 2)])
    for kind, metric in EMBEDDINGS[m].items():
        scaled = alone * [np.broadcast_to(g, 3) for g in metric(*states.T)]
        if scaled[0, 0] > 0 and np.allclose(scaled, scaled[0, 0], rtol=1e-9) and np.allclose(both, sums, rtol=1e-9):
            return _orbit(system, kind)
    return None


def _orbit(system: DrawnSystem, kind: str) -> MovingShape:
    """Return a body in curvilinear coordinates; in a uniform field of gravity, down is down."""
    names = system.coordinates
    a, b, *more = map(symbol, names)
    sin, cos = sympy.sin, sympy.cos
    link: list[dict[str, Any]] = [{"kind": "pivot", "points": [0]}]
    angles = [1]
    if kind == "sphere":
        length = _formula(system.parameter(LENGTHS, ""))
        up = 1 if _difference(system, [0.0, 0.0], [math.pi, 0.0]) > 0 else -1
        place = [length * sin(a) * cos(b), length * sin(a) * sin(b), up * length * cos(a)]
        link.insert(0, {"kind": "rod", "points": [0, 1]})
    elif kind == "space":
        place, angles = [a * sin(b) * cos(more[0]), a * sin(b) * sin(more[0]), a * cos(b)], [1, 2]
    elif kind == "cylinder":
        place = [a * cos(b), a * sin(b), more[0]]
    else:
        across, along = (
            [_difference(system, [r, turn], [r, turn - math.pi]) for r in (1.0, 2.0)] for turn in (math.pi, math.pi / 2)
        )
        uniform = np.allclose([across[1], along[1]], [2 * across[0], 2 * along[0]], rtol=1e-9, atol=1e-12)
        if uniform and abs(across[0]) > 1e-9:  # the angle is measured from the vertical
            place = [a * sin(b), (-1 if across[0] > 0 else 1) * a * cos(b)]
            link.insert(0, {"kind": "spring", "points": [0, 1]})
        else:
            place = [a * cos(b), (-1 if uniform and along[0] < 0 else 1) * a * sin(b)]
    program = PointProgram(system.names)
    points = [program.point([0] * len(place)), program.point(place)]
    marks = [*link, {"kind": "body", "points": [1], "mass": system.parameter(("m",), "")}]
    return MovingShape(
        dimension=len(place), points=points, program=program.entries, marks=marks, trails=[1], movable=[1],
        angles=angles,
    )  # fmt: skip


def _difference(system: DrawnSystem, upper: Sequence[float], lower: Sequence[float]) -> float:
    """Return the potential energy at one state minus that at another; 0 if it is undefined."""
    try:
        upper_energy, lower_energy = system.potential(upper, lower)
    except StateError:
        return 0.0
    return float(upper_energy - lower_energy)


def _solids(system: DrawnSystem) -> MovingShape:
    """Return a box for each rotation (a top if it is symmetric), an arrow for each direction and spin.

    They are at (x, y, z), else several rotations, and members of arrays, are side by side.
    """
    program = PointProgram(system.names)
    members = RotationNames.members_of(system.rotations)
    moving = all(name in system.coordinates for name in "xyz")
    apart = SPACING if not moving and (system.shapes or isinstance(members[-1], Rotation)) else 0
    points: list[list[int]] = []
    marks: list[dict[str, Any]] = []
    solids, trails = [], []
    for number, member in enumerate(members):
        centre = Matrix([symbol(name) for name in "xyz"] if moving else [apart * number, 0, 0])
        points.append(program.point(centre))
        values, place, first = member.values(), len(points) - 1, len(points)
        if isinstance(member, Rotation):
            matrix = Matrix(3, 3, [values[entry] for entry in member.entries])
            points += [program.point(centre + matrix[:, axis]) for axis in range(3)]
            symmetric = f"body momentum 3 of {member.name}" in system.map_names
            kind = "top" if symmetric else "box"
            marks.append({"kind": kind, "points": [place, first, first + 1, first + 2], "color": number})
            marks.append({"kind": "body", "points": [first + 2], "mass": 0.1, "color": number + 1})
        else:
            vector = Matrix([values[entry] for entry in member.entries])
            length = Intermediate.named(sympy.sqrt(sympy.Add(*(component**2 for component in vector))))
            points.append(program.point(centre + vector / length))
            marks.append({"kind": "arrow", "points": [place, first], "color": number})
        trails.append(len(points) - 1)
        solids.append({"name": member.name, "centre": place, "tip": trails[-1]})
    return MovingShape(dimension=3, points=points, program=program.entries, marks=marks, trails=trails, solids=solids)


def _robot(system: DrawnSystem) -> MovingShape:
    """Return the links of a robot, from the origin of each frame to those of its children.

    A link without children ends at twice the distance of its center of mass. The rotation of link i into the world is
    A_i = A_p C_i R(q_i), its origin is o_p + A_p r_i.
    """
    links, members = system.links, {member.name: member for member in RotationNames.members_of(system.rotations)}
    origins: list[Matrix] = []
    turns: list[Matrix] = []
    for link in links:
        origin, turn = _placed(link, members)
        if link.parent >= 0:
            origin = origins[link.parent] + turns[link.parent] * origin
            turn = turns[link.parent] * turn
        origins.append(origin.applyfunc(Intermediate.named))
        turns.append(turn.applyfunc(Intermediate.named))
    program = PointProgram(system.names)
    points = [program.point(origin) for origin in origins]
    based = [i for i, link in enumerate(links) if link.parent < 0 and link.kind != "free" and any(origins[i])]
    marks, tips = [], []
    if based:
        points.append(program.point([0, 0, 0]))
        marks = [{"kind": "link", "points": [len(links), i], "color": -1} for i in based]
    for i, (link, origin, turn) in enumerate(zip(links, origins, turns, strict=True)):
        children = [k for k, child in enumerate(links) if child.parent == i]
        if not children:
            tips.append(len(points))
            points.append(program.point(origin + 2 * turn * Matrix(link.center)))
        marks += [{"kind": "link", "points": [i, end], "color": i} for end in children or tips[-1:]]
    base = 0 if links[0].kind == "free" and all(link.parent >= 0 for link in links[1:]) else None
    return MovingShape(
        dimension=3, points=points, program=program.entries, marks=marks, trails=tips, movable=tips, followed=base
    )


def _placed(link: Any, members: Mapping[str, Any]) -> tuple[Matrix, Matrix]:
    """Return the origin of a link in the frame of its parent, and its rotation into it."""
    constant, position = Matrix(link.rotation), Matrix(link.position)
    if link.kind in ("free", "ball"):
        member = members[f"R_{link.name}"]
        values = member.values()
        turn = Matrix(3, 3, [values[entry] for entry in member.entries])
        if link.kind == "free":
            return Matrix([symbol(f"{axis}_{link.name}") for axis in "xyz"]), turn
        return position, constant * turn
    name, factor, offset = link.follows or (link.name, 1, 0)
    moved = factor * symbol(name) + offset - link.zero
    if link.kind == "slide":
        return position + moved * constant[:, 2], constant
    sine, cosine = sympy.sin(moved), sympy.cos(moved)
    return position, constant * Matrix([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
