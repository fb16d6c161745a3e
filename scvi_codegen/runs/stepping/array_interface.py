"""Arrays of run-time sizes: validation, sizes and tables of the arrays of a call, and interfaces with these sizes."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.codegen.rendering.source import ArrayLayout, Interface
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.common.validation import MAPPING, check_kind, checked_count
from scvi_codegen.runs.states.attitudes import quaternions
from scvi_codegen.runs.states.validation import EntryNames, check_named
from scvi_codegen.runs.states.words import NamedState
from scvi_codegen.runs.stepping.features import refusal
from scvi_codegen.systems.formulas.indices import MOST_THREADS, Array, Loop, Place

Numbers = NDArray[np.float64]
IndexTable = NDArray[np.int32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunSizes:
    """Sizes and tables of a run by name, and the number of threads per step."""

    sizes: dict[str, int]
    places: dict[str, IndexTable]
    threads: int = 1

    @property
    def key(self) -> Hashable:
        """Key that is equal for equal sizes, tables and threads."""
        return tuple(self.sizes.values()), tuple(table.tobytes() for table in self.places.values()), self.threads


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunArrays(RunSizes):
    """Data of a run: also positions and fields by name, and scalar parameters in order."""

    state: dict[str, Numbers]
    numbers: list[float]
    fields: dict[str, Numbers]


def read_arrays(
    interface: Interface,
    q: ArrayLike | Mapping[str, ArrayLike],
    parameters: Mapping[str, ArrayLike] | None,
    tables: Mapping[str, ArrayLike] | None,
) -> RunArrays:
    """Return the arrays of a run, valid by their declarations and together; StateError otherwise."""
    index_tables, state = read_tables(interface, tables), read_state(interface, q, "positions")
    if not any(values.size for values in state.values()):
        raise StateError(f"positions: the array '{next(iter(state))}' is empty: a motion has at least one coordinate")
    shapes = [(array, state[array.name].shape) for array in interface.layout.coordinates]
    if (mesh := interface.layout.mesh) is not None:
        for array, shape in shapes:
            if len(shape) == mesh.weights.ndim != 0 and shape != mesh.weights.shape:
                points = " x ".join(map(str, mesh.weights.shape))
                raise StateError(
                    f"positions: the field '{array.name}' has the shape {shape}: the mesh has {points} points"
                )
    shapes += [(table, index_tables[table.name].shape) for table in interface.layout.tables]
    names = {field.name for field in interface.layout.fields}
    argument = {name: value for name, value in interface.layout.data.items() if name in names} | dict(parameters or {})
    numbers = number_values(interface, argument)
    shapes += [
        (field, real_array(argument[field.name], field.name).shape)
        for field in interface.layout.fields
        if field.name in argument
    ]
    sizes = sizes_of([pair for pair in shapes if len(pair[0].axes) == len(pair[1])], interface.layout.sizes)
    fields = field_values(interface, argument, sizes)
    check_accesses(interface.layout, sizes, index_tables)
    return RunArrays(sizes=sizes, state=state, numbers=numbers, fields=fields, places=index_tables)


def first_state(interface: Interface, argument: Any) -> Any:
    """Return the first of several states (k, ..), by name or as an array, and one state as it is."""
    if isinstance(argument, NamedState):
        return argument if argument.ndim == 1 else argument[0]
    first = interface.layout.coordinates[0]
    values = argument.get(first.name) if isinstance(argument, Mapping) else argument
    if values is None or (array := real_array(values, "positions")).ndim <= len(first.axes) or not len(array):
        return argument
    if isinstance(argument, Mapping):
        arrays = {name: real_array(values, f"q: '{name}'") for name, values in argument.items()}
        return {name: values[0] if values.ndim and len(values) else values for name, values in arrays.items()}
    return real_array(argument, "q")[0]


def read_state(interface: Interface, argument: ArrayLike | Mapping[str, ArrayLike], label: str) -> dict[str, Numbers]:
    """Return the arrays of coordinates, velocities or momenta by name, from a mapping or one array; else StateError."""
    names = list(interface.coordinates)
    if isinstance(argument, NamedState):
        argument = dict(argument.items())
    if not isinstance(argument, Mapping):
        if len(names) > 1:
            raise StateError(f"{label} must be given by name, as {{'{names[0]}': .., '{names[1]}': ..}}")
        argument = {names[0]: argument}
    check_named(argument, names, label, whole=True)
    return {
        array.name: _of_axes(array, real_array(argument[array.name], label), label)
        for array in interface.layout.coordinates
    }


def number_values(interface: Interface, argument: Mapping[str, ArrayLike]) -> list[float]:
    """Return the scalar parameters in order."""
    defaults = dict(zip(interface.parameters, interface.defaults, strict=True))
    check_named(argument, [*defaults, *(field.name for field in interface.layout.fields)], "parameters", whole=False)
    return [checked_number(argument.get(name, value), name) for name, value in defaults.items()]


def field_values(
    interface: Interface, argument: Mapping[str, ArrayLike], sizes: Mapping[str, int]
) -> dict[str, Numbers]:
    """Return the field arrays by name, in full shape; a scalar fills its array."""
    fields = {}
    for array, default in zip(interface.layout.fields, interface.layout.field_defaults, strict=True):
        values = real_array(argument.get(array.name, default), array.name)
        _check_finite(values, array.name)
        shape = array.shape(sizes)
        if values.shape not in ((), shape):
            raise StateError(
                f"'{array.name}' must have the shape {' x '.join(map(str, shape))} of {array}, not {values.shape}"
            )
        fields[array.name] = _read_only(np.ascontiguousarray(np.broadcast_to(values, shape)))
    return fields


def read_tables(interface: Interface, argument: Mapping[str, ArrayLike] | None) -> dict[str, IndexTable]:
    """Return read-only copies of the tables by name, so that indices cannot change after validation."""
    names = [table.name for table in interface.layout.tables]
    tables = {name: value for name, value in interface.layout.data.items() if name in names} | dict(argument or {})
    check_named(tables, names, "tables", whole=True)
    result = {}
    for table in interface.layout.tables:
        try:
            values = np.asarray(tables[table.name])
        except (TypeError, ValueError, OverflowError) as error:
            raise StateError(
                f"the table '{table.name}' must be an array of whole numbers with {table.axes[1].number} columns: "
                f"{error}"
            ) from error
        if values.size and values.dtype.kind not in "iu":
            raise StateError(f"the table '{table.name}' must be whole numbers, not {values.dtype.name}")
        if values.ndim == 1 and table.axes[1].number == 1:
            values = values[:, None]
        if values.ndim != 2 or values.shape[1] != table.axes[1].number:
            raise StateError(f"the table '{table.name}' must have the shape of {table}, not {values.shape}")
        if values.size and not 0 <= values.min() <= values.max() < 2**31:
            raise StateError(
                f"the indices in the table '{table.name}' must be from 0 to 2**31 - 1, "
                f"not {values.min()} to {values.max()}"
            )
        result[table.name] = _read_only(np.array(values, dtype=np.int32, order="C"))
    return result


def _read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Make an array read-only and return it: C code keeps a pointer to it."""
    array.flags.writeable = False
    return array


def sizes_of(arrays: Sequence[tuple[Array, tuple[int, ...]]], names: Sequence[str]) -> dict[str, int]:
    """Return every size, from the shapes of arrays; StateError if two imply different values, or none implies any."""
    lengths: dict[str, tuple[int, Array]] = {}
    for array, shape in arrays:
        for axis, length in zip(array.axes, shape, strict=True):
            before, other = lengths.setdefault(axis.name, (length, array)) if axis.name else (axis.number, array)
            if before != length:
                raise StateError(
                    f"{axis} must be the same in all arrays: it is {length} in {array}, {before} in {other}"
                )
    for name in names:
        if name not in lengths:
            raise StateError(f"the size {name} is undetermined: pass an array that has an axis of this size")
    return {name: length for name, (length, _) in lengths.items()}


def check_accesses(layout: ArrayLayout, sizes: Mapping[str, int], tables: Mapping[str, IndexTable]) -> None:
    """Raise :class:`StateError` if an access leaves its array, or an index its table, for these sizes and tables."""
    rows = {table.name: table for table in layout.tables}
    for access, loops in layout.accesses:
        spans = {loop.index: loop for loop in loops}
        if any(loop.end.at(sizes) <= loop.first.at(sizes) for loop in loops):
            continue  # empty loop
        for k, subscript in enumerate(access.places):
            if subscript.table:
                _check_span(f"{subscript}", _span(spans[subscript.index], sizes), rows[subscript.table], 0, sizes)
            span = _index_range(subscript, spans, sizes, tables, access.array.axes[k].at(sizes))
            _check_span(f"{access}", span, access.array, k, sizes)


def table_limits(interface: Interface, sizes: Mapping[str, int]) -> list[tuple[str, list[int]]]:
    """Return for each table and column the length of the shortest axis that its entries index."""
    limits_of = {table.name: [2**31] * table.axes[1].number for table in interface.layout.tables}
    for access, _ in interface.layout.accesses:
        for axis, subscript in zip(access.array.axes, access.places, strict=True):
            if subscript.table:
                limits = limits_of[subscript.table]
                limits[subscript.column] = min(limits[subscript.column], axis.at(sizes))
    return list(limits_of.items())


def _index_range(
    subscript: Place, spans: Mapping[str, Loop], sizes: Mapping[str, int], tables: Mapping[str, IndexTable], length: int
) -> tuple[int, int]:
    """Return the smallest and the largest index on an axis of a given length."""
    if subscript.table:
        column = tables[subscript.table][:, subscript.column]
        return int(column.min()), int(column.max())
    if not subscript.index:
        return (subscript.base.at(sizes),) * 2
    loop, offset = spans[subscript.index], subscript.base.number
    if loop.periodic and abs(offset) <= length:
        return 0, loop.end.at(sizes) - 1
    first, last = (1, loop.end.at(sizes) - 1) if subscript.minus else _span(loop, sizes)
    return first + offset, last + offset


def _span(loop: Loop, sizes: Mapping[str, int]) -> tuple[int, int]:
    """Return the first and the last value of a loop index."""
    return loop.first.at(sizes), loop.end.at(sizes) - 1


def _check_span(label: str, span: tuple[int, int], array: Array, axis: int, sizes: Mapping[str, int]) -> None:
    (low, high), length = span, array.axes[axis].at(sizes)
    if low < 0 or high >= length:
        raise StateError(
            f"the index of {label} runs from {low} to {high}, but {array} has {array.axes[axis]} = {length} entries"
        )


def _of_axes(array: Array, values: Numbers, label: str) -> Numbers:
    literal = [(k, axis.number) for k, axis in enumerate(array.axes) if not axis.name]
    if values.ndim != len(array.axes) or any(values.shape[k] != number for k, number in literal):
        raise StateError(f"{label}: '{array.name}' must have the shape of {array}, not {values.shape}")
    _check_finite(values, f"{label}: '{array.name}'")
    return values


def _check_finite(values: Numbers, label: str) -> None:
    if not np.all(np.isfinite(values)):
        index = np.argwhere(~np.isfinite(np.atleast_1d(values)))[0]
        raise StateError(f"{label} must be finite, but is not at the index {[int(k) for k in index]}")


MOST_COORDINATES, MOST_OF_MESH = 2000, 64
"""Largest numbers of coordinates that are compiled with known sizes for what requires it: in general, and for Newton's
method on a mesh."""


def sizes_of_run(
    interface: Interface,
    q: Any,
    parameters: Mapping[str, ArrayLike] | None,
    tables: Mapping[str, ArrayLike] | None,
    threads: int | None,
) -> RunSizes:
    """Return the sizes and tables of arrays; of several states the first determines them."""
    for name, value in (("parameters", parameters), ("tables", tables)):
        if value is not None:
            check_kind(MAPPING, value, name, StateError)
    count = checked_count(1 if threads is None else threads, "threads", least=1, most=MOST_THREADS)
    if count > 1 and interface.layout.constraints:
        raise refusal("threads", "with constraints of arrays")
    arrays = read_arrays(interface, first_state(interface, _homogeneous(interface, q)), parameters, tables)
    return RunSizes(sizes=arrays.sizes, places=arrays.places, threads=count)


def shapes_of_call(q: Any, parameters: Any, threads: Any) -> Hashable:
    """Return what determines the sizes of a call without tables: equal for equal ones; ``None`` if it is not known."""
    if type(q) is np.ndarray and parameters is None:
        return q.shape, threads
    named = q if type(q) is dict else {"": q}
    numbers = parameters if type(parameters) is dict else {}
    is_read = parameters is None or numbers is parameters
    if not is_read or any(type(x) not in (float, int) for x in numbers.values()):
        return None
    if any(type(x) is not np.ndarray for x in named.values()):
        return None
    return tuple(named), tuple(x.shape for x in named.values()), tuple(numbers), threads


def _homogeneous(interface: Interface, q: Any) -> Any:
    """Return a state by name with homogeneous coordinates of the shape of rotations, directions and spins."""
    arrays = {array.name: array for array in interface.layout.coordinates if array.letters}
    if not isinstance(q, Mapping) or arrays.keys().isdisjoint(q):
        return q
    shapes = {
        name: (quaternions(q[name], name) if array.letters == "wxyz" else real_array(q[name], name)).shape[:-1]
        for name, array in arrays.items()
        if name in q
    }
    return {**q, **{name: np.zeros((*shape, len(arrays[name].letters))) for name, shape in shapes.items()}}


def check_few_coordinates(interface: Interface, sizes: Mapping[str, int], reason: str | None) -> None:
    """Raise :class:`MethodError` unless all sizes are known and there are few coordinates."""
    if missing := [name for name in interface.layout.sizes if name not in sizes]:
        raise MethodError(f"the size {missing[0]} is missing: give with_sizes({missing[0]}=...)")
    count = sum(int(np.prod(array.shape(sizes))) for array in interface.layout.coordinates)
    of_mesh = reason is not None and interface.layout.mesh is not None and interface.solver == "newton"
    most = MOST_OF_MESH if of_mesh else MOST_COORDINATES
    if count > most:
        remark = "" if reason is None else f". {reason}"
        raise MethodError(
            f"{count} coordinates are too many to compile with known sizes, which this requires: at most "
            f"{most}. Reduce the sizes; derivatives of larger systems are differences of runs"
            f"{remark}"
        )


def interface_of_sizes(interface: Interface, sizes: Mapping[str, int]) -> Interface:
    """Return the interface of these sizes, whose names are made when they are read."""
    layout = interface.layout
    shapes = [(array.name, array.shape(sizes)) for array in (*layout.coordinates, *layout.fields)]
    count = len(layout.coordinates)
    momenta = [(array.name, array.shape(sizes)) for array in layout.momenta]
    of_fields = []
    for (name, shape), default in zip(shapes[count:], layout.field_defaults, strict=True):
        values = np.asarray(layout.data.get(name, default))
        of_fields.append(np.broadcast_to(values if values.shape in ((), shape) else default, shape).ravel())
    names: dict[str, Any] = {
        "coordinates": EntryNames(shapes[:count]),
        "parameters": EntryNames([*((name, ()) for name in interface.parameters), *shapes[count:]]),
        "defaults": np.concatenate([interface.defaults, *of_fields]),
        "momentum_names": EntryNames(momenta) if momenta else (),
        "constraints": tuple(
            f"constraint {number}" + (str(list(map(int, index))) if shape else "")
            for number, shape in enumerate(constraint_shapes(layout, sizes), 1)
            for index in np.ndindex(*shape)
        ),
    }
    declared = tuple(f"{name}[{', '.join(map(str, shape))}]" if shape else name for name, shape in shapes)
    return replace(interface, arrays=declared, map_names=tuple(quantity.name for quantity in layout.maps), **names)


def constraint_shapes(layout: ArrayLayout, sizes: Mapping[str, int]) -> list[list[int]]:
    """Return one axis per loop of each constraint; the two loops of a pair share one axis."""

    def shape(loops: tuple[Loop, ...]) -> list[int]:
        outer = {loop.behind for loop in loops}
        spans = [(loop, loop.end.at(sizes) - loop.first.at(sizes)) for loop in loops if loop.index not in outer]
        return [span * (span - 1) // 2 if loop.behind else span for loop, span in spans]

    return [shape(loops) for loops in layout.constraints]
