"""Description of what a page draws, as data: points by columns of q, rods, rigid bodies or grids of fields.

The order of recognition is that of :func:`scvi_codegen.pictures.animation.shape_of`.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import sympy

from scvi_codegen.errors import ExpressionError
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.mechanics.symmetry.sampling import bodies
from scvi_codegen.pictures.animation import LENGTHS, hanging, numbers_of


def _named(parameters: Sequence[str], starts: Sequence[str], number: Any) -> str | float:
    """Return the parameter of a body, m1 or m_1 or m; 1 if there is none."""
    names = [f"{start}{end}" for end in (number, f"_{number}", "") for start in starts]
    return next((name for name in names if name in parameters), 1.0)


def shape_data(model: Any, interface: Any, q: list[float]) -> dict[str, Any]:
    """Return how states are drawn, as :func:`scvi_codegen.pictures.animation.shape_of` recognises it."""
    names = interface.coordinates
    shape: dict[str, Any] = {"dimension": 2, "marks": [], "trails": [], "movable": []}
    columns: list[Any]
    marks: list[dict[str, Any]]
    axes: dict[str, list[Any]]
    if (mesh := model.mesh) is not None:
        axes = {name: np.unique(np.round(nodes, 12)).tolist() for name, nodes in mesh.points.items()}
        fields = list(model.q) if isinstance(model.q, dict) else [mesh.field_system.name]
        count = len(q) // len(fields)
        columns = [{"name": name, "columns": [k * count, (k + 1) * count]} for k, name in enumerate(fields)]
        return shape | {"source": {"mesh": {"axes": axes, "fields": columns}}}
    if interface.array:
        [(name, values)] = list(model.q.items())[:1]
        values = np.asarray(values)
        if values.ndim == 2 and values.shape[1] in (2, 3):
            dimension, count = values.shape[1], len(values)
            columns = [list(map(int, row)) for row in np.arange(values.size).reshape(values.shape)]
            marks = [{"kind": "particles", "points": list(range(count))}]
            return shape | {"dimension": dimension, "source": {"columns": columns}, "marks": marks}
        letters = [f"{letter}" for letter in "ij"[: values.ndim]]
        axes = {letter: list(range(size)) for letter, size in zip(letters, values.shape, strict=True)}
        field = [{"name": name, "columns": [0, values.size]}]
        return shape | {"source": {"mesh": {"axes": axes, "fields": field}}, "dots": values.size <= 100}
    if interface.rotations:
        return shape | _solids(interface)
    if found := bodies(names):
        columns = [list(body.columns) for body in found]
        marks = [
            {"kind": "body", "points": [k], "mass": _named(interface.parameters, ("m",), body.name), "name": body.name}
            for k, body in enumerate(found)
        ]
        points = list(range(len(found)))
        rods, pins = _rods(interface, found)
        return shape | {
            "dimension": len(columns[0]),
            "source": {"columns": columns, "pins": pins},
            "marks": rods + marks,
            "trails": points,
            "movable": points,
        }
    drawn = SimpleNamespace(
        stepper=model.stepper(), q=np.atleast_2d(q), t=[float(model.t)],
        parameters=[model.parameters.get(name, value) for name, value in zip(interface.parameters, interface.defaults)],  # noqa: B905
    )  # fmt: skip
    if (sign := hanging(drawn)) is not None:
        numbers = numbers_of(names) or ("",) * len(names)
        lengths = [_named(interface.parameters, LENGTHS, number) for number in numbers]
        ends = list(range(1, len(names) + 1))
        marks = [{"kind": "rod", "points": [0, *ends]}, {"kind": "pivot", "points": [0]}]
        marks += [
            {"kind": "bob", "points": [k], "mass": _named(interface.parameters, ("m",), number)}
            for k, number in zip(ends, numbers, strict=True)
        ]
        return shape | {"source": {"rods": {"sign": sign, "lengths": lengths}}, "marks": marks, "trails": ends[-1:],
                        "movable": ends}  # fmt: skip
    if len(names) <= 2:
        columns = [[0, 1] if len(names) == 2 else [-1, 0]]
        marks = [{"kind": "body", "points": [0]}]
        return shape | {"source": {"columns": columns}, "marks": marks, "trails": [0], "movable": [0]}
    field = [{"name": "q", "columns": [0, len(q)]}]
    return shape | {"source": {"mesh": {"axes": {"i": list(range(len(q)))}, "fields": field}}, "dots": True}


def _rods(interface: Any, found: Any) -> tuple[list[dict[str, Any]], list[list[Any]]]:
    """Return rods of constraints on the distance of two bodies, or of one from a fixed point, and these points."""
    rods: list[dict[str, Any]] = []
    pins: list[list[Any]] = []
    known = {name: symbol(name) for name in (*interface.coordinates, *interface.parameters)}
    for text in interface.constraints:
        try:
            constraint = parse_expression(text, known)
        except ExpressionError:
            continue
        used = {each.name for each in constraint.free_symbols}
        names = [[interface.coordinates[c] for c in body.columns] for body in found]
        ends = [k for k, each in enumerate(names) if used & {*each}]
        if len(ends) == 2:
            rods.append({"kind": "rod", "points": ends})
        elif len(ends) == 1:
            place = [known[name] for name in names[ends[0]]]
            centre: Any = sympy.solve([constraint.diff(x) for x in place], place)
            values: list[Any] = [centre.get(x) if isinstance(centre, dict) else None for x in place]
            if all(value is not None and (value.is_Symbol or value.is_number) for value in values):
                rods.append({"kind": "rod", "points": [len(found) + len(pins), ends[0]]})
                rods.append({"kind": "pivot", "points": [len(found) + len(pins)]})
                pins.append([value.name if value.is_Symbol else float(value) for value in values])
    return rods, pins


def _solids(interface: Any) -> dict[str, Any]:
    """Return boxes of rotations, tops of symmetric ones, and arrows of directions and spins."""
    names, solids, trails = interface.coordinates, [], []
    marks: list[dict[str, Any]] = []
    centre = [names.index(name) for name in "xyz" if name in names]
    for k, text in enumerate(interface.rotations):
        kind, name, rate = text.split()[:3] if len(text.split()) > 2 else (*text.split(), "")
        letters = "wxyz" if kind == "rotation" else "xyz"
        columns = [names.index(f"{name}_{letter}") for letter in letters]
        symmetric = f"body momentum 3 of {name}" in interface.map_names
        solid = {"name": name, "columns": columns, "form": "top" if symmetric else "box"}
        solids.append(solid | {"omega": [f"{rate}_{axis}" for axis in (1, 2, 3)]})
        if len(centre) == 3:
            solids[-1]["centre"] = centre
        mark = {"kind": "body", "points": [2 * k + 1], "mass": 0.1, "color": k + 1}
        marks += [mark] if kind == "rotation" else [{"kind": "arrow", "points": [2 * k, 2 * k + 1]}]
        trails.append(2 * k + 1)
    return {"dimension": 3, "source": {"solids": solids}, "marks": marks, "trails": trails}
