"""Section ``[field]`` of model files: a density with its discretisation in space, in the place of ``[system]``.

Keys are the arguments of :meth:`~scvi_codegen.FieldSystem.from_text` and
:meth:`~scvi_codegen.FieldSystem.discretise`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.api.commands import ModelSection
from scvi_codegen.api.formulas import TIME, array_value, parse_expression, symbol
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.extras.fields.mesh import Mesh
from scvi_codegen.extras.fields.system import FieldSystem

OTHERS = ("forces", "torques", "torques_space", "inputs", "sizes", "tables")
"""Sections that a density replaces."""


def read_field(document: Mapping[str, Mapping[str, Any]]) -> Any:
    """Return the semi-discrete system of the density in ``[field]``."""
    ModelSection.check_keys(document.get("system", {}), ("time_transformation",), "key", "[system] beside [field]")
    for name in OTHERS:
        if document.get(name):
            raise ModelFileError(f"[{name}] is not available beside [field]: write its terms in density or dissipation")
    arguments = dict(document["field"])
    if not isinstance(options := arguments.pop("discretisation"), dict) or "method" not in options:
        raise ModelFileError(f'[field] discretisation must be a table, {{ method = "fourier", .. }}, not {options!r}')
    parameters = document.get("parameters", {})
    system = ModelSection.within("[field]", lambda: FieldSystem.from_text(**arguments, parameters=parameters))
    return ModelSection.within("[field] discretisation", lambda: system.discretise(**options)).system


def fields_at_points(section: Mapping[str, Any], system: Any) -> Mapping[str, Any]:
    """Return ``[initial]`` with numbers and formulas of fields evaluated at the points of the mesh."""
    mesh: Mesh = system.mesh
    density, state = mesh.field_system, dict(section)
    names = {TIME: ModelSection.real(section.get(TIME, 0.0), "[initial] t"), **mesh.points}
    names |= system.constants_by_name
    for key in {"q", "p", "q_dot"} & section.keys():
        value = section[key]
        if not isinstance(value, dict) or "file" in value:
            value = {density.fields[0]: value}
        variables = [coordinate.name for coordinate in system.coordinates]
        if key == "q":
            variables += density.momenta
        ModelSection.check_keys(value, variables, "field", f"[initial] {key}")
        state[key] = {
            name: _values(formula, f"[initial] {key}, {name}", mesh, names) for name, formula in value.items()
        }
        state[key] |= {name: float(np.ravel(state[key][name])[0]) for name in {*density.scalars} & value.keys()}
    for momentum, field in zip(density.momenta, density.fields, strict=bool(density.momenta)):
        if momentum in state.get("q", {}):
            values = ModelSection.within(f"[initial] q, {momentum}", lambda: mesh.weights * state["q"].pop(momentum))  # noqa: B023
            state["p"] = {**state.get("p", {}), field: values.tolist()}
    return state


def _values(value: Any, where: str, mesh: Mesh, names: Mapping[str, Any]) -> Any:
    """Return the values of a number or a formula at the points; other values as they are."""
    if isinstance(value, dict | list):
        return value
    formula = ModelSection.within(where, lambda: parse_expression(str(value), {name: symbol(name) for name in names}))
    with np.errstate(all="ignore"):
        values = array_value(formula, {symbol(name): number for name, number in names.items()})
    return np.broadcast_to(np.asarray(values, float), mesh.weights.shape).tolist()


field = ModelSection(
    keys=(
        *("name", "fields", "momenta", "space", "boundary", "density", "hamiltonian", "dissipation"),
        *("scalars", "point_lagrangians", "discretisation"),
    ),
    system=read_field,
    initial=fields_at_points,
)
