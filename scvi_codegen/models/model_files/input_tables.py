"""Tables of numbers in CSV, and inputs of a model as such tables, which can be compared and written to files."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import ModelFileError, StateError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.rendering.program_source import ExampleInput
from scvi_codegen.runtime.inputs.segments import POWERS, first_inner_time, input_of, parameters_at

NUMBER = re.compile(r"[+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf(inity)?)", re.ASCII | re.IGNORECASE)
"""Pattern of numbers in ASCII digits; Python also accepts 1_0 and digits of other scripts."""
MAX_SHOWN_LENGTH = 60


@dataclass(frozen=True, slots=True, eq=False)
class CsvTable:
    """Columns of numbers.

    Attributes:
        columns: (n,) values by name, in the order of the file.
        lines: (n,) line numbers of the rows, from 1; empty for a file without lines.
    """

    columns: dict[str, NDArray[np.float64]]
    lines: tuple[int, ...]

    def place(self, k: int) -> str:
        """Return the location of row k for messages."""
        return f"line {self.lines[k]}" if self.lines else f"row {k}"


def parse_table(text: str, check: Callable[[list[str]], None] | None = None) -> CsvTable:
    """Parse a table; ``check`` is called with its names before its numbers are parsed.

    Raises:
        ModelFileError: naming the column or line at fault.
    """
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
    rows = [_row(cells, names, number) for number, cells in lines[1:]]
    return CsvTable(dict(zip(names, np.array(rows).T, strict=True)), tuple(number for number, _ in lines[1:]))


def _row(cells: list[str], names: list[str], number: int) -> list[float]:
    if len(cells) != len(names):
        raise ModelFileError(f"line {number} must have a number for each of {len(names)} names, and has {len(cells)}")
    values = []
    for name, cell in zip(names, cells, strict=True):
        if not NUMBER.fullmatch(cell):
            raise ModelFileError(f"line {number}, {name}: '{cell[:MAX_SHOWN_LENGTH]}' is not a number")
        values.append(float(cell))
        if not math.isfinite(values[-1]):
            raise ModelFileError(f"line {number}, {name}: {cell[:MAX_SHOWN_LENGTH]} is not a finite number")
    return values


class InputTable(NamedTuple):
    """Function of time as :meth:`Stepper.integrate` accepts it: n ascending times, n values, kind of interpolation."""

    t: tuple[float, ...]
    values: tuple[float, ...]
    kind: str = "linear"


def checked_tables(system: MechanicalSystem, tables: Mapping[str, Any]) -> dict[str, InputTable]:
    """Return validated tables by name, as plain numbers; some may be missing.

    Raises:
        ModelFileError: for a name that is not an input of the system, and a value that is not a table.
    """
    checked = {}
    for name, table in tables.items():
        if name not in system.inputs:
            raise ModelFileError(
                f"'{name}' is not an input of '{system.name}', whose inputs are {', '.join(system.inputs) or 'none'}"
            )
        if not isinstance(table, tuple):
            raise ModelFileError(f"the input {name} of a model must be a table, (t, values) or (t, values, kind)")
        try:
            input_of(name, tuple(table))
        except StateError as error:
            raise ModelFileError(str(error)) from error
        t, values = (tuple(np.asarray(part, dtype=float).tolist()) for part in table[:2])
        checked[name] = InputTable(t, values, *table[2:])
    return checked


def tables_of_example(
    system: MechanicalSystem, inputs: Mapping[str, InputTable], span: tuple[float, float]
) -> tuple[tuple[ExampleInput, ...], tuple[float, ...]]:
    """Return the tables of all inputs (or none) for C, and all parameters at the start of a run over that time span."""
    data = {name: input_of(name, tuple(inputs[name])) for name in system.inputs if inputs}
    tables = tuple(
        ExampleInput(name, tuple(each.breakpoints.tolist()), tuple(map(tuple, each.pieces[:, :POWERS].tolist())))
        for name, each in data.items()
    )
    names = [parameter.name for parameter in system.parameters]
    return tables, tuple(parameters_at(names, np.array(system.defaults), data, first_inner_time(*span)).tolist())
