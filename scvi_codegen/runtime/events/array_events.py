"""Events in index notation over arrays of run-time sizes: the compiled search evaluates their functions in loops."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.native.building import Library
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.binding import ArrayBinding
from scvi_codegen.runtime.arrays.interface import Numbers, RunSizes, check_accesses
from scvi_codegen.runtime.events.event import Event

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
        from scvi_codegen.rendering.events import array_events  # here: imports SymPy

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
