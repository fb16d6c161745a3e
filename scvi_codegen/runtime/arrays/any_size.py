"""Sizes and tables of the arrays of a call, and interfaces with these sizes."""

from collections.abc import Hashable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.indices import MOST_THREADS, Loop
from scvi_codegen.native.arguments import real_array
from scvi_codegen.rendering.source import ArrayLayout, Interface
from scvi_codegen.runtime.arrays.interface import RunSizes, first_state, read_arrays
from scvi_codegen.runtime.core.features import refusal
from scvi_codegen.runtime.core.validation import EntryNames
from scvi_codegen.runtime.rotations.attitudes import quaternions
from scvi_codegen.validation import MAPPING, check_kind, checked_count

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
    """Return the sizes and tables of arrays; of several states the first determines them.

    Raises:
        StateError: if a name, shape or number is invalid, or an index would leave its array.
        MethodError: for several threads with constraints.
    """
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
    known = all(type(x) in (float, int) for x in numbers.values()) and (parameters is None or numbers is parameters)
    if not known or any(type(x) is not np.ndarray for x in named.values()):
        return None
    return tuple(named), tuple(x.shape for x in named.values()), tuple(numbers), threads


def _homogeneous(interface: Interface, q: Any) -> Any:
    """Return a state by name with homogeneous coordinates of the shape of rotations, directions and spins."""
    arrays = {each.name: each for each in interface.layout.coordinates if each.letters}
    if not isinstance(q, Mapping) or arrays.keys().isdisjoint(q):
        return q
    shapes = {
        name: (quaternions(q[name], name) if array.letters == "wxyz" else real_array(q[name], name)).shape[:-1]
        for name, array in arrays.items()
        if name in q
    }
    return {**q, **{name: np.zeros((*shape, len(arrays[name].letters))) for name, shape in shapes.items()}}


def check_few_coordinates(interface: Interface, sizes: Mapping[str, int], reason: str) -> None:
    """Raise :class:`MethodError` unless all sizes are known and there are few coordinates."""
    if missing := [name for name in interface.layout.sizes if name not in sizes]:
        raise MethodError(f"the size {missing[0]} is missing: give with_sizes({missing[0]}=...)")
    count = sum(int(np.prod(array.shape(sizes))) for array in interface.layout.coordinates)
    of_mesh = reason and interface.layout.mesh and interface.solver == "newton"
    most = MOST_OF_MESH if of_mesh else MOST_COORDINATES
    if count > most:
        raise MethodError(
            f"{count} coordinates are too many to compile with known sizes, which this requires: at most "
            f"{most}. Reduce the sizes; derivatives of larger systems are differences of runs"
            f"{'. ' * bool(reason)}{reason}"
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
    return replace(interface, arrays=declared, map_names=tuple(each.name for each in layout.maps), **names)


def constraint_shapes(layout: ArrayLayout, sizes: Mapping[str, int]) -> list[list[int]]:
    """Return one axis per loop of each constraint; the two loops of a pair share one axis."""

    def shape(loops: tuple[Loop, ...]) -> list[int]:
        outer = {loop.behind for loop in loops}
        spans = [(loop, loop.end.at(sizes) - loop.first.at(sizes)) for loop in loops if loop.index not in outer]
        return [span * (span - 1) // 2 if loop.behind else span for loop, span in spans]

    return [shape(loops) for loops in layout.constraints]
