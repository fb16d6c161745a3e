"""States and parameters by name: arrays of known sizes, and single coordinates and parameters."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, KeysView, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.native.arguments import real_array
from scvi_codegen.rendering.source import Interface

Array = NDArray[np.float64]
Shapes = Sequence[tuple[str, tuple[int, ...]]]


class NamedState(np.ndarray[Any, Any]):
    """Numbers (.., m) of states with arrays of coordinates, also by name: ``q["u"]`` has the shape (.., *shape of u).

    Slices of states have names as well; results of arithmetic are ordinary arrays.
    """

    shapes: Shapes | None = None

    def __array_finalize__(self, other: Any) -> None:
        self.shapes = getattr(other, "shapes", None)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        plain = np.asarray(array)
        return plain if plain.ndim else plain[()]

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        values, first = np.asarray(self), 0
        for name, shape in self.shapes or ():
            size = math.prod(shape)
            if name == key:
                return values[..., first : first + size].reshape((*values.shape[:-1], *shape))
            first += size
        raise KeyError(f"there is no array '{key}' among {', '.join(self.keys()) or 'no names'}")

    def keys(self) -> KeysView[str]:
        """Return the names of the arrays."""
        return dict(self.shapes or ()).keys()

    def values(self) -> list[Array]:
        """Return the arrays in order."""
        return [self[name] for name in self.keys()]

    def items(self) -> list[tuple[str, Array]]:
        """Return the names and the arrays in order."""
        return [(name, self[name]) for name in self.keys()]

    def __reduce__(self) -> tuple[Any, ...]:
        return named, (np.asarray(self), self.shapes)


def named(values: Array, shapes: Shapes | None) -> Array:
    """Return states that have the arrays of these names and shapes; shares memory."""
    state = values.view(NamedState)
    state.shapes = shapes
    return state


class EntryNames(Sequence[str]):
    """Names of all entries of arrays in order, ``q_0``, ``q_1``, .., which are made when they are read."""

    def __init__(self, arrays: Shapes) -> None:
        self.arrays = tuple(arrays)
        self.firsts: list[int] = [0, *np.cumsum([math.prod(shape) for _, shape in arrays], dtype=int).tolist()]

    def __len__(self) -> int:
        return self.firsts[-1]

    def __getitem__(self, row: Any) -> Any:
        if isinstance(row, slice):
            return tuple(self[k] for k in range(*row.indices(len(self))))
        k = int(range(len(self))[row])
        which = int(np.searchsorted(self.firsts, k, side="right")) - 1
        name, shape = self.arrays[which]
        return "_".join([name, *map(str, np.unravel_index(k - self.firsts[which], shape))]) if shape else name

    def index(self, name: Any, *_: Any) -> int:
        """Return the position of a name; raise ``ValueError`` if there is none."""
        for (array, shape), first in zip(self.arrays, self.firsts, strict=False):
            if array == name and not shape:
                return first
            parts = name.removeprefix(f"{array}_").split("_")
            if shape and name.startswith(f"{array}_") and len(parts) == len(shape) and all(map(str.isdigit, parts)):
                index = tuple(map(int, parts))
                if all(k < size for k, size in zip(index, shape, strict=True)):
                    return first + int(np.ravel_multi_index(index, shape))
        raise ValueError(f"{name!r} is no entry")

    def __contains__(self, name: object) -> bool:
        try:
            return isinstance(name, str) and self.index(name) >= 0
        except ValueError:
            return False


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
    state, first, values = {}, 0, np.asarray(values)
    for name, shape in _coordinates(interface):
        size = math.prod(shape)
        state[name] = values[..., first : first + size].reshape((*values.shape[:-1], *shape))
        first += size
    return state


def shapes_of(interface: Interface) -> Shapes | None:
    """Return the names and shapes of the arrays of coordinates; ``None`` without arrays."""
    return _coordinates(interface) if interface.arrays else None


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
    for name, shape in declared(interface.arrays or interface.coordinates):
        if total < interface.dimension:
            coordinates.append((name, shape))
            total += math.prod(shape)
    return coordinates


def declared(declarations: Sequence[str]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield the name and shape of each declaration; a single name has the shape ()."""
    for each in declarations:
        yield each.partition("[")[0], tuple(map(int, re.findall(r"\d+", each.partition("[")[2])))
