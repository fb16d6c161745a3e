"""Binding of arrays whose sizes are known at run time: its runs are bound to sizes and tables, and to events."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.building import Library
from scvi_codegen.codegen.native.options import FAILURES, NOT_CONVERGED
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import EventError, ScviCodegenError, StateError
from scvi_codegen.runs.stepping.array_envelope import envelope_of
from scvi_codegen.runs.stepping.array_interface import Numbers, RunSizes, check_accesses
from scvi_codegen.systems.event import Event

MASSES = ("a coordinate has no positive mass", "Add its kinetic energy to L, or check the parameters")
FAILURES_BY_SOLVER = {
    "explicit": FAILURES | {"singular": MASSES},
    "fixed-point": FAILURES
    | {
        NOT_CONVERGED: (
            "the fixed-point iteration did not converge",
            "It converges if h times the highest frequency is below about 1 to 3. Use a smaller h, or "
            "solver='newton' if the fast modes are not excited (stiff bonds, short waves on a lattice)",
        ),
        "singular": MASSES,
    },
    "newton": FAILURES | {NOT_CONVERGED: ("Newton-GMRES did not converge", "Use a smaller h"), "singular": MASSES},
    "rattle": FAILURES
    | {
        NOT_CONVERGED: ("the iteration on the constraints did not converge", "Use a smaller h"),
        "singular": (
            "the constraints are contradictory or redundant there",
            "Remove the constraints that follow from others",
        ),
    },
}
ALIGNMENT = 64
"""Alignment in bytes, the size of the widest SIMD register."""


def aligned(count: int) -> Numbers:
    """Return ``count`` zeros, aligned to a SIMD register."""
    try:
        memory = np.zeros(count + ALIGNMENT // 8)
    except (MemoryError, ValueError) as error:
        raise StateError(f"there is not enough memory for {count} numbers") from error
    start = -memory.ctypes.data % ALIGNMENT // 8
    return memory[start : start + count]


class ArrayBinding(Binding):
    """Binding of arrays of given sizes and tables; states and parameters are vectors, as for known sizes.

    Args:
        library: the compiled source.
        interface: interface of the source.
        sizes: sizes, tables and number of threads per step.
    """

    def __init__(self, library: Library, interface: Interface, sizes: RunSizes) -> None:
        super().__init__(library, interface.prefix)
        self.interface, self.sizes, layout = interface, sizes, interface.layout
        self.reusable = not layout.neighbours  # their lists, and rounding errors, depend on earlier states
        self.count = sum(math.prod(array.shape(sizes.sizes)) for array in layout.coordinates)

    @cached_property
    def failures(self) -> Mapping[str, tuple[str, str]]:
        """Messages of failed steps."""
        failures, hint = FAILURES_BY_SOLVER.get(self.interface.solver, FAILURES), ""
        if mesh := self.interface.layout.mesh:
            hint = (
                f". The highest frequency is at most {mesh.highest_frequency():.3g}: choose h below "
                "mesh.largest_step(method), with the method of compile_stepper"
            )
        if names := self.interface.layout.neighbours:
            hint = f". No particle may move by a cutoff of {', '.join(map(repr, names))} in one step"
        return {word: (cause, remedy + hint) for word, (cause, remedy) in failures.items()}

    @cached_property
    def _bound(self) -> tuple[Any, Any, tuple[NDArray[Any], ...]]:
        """Sizes and tables as pointers, and the arrays that these refer to."""
        layout = self.interface.layout
        tables = [self.sizes.places[table.name].reshape(-1) for table in layout.tables]
        if self.constant("TABLES") > len(tables):
            envelope = envelope_of(layout, self.sizes)
            tables.append(np.empty(0, np.int32) if envelope is None else envelope.pattern)
        sizes = self._ffi.new("long long[]", [*(self.sizes.sizes[name] for name in layout.sizes), 0])
        return sizes, self._ffi.new("int *[]", [*map(self.pointer, tables), self.null]), tuple(tables)

    def new(self, type_name: str) -> Any:
        """Return a run in memory of its own, bound to the sizes and tables; else what :meth:`Binding.new` returns."""
        if type_name != "run *":
            return super().new(type_name)
        sizes, tables, arrays = self._bound
        if (length := self._call("memory", sizes, tables)) < 0:
            raise StateError("the constraints are invalid, or too many for the memory: check the bounds of their loops")
        memory = aligned(length)
        run = self._call("bind", sizes, tables, self.pointer(memory))
        if run == self.null:
            raise StateError(f"there is not enough memory for a run of {length} numbers")
        run.threads = self.sizes.threads
        release = self._call if self.has("release") else None

        def freed(run: Any, _: object = (memory, arrays)) -> None:
            if release is not None:
                release("release", run)

        return self._ffi.gc(run, freed)

    def _call(self, name: str, *arguments: Any) -> Any:
        return getattr(self._lib, f"{self._prefix}_{name}")(*arguments)


SEARCHES = ("crossings", "advance_with_changes")
"""Functions of C that search for events."""
LARGEST_NUMBER = 2**31 - 1
"""Largest number of functions of events, and of variables that a function changes."""


class EventBinding(ArrayBinding):
    """Binding of arrays of given sizes with events.

    Args:
        library, interface, sizes: as of :class:`ArrayBinding`.
        events: of every run.

    Raises:
        EventError: if an index leaves its array, or there are too many functions.
    """

    def __init__(self, library: Library, interface: Interface, sizes: RunSizes, events: tuple[Event, ...]) -> None:
        from scvi_codegen.codegen.rendering.events import array_events  # here: imports SymPy

        super().__init__(library, interface, sizes)
        self.reusable = False
        self.events, self.acts = events, any(event.changes_state for event in events)
        for event, code in zip(events, array_events(interface, events).events, strict=True):
            try:
                check_accesses(replace(interface.layout, accesses=code["accesses"]), sizes.sizes, sizes.places)
            except ScviCodegenError as error:
                raise EventError(f"the event '{event.function}': {error}") from error
        self._first = np.zeros(len(events) + 1, dtype=np.int64)
        self._changes = super().function("event_sizes")(self.new("run *"), self.whole_numbers(self._first))
        if max(self._first[-1], self._changes) > LARGEST_NUMBER:
            raise EventError(f"the events have {self._first[-1]} functions, more than {LARGEST_NUMBER}: use fewer")
        self._rows: WeakKeyDictionary[Any, Numbers] = WeakKeyDictionary()

    def new(self, type_name: str) -> Any:
        """Return memory of a run, a search or crossings."""
        if type_name == "watch *" and self.acts:
            return self._ffi.new(f"{self._prefix}_watch *", {"history": int(self._first[-1])})
        return super().new(type_name)

    def records(self, structs: Any, count: int | None = None) -> NDArray[np.void]:
        """Return a copy of the first of several crossings, by the names of their fields."""
        fields = {"t": float, "fraction": float, "function": np.int32, "direction": np.int32, "element": np.int64}
        count = len(structs) if count is None else count
        records = np.empty(count, [*fields.items(), *((name, float, (self.count,)) for name in "qp")])
        for k in range(count):
            record, crossing = records[k], structs[k]
            record["q"], record["p"] = self.vector(crossing.q), self.vector(crossing.p)
            for name in fields:
                record[name] = getattr(crossing, name)
        return records

    def function(self, name: str, memory: Any = None) -> Callable[..., Any]:
        """Return a function of C; those of the search with memory for it."""
        function = super().function(name, memory)
        return partial(self._search, function, memory is not None) if name in SEARCHES else function

    def _search(self, function: Callable[..., Any], advances: bool, watch: Any, *arguments: Any) -> int:
        room, crossings, n, functions = arguments[-5], arguments[-4], self.count or 0, int(self._first[-1])
        size = self.constant("EVENT_STATES") * n + self.constant("EVENT_VALUES") * functions
        work, values, places = np.empty(size), np.empty(self._changes + n), np.zeros(self._changes, np.int32)
        if crossings not in self._rows:
            self._rows[crossings] = np.empty((room, 2 * n))
        host = self.new("event_host *")
        host.count, host.functions, host.changes, host.first = n, functions, self._changes, self._first.tolist()
        host.memory, host.states = self.pointer(work), self.pointer(self._rows[crossings])
        host.values, host.places = self.pointer(values), self.pointer(places)
        watch.host = host
        status = function(watch, *arguments[:-1], self.workspace() if advances else arguments[-1])
        watch.host, watch.used = self.null, 0
        return int(status)
