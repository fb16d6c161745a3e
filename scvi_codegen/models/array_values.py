"""Arrays in model files: numbers, lists, files, and formulas in the indices of their entries.

    q = 0.5                                             # all entries
    q = [0.1, 0.2, 0.3]                                 # its length is the size
    q = { file = "q.npy" }                              # .npy, .npz, .csv; of several arrays in a file: array = "name"
    q = "sin(2*pi*i/N)"                                 # in the indices i, j, k of its axes, sizes and parameters
    r = ["cos(2*pi*i/N)", "sin(2*pi*i/N)", 0.0]         # each component of r[N, 3]

Formulas are those of :mod:`scvi_codegen.formulas.grammar`: parsed by it and evaluated node by node, never executed as
code.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from sympy import Expr

from scvi_codegen.errors import ExpressionError, ModelFileError, closest
from scvi_codegen.files.numpy_files import loaded
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.formulas.vectorized import on_arrays
from scvi_codegen.indices import Array
from scvi_codegen.models.csv_tables import parse_table
from scvi_codegen.models.time_span import real
from scvi_codegen.native.arguments import real_array

__all__ = ["INDICES", "is_filled", "read_array"]

Numbers: TypeAlias = NDArray[np.float64]

INDICES = ("i", "j", "k")
"""Names of the indices in formulas, by axis."""
FILE_KEYS = ("file", "array")


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
    """Return the array defined by a value of a model file.

    Args:
        array: its declaration.
        value: of the file.
        where: beginning of error messages.
        folder: base of relative paths.
        sizes: known sizes, for numbers and formulas.
        parameters: numbers that formulas may use.

    Raises:
        ModelFileError: naming the key, the file and the line at fault.
    """
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
    known: dict[Expr, Any] = {symbol(name): number for name, number in (*names.items(), *coordinates)}
    with np.errstate(all="ignore"):
        return np.array(np.broadcast_to(on_arrays(formula, known), shape), dtype=float)


def _from_list(value: list[Any], where: str) -> Numbers:
    try:
        array = np.array(value, dtype=object)
        return np.array([real(entry, where) for entry in array.reshape(-1)]).reshape(array.shape)
    except ValueError as error:
        raise ModelFileError(f"{where} must be a list of numbers, or of lists of one length") from error


def _from_file(array: Array, value: Mapping[str, Any], where: str, folder: Path) -> Numbers:
    for key in value:
        if key not in FILE_KEYS:
            raise ModelFileError(
                f"unknown key '{key}' in {where}{closest(key, FILE_KEYS)} Known: {', '.join(FILE_KEYS)}"
            )
    name, wanted = value.get("file"), value.get("array", array.name)
    if not isinstance(name, str) or not isinstance(wanted, str):
        raise ModelFileError(f'{where} must be a file, {{ file = "{array.name}.npy" }}, with text between quotes')
    readers = {".npy": _read_npy, ".npz": _read_npz, ".csv": _read_csv}
    reader = readers.get(Path(name).suffix.lower())
    if reader is None:
        raise ModelFileError(f"{where}: {name}: arrays must be in {', '.join(readers)} files")
    try:
        return reader(folder / name, wanted, array)
    except OSError as error:
        raise ModelFileError(f"{where}: {name}: it cannot be read: {error.strerror or error}") from error
    except ValueError as error:
        raise ModelFileError(f"{where}: {name}: {error}") from error


def _read_npy(path: Path, name: str, array: Array) -> Numbers:
    with loaded(path) as array_in_file:
        return real_array(array_in_file, name)


def _read_npz(path: Path, name: str, array: Array) -> Numbers:
    with loaded(path) as arrays:
        chosen = name if name in arrays or len(arrays) != 1 else arrays.files[0]
        if chosen not in arrays:
            raise ModelFileError(f"there is no array {name} among {', '.join(arrays)}")
        return real_array(arrays[chosen], chosen)


def _read_csv(path: Path, name: str, array: Array) -> Numbers:
    """Read the column of that name, or the only one; an array with components has one column each."""
    columns = parse_table(path.read_text(encoding="utf-8-sig")).columns
    if len(array.axes) > 1:
        return np.stack(list(columns.values()), axis=-1)
    if name not in columns and len(columns) != 1:
        raise ModelFileError(f"there is no column {name} among {', '.join(columns)}")
    return columns.get(name, next(iter(columns.values())))
