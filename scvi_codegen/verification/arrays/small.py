"""Reduction of arrays to a few indices, for certificates."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.indices import Array
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunArrays, check_accesses

Numbers = NDArray[np.float64]

CUT_SIZES = ((5, 6), (4, 4), (3, 3), (3, 2), (2, 2), (2, 1), (6, 6), (8, 8), (12, 12), (16, 16))
"""Numbers of indices of a size and of rows of a table; the first pair that is consistent and small is used."""
MAX_COORDINATES = 9
"""Largest number of coordinates; steps in 60 digits take seconds for it."""


@dataclass(frozen=True, slots=True)
class SmallStart:
    """Arrays of small sizes and their momenta, as of :meth:`Stepper.start`."""

    arrays: RunArrays
    p: dict[str, Numbers]


def small_start(interface: Interface, arrays: RunArrays, p: Mapping[str, Numbers]) -> SmallStart:
    """Cut out a few indices where the arrays are largest, and table rows with the indices that occur in them.

    Raises:
        StateError: if no small cut is closed under the accesses of the system.
    """
    result = None
    for window, rows in CUT_SIZES:
        start = _cut(interface, arrays, p, _indices_to_keep(interface, arrays, p, window, rows))
        try:
            check_accesses(interface.layout, start.arrays.sizes, start.arrays.places)
        except StateError:
            continue
        count = sum(values.size for values in start.arrays.state.values())
        if count <= MAX_COORDINATES:
            return start
        result = result or start
    if result is None:
        raise StateError("no small array sizes were found at which all indices are in range")
    return result


def _indices_to_keep(
    interface: Interface, arrays: RunArrays, p: Mapping[str, Numbers], window: int, rows: int
) -> dict[str, NDArray[np.int64]]:
    """Return the indices to keep for each size."""
    tables = {table.axes[0].name for table in interface.layout.tables}
    chosen = {name: np.arange(min(arrays.sizes[name], rows)) for name in tables}
    for name in interface.layout.sizes:
        if name in chosen:
            continue
        used = [
            arrays.places[table][chosen[row], column] for table, row, column, of in _columns(interface) if of == name
        ]
        known = np.unique(np.concatenate([*used, np.empty(0, dtype=np.int64)]))
        others = np.setdiff1d(_around(interface, arrays, p, name, window), known)
        chosen[name] = np.union1d(known, others[: max(0, window - len(known))])
    return chosen


def _columns(interface: Interface) -> Iterator[tuple[str, str, int, str]]:
    """Yield table, row size and column of each table access, and the size that its indices refer to."""
    rows = {table.name: table.axes[0].name for table in interface.layout.tables}
    for access, _ in interface.layout.accesses:
        for subscript, axis in zip(access.places, access.array.axes, strict=True):
            if subscript.table and axis.name:
                yield subscript.table, rows[subscript.table], subscript.column, axis.name


def _around(
    interface: Interface, arrays: RunArrays, p: Mapping[str, Numbers], size: str, window: int
) -> NDArray[np.int64]:
    """Return consecutive indices around the maximum of the first array of that size."""
    length, centre = arrays.sizes[size], 0
    for array in interface.layout.coordinates:
        axes = [k for k, axis in enumerate(array.axes) if axis.name == size]
        if axes:
            others = tuple(k for k in range(len(array.axes)) if k != axes[0])
            centre = int(np.argmax((np.abs(arrays.state[array.name]) + np.abs(p[array.name])).max(axis=others)))
            break
    first = max(0, min(centre - window // 2, length - window))
    return np.arange(first, min(length, first + window))


def _cut(
    interface: Interface, arrays: RunArrays, p: Mapping[str, Numbers], indices: Mapping[str, NDArray[np.int64]]
) -> SmallStart:
    def part(array: Array, values: Numbers) -> Numbers:
        return np.ascontiguousarray(
            values[np.ix_(*(indices[axis.name] if axis.name else np.arange(axis.number) for axis in array.axes))]
        )

    tables = {table.name: arrays.places[table.name][indices[table.axes[0].name]] for table in interface.layout.tables}
    for table, _, column, size in _columns(interface):
        old = arrays.places[table][indices[_row_size(interface, table)], column]
        new = np.minimum(np.searchsorted(indices[size], old), len(indices[size]) - 1)
        tables[table][:, column] = np.where(indices[size][new] == old, new, old % len(indices[size]))
    return SmallStart(
        RunArrays(
            sizes={name: len(indices[name]) for name in interface.layout.sizes},
            state={array.name: part(array, arrays.state[array.name]) for array in interface.layout.coordinates},
            numbers=arrays.numbers,
            fields={array.name: part(array, arrays.fields[array.name]) for array in interface.layout.fields},
            places=tables,
        ),
        {array.name: part(array, p[array.name]) for array in interface.layout.coordinates},
    )


def _row_size(interface: Interface, table: str) -> str:
    return next(each.axes[0].name for each in interface.layout.tables if each.name == table)
