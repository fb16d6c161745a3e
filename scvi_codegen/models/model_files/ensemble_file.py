"""Initial states of an ensemble, from a grid in TOML or a table in CSV; other values are those of the model.

A grid lists values of some quantities; every combination is a trajectory, the last name varying fastest:

    [grid]
    q1 = { from = 0.5, to = 1.5, count = 11 }           # equally spaced, both ends included
    p_q2 = [0.9, 1.0, 1.1]                              # a list
    mu = 2.0                                            # or one number

A table has a header of names and one line per trajectory:

    q1,q1_dot,mu
    0.5,0.0,1.0
    0.6,0.1,1.2

Names are those of coordinates, of velocities (``q1_dot``) or momenta (``p_q1``), not both in one file, and of
parameters.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import ModelFileError, closest
from scvi_codegen.files.toml_text import read_toml
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.input_tables import parse_table
from scvi_codegen.models.time_span import real
from scvi_codegen.validation import checked_count

if TYPE_CHECKING:
    from scvi_codegen.runtime.core.stepper import Stepper

Array = NDArray[np.float64]
Check = Callable[[Sequence[str]], None]

MOST = 10**8
"""Maximum number of trajectories of a grid."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleStates:
    """Initial values of k trajectories from a file.

    Attributes:
        columns: (k,) values by name.
        model: provides all other values.
    """

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
        return self._table(self._coordinates, self.model.q)

    def momenta(self, stepper: Stepper) -> Array:
        """Return (k, m) momenta: those of the file, or Legendre transforms of its velocities; others from the model.

        Raises:
            StateError: if a velocity has no momentum.
        """
        model = self.model
        if self._names(self._momenta) or (model.velocity is None and not self._names(self._velocities)):
            return self._table(self._momenta, model.momenta(stepper))
        default = model.velocity
        if default is None:
            start = model.parameters_at_start(stepper)
            default = tuple(stepper.velocity(model.q, model.momenta(stepper), model.t, start))
        states = zip(self.q, self._table(self._velocities, default), self._at_start(stepper), strict=True)
        return np.array([stepper.momentum(q, v, model.t, values) for q, v, values in states])

    def _at_start(self, stepper: Stepper) -> Array:
        """Return (k, number of parameters), including the initial coefficients of the model's inputs."""
        if not self.model.inputs:
            return self.parameters
        return self._table(list(stepper.parameters), self.model.parameters_at_start(stepper))

    @property
    def _coordinates(self) -> list[str]:
        return [coordinate.name for coordinate in self.model.system.coordinates]

    @property
    def _velocities(self) -> list[str]:
        return [f"{name}_dot" for name in self._coordinates]

    @property
    def _momenta(self) -> list[str]:
        return [f"p_{name}" for name in self._coordinates]

    def _names(self, names: list[str]) -> bool:
        """Return whether the file contains one of the names."""
        return not set(names).isdisjoint(self.columns)

    def _table(self, names: list[str], defaults: Any) -> Array:
        table = np.tile(np.asarray(defaults, dtype=float), (len(self), 1))
        for i, name in enumerate(names):
            if name in self.columns:
                table[:, i] = self.columns[name]
        return table


def load_ensemble(path: str | os.PathLike[str], model: Model) -> EnsembleStates:
    """Read a grid (``.toml``) or a table (``.csv``).

    Raises:
        ModelFileError: beginning with the path and naming the name or line at fault.
    """
    readers = {".toml": _read_grid, ".csv": _read_table}
    suffix = Path(path).suffix.lower()
    try:
        if suffix not in readers:
            raise ModelFileError("an ensemble must be a grid in a .toml file or a table in a .csv file")
        columns = readers[suffix](Path(path).read_text(encoding="utf-8-sig"), partial(_check_names, model))
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ModelFileError(f"{path} is not a text file in UTF-8: {error.reason} at byte {error.start}") from error
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from error
    return EnsembleStates(columns=columns, model=model)


def _read_grid(text: str, check: Check) -> dict[str, Array]:
    document = read_toml(text)
    grid = document.get("grid")
    if set(document) != {"grid"} or not isinstance(grid, dict) or not grid:
        raise ModelFileError("the file must have one section, [grid], with a line for each quantity that varies")
    check(list(grid))
    axes = [_axis(value, f"[grid] {name}") for name, value in grid.items()]
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


def _read_table(text: str, check: Check) -> dict[str, Array]:
    return parse_table(text, check).columns


def _check_names(model: Model, names: Sequence[str]) -> None:
    coordinates = [coordinate.name for coordinate in model.system.coordinates]
    parameters = list(model.parameters)
    velocities, momenta = [f"{name}_dot" for name in coordinates], [f"p_{name}" for name in coordinates]
    known = [*coordinates, *velocities, *momenta, *parameters]
    for name in names:
        if name not in known:
            hint = f"{closest(name, known)} Known: {', '.join(known[:12])}"
            raise ModelFileError(f"'{name}' is not a coordinate, velocity, momentum or parameter of the system{hint}")
    if not set(names).isdisjoint(velocities) and not set(names).isdisjoint(momenta):
        raise ModelFileError("there are both velocities and momenta: give one or the other")
