"""Initial states of an ensemble, from a grid in TOML or a table in CSV; other values are those of the model.

A grid lists values of some quantities; every combination is a trajectory, the last name varying fastest. A table has a
header of names and one line per trajectory. Names are those of coordinates, of velocities (``q1_dot``) or momenta
(``p_q1``), not both in one file, and of parameters; see ``scvi-codegen run --help`` for examples.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.common.errors import ModelFileError, closest
from scvi_codegen.common.toml_text import read_toml
from scvi_codegen.common.validation import ExactNumber, checked_count
from scvi_codegen.interfaces.models.input_tables import parse_table
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.sections import text_in
from scvi_codegen.interfaces.models.options import real, with_exact_numbers
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import split, stacked, with_low

if TYPE_CHECKING:
    from scvi_codegen.runs.stepper import Stepper

Check = Callable[[Sequence[str]], None]

MOST = 10**8
"""Maximum number of trajectories of a grid."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleStates:
    """Initial values of k trajectories from a file, exact numbers in two words; the model has all others."""

    columns: Mapping[str, Array]
    model: Model

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    @property
    def parameters(self) -> Array:
        """Parameters of shape (k, number of parameters)."""
        system = self.model.system
        return self._table([symbol.name for symbol in system.parameters], system.defaults)

    @property
    def q(self) -> Array:
        """Coordinates of shape (k, m)."""
        return self._table(_names_of(self.model)[0], self.model.q)

    def momenta(self, stepper: Stepper) -> Array:
        """Return (k, m) momenta: those of the file, or Legendre transforms of its velocities; others from the model."""
        model = self.model
        _, velocities, momenta = _names_of(model)
        moving = not self.columns.keys().isdisjoint(velocities)
        if not self.columns.keys().isdisjoint(momenta) or (model.velocity is None and not moving):
            return self._table(momenta, model.momenta(stepper))
        default = model.velocity
        if default is None:
            start = model.parameters_at_start(stepper)
            default = stepper.velocity(model.q, model.momenta(stepper), model.t, start)
        parameters = self.parameters
        if model.inputs:  # with their initial coefficients
            parameters = self._table(list(stepper.interface.parameters), model.parameters_at_start(stepper))
        states = zip(self.q, self._table(velocities, default), parameters, strict=True)
        return stacked([stepper.momentum(q, v, model.t, values) for q, v, values in states])

    def _table(self, names: list[str], defaults: Any) -> Array:
        columns = {name: values for name, values in self.columns.items() if name in names}
        if not self.model.in_double_double:
            return self._filled(names, defaults, columns)
        words = zip(split(defaults, "a value"), split(columns, "the ensemble"), strict=True)
        high, low = (self._filled(names, *word) for word in words)
        table: Array = with_low(high, low)
        return table

    def _filled(self, names: list[str], defaults: Any, columns: Mapping[str, Array]) -> Array:
        table = np.tile(np.asarray(defaults, dtype=float), (len(self), 1))
        for i, name in enumerate(names):
            if name in columns:
                table[:, i] = columns[name]
        return table


def _names_of(model: Model) -> tuple[list[str], list[str], list[str]]:
    names = [coordinate.name for coordinate in model.system.coordinates]
    return names, [f"{name}_dot" for name in names], [f"p_{name}" for name in names]


def load_ensemble(path: str | os.PathLike[str], model: Model) -> EnsembleStates:
    """Read a grid (``.toml``) or a table (``.csv``); ModelFileError names the path and the line at fault."""
    number = ExactNumber if model.in_double_double else float
    readers: dict[str, Callable[[str, Check], dict[str, Array]]]
    readers = {
        ".toml": partial(_read_grid, number=number),
        ".csv": lambda text, check: parse_table(text, check, number).columns,
    }
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        raise ModelFileError(f"{path}: an ensemble must be a grid in a .toml file or a table in a .csv file")
    text = text_in(path)
    try:
        columns = readers[suffix](text, partial(_check_names, model))
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error
    return EnsembleStates(columns=columns, model=model)


def _read_grid(text: str, check: Check, *, number: Callable[[str], float]) -> dict[str, Array]:
    document = read_toml(text, number)
    grid = document.get("grid")
    if set(document) != {"grid"} or not isinstance(grid, dict) or not grid:
        raise ModelFileError("the file must have one section, [grid], with a line for each quantity that varies")
    check(list(grid))
    read = _axis if number is float else _exact_axis
    axes = [read(value, f"[grid] {name}") for name, value in grid.items()]
    count = math.prod(map(len, axes))
    if count > MOST:
        raise ModelFileError(f"the grid has {count} combinations, more than the {MOST} that are supported")
    combined = np.meshgrid(*axes, indexing="ij")
    return {name: values.ravel() for name, values in zip(grid, combined, strict=True)}


def _axis(value: Any, where: str) -> Array:
    """Return the values of one quantity: a number, a list, or from, to and count."""
    if isinstance(value, dict):
        if set(value) != {"from", "to", "count"}:
            raise ModelFileError(f"{where} must have from, to and count, not {', '.join(value) or 'nothing'}")
        count = checked_count(value["count"], f"{where} count", least=1, most=MOST, error=ModelFileError)
        return np.linspace(real(value["from"], f"{where} from"), real(value["to"], f"{where} to"), count)
    values = value if isinstance(value, list) else [value]
    if not values:
        raise ModelFileError(f"{where} is an empty list")
    return np.array([real(item, where) for item in values])


def _exact_axis(value: Any, where: str) -> Array:
    """Return the values of one quantity as exact numbers and fractions."""
    value = with_exact_numbers(value)
    doubles = _axis(value, where)
    if not isinstance(value, dict):
        return np.array(value if isinstance(value, list) else [value], dtype=object)
    first, last = (Fraction(getattr(value[key], "decimal", None) or value[key]) for key in ("from", "to"))
    parts = max(1, len(doubles) - 1)
    return np.array([first + (last - first) * Fraction(k, parts) for k in range(len(doubles))], dtype=object)


def _check_names(model: Model, names: Sequence[str]) -> None:
    coordinates, velocities, momenta = _names_of(model)
    possible = [*coordinates, *velocities, *momenta, *model.parameters]
    for name in names:
        if name not in possible:
            hint = f"{closest(name, possible)} Known: {', '.join(possible[:12])}"
            raise ModelFileError(f"'{name}' is not a coordinate, velocity, momentum or parameter of the system{hint}")
    if not set(names).isdisjoint(velocities) and not set(names).isdisjoint(momenta):
        raise ModelFileError("there are both velocities and momenta: give one or the other")
