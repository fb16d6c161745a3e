"""Conversion of models to the sections of a model file."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.options import FURTHER, STATE
from scvi_codegen.systems.bath import FRICTION
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.interfaces.models.input_tables import InputTable

SHORT_VECTOR = 4
TEXT_WIDTH = 100
LONG_ARRAY = 1000
"""Largest number of entries of an array that is written into a model file with tables."""


def document_of(model: Model, *, as_arrays: bool = True) -> dict[str, Any]:
    """Return all sections, in the order of a file; ``as_arrays``: with the arrays that the system was read with."""
    clock, system = model.system.clock, model.system.in_time
    document, parameters, motion = _system_and_state(model, system, as_arrays=as_arrays)
    if g := clock.time_transformation if clock else model.time_transformation:
        document["system"]["time_transformation"] = g
    if system.functions:
        document["functions"] = {name: asdict(table) for name, table in system.functions}
    if model.inputs:
        document["inputs"] = {name: _as_lists(value) for name, value in model.inputs.items()}
    if system.has_contacts:
        document["contacts"] = [item.table for item in system.contacts]
    if model.events:
        document["events"] = [event.table for event in model.events]
    if (sizes := {name: size for name, size in model.sizes.items() if size}) and "field" not in document:
        document["sizes"] = sizes
    if parameters:
        document["parameters"] = parameters
    if model.tables and "field" not in document:
        declared = {table.partition("[")[0]: table for table in system.definition.get("tables", ())}
        document["tables"] = {declared[name]: np.asarray(rows).tolist() for name, rows in model.tables.items()}
    further = {name: getattr(model, name) for name in FURTHER if getattr(model, name)}
    return {**document, **motion, **further}


def _system_and_state(
    model: Model, system: MechanicalSystem, *, as_arrays: bool
) -> tuple[dict[str, Any], Mapping[str, Any], dict[str, Any]]:
    """Return the sections of the system, its parameters, and the sections of :func:`motion_of`."""
    names = [coordinate.name for coordinate in system.coordinates]
    if system.sizes and not system.definition:
        raise ModelFileError(f"'{system.name}' was not read from text: give its formula to from_text to write a file")
    motion = motion_of(model, names)
    if isinstance(system, FirstOrderSystem):
        state = {"t": model.t, "q": system.joined(model.q, model.p)}
        return _definition(system), model.parameters, motion | {"initial": state}
    if system.definition and system.rotations and not system.sizes:
        return _of_rotations(system), model.parameters, motion
    if as_arrays and system.definition:
        state = {"t": model.t, **_state_by_array(model, names)}
        if (mesh := system.mesh) is not None:
            numbers = {name: value for name, value in model.parameters.items() if name not in model.fields}
            return {"field": mesh.to_section()}, numbers, motion | {"initial": state}
        return _definition(system), _declared_parameters(model), motion | {"initial": state}
    return _formulas(system, names), model.parameters, motion


def _definition(system: MechanicalSystem) -> dict[str, Any]:
    """Return the sections of a system that was read from text with arrays."""
    texts = {key: value for key, value in system.definition.items() if key not in ("forces", "tables")}
    for key in ("lagrangian", "hamiltonian"):
        if key in texts:
            texts[key] = _wrapped(texts[key])
    forces = system.definition.get("forces")
    return {"system": {"name": system.name, **texts}, **({"forces": dict(forces)} if forces else {})}


def _of_rotations(system: MechanicalSystem) -> dict[str, Any]:
    """Return the sections of a system that was read from text with rotations, directions or spins."""
    document, definition = _definition(system), dict(system.definition)
    for key in ("torques", "torques_space"):
        document["system"].pop(key, None)
        if key in definition:
            document[key] = definition[key]
    return document


def _formulas(system: MechanicalSystem, names: Sequence[str]) -> dict[str, Any]:
    kind = "hamiltonian" if system.auxiliaries else "lagrangian"
    momenta = {"momenta": [p.name for p in system.auxiliaries]} if system.auxiliaries else {}
    document: dict[str, Any] = {
        "system": {
            "name": system.name,
            "coordinates": list(names),
            **momenta,
            kind: _wrapped(system.text_of(system.formula)),
        }
    }
    forces = zip(names, system.forces, strict=False)
    if applied := {name: _wrapped(system.text_of(force)) for name, force in forces if force != 0}:
        document["forces"] = applied
    if system.damping != 0:
        document["system"]["damping"] = system.text_of(system.damping)
    if system.bath:
        document["system"] |= _bath(system, names)
    if system.constraints:
        document["system"]["constraints"] = [system.text_of(g) for g in system.constraints]
    if system.inputs:
        document["system"]["inputs"] = list(system.inputs)
    return document


def _bath(system: MechanicalSystem, names: Sequence[str]) -> dict[str, Any]:
    """Return the keys of a heat bath."""
    bath, text = system.bath, system.text_of
    noise = {name: text(sigma) for name, sigma in zip(names, bath.noise, strict=False) if sigma != 0}
    friction = {name: text(value) for name in FRICTION if (value := getattr(bath, name)) != 0}
    return (
        friction | ({"temperature": text(bath.temperature)} if friction else {}) | ({"noise": noise} if noise else {})
    )


def _declared_parameters(model: Model) -> dict[str, Any]:
    """Return the values of parameters, those of arrays by declaration."""
    values = dict(model.parameters)
    if arrays := model.array_system:
        defaults = zip(arrays.fields, arrays.field_defaults, strict=True)
        return {**_without(values, model.fields), **{str(f): _list(values.get(f.name, x)) for f, x in defaults}}
    declared = {}
    for array in model.system.arrays:
        if array.axes and set(array.elements) <= set(values):
            declared[str(array)] = _entries(array, values)
            values = _without(values, array.elements)
    return values | declared


def _state_by_array(model: Model, names: Sequence[str]) -> dict[str, Any]:
    """Return positions, and velocities or momenta, by the name of their array."""
    state = {key: getattr(model, name) for key, name in STATE.items() if getattr(model, name) is not None}
    if model.array_system is not None:
        lists = {key: {name: _list(values) for name, values in arrays.items()} for key, arrays in state.items()}
        return {key: arrays if len(arrays) > 1 else next(iter(arrays.values())) for key, arrays in lists.items()}
    arrays = [array for array in model.system.arrays if set(array.elements) <= set(names)]
    by_name = {key: dict(zip(names, values, strict=True)) for key, values in state.items()}
    return {key: {array.name: _entries(array, values) for array in arrays} for key, values in by_name.items()}


def _entries(array: Array, values: Mapping[str, float]) -> Any:
    return _list(np.reshape([values[name] for name in array.elements], array.shape({})))


def _list(values: Any) -> Any:
    """Return the entries of an array as lists, or as one number if they are equal."""
    entries = np.asarray(values, dtype=float)
    return float(entries.flat[0]) if entries.size and np.all(entries == entries.flat[0]) else entries.tolist()


def _without(values: Mapping[str, Any], names: Any) -> dict[str, Any]:
    return {name: value for name, value in values.items() if name not in names}


def _as_lists(table: InputTable | float) -> Any:
    if isinstance(table, float):
        return table
    return {key: list(value) if isinstance(value, tuple) else value for key, value in table._asdict().items()}


def motion_of(model: Model, names: Sequence[str]) -> dict[str, Any]:
    """Return the sections other than the system."""
    vectors = {key: getattr(model, name) for key, name in STATE.items()}
    initial = {key: _named(names, vector) for key, vector in vectors.items() if vector is not None}
    specification = model.method.specification().items()
    method = {key: list(value) if isinstance(value, tuple) else value for key, value in specification}
    solver = {} if model.solver == "auto" else {"solver": model.solver}
    return {"initial": {"t": model.t, **initial}, "method": {**method, **solver}, "run": model._run_section()}


def _wrapped(formula: str) -> str:
    """Return a formula, wrapped to several lines if it is long."""
    lines = textwrap.wrap(formula, TEXT_WIDTH, break_long_words=False, break_on_hyphens=False)
    return lines[0] if len(lines) == 1 else "\n".join(["", *lines, ""])


def _named(names: Sequence[str], vector: Sequence[float]) -> list[float] | dict[str, float]:
    return list(vector) if len(vector) <= SHORT_VECTOR else dict(zip(names, vector, strict=True))


def with_files(document: Mapping[str, Any], stem: str) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the document with long arrays of one or two axes replaced by CSV files, and these by name."""
    files: dict[str, str] = {}

    def shortened(name: str, value: Any) -> Any:
        if isinstance(value, dict):
            return {key: shortened(f"{name}_{key.partition('[')[0]}", entry) for key, entry in value.items()}
        if not isinstance(value, list) or np.size(value) <= LONG_ARRAY or np.ndim(value) > 2:
            return value
        rows = np.reshape(value, (len(value), -1)).tolist()
        lines = [[f"c{k}" for k in range(len(rows[0]))], *([repr(x) for x in row] for row in rows)]
        files[f"{name}.csv"] = "".join(f"{','.join(line)}\n" for line in lines)
        return {"file": f"{name}.csv"}

    sections = ("parameters", "tables", "initial")
    shorter = {name: shortened(stem, document[name]) for name in sections if name in document}
    return {**document, **shorter}, files
