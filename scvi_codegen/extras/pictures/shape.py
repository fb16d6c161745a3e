"""Shapes: points and marks that represent a state, as data, for films (NumPy) and pages (JavaScript).

A shape is recognised from a system, or written by the user as formulas (``[picture]`` in model files). Its points are
registers of a straight-line program: the first registers contain t, the coordinates, the momenta and the parameters,
and each entry of the program, a number or an operation on earlier registers, adds one. ``drawing.js`` evaluates the
same program, so that no text is evaluated as code.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr

from scvi_codegen.api.formulas import DOT, TIME, Array, Intermediate, RotationNames, symbol
from scvi_codegen.api.systems import ArraySystem
from scvi_codegen.common.errors import ExpressionError, ModelFileError, SystemDefinitionError, closest

Values = NDArray[np.float64]

FAMILY = re.compile(r"(\w+)\[([A-Za-z]\w*) in (\d+)\]")
"""Name of a family of points: name, index and number."""
MAX_FAMILY = 1000
MARKS = ("walls", "rods", "springs", "bodies", "trails")
"""Keys of a picture besides ``points``, in the order in which they are drawn."""
OPERATIONS: Mapping[str, Callable[..., Any]] = {
    "add": lambda *terms: sum(terms),
    "mul": lambda *factors: math.prod(factors),
    "pow": np.power,
    "rint": np.rint,
    "unit_step": lambda x: np.heaviside(x, 1.0),
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log")},
    **{name: getattr(np, f"arc{name[1:]}") for name in ("asin", "acos", "atan", "atan2", "asinh", "acosh", "atanh")},
}
"""Operations of a program; ``drawing.js`` has those of the same names."""


@dataclass(frozen=True, kw_only=True)
class MovingShape:
    """Points and marks that represent a state.

    Attributes:
        dimension: of the points, 2 or 3.
        points: registers of the components of each point.
        program: numbers and operations, the values of the registers after those of t, q, p and the parameters.
        marks: kind and points of each mark, and where it has them name, mass (a number or parameter) and color.
        trails: points whose paths are drawn.
        movable: points that can be dragged.
        followed: point that the view of a page follows, of what moves freely in space.
        labels: of the axes, if the points are no positions in space.
        equal: use one scale for all axes.
        angles: coordinates of period 2 pi.
        solids: rotations, directions and spins: name, points of the centre and the tip.
        mesh: nodes by axis, fields with their columns of (q, p) and the weights that divide those of p, and whether
            nodes are dots, instead of points.
        box: registers of the periods of the components of all points; none without periods.
    """

    dimension: int = 2
    points: Sequence[Sequence[int]] = ()
    program: Sequence[Any] = ()
    marks: Sequence[Mapping[str, Any]] = ()
    trails: Sequence[int] = ()
    movable: Sequence[int] = ()
    followed: int | None = None
    labels: Sequence[str] = ()
    equal: bool = True
    angles: Sequence[int] = ()
    solids: Sequence[Mapping[str, Any]] = ()
    mesh: Mapping[str, Any] | None = None
    box: Sequence[int] = ()

    def to_data(self) -> dict[str, Any]:
        """Return the attributes that differ from their defaults, for JSON."""
        attributes = {
            name: list(value) if isinstance(value, range | tuple) else value for name, value in asdict(self).items()
        }
        return {name: value for name, value in attributes.items() if isinstance(value, list | int) or value}

    def positions(self, t: Any, q: Values, p: Values, parameters: Any) -> Values:
        """Return the points (n, k, d) of states with t (n,), q and p (n, m), and parameters."""
        if self.mesh is not None:
            return _points_of_mesh(self.mesh, q, p)
        registers = [t, *np.transpose(q), *np.transpose(p), *parameters]
        for entry in self.program:
            if isinstance(entry, float):
                registers.append(entry)
            else:
                operation, *operands = entry
                with np.errstate(all="ignore"):  # points that are undefined are not drawn
                    registers.append(OPERATIONS[operation](*[registers[k] for k in operands]))
        components = [[np.broadcast_to(registers[k], len(q)) for k in point] for point in self.points]
        result: Values = np.transpose(np.array(components, dtype=float), (2, 0, 1))
        return np.mod(result, [float(registers[k]) for k in self.box]) if self.box else result


def _points_of_mesh(mesh: Mapping[str, Any], q: Values, p: Values) -> Values:
    """Return the nodes of a mesh with the values of its first field there, (n, nodes, axes + 1)."""
    nodes, field = np.meshgrid(*mesh["axes"].values(), indexing="ij"), mesh["fields"][0]
    begin, end = field["columns"]
    grids = [np.broadcast_to(np.ravel(coordinates), (len(q), end - begin)) for coordinates in nodes]
    values = np.concatenate([q, p], axis=1)[:, begin:end] / field.get("weights", 1.0)
    return np.stack([*grids, values], axis=2)


class PointProgram:
    """Straight-line program of the points of a shape, in the registers of a state."""

    def __init__(self, names: Sequence[str]) -> None:
        self.entries: list[Any] = []
        self.places: dict[Expr, int] = {symbol(name): place for place, name in enumerate(names)}
        self.begin = len(names)

    def point(self, components: Sequence[Any]) -> list[int]:
        """Return the registers of a point, whose components are expressions or numbers."""
        formulas = [sympy.sympify(component) for component in components]
        for intermediate in Intermediate.within(*formulas):
            self._place(intermediate)
        return [self._place(formula) for formula in formulas]

    def _place(self, formula: Any) -> int:
        if formula not in self.places:
            if isinstance(formula, Intermediate):
                self.places[formula] = self._place(formula.definition)
                return self.places[formula]
            name = type(formula).__name__.lower()
            entry = [name, *map(self._place, formula.args)] if formula.args else float(formula)
            self.entries.append(entry)
            self.places[formula] = self.begin + len(self.entries) - 1
        return self.places[formula]


@dataclass(frozen=True, kw_only=True)
class DrawnSystem:
    """System whose states are drawn, from a trajectory or a model.

    Attributes:
        coordinates, momenta, parameters: names; coordinates of arrays are those of their entries.
        rotations, constraints, map_names: as of :class:`~scvi_codegen.codegen.rendering.source.Interface`.
        shapes: shapes of the arrays whose entries are the coordinates, in order; none of named coordinates.
        energy: energies (n,) of states q and p (n, m); ``None`` of arrays whose sizes are known at run time.
        mesh: of fields of a density.
        links: of a robot from a file.
        lengths: periods of lists of neighbours, as :attr:`Interface.lengths`.
        tables: index tables by name.
    """

    coordinates: Sequence[str]
    momenta: Sequence[str]
    parameters: Sequence[str]
    shapes: Mapping[str, tuple[int, ...]]
    energy: Callable[[Values, Values], Values] | None = None
    mesh: Any = None
    rotations: Sequence[str] = ()
    constraints: Sequence[str] = ()
    map_names: Sequence[str] = ()
    links: Sequence[Any] = ()
    lengths: Sequence[Sequence[str]] = ()
    tables: Mapping[str, Any] = field(default_factory=dict)

    @property
    def nodes(self) -> dict[str, list[float]]:
        """Nodes of the mesh by axis."""
        return {axis.name: axis.points.tolist() for axis in self.mesh.axes}

    @cached_property
    def names(self) -> list[str]:
        """Names of the registers of a state."""
        names = self.coordinates
        momenta = [f"p_{name}" for name in names] if self.shapes else self.momenta
        return [TIME, *names, *momenta, *self.parameters]

    def parameter(self, starts: Sequence[str], number: Any) -> str | float:
        """Return the name of the parameter of a body, m1 or m_1 or m; 1 if there is none."""
        names = [f"{start}{end}" for end in (number, f"_{number}", "") for start in starts]
        return next((name for name in names if name in self.parameters), 1.0)

    def potential(self, *states: Any) -> Values:
        """Return energies at rest."""
        q = np.array(states, dtype=float)
        return self.energy(q, np.zeros_like(q)) if self.energy else np.zeros(len(q))


def entry_names(shapes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Return the names of the entries of arrays, ``q_0_1``."""
    return ["_".join(map(str, (name, *index))) for name, shape in shapes.items() for index in np.ndindex(*shape)]


def graph_of(axes: Mapping[str, Any], fields: Sequence[str], *, dots: bool = False) -> MovingShape:
    """Return the graphs of fields over the nodes of their axes."""
    nodes = {name: [float(x) for x in points] for name, points in axes.items()}
    size = math.prod(map(len, nodes.values()))
    columns = [{"name": name, "columns": [k * size, (k + 1) * size]} for k, name in enumerate(fields)]
    labels = (*nodes, fields[0])
    return MovingShape(
        dimension=len(labels), labels=labels, equal=False, mesh={"axes": nodes, "fields": columns, "dots": dots}
    )


def shape_of_picture(system: DrawnSystem, picture: Mapping[str, Any], where: str = "picture") -> MovingShape:
    """Return the shape that a user describes by formulas.

    Args:
        system: system with the names that the formulas may use.
        picture: ``points``, two or three formulas or numbers by name, in coordinates, momenta, entries of rotations,
            parameters and t, by ``p[k in 12]`` of ``p[0]`` to ``p[11]``, all of which ``p`` names; ``rods``,
            ``springs`` and ``walls``, lists of names of points; ``bodies`` and ``trails``, names of points, by default
            those that move and are not ends of walls, and the bodies. Of a field on a mesh instead ``fields``, the
            names of fields or momenta that are drawn.
        where: of it, for messages.
    """
    if isinstance(picture, Mapping) and "fields" in picture:
        if system.mesh is None or len(picture) > 1:
            raise ModelFileError(
                f"{where}: fields chooses what is drawn of a field on a mesh, without other keys: omit it"
            )
        return _chosen_fields(system, _listed(picture, "fields", where), f"{where} fields")
    _check_keys(picture, where)
    reader, program = _reader(system), PointProgram(system.names)
    points = _single_points(picture["points"], where)
    names = [*points]
    formulas = [_components(reader, components, f"{where} points {name}") for name, components in points.items()]
    if len({*map(len, formulas)}) > 1:
        raise ModelFileError(f"{where} points must all have two components, in the plane, or all three, in space")
    state = {symbol(name) for name in system.names[: len(system.names) - len(system.parameters)]}
    moving = {k for k, point in enumerate(formulas) if any(x.free_symbols & state for x in point)}
    lines = list(_lines_of_picture(picture, names, where))
    walls = {k for line in lines if line["kind"] == "wall" for k in line["points"]}
    free = [names[k] for k in sorted(moving - walls)]
    shown = _numbers(_listed(picture, "bodies", where, free), names, f"{where} bodies")
    held = {line["points"][0] for line in lines if line["kind"] != "wall"} - moving
    marks = lines + [{"kind": "pivot", "points": [k]} for k in sorted(held - {*shown})]
    marks += [{"kind": "body", "points": [k], "mass": system.parameter(("m",), names[k])} for k in shown]
    trails = _numbers(_listed(picture, "trails", where, [names[k] for k in shown]), names, f"{where} trails")
    return MovingShape(
        dimension=len(formulas[0]), points=[program.point(point) for point in formulas], program=program.entries,
        marks=marks, trails=trails, movable=[k for k in shown if k in moving],
    )  # fmt: skip


def _check_keys(picture: Any, where: str) -> None:
    """Raise :class:`ModelFileError` for a picture without points, and for keys that pictures do not have."""
    if not isinstance(picture, Mapping) or not isinstance(picture.get("points"), Mapping) or not picture["points"]:
        raise ModelFileError(
            f'{where} must have points, {{ bob = ["l*sin(q)", "-l*cos(q)"] }}, not {picture!r:.60}: give points'
        )
    for key in picture:
        if key not in ("points", *MARKS):
            raise ModelFileError(f"{where}: unknown key {key!r}{closest(key, MARKS)} Known: points, {', '.join(MARKS)}")


def _lines_of_picture(picture: Mapping[str, Any], names: Sequence[str], where: str) -> Iterator[dict[str, Any]]:
    """Yield the walls, rods and springs of a picture."""
    for key in MARKS[:3]:
        for ends in _listed(picture, key, where):
            points = _numbers(ends, names, f"{where} {key}")
            if len(points) < 2 or (key == "springs" and len(points) > 2):
                more = "" if key == "springs" else ", or more"
                raise ModelFileError(f"{where} {key}: {ends!r} must be two points{more}")
            yield {"kind": key[:-1], "points": points}


def _single_points(points: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Return points by name, with families as ``p[k in 12]`` expanded."""
    result: dict[str, Any] = {}
    for name, formulas in points.items():
        if not (family := FAMILY.fullmatch(name)):
            result[name] = formulas
            continue
        begin, letter, count = family[1], family[2], int(family[3])
        if not 0 < count <= MAX_FAMILY or not isinstance(formulas, list | tuple):
            raise ModelFileError(
                f"{where} points {name} must be formulas of 1 to {MAX_FAMILY} points, not {formulas!r:.60}"
            )
        index = re.compile(rf"\b{letter}\b")
        for k in range(count):
            result[f"{begin}[{k}]"] = [index.sub(str(k), x) if isinstance(x, str) else x for x in formulas]
    return result


def _chosen_fields(system: DrawnSystem, names: Sequence[Any], where: str) -> MovingShape:
    """Return the graphs of fields and momenta by name; momenta of nodes are divided by the weights of the nodes."""
    fields = system.mesh.field_system.fields
    choices = [*fields, *system.mesh.field_system.momenta]
    numbers = _numbers(names, choices, where)
    if not numbers or len(system.nodes) > 2:
        raise ModelFileError(f"{where} must name fields on one or two axes, {choices}, not {names!r}")
    graph = graph_of(system.nodes, choices)
    weights, mesh = np.ravel(system.mesh.weights).tolist(), dict(graph.mesh or {})
    mesh["fields"] = [mesh["fields"][k] | ({"weights": weights} if k >= len(fields) else {}) for k in numbers]
    return replace(graph, labels=(*system.nodes, choices[numbers[0]]), mesh=mesh)


def _reader(system: DrawnSystem) -> Callable[[str], Expr]:
    """Return a function that parses formulas in the names of a state."""
    names = RotationNames.of_states(system.rotations, system.names)
    velocities = {symbol(f"{name}{DOT}") for name in names.coordinates}
    turning = {entry.name: entry for entry, value in names.values.items() if not value.free_symbols & velocities}
    symbols = turning | {name: symbol(name) for name in system.names}
    arrays = [Array.of_shape(name, shape) for name, shape in system.shapes.items()]

    def read(text: str) -> Expr:
        if system.shapes and ArraySystem.is_indexed(text):
            return ArraySystem.formula_of_entries(text, arrays, symbols)
        return names.in_coordinates(names.read(text, symbols))

    return read


def _components(read: Callable[[str], Expr], formulas: Any, where: str) -> list[Expr]:
    """Return the components of a point."""
    if not isinstance(formulas, list | tuple) or len(formulas) not in (2, 3):
        raise ModelFileError(f'{where} must be two or three formulas or numbers, ["x", "y"], not {formulas!r}')
    result = []
    for component in formulas:
        if isinstance(component, bool) or not isinstance(component, str | int | float):
            raise ModelFileError(f"{where}: {component!r} must be a formula or a number")
        try:
            result.append(read(str(component)))
        except (ExpressionError, SystemDefinitionError) as error:
            raise ModelFileError(f"{where}: {error}") from error
    return result


def _listed(picture: Mapping[str, Any], key: str, where: str, default: Sequence[Any] = ()) -> Sequence[Any]:
    """Return a list of a picture."""
    value = picture.get(key, default)
    if not isinstance(value, list | tuple):
        raise ModelFileError(f"{where} {key} must be a list, not {value!r}")
    return value


def _numbers(names: Any, choices: Sequence[str], where: str) -> list[int]:
    """Return the numbers of points by name."""
    if not isinstance(names, list | tuple):
        raise ModelFileError(f"{where} must be lists of points, [[{', '.join(map(repr, choices[:2]))}]], not {names!r}")
    numbers: dict[Any, list[int]] = {}
    for k, name in enumerate(choices):
        numbers.setdefault(name, []).append(k)
        if name.endswith("]"):
            numbers.setdefault(name.partition("[")[0], []).append(k)
    for name in names:
        if not isinstance(name, str) or name not in numbers:
            raise ModelFileError(
                f"{where}: there is no {name!r}{closest(str(name), choices)} Known: {', '.join(choices)}"
            )
    return [k for name in names for k in numbers[name]]
