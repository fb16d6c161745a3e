"""Model files of array systems: those of :mod:`scvi_codegen.models.model_file` with arrays.

    [system]
    name = "ring"
    coordinates = ["q[N]"]                              # "r[N, 3]", "u[NX, NY]", several arrays
    lagrangian = "sum(i in N, m[i]*q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)"
    # dissipation = "sum(i in N, c*q_dot[i]**2/2)"      # Rayleigh's function
    # constraints = ["(q[i+1] - q[i])**2 = 1 for i in 0..N-2"]

    [forces]                                            # on coordinates, for all indices or for one; default: 0
    # "q[i]" = "-c*q_dot[i]"
    # "q[0]" = "cos(w*t)"

    [sizes]                                             # unless determined by a list or file of numbers
    N = 1000

    [parameters]
    k = 1.0
    "m[N]" = 1.0                                        # an array: values as in [initial]

    [tables]                                            # whole numbers; or { file = "bonds.csv" }
    # "bonds[B, 2]" = [[0, 1], [1, 2]]

    [initial]                                           # of several arrays: [initial.q] with a line each
    q = "sin(2*pi*i/N)"                                 # a number, a list, { file = "q.npy" }, a formula
    q_dot = 0.0                                         # or p; default: 0

    [method]
    method = "svi:4"
    # solver = "newton"                                 # for stiff systems; default: "fixed-point"

    [run]
    step = 0.1                                          # fixed step size; or tolerance = 1e-9 for adaptive steps
    span = 100.0                                        # (without both: adaptive, errors at round-off level)
    save_every = 10

Hamiltonians, and the merging of sections, are as in model files of other systems.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from scvi_codegen.errors import ModelFileError
from scvi_codegen.formulas.arrays import parse_array
from scvi_codegen.indices import Array
from scvi_codegen.lowering.arrays import SOLVERS, one_coordinate
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.methods import fitted
from scvi_codegen.models.array_model import ArrayModel
from scvi_codegen.models.array_values import is_filled, read_array
from scvi_codegen.models.sections import (
    Document,
    Section,
    check_keys,
    check_one,
    chosen_method,
    in_section,
    merged_sections,
    names_of,
    read_method,
    read_run,
    required,
    text_of,
)
from scvi_codegen.models.time_span import real
from scvi_codegen.validation.counts import checked_count

__all__ = ["read_array_model"]

KEYS = {
    "system": ("name", "coordinates", "momenta", "lagrangian", "hamiltonian", "dissipation", "constraints"),
    "initial": ("q", "p", "q_dot", "t"),
    "run": ("step", "tolerance", "error", "span", "steps", "save_every"),
}
SECTIONS = ("system", "forces", "sizes", "parameters", "tables", "initial", "method", "run")
OTHERS = {
    "": ("inputs",),
    "system": ("inputs", "catalogue", "time_transformation"),
    "run": ("controller",),
}
"""Keys of models without arrays, which array systems do not support."""
GROUPS = ("q", "p", "q_dot", "parameters", "tables")
"""Sections and keys whose values are arrays."""


@dataclass(frozen=True, slots=True)
class Entry:
    """Value of an array in a file, and its location for messages."""

    array: Array
    value: Any
    where: str


def read_array_model(document: Document, changes: Document, folder: str | os.PathLike[str]) -> ArrayModel:
    """Return the model of a file, with the sections ``changes`` merged over it.

    Raises:
        ModelFileError: naming the key at fault.
    """
    for layer in (document, changes):
        _check_known(layer)
    specification = {key: value for key, value in chosen_method(document, changes).items() if key != "solver"}
    solver = {"solver": SOLVERS[0], **document.get("method", {}), **changes.get("method", {})}["solver"]
    parameters = _declared(document.get("parameters", {}), changes.get("parameters", {}))
    document = {**merged_sections(document, changes), "parameters": parameters}
    tables = {key: in_section("[tables]", partial(parse_array, key)) for key in document.get("tables", {})}
    system = _read_system(document)
    method = in_section("[method]", lambda: read_method(fitted(specification, one_coordinate(system))))
    entries = {
        **_state_entries(document.get("initial", {}), system),
        **{
            ("parameters", array.name): Entry(array, parameters[str(array)], f"[parameters] {array.name}")
            for array in system.fields
            if not _is_number(parameters[str(array)])
        },
        **{
            ("tables", table.name): Entry(table, document["tables"][key], f"[tables] {table.name}")
            for key, table in tables.items()
        },
    }
    numbers = {parameter.name: value for parameter, value in zip(system.parameters, system.defaults, strict=True)}
    arrays = _read_arrays(entries, _read_sizes(document.get("sizes", {}), system), folder, numbers)
    groups = {key: {name: values for (group, name), values in arrays.items() if group == key} for key in GROUPS}
    return ArrayModel(
        system=system,
        method=method,
        solver=solver,
        q=groups["q"],
        p=groups["p"] or None,
        velocity=groups["q_dot"] or None,
        t=real(document.get("initial", {}).get("t", 0.0), "[initial] t"),
        parameters=groups["parameters"],
        tables={name: _whole(values, f"[tables] {name}") for name, values in groups["tables"].items()},
        document=document,
        **read_run(document.get("run", {})),
    )


def _check_known(document: Document) -> None:
    """Raise an error for unknown keys, and a specific one for keys that array systems do not support."""
    for name, section in (("", document), *document.items()):
        for key in section if name in OTHERS else ():
            if key in OTHERS[name]:
                where = f"[{name}] {key}" if name else f"[{key}]"
                raise ModelFileError(
                    f"{where} is not supported for array systems: leave it out, or unroll the system (unroll_sums)"
                )
    check_keys(document, SECTIONS, "section")
    for name, known in KEYS.items():
        check_keys(document.get(name, {}), known, "key", f"[{name}]")


def _declared(section: Section, changes: Section) -> dict[str, Any]:
    """Return parameters by declaration, ``m[N]``, with ``changes`` values by name replacing those of the section."""
    names = {key.partition("[")[0]: key for key in section}
    for name in changes:
        if name not in names:
            raise ModelFileError(f"the system has no parameter '{name}'")
    return {**section, **{names[name]: value for name, value in changes.items()}}


def _is_number(value: Any) -> bool:
    return not isinstance(value, str | list | dict)


def _read_system(document: Document) -> ArraySystem:
    section, parameters = document.get("system", {}), document["parameters"]
    check_one(section, "system", "lagrangian", "hamiltonian")
    kind = "hamiltonian" if "hamiltonian" in section else "lagrangian"
    defaults = {
        key: real(value, f"[parameters] {key}") if "[" not in key or _is_number(value) else 1.0
        for key, value in parameters.items()
    }
    arguments: dict[str, Any] = {
        "name": text_of(section, "name", "[system]"),
        "coordinates": names_of(section, "coordinates"),
        "parameters": defaults,
        "tables": list(document.get("tables", {})),
        "momenta": names_of(section, "momenta") if "momenta" in section else None,
        kind: text_of(section, kind, "[system]"),
        "forces": {key: text_of(document["forces"], key, "[forces]") for key in document.get("forces", {})},
        "dissipation": text_of(section, "dissipation", "[system]") if "dissipation" in section else None,
        "constraints": names_of(section, "constraints") if "constraints" in section else (),
    }
    return in_section("[system]", lambda: ArraySystem.from_text(**arguments))


def _state_entries(section: Section, system: ArraySystem) -> dict[tuple[str, str], Entry]:
    """Return the values of each array of coordinates, and of its velocities or momenta."""
    check_one(section, "initial", "p", "q_dot")
    required(section, "q", "[initial]")
    names = [array.name for array in system.coordinates]
    entries = {}
    for key in ("q", "p", "q_dot"):
        if key not in section:
            continue
        value, where = section[key], f"[initial] {key}"
        if not isinstance(value, dict) or (len(names) == 1 and names[0] not in value):
            if len(names) > 1:
                raise ModelFileError(
                    f"{where} must be a table by array, [initial.{key}] with a line for each of {', '.join(names)}"
                )
            value = {names[0]: value}
        check_keys(value, names, "array", where)
        for array in system.coordinates:
            entries[key, array.name] = Entry(array, required(value, array.name, where), f"{where}, {array.name}")
    return entries


def _read_sizes(section: Section, system: ArraySystem) -> dict[str, int]:
    check_keys(section, system.sizes, "size", "[sizes]")
    return {
        name: checked_count(value, f"[sizes] {name}", least=1, error=ModelFileError) for name, value in section.items()
    }


def _read_arrays(
    entries: Mapping[tuple[str, str], Entry],
    sizes: Mapping[str, int],
    folder: str | os.PathLike[str],
    numbers: Mapping[str, float],
) -> dict[tuple[str, str], Any]:
    """Read all arrays: lists and files first, since they determine sizes, then numbers and formulas."""
    sizes, arrays = dict(sizes), {}
    for key, entry in sorted(entries.items(), key=lambda item: is_filled(item[1].value)):
        values = read_array(entry.array, entry.value, entry.where, folder=folder, sizes=sizes, parameters=numbers)
        if values.ndim != len(entry.array.axes):
            raise ModelFileError(f"{entry.where} has the shape {values.shape}, which does not match {entry.array}")
        for axis, length in zip(entry.array.axes, values.shape, strict=True):
            if axis.name and sizes.setdefault(axis.name, length) != length:
                raise ModelFileError(
                    f"{entry.where}: the size {axis} is {length} here, but {sizes[axis.name]} elsewhere or in [sizes]"
                )
        arrays[key] = values
    return arrays


def _whole(values: Any, where: str) -> Any:
    whole = np.asarray(values).astype(np.int64)
    if not np.array_equal(whole, values):
        raise ModelFileError(f"{where} must be whole numbers")
    return whole
