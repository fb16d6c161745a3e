"""Inputs in model files: tables in the model file or in separate files, or constants.

Values are interpolated as ``constant`` (zero-order hold), ``linear`` (default) or ``cubic``. The column of an input has
its name, or is called ``value``, or is the only one other than ``t``: one file may contain several inputs.

An input is kept as a table of plain numbers, which can be compared and written to files.
"""

import csv
import errno
import math
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.rendering.source import ExampleInput
from scvi_codegen.common.atomic import inside, read_text
from scvi_codegen.common.errors import ModelFileError, StateError
from scvi_codegen.interfaces.models.options import real
from scvi_codegen.runs.driver.segments import POWERS, clamped_inputs, first_inner_time, input_of, parameters_at
from scvi_codegen.runs.results.export import loaded
from scvi_codegen.systems.system import MechanicalSystem

NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf(inity)?)", re.ASCII | re.IGNORECASE)
"""Pattern of numbers in ASCII digits; Python also accepts 1_0 and digits of other scripts."""
MAX_SHOWN_LENGTH = 60


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """Columns of numbers by name in the order of the file, and line numbers of the rows from 1, if there are lines."""

    columns: dict[str, NDArray[np.float64]]
    lines: tuple[int, ...]

    def place(self, k: int) -> str:
        """Return the location of row k for messages."""
        return f"line {self.lines[k]}" if self.lines else f"row {k}"


def parse_table(
    text: str, check: Callable[[list[str]], None] | None = None, number: Callable[[str], float] = float
) -> CsvTable:
    """Parse a table, its cells by ``number``, its names first checked by ``check``; ModelFileError names the place."""
    reader = csv.reader(text.splitlines(), skipinitialspace=True)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in line]) for line in reader if any(map(str.strip, line))]
    except csv.Error as error:
        raise ModelFileError(f"line {reader.line_num} is not a line of a table: {error}") from error
    if len(lines) < 2:
        raise ModelFileError("a table must have a header of names and at least one line of numbers")
    names = lines[0][1]
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise ModelFileError(f"the column '{repeated[0]}' occurs twice: rename one")
    if "" in names:
        raise ModelFileError(f"column {names.index('') + 1} has no name in the first line")
    if check is not None:
        check(names)
    rows = np.array(
        [_row(cells, names, line, number) for line, cells in lines[1:]], float if number is float else object
    )
    return CsvTable(dict(zip(names, rows.T, strict=True)), tuple(line for line, _ in lines[1:]))


def _row(cells: list[str], names: list[str], line: int, number: Callable[[str], float]) -> list[float]:
    if len(cells) != len(names):
        raise ModelFileError(f"line {line} must have a number for each of {len(names)} names, and has {len(cells)}")
    values = []
    for name, cell in zip(names, cells, strict=True):
        if not NUMBER.fullmatch(cell):
            raise ModelFileError(f"line {line}, {name}: '{cell[:MAX_SHOWN_LENGTH]}' is not a number")
        values.append(number(cell))
        if not math.isfinite(values[-1]):
            raise ModelFileError(f"line {line}, {name}: {cell[:MAX_SHOWN_LENGTH]} is not a finite number")
    return values


class InputTable(NamedTuple):
    """Function of time as :meth:`Stepper.integrate` accepts it: n ascending times, n values, kind of interpolation."""

    t: tuple[float, ...]
    values: tuple[float, ...]
    kind: str = "linear"


def checked_tables(system: MechanicalSystem, tables: Mapping[str, Any]) -> dict[str, InputTable | float]:
    """Return tables and constants of inputs as plain numbers, some may be missing; ModelFileError for other names."""
    checked = dict[str, InputTable | float]()
    for name, table in tables.items():
        if name not in system.inputs:
            raise ModelFileError(
                f"'{name}' is not an input of '{system.name}', whose inputs are {', '.join(system.inputs) or 'none'}"
            )
        if hasattr(table, "c"):
            raise ModelFileError(f"the input {name} of a model must be a number, (t, values) or (t, values, kind)")
        try:
            input_of(name, table)
        except StateError as error:
            raise ModelFileError(str(error)) from error
        if not isinstance(table, tuple):
            checked[name] = float(table)
            continue
        t, values = (tuple(np.asarray(part, dtype=float).tolist()) for part in table[:2])
        checked[name] = InputTable(t, values, *table[2:])
    return checked


def tables_of_example(
    system: MechanicalSystem, inputs: Mapping[str, InputTable | float], span: tuple[float, float]
) -> tuple[tuple[ExampleInput, ...], tuple[float, ...]]:
    """Return the tables of all inputs (or none) for C, and all parameters at the start of a run over that time span."""
    whole = min(span), max(span) + 1.0  # of the only piece of a constant
    functions = {}
    for name in system.inputs:
        if inputs:
            table = inputs[name]
            functions[name] = input_of(name, table if isinstance(table, tuple) else (whole, (table, table)))
    functions = clamped_inputs(system, functions)
    tables = tuple(
        ExampleInput(name, tuple(spline.breakpoints.tolist()), tuple(map(tuple, spline.pieces[:, :POWERS].tolist())))
        for name, spline in functions.items()
    )
    names = [parameter.name for parameter in system.parameters]
    values = parameters_at(names, np.array(system.defaults), functions, first_inner_time(*span))
    return tables, tuple(values.tolist())


TIME, VALUE = "t", "value"
KEYS = ("file", "t", "values", "kind")


def read_input(name: str, entry: Any, folder: str | os.PathLike[str]) -> InputTable | float:
    """Read the entry of an input: a number, ``{t, values, kind}``, or ``{file, kind}`` with a path below ``folder``."""
    where = f"[inputs] {name}"
    if isinstance(entry, int | float):
        return real(entry, where)
    if not isinstance(entry, dict):
        tables = f'{{ file = "{name}.csv" }} or {{ t = [..], values = [..] }}'
        raise ModelFileError(f"{where} must be a number or a table, {tables}")
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
        t, values = _read(name, folder, entry["file"])
    except ModelFileError as error:
        raise ModelFileError(f"{where}: {entry['file']}: {error}") from error
    return InputTable(t, values, kind)


def _numbers(value: Any, where: str) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise ModelFileError(f"{where} must be a list of numbers, not {value!r}")
    return tuple(real(item, f"{where}[{k}]") for k, item in enumerate(value))


def _read(name: str, folder: str | os.PathLike[str], file: str) -> tuple[tuple[float, ...], tuple[float, ...]]:
    readers, path = {".csv": _read_csv, ".npz": _read_npz}, Path(file)
    if path.suffix.lower() not in readers:
        raise ModelFileError(f"inputs must be in {' or '.join(readers)} files")
    try:
        table = readers[path.suffix.lower()](inside(folder, file))
    except OSError as error:
        denied = error.errno == errno.EACCES
        remedy = f", or name it on the command line: --input {name}={file}" if denied else ""
        raise ModelFileError(f"it cannot be read: {error.strerror or error}{remedy}") from error
    t = _column(table, TIME)
    others = [column_name for column_name in table.columns if column_name != TIME]
    column = next((column_name for column_name in (name, VALUE) if column_name in others), None)
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
        return parse_table(read_text(path, "utf-8-sig"))
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
