"""Inputs in model files: tables in the model file or in separate files.

    [inputs]
    u = { file = "u.csv", kind = "cubic" }              # .csv or .npz, relative to the model file; columns t and u
    w = { t = [0.0, 1.0, 2.0], values = [0.0, 0.5, 0.0] }

Values are interpolated as ``constant`` (zero-order hold), ``linear`` (default) or ``cubic``. The column of an input has
its name, or is called ``value``, or is the only one other than ``t``: one file may contain several inputs.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import ModelFileError
from scvi_codegen.files.numpy_files import loaded
from scvi_codegen.models.model_files.input_tables import CsvTable, InputTable, parse_table
from scvi_codegen.models.time_span import real
from scvi_codegen.native.arguments import real_array

TIME, VALUE = "t", "value"
KEYS = ("file", "t", "values", "kind")


def read_input(name: str, entry: Any, folder: str | os.PathLike[str]) -> InputTable:
    """Read the entry of an input in a model file.

    Args:
        name: of the input.
        entry: ``{file, kind}`` or ``{t, values, kind}``.
        folder: base of relative paths.

    Raises:
        ModelFileError: naming the input, the file and the line or row at fault.
    """
    where = f"[inputs] {name}"
    if not isinstance(entry, dict):
        raise ModelFileError(f'{where} must be a table, {{ file = "{name}.csv" }} or {{ t = [..], values = [..] }}')
    for key in entry:
        if key not in KEYS:
            raise ModelFileError(f"unknown key '{key}' in {where}. Known: {', '.join(KEYS)}")
    if ("file" in entry) == ("t" in entry or "values" in entry):
        raise ModelFileError(f"{where} must have either file, or t and values")
    kind = entry.get("kind", "linear")
    if not isinstance(kind, str):
        raise ModelFileError(f"{where} kind must be text between quotes, not {kind!r}")
    if "file" not in entry:
        t, values = (_numbers(entry.get(key), f"{where} {key}") for key in ("t", "values"))
        return InputTable(t, values, kind)
    if not isinstance(entry["file"], str):
        raise ModelFileError(f"{where} file must be a path between quotes, not {entry['file']!r}")
    try:
        t, values = _read(name, Path(folder) / entry["file"])
    except ModelFileError as error:
        raise ModelFileError(f"{where}: {entry['file']}: {error}") from error
    return InputTable(t, values, kind)


def _numbers(value: Any, where: str) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise ModelFileError(f"{where} must be a list of numbers, not {value!r}")
    return tuple(real(item, f"{where}[{k}]") for k, item in enumerate(value))


def _read(name: str, path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return times and values of an input in a file."""
    readers = {".csv": _read_csv, ".npz": _read_npz}
    if path.suffix.lower() not in readers:
        raise ModelFileError(f"inputs must be in {' or '.join(readers)} files")
    try:
        table = readers[path.suffix.lower()](path)
    except OSError as error:
        raise ModelFileError(f"it cannot be read: {error.strerror or error}") from error
    t = _column(table, TIME)
    others = [each for each in table.columns if each != TIME]
    column = next((each for each in (name, VALUE) if each in others), None)
    if column is None and len(others) != 1:
        raise ModelFileError(f"there is no column {name} or {VALUE} among {', '.join(table.columns)}")
    late = np.flatnonzero(np.diff(t) <= 0.0)
    if late.size:
        k = int(late[0]) + 1
        raise ModelFileError(f"{table.place(k)}, t: {t[k]:g} is not greater than {t[k - 1]:g}: times must ascend")
    return tuple(t.tolist()), tuple(_column(table, column or others[0]).tolist())


def _column(table: CsvTable, name: str) -> NDArray[np.float64]:
    if name not in table.columns:
        raise ModelFileError(f"there is no column {name} among {', '.join(table.columns)}")
    values = table.columns[name]
    wrong = np.flatnonzero(~np.isfinite(values))
    if wrong.size:
        raise ModelFileError(f"{table.place(int(wrong[0]))}, {name}: {values[wrong[0]]} is not a finite number")
    return values


def _read_csv(path: Path) -> CsvTable:
    try:
        return parse_table(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as error:
        raise ModelFileError(f"it is not a text file in UTF-8: {error.reason} at byte {error.start}") from error


def _read_npz(path: Path) -> CsvTable:
    """Return the one-dimensional arrays of the file as columns."""
    try:
        with loaded(path) as arrays:
            columns = {name: real_array(arrays[name], name) for name in arrays}
    except ValueError as error:
        raise ModelFileError(f"it contains no arrays of numbers: {error}") from error
    count = columns[TIME].size if TIME in columns else 0
    return CsvTable({name: values for name, values in columns.items() if values.shape == (count,)}, ())
