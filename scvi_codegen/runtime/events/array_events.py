"""Events in index notation: formulas of arrays of run-time sizes as formulas of their entries.

A run with events uses the stepper that is compiled with the sizes of the call, whose coordinates are q_0, q_1, ..
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.indices import Access, Array
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunSizes, check_accesses
from scvi_codegen.runtime.events.event import Event

if TYPE_CHECKING:
    from sympy import Expr


class EntryFormulas:
    """Conversion of formulas in index notation to formulas of the entries of arrays.

    Args:
        interface: of the stepper of any size.
        problem: sizes and index tables.
    """

    def __init__(self, interface: Interface, problem: RunSizes) -> None:
        self.interface, self.problem = interface, problem
        coordinates, momenta = interface.layout.coordinates, interface.layout.momenta
        self.arrays = [*coordinates, *interface.layout.fields]
        self.endings: dict[str, tuple[str, str]] = {}
        """Beginning and ending of the names of the entries of velocity arrays."""
        self.arrays += momenta or [Array(f"p_{array.name}", array.axes) for array in coordinates]
        if not momenta:
            self.arrays += [Array(f"{array.name}_dot", array.axes) for array in coordinates]
            self.endings = {f"{array.name}_dot": (array.name, "_dot") for array in coordinates}

    def event(self, event: Event) -> Event:
        """Return an event whose formulas contain the entries.

        Raises:
            EventError: if a formula is invalid, or an index leaves its array.
        """
        changes = {str(self._formula(name, event)): self._formula(value, event) for name, value in event.changes}
        where = [self._formula(condition, event) for condition in event.conditions]
        return replace(
            event,
            function=self._formula(event.function, event),
            then=changes or None,
            where=tuple(cast("Any", condition) >= 0 for condition in where) or None,
            restitution=None if event.restitution is None else self._formula(event.restitution, event),
        )

    def _formula(self, formula: Any, event: Event) -> Expr:
        from sympy import Add  # here: slow to import, with the modules that use it

        from scvi_codegen.formulas.arrays import parse_sums
        from scvi_codegen.formulas.numpy_values import Elements
        from scvi_codegen.formulas.symbols import TIME, symbol

        layout, problem = self.interface.layout, self.problem
        symbols = {name: symbol(name) for name in (*self.interface.parameters, TIME)}
        try:
            terms = parse_sums(str(formula), self.arrays, symbols, layout.tables)
            accesses = tuple((access, term.loops) for term in terms for _, access in term.slots)
            check_accesses(replace(layout, accesses=accesses), problem.sizes, problem.places)
        except ScviCodegenError as error:
            raise EventError(f"the formula '{formula}' of the event '{event.function}': {error}") from error
        total = []
        for term in terms:
            elements = Elements(term.loops, problem.sizes, problem.places)
            count = len(next(iter(elements.index.values()))) if elements.index else 1
            names = [(slot, self._entries(access, elements.of(access), count)) for slot, access in term.slots]
            total += [
                term.formula.xreplace({slot: symbol(entries[k]) for slot, entries in names}) for k in range(count)
            ]
        return cast("Expr", Add(*total))

    def _entries(self, access: Access, indices: tuple[Any, ...], count: int) -> list[str]:
        """Return the names of the entries of an access at all elements of its loops."""
        array, ending = self.endings.get(access.array.name, (access.array.name, ""))
        columns: list[NDArray[np.int64]] = [np.broadcast_to(each, count) for each in indices]
        return ["_".join([array, *map(str, row)]) + ending for row in zip(*columns, strict=True)] or [array + ending]


def events_of_entries(interface: Interface, problem: RunSizes, events: tuple[Event, ...]) -> tuple[Event, ...]:
    """Return events in index notation as events of the entries of arrays."""
    formulas = EntryFormulas(interface, problem)
    return tuple(map(formulas.event, events))
