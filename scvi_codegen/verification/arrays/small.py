"""Reduction of arrays to a few indices, and the integrator there as one of named coordinates, for certificates."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.indices import Array
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunArrays, check_accesses
from scvi_codegen.runtime.arrays.stepper import ArrayStepper
from scvi_codegen.runtime.run.run import Run

Numbers = NDArray[np.float64]

CUT_SIZES = ((5, 6), (4, 4), (3, 3), (3, 2), (2, 2), (2, 1), (6, 6), (8, 8), (12, 12), (16, 16))
"""Numbers of indices of a size and of rows of a table; the first pair that is consistent and small is used."""
MAX_COORDINATES = 9
"""Largest number of coordinates; steps in 60 digits take seconds for it."""


@dataclass(frozen=True, slots=True)
class SmallStart:
    """Arrays of small sizes and their momenta, as of :meth:`ArrayStepper.start`."""

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


class SmallStepper:
    """Integrator of arrays at small sizes with the interface of a stepper of named coordinates.

    Args:
        stepper: stepper of any size.
        start: sizes, fields and tables.
        unrolled: unrolled system, whose parameters include the entries of fields.
    """

    interface = SimpleNamespace(has_action=False, has_fallback=False, map_names=(), map_exact=(), energy_parameter="")

    def __init__(self, stepper: ArrayStepper, start: SmallStart, unrolled: MechanicalSystem) -> None:
        self.stepper, self.arrays, self.unrolled = stepper, start.arrays, unrolled
        self.defaults = [float(value) for value in unrolled.defaults]

    def integrate(
        self,
        q: Numbers,
        p: Numbers,
        *,
        h: float,
        steps: int,
        t: float = 0.0,
        parameters: Any = None,
        options: SolverOptions | None = None,
    ) -> SimpleNamespace:
        """Return every state, (steps + 1, m), and the iterations of each step.

        Raises as :meth:`ArrayStepper.integrate`.
        """
        run = self._run(q, p, h, t, parameters, options)
        states, counts, times = [self._flat(run)], [0], [run.t]
        for _ in range(steps):
            before = run.iterations
            run.advance(1)
            states.append(self._flat(run))
            counts.append(run.iterations - before)
            times.append(run.t)
        both = np.array(states)
        return SimpleNamespace(t=np.array(times), q=both[:, 0], p=both[:, 1], iterations=np.array(counts))

    def step(
        self,
        q: Numbers,
        p: Numbers,
        h: float,
        t: float = 0.0,
        parameters: Any = None,
        options: SolverOptions | None = None,
    ) -> tuple[Numbers, Numbers]:
        """Return the state after one step; raises as :meth:`ArrayStepper.integrate`."""
        run = self._run(q, p, h, t, parameters, options)
        run.advance(1)
        end = self._flat(run)
        return end[0], end[1]

    def velocity(self, q: Numbers, p: Numbers, t: float = 0.0, parameters: Any = None) -> Numbers:
        """Return the velocities (m,) of a state; raises StateError for a Hamiltonian."""
        return np.asarray(self._run(q, p, 1.0, t, parameters, None).velocity)

    def momentum(self, q: Numbers, v: Numbers, t: float = 0.0, parameters: Any = None) -> Numbers:
        """Return the momenta (m,) of positions and velocities."""
        return np.asarray(self._run(q, v, 1.0, t, parameters, None).stepper.momentum(q, v, t, self._values(parameters)))

    def energy(self, q: Numbers, p: Numbers, t: float = 0.0, parameters: Any = None) -> float:
        """Return the energy of a state."""
        return self._run(q, p, 1.0, t, parameters, None).energy

    def _run(self, q: Numbers, p: Numbers, h: float, t: float, parameters: Any, options: SolverOptions | None) -> Run:
        values = self._values(parameters)
        return self.stepper.start(
            self._arrays(q),
            self._arrays(p),
            h=h,
            t=t,
            parameters=values,
            tables=self.arrays.places,
            options=options,
        )

    def _values(self, parameters: Any) -> dict[str, Any]:
        """Return numbers and fields from the parameters of the unrolled system, by name or in order."""
        names = [parameter.name for parameter in self.unrolled.parameters]
        values = self.defaults if parameters is None else parameters
        known = dict(values) if isinstance(values, Mapping) else dict(zip(names, values, strict=True))
        result: dict[str, Any] = {name: known[name] for name in self.stepper.interface.parameters}
        for array in self.stepper.interface.layout.fields:
            shape = array.shape(self.arrays.sizes)
            entries = ["_".join([array.name, *map(str, index)]) for index in np.ndindex(*shape)]
            result[array.name] = np.array([known[name] for name in entries]).reshape(shape)
        return result

    def _arrays(self, flat: Numbers) -> dict[str, Numbers]:
        result, start = {}, 0
        for name, values in self.arrays.state.items():
            result[name] = np.asarray(flat)[start : start + values.size].reshape(values.shape)
            start += values.size
        return result

    def _flat(self, run: Run) -> tuple[Numbers, Numbers]:
        return np.asarray(run.q), np.asarray(run.p)


def _joined(arrays: Mapping[str, Numbers]) -> Numbers:
    return np.concatenate([values.reshape(-1) for values in arrays.values()])
