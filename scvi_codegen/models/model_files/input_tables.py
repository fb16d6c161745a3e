"""Inputs of a model: functions of time as tables of plain numbers, which can be compared and written to files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.errors import ModelFileError, StateError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.rendering.program_source import ExampleInput
from scvi_codegen.runtime.inputs.segments import POWERS, first_inner_time, input_of, parameters_at


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
