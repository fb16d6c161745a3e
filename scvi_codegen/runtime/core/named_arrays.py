"""States and parameters by name: arrays of known sizes, and single coordinates and parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.native.arguments import real_array
from scvi_codegen.rendering.source import Interface

__all__ = ["entries_by_name", "flat_state", "state_by_name"]

Array = NDArray[np.float64]


def flat_state(interface: Interface, value: Any, name: str) -> Any:
    """Return a state given by the names of its arrays as (.., m) numbers in order, and other values as they are.

    The only array of a system need not be named: numbers of its shape suffice.
    """
    arrays = _coordinates(interface)
    if isinstance(value, Mapping):
        return _joined(arrays, value, name)
    (_, shape), *others = arrays
    if others or len(shape) < 2:
        return value
    array = real_array(value, name)
    whole = array.shape[-len(shape) :] == shape
    return array.reshape(*array.shape[: -len(shape)], -1) if whole and array.ndim != 1 else value


def state_by_name(interface: Interface, values: Array) -> dict[str, Array]:
    """Return (.., m) numbers, such as states of a trajectory, by the names of their arrays."""
    state, first = {}, 0
    for name, shape in _coordinates(interface):
        size = math.prod(shape)
        state[name] = values[..., first : first + size].reshape(*values.shape[:-1], *shape)
        first += size
    return state


def entries_by_name(interface: Interface, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return parameters with each array replaced by its entries; a number is the value of all entries."""
    arrays = dict(_declared(interface.arrays))
    entries = {}
    for name, value in parameters.items():
        shape = () if name in interface.parameters else arrays.get(name, ())
        if not shape:
            entries[name] = value
            continue
        array = real_array(value, f"the parameter {name}")
        if array.ndim and array.shape[array.ndim - len(shape) :] != shape:
            raise StateError(f"the parameter {name} must have the shape {shape}, not {array.shape}")
        by_index = np.moveaxis(array, range(-len(shape), 0), range(len(shape))) if array.ndim else array
        for index in product(*map(range, shape)):
            entries["_".join([name, *map(str, index)])] = by_index[index] if array.ndim else array
    return entries


def _joined(arrays: Sequence[tuple[str, tuple[int, ...]]], by_name: Mapping[str, Any], what: str) -> Array:
    names = [name for name, _ in arrays]
    for name in by_name:
        if name not in names:
            raise StateError(f"there is no '{name}' in {what}{closest(str(name), names)} Known: {', '.join(names)}")
    parts = []
    for name, shape in arrays:
        if name not in by_name:
            raise StateError(f"'{name}' is missing in {what}")
        part = real_array(by_name[name], f"{what}: '{name}'")
        if part.shape[max(0, part.ndim - len(shape)) :] != shape:
            raise StateError(f"{what}: '{name}' must have the shape {shape}, not {part.shape}")
        parts.append(part.reshape(*part.shape[: part.ndim - len(shape)], math.prod(shape)))
    if len({part.shape[:-1] for part in parts}) > 1:
        raise StateError(f"{what}: the arrays have different numbers of states")
    return np.concatenate(parts, axis=-1)


def _coordinates(interface: Interface) -> list[tuple[str, tuple[int, ...]]]:
    """Return the name and shape of each array of coordinates; without arrays, each coordinate is one."""
    coordinates, total = [], 0
    for name, shape in _declared(interface.arrays or interface.coordinates):
        if total < interface.dimension:
            coordinates.append((name, shape))
            total += math.prod(shape)
    return coordinates


def _declared(declarations: Sequence[str]) -> Iterator[tuple[str, tuple[int, ...]]]:
    for each in declarations:
        yield each.partition("[")[0], tuple(map(int, re.findall(r"\d+", each.partition("[")[2])))
