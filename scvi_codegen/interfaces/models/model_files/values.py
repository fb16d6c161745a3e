"""Values in model files: parameters, index tables and the initial state, as numbers, lists, files and formulas.

Formulas are those of :mod:`scvi_codegen.systems.formulas.grammar`: parsed by it and evaluated node by node, never
executed as code.
"""

import math
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sympy import Expr

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.native.option_table import OPTION
from scvi_codegen.common.atomic import inside, read_text
from scvi_codegen.common.errors import ExpressionError, ModelFileError
from scvi_codegen.common.registry import part
from scvi_codegen.common.validation import checked_count
from scvi_codegen.interfaces.models.input_tables import parse_table
from scvi_codegen.interfaces.models.model_files.sections import (
    Document,
    Section,
    check_keys,
    in_section,
    is_number,
    required,
)
from scvi_codegen.interfaces.models.options import STATE, real
from scvi_codegen.interfaces.models.time_span import check_length
from scvi_codegen.runs.results.export import loaded
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.formulas.arrays import parse_array
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.system import MechanicalSystem

Numbers: TypeAlias = NDArray[np.float64]
Key: TypeAlias = tuple[str, str]

MOST = 10**8
"""Largest number of entries of an array whose size a file names."""
INDICES = ("i", "j", "k")
"""Names of the indices in formulas, by axis."""
FILE_KEYS = ("file", "array")


class ArrayValue(NamedTuple):
    """Value of an array in a file, and its location for messages."""

    array: Array
    value: Any
    where: str


def read_values(
    document: Document, system: MechanicalSystem, folder: str | os.PathLike[str]
) -> tuple[MechanicalSystem, dict[str, Any]]:
    """Return the system with the values of its parameters, and the fields of a model for state, arrays and tables."""
    section = document["initial"]
    time = {"t": OPTION["t"].checked(section.get("t", 0.0), ModelFileError)}
    entries = _parameter_entries(document.get("parameters", {}), system)
    if isinstance(system, ArraySystem):
        return system, _values_of_arrays(document, system, entries, folder) | time
    changed, vectors = _values_of_coordinates(section, system, entries, folder)
    return (system.with_parameters(**changed) if changed else system), {**vectors, **time}


def _values_of_coordinates(
    section: Section, system: MechanicalSystem, entries: dict[Key, ArrayValue], folder: str | os.PathLike[str]
) -> tuple[dict[str, float], dict[str, Any]]:
    """Return the values of the entries of arrays of parameters, and the state; ``entries`` are those of parameters."""
    names = [coordinate.name for coordinate in system.coordinates]
    section = _by_coordinate(section, system)
    coordinate_arrays = [array for array in system.arrays if array.axes and set(array.elements) <= set(names)]
    for key in STATE:
        value: Any = section.get(key)
        where = f"[initial] {key}, "
        for array in coordinate_arrays:
            if isinstance(value, dict) and array.name in value:
                entries[key, array.name] = ArrayValue(array, value[array.name], where + array.name)
    read = _read_arrays(entries, {}, folder, system.constants_by_name)
    elements = {
        key: dict(zip(entries[key].array.elements, values.reshape(-1).tolist(), strict=True))
        for key, values in read.items()
    }
    changed = {name: x for (group, _), values in elements.items() if group == "fields" for name, x in values.items()}
    vectors = {
        name: _read_vector(
            section[key], names, key, {array: x for (group, array), x in elements.items() if group == key}
        )
        for key, name in STATE.items()
        if key in section
    }
    return changed, vectors


def _by_coordinate(section: Section, system: MechanicalSystem) -> Section:
    """Return the initial state in homogeneous coordinates; that of a first-order system as coordinates and momenta."""
    from scvi_codegen.runs.states.rotations import state_by_name  # not needed for other systems

    q = section.get("q")
    if isinstance(system, FirstOrderSystem) and q is not None and section.keys().isdisjoint(("p", "q_dot")):
        halves = in_section("[initial]", lambda: system.halves(q))
        return {**section, **{key: list(half) for key, half in zip(("q", "p"), halves, strict=True)}}
    if not system.rotations:
        return section
    entries = [section.get(key) for key in STATE]
    state = in_section("[initial]", lambda: state_by_name(system, *entries))
    vectors = {key: value for key, value in zip(STATE, state, strict=True) if value is not None}
    return {
        **section,
        **{key: value if value is section.get(key) else value.tolist() for key, value in vectors.items()},
    }


def _values_of_arrays(
    document: Document, system: ArraySystem, entries: dict[Key, ArrayValue], folder: str | os.PathLike[str]
) -> dict[str, Any]:
    """Return the fields of a model with arrays whose sizes are names; ``entries`` are those of parameters."""
    if system.rotations:
        name = system.rotations[0].member.name
        raise ModelFileError(f"sizes of arrays of rotations, directions and spins must be numbers, as '{name}[3]'")
    if system.mesh is not None:
        document = {**document, "initial": part("sections", "field").initial(document["initial"], system)}
    for key, value in document.get("tables", {}).items():
        table = in_section("[tables]", partial(parse_array, key))
        entries["tables", table.name] = ArrayValue(table, value, f"[tables] {table.name}")
    entries |= _state_entries(document["initial"], system)
    sizes = document.get("sizes", {})
    check_keys(sizes, system.sizes, "size", "[sizes]")
    for name, value in sizes.items():
        checked_count(value, f"[sizes] {name}", least=1, error=ModelFileError)
    read = _read_arrays(entries, sizes, folder, system.constants_by_name)
    groups: dict[str, dict[str, Any]] = {}
    for (group, name), values in read.items():
        groups.setdefault(group, {})[name] = _whole(values, f"[tables] {name}") if group == "tables" else values
    return dict(groups)


def _parameter_entries(section: Section, system: MechanicalSystem) -> dict[Key, ArrayValue]:
    """Return the values of arrays of parameters that are not one number."""
    declared = {array.name: array for array in system.arrays}
    names = {key: key.partition("[")[0] for key, value in section.items() if "[" in key and not is_number(value)}
    return {
        ("fields", name): ArrayValue(declared[name], section[key], f"[parameters] {name}")
        for key, name in names.items()
    }


def _state_entries(section: Section, system: ArraySystem) -> dict[Key, ArrayValue]:
    """Return the values of each array of coordinates, and of its velocities or momenta."""
    required(section, "q", "[initial]")
    names = [array.name for array in system.coordinates]
    entries = {}
    for key, field in STATE.items():
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
            entries[field, array.name] = ArrayValue(array, required(value, array.name, where), f"{where}, {array.name}")
    return entries


def _read_arrays(
    entries: Mapping[Key, ArrayValue],
    sizes: Mapping[str, int],
    folder: str | os.PathLike[str],
    numbers: Mapping[str, float],
) -> dict[Key, Numbers]:
    """Read all arrays: lists and files first, since they determine sizes, then numbers and formulas."""
    sizes, arrays = dict(sizes), {}
    for key, entry in sorted(entries.items(), key=lambda item: is_filled(item[1].value)):
        values = read_array(entry.array, entry.value, entry.where, folder=folder, sizes=sizes, parameters=numbers)
        if not entry.array.names and values.size in (1, len(entry.array.elements)):
            values = np.resize(values, entry.array.shape({}))
        whole = [axis.number == length for axis, length in zip(entry.array.axes, values.shape) if not axis.name]  # noqa: B905
        if values.ndim != len(entry.array.axes) or not all(whole):
            raise ModelFileError(f"{entry.where} has the shape {values.shape}, which does not match {entry.array}")
        for axis, length in zip(entry.array.axes, values.shape, strict=True):
            if axis.name and sizes.setdefault(axis.name, length) != length:
                raise ModelFileError(
                    f"{entry.where}: the size {axis} is {length} here, but {sizes[axis.name]} elsewhere or in [sizes]"
                )
        arrays[key] = values
    return arrays


def _whole(values: Numbers, where: str) -> NDArray[np.int64]:
    whole = values.astype(np.int64)
    if not np.array_equal(whole, values):
        raise ModelFileError(f"{where} must be whole numbers")
    return whole


def _read_vector(
    value: Any, names: Sequence[str], key: str, elements: Mapping[str, Mapping[str, float]]
) -> tuple[float, ...]:
    """Return the vector of a list, or of a table by coordinate; ``elements`` are the entries of arrays by name."""
    where = f"[initial] {key}"
    if isinstance(value, dict):
        value = {name: entry for name, entry in value.items() if name not in elements}
        for of_array in elements.values():
            value |= of_array
        check_keys(value, names, "coordinate", where)
        value = [required(value, name, where) for name in names]
    if not isinstance(value, list):
        raise ModelFileError(f"{where} must be a list of numbers or a table by coordinate, not {value!r}")
    check_length(value, names, where)
    return tuple(real(item, f"{where}, {name},") for name, item in zip(names, value, strict=True))


def is_filled(value: Any) -> bool:
    """Return whether a value leaves sizes open: a number or a formula, or one for each component."""
    if isinstance(value, list):
        return any(isinstance(entry, str) for entry in value)
    return not isinstance(value, dict)


def read_array(
    array: Array,
    value: Any,
    where: str,
    *,
    folder: str | os.PathLike[str],
    sizes: Mapping[str, int],
    parameters: Mapping[str, float],
) -> Numbers:
    """Return an array from its value in a model file: numbers, a formula or a file; ``where`` begins messages."""
    if isinstance(value, dict):
        return _from_file(array, value, where, Path(folder))
    if not is_filled(value):
        return _from_list(value, where)
    for name in array.names:
        if name not in sizes:
            raise ModelFileError(
                f"{where}: the size {name} is undefined: write [sizes] {name} = .., or --size {name}=.."
            )
    shape = array.shape(sizes)
    if (count := math.prod(shape)) > MOST:
        raise ModelFileError(f"{where} has {count} entries, more than the {MOST} that are supported in files")
    if not isinstance(value, list):
        return _filled(value, shape, where, {**parameters, **sizes})
    if array.axes[-1].name or len(value) != shape[-1]:
        raise ModelFileError(f"{where} has {len(value)} formulas: give one, or one for each component of {array}")
    parts = [_filled(entry, shape[:-1], f"{where}[{k}]", {**parameters, **sizes}) for k, entry in enumerate(value)]
    return np.stack(parts, axis=-1)


def _filled(value: Any, shape: tuple[int, ...], where: str, names: Mapping[str, float]) -> Numbers:
    """Return a number or a formula evaluated at every index."""
    if not isinstance(value, str):
        return np.full(shape, real(value, where))
    indices = INDICES[: len(shape)]
    if taken := next((name for name in indices if name in names), None):
        raise ModelFileError(
            f"{where}: {taken} is the name of an index in formulas of arrays: rename the parameter or size {taken}"
        )
    try:
        formula = parse_expression(value, {name: symbol(name) for name in (*indices, *names)})
    except ExpressionError as error:
        raise ModelFileError(f"{where}: {error}") from error
    coordinates = zip(indices, np.indices(shape, dtype=float, sparse=True), strict=True)
    arguments: dict[Expr, Any] = {symbol(name): number for name, number in (*names.items(), *coordinates)}
    with np.errstate(all="ignore"):
        return np.array(np.broadcast_to(array_value(formula, arguments), shape), dtype=float)


def _from_list(value: list[Any], where: str) -> Numbers:
    try:
        array = np.array(value, dtype=object)
        return np.array([real(entry, where) for entry in array.reshape(-1)]).reshape(array.shape)
    except ValueError as error:
        raise ModelFileError(f"{where} must be a list of numbers, or of lists of one length") from error


def _from_file(array: Array, value: Mapping[str, Any], where: str, folder: Path) -> Numbers:
    check_keys(value, FILE_KEYS, "key", where)
    name, array_name = value.get("file"), value.get("array", array.name)
    if not isinstance(name, str) or not isinstance(array_name, str):
        raise ModelFileError(f'{where} must be a file, {{ file = "{array.name}.npy" }}, with text between quotes')
    readers = {".npy": _read_numpy, ".npz": _read_numpy, ".csv": _read_csv}
    reader = readers.get(Path(name).suffix.lower())
    if reader is None:
        raise ModelFileError(f"{where}: {name}: arrays must be in {', '.join(readers)} files")
    try:
        return reader(inside(folder, name), array_name, array)
    except OSError as error:
        raise ModelFileError(f"{where}: {name}: it cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ModelFileError(f"{where}: {name}: {error}") from error


def _read_numpy(path: Path, name: str, array: Array) -> Numbers:
    """Read the array of a .npy file, or that of the name, or the only one, of a .npz file."""
    with loaded(path) as arrays:
        if path.suffix.lower() == ".npy":
            return real_array(arrays, name)
        if name not in arrays and len(arrays) == 1:
            name = arrays.files[0]
        if name not in arrays:
            raise ModelFileError(f"there is no array {name} among {', '.join(arrays)}")
        return real_array(arrays[name], name)


def _read_csv(path: Path, name: str, array: Array) -> Numbers:
    """Read the column of that name, or the only one; an array with components has one column each."""
    columns = parse_table(read_text(path, "utf-8-sig")).columns
    if len(array.axes) > 1:
        return np.stack(list(columns.values()), axis=-1)
    if name not in columns and len(columns) != 1:
        raise ModelFileError(f"there is no column {name} among {', '.join(columns)}")
    return columns.get(name, next(iter(columns.values())))
