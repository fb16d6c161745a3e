"""Events in index notation, over arrays of run-time sizes.

The compiled search calls :class:`ArrayEvents`, which evaluates formulas by NumPy. A system that is compiled with the
sizes of each call has coordinates q_0, q_1, .., of which :func:`events_of_entries` makes the formulas.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.indices import Array
from scvi_codegen.native.building import Library
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.binding import ArrayBinding
from scvi_codegen.runtime.arrays.interface import Numbers, RunSizes, check_accesses
from scvi_codegen.runtime.core.validation import by_name
from scvi_codegen.runtime.events.event import Event

if TYPE_CHECKING:
    from sympy import Expr

    from scvi_codegen.formulas.arrays import ArrayTerm

CONDITIONS, MAPS = 1, 2
"""Kernels of events (``templates/support/run/events.h``): 0 functions, 1 conditions, 2 + k changes by function k."""
FAILED = 3
"""Status of a call that raised an exception."""


class EventFormulasOfArrays:
    """Parser of formulas in index notation.

    Args:
        interface: of the stepper of any size.
        problem: sizes and index tables.

    Attributes:
        momenta, velocities: their arrays; a system that is defined by a Hamiltonian has no velocities.
        moving: both.
        symbols: time and parameters by name.
    """

    def __init__(self, interface: Interface, problem: RunSizes) -> None:
        from scvi_codegen.formulas.symbols import TIME, symbol  # here: slow to import, with the modules that use it

        self.interface, self.problem = interface, problem
        coordinates, momenta = interface.layout.coordinates, interface.layout.momenta
        self.momenta = [*momenta] or [Array(f"p_{array.name}", array.axes) for array in coordinates]
        self.velocities = [] if momenta else [Array(f"{array.name}_dot", array.axes) for array in coordinates]
        self.moving = [*self.momenta, *self.velocities]
        self.arrays = [*coordinates, *interface.layout.fields, *self.moving]
        self.symbols = {name: symbol(name) for name in (TIME, *interface.parameters)}

    def terms(self, formula: Any, event: Event) -> tuple[ArrayTerm, ...]:
        """Return the terms of a formula of an event.

        Raises:
            EventError: if the formula is invalid, or an index leaves its array.
        """
        from scvi_codegen.formulas.arrays import parse_sums  # here: slow to import, with the modules that use it

        layout, problem = self.interface.layout, self.problem
        try:
            terms = parse_sums(str(formula), self.arrays, self.symbols, layout.tables)
            accesses = tuple((access, term.loops) for term in terms for _, access in term.slots)
            check_accesses(replace(layout, accesses=accesses), problem.sizes, problem.places)
        except ScviCodegenError as error:
            raise EventError(f"the formula '{formula}' of the event '{event.function}': {error}") from error
        return terms


def events_of_entries(interface: Interface, problem: RunSizes, events: tuple[Event, ...]) -> tuple[Event, ...]:
    """Return events in index notation as events of the entries of arrays, q_0, q_1, ..

    Raises:
        EventError: if a formula is invalid, or an index leaves its array.
    """
    from scvi_codegen.formulas.array_entries import EntryRules, entry_names, formula_of_entries  # here: imports SymPy

    parser, sizes = EventFormulasOfArrays(interface, problem), problem.sizes
    names = {array.name: entry_names(array, sizes) for array in parser.arrays if array not in parser.velocities}
    rules = EntryRules(sizes, cast("Any", problem.places), names)

    def formula(text: Any, event: Event) -> Expr:
        try:
            return formula_of_entries(str(text), parser.arrays, parser.symbols, interface.layout.tables, rules)
        except ScviCodegenError as error:
            raise EventError(f"the formula '{text}' of the event '{event.function}': {error}") from error

    return tuple(
        replace(
            event,
            function=formula(event.function, event),
            then={str(formula(name, event)): formula(value, event) for name, value in event.changes} or None,
            where=tuple(cast("Any", formula(each, event)) >= 0 for each in event.conditions) or None,
            restitution=None if event.restitution is None else formula(event.restitution, event),
        )
        for event in events
    )


class Term:
    """Term of a formula: NumPy functions of its value and its derivatives, and the indices of its array entries."""

    def __init__(self, term: ArrayTerm, parser: EventFormulasOfArrays) -> None:
        from sympy import lambdify  # here: slow to import, with the modules that use it

        from scvi_codegen.formulas.expressions import PIECEWISE_CONSTANT
        from scvi_codegen.formulas.numpy_values import Elements

        elements = Elements(term.loops, parser.problem.sizes, parser.problem.places)
        self.entries = [(access.array.name, elements.of(access)) for _, access in term.slots]
        self.count = len(next(iter(elements.index.values()))) if elements.index else 1
        self.array = term.slots[0][1].array if len(term.slots) == 1 and term.formula == term.slots[0][0] else None
        variables = [*(slot for slot, _ in term.slots), *parser.symbols.values()]
        self.is_constant = not term.formula.free_symbols
        modules: list[Any] = [{name: function for name, (_, function) in PIECEWISE_CONSTANT.items()}, "numpy"]
        self._value = lambdify(variables, term.formula, modules)
        self._rates = lambdify(variables, [term.formula.diff(each) for each in variables], modules)

    def value(self, arrays: Mapping[str, Numbers], numbers: Sequence[float]) -> float:
        """Return the sum over all elements; ``numbers``: time and parameters."""
        value = self._value(*(arrays[name][indices] for name, indices in self.entries), *numbers)
        return float(np.sum(value) if np.ndim(value) else value * self.count)

    def add_gradient(
        self, arrays: Mapping[str, Numbers], numbers: Sequence[float], gradient: Mapping[str, Numbers]
    ) -> float:
        """Add the derivatives by coordinates to ``gradient``; return the derivative by time."""
        rates = self._rates(*(arrays[name][indices] for name, indices in self.entries), *numbers)
        for (name, indices), rate in zip(self.entries, rates, strict=False):
            if name in gradient:
                np.add.at(gradient[name], indices, rate)
        rate = rates[len(self.entries)]
        return float(np.sum(rate) if np.ndim(rate) else rate * self.count)


def value_of(terms: Sequence[Term], arrays: Mapping[str, Numbers], numbers: Sequence[float]) -> float:
    """Return the value of a formula."""
    return sum(term.value(arrays, numbers) for term in terms)


class ArrayEvents:
    """Functions, conditions and changes of events in index notation.

    Args:
        parser: of their formulas.
        events: the events.

    Raises:
        EventError: if a formula is invalid, or an index leaves its array.
    """

    def __init__(self, parser: EventFormulasOfArrays, events: tuple[Event, ...]) -> None:
        self.parser, self.events = parser, events
        self.functions = [self._terms(event.function, event) for event in events]
        self.conditions = [self._terms(each, event) for event in events for each in event.conditions]
        self.restitutions = [self._terms(event.restitution or 0, event) for event in events]
        self.changes = [self._changes(event) for event in events]
        rates = {array.name for array in parser.velocities}
        parsed = [
            *self.functions,
            *self.conditions,
            *(each for pairs in self.changes for pair in pairs for each in pair),
        ]
        self.uses_velocity = any(name in rates for terms in parsed for term in terms for name, _ in term.entries)
        for event, terms in zip(events, self.functions, strict=True):
            self._check_function(event, terms)

    def _terms(self, formula: Any, event: Event) -> list[Term]:
        return [Term(term, self.parser) for term in self.parser.terms(formula, event)]

    def _check_function(self, event: Event, terms: list[Term]) -> None:
        if all(term.is_constant for term in terms):
            raise EventError(
                f"the event function '{event.function}' is constant and never crosses zero: use a function of the "
                "state or of time"
            )
        names = {array.name for array in (*self.parser.momenta, *self.parser.velocities)}
        moving = [name for term in terms for name, _ in term.entries if name in names]
        if event.restitution is not None and moving:
            raise EventError(
                f"the wall '{event.function}' of an impact contains '{moving[0]}': a wall is a function of "
                "positions, time and parameters; write the change of the state with then="
            )

    def _changes(self, event: Event) -> list[tuple[list[Term], list[Term]]]:
        """Return the entry that is set and its new value, for each of the changes of an event."""
        changes = [(self._terms(name, event), self._terms(value, event)) for name, value in event.changes]
        for (name, value), (target, _) in zip(event.changes, changes, strict=True):
            if (
                len(target) != 1
                or target[0].count > 1
                or target[0].array in (None, *self.parser.interface.layout.fields)
            ):
                raise EventError(
                    f"then={{'{name}': '{value}'}} of the event '{event.function}': '{name}' is not an entry of a "
                    f"coordinate, a momentum or a velocity, such as {self.parser.momenta[0]}"
                )
        names = {
            target[0].array in self.parser.velocities for target, _ in changes if target[0].array in self.parser.moving
        }
        if len(names) > 1:
            raise EventError(f"the event '{event.function}' sets momenta and velocities: set one or the other")
        return changes


class EventBinding(ArrayBinding):
    """Binding of arrays of given sizes with events; the compiled search calls it for states and formulas.

    Args:
        library, interface, sizes: as of :class:`ArrayBinding`.
        events: of every run.
    """

    def __init__(self, library: Library, interface: Interface, sizes: RunSizes, events: tuple[Event, ...]) -> None:
        super().__init__(library, interface, sizes)
        self.events = ArrayEvents(EventFormulasOfArrays(interface, sizes), events)
        self._rows: WeakKeyDictionary[Any, Numbers] = WeakKeyDictionary()

    def new(self, what: str) -> Any:
        """Return memory of a run, a search or crossings, or a report."""
        searched = what.startswith(("watch", "crossing"))
        return self._ffi.new(f"{self._prefix}_{what}") if searched else super().new(what)

    def records(self, structs: Any) -> NDArray[np.void]:
        """Return a copy of crossings, by the names of their fields."""
        states = self._rows.get(structs, np.zeros((0, 2 * self.count)))
        fields = [("t", float), ("fraction", float), ("function", np.int32), ("direction", np.int32)]
        records = np.zeros(len(structs), [*fields, ("q", float, (self.count,)), ("p", float, (self.count,))])
        first = self._ffi.cast("size_t", self.pointer(states))
        for record, crossing in zip(records, structs, strict=True):
            if crossing.q == self.null:
                break
            row = (int(self._ffi.cast("size_t", crossing.q)) - int(first)) // (16 * self.count)
            record["q"], record["p"] = np.split(states[row], 2)
            for name, _ in fields:
                record[name] = getattr(crossing, name)
        return records

    def _crossings(self, watch: Any, *arguments: Any) -> int:
        return self._call("crossings", None, watch, *arguments)

    def _advance_with_changes(self, run: Any, watch: Any, *arguments: Any) -> int:
        return self._call("advance_with_changes", run, watch, *arguments)

    def _call(self, name: str, run: Any, watch: Any, *arguments: Any) -> int:
        """Call a function of the search, with this binding as its host."""
        *inputs, room, found, filled, report, workspace = arguments
        new = super(ArrayBinding, self).new
        failures, host, made = list[BaseException](), new("event_host *"), new("event_report *")
        work, self._rows[found] = np.empty(19 * self.count + 2), np.empty((room, 2 * self.count))
        functions = {"step": self._step, "velocity": self._velocity, "energies": self._energies}
        functions |= {"project": self._project, "evaluate": self._event_values}
        types = dict(self._ffi.typeof(host).item.fields)
        callbacks = {
            key: self._ffi.callback(
                types[key].type, function, error=FAILED, onerror=lambda _, failure, __: failures.append(failure)
            )
            for key, function in functions.items()
        }
        for key, value in callbacks.items():
            setattr(host, key, value)
        host.count, host.memory, host.states = self.count, self.pointer(work), self.pointer(self._rows[found])
        if run is not None:
            host.problem = self._arrays[run].problem
        function, watch.host = super(ArrayBinding, self).function(name, run), host
        status = function(watch, *inputs, room, found, filled, made, workspace)
        for field in ("steps", "stored", "iterations", "change", "t"):
            setattr(report, field, getattr(made, field))
        if failures:
            raise failures[0]
        return int(status)

    @np.errstate(all="ignore")
    def _event_values(self, kernel: int, t: float, q: Any, p: Any, parameters: Any, values: Any) -> int:
        """Compute the values of a kernel of events at a state, as the compiled search requires them."""
        events, n, parser, scalars = self.events, self.count, self.events.parser, len(self.interface.parameters)
        data, rates = self.vector(parameters, self.parameter_count), np.empty(n)
        arrays = by_name(self.vector(q), self.shapes) | by_name(data[scalars:], self.fields)
        arrays |= self._renamed(parser.momenta, self.vector(p))
        if events.uses_velocity:
            self._velocity(t, q, p, parameters, self.pointer(rates), None)
            arrays |= self._renamed(parser.velocities, rates)
        known = arrays, (t, *data[:scalars].tolist())
        if kernel < MAPS:
            formulas = events.conditions if kernel == CONDITIONS else events.functions
            self.vector(values, len(formulas))[:] = [value_of(terms, *known) for terms in formulas]
            return 0
        k = kernel - MAPS
        if events.events[k].restitution is not None:
            normal = self.vector(values, n + 2)
            normal[:n] = 0.0
            gradient = by_name(normal[:n], self.shapes)
            normal[n] = sum(term.add_gradient(*known, gradient) for term in events.functions[k])
            normal[n + 1] = value_of(events.restitutions[k], *known)
            return 0
        results = [value_of(terms, *known) for _, terms in events.changes[k]]
        after = self.vector(values, 2 * n)
        after[:n], after[n:] = self.vector(q), self.vector(p)
        targets = by_name(after[:n], self.shapes) | self._renamed(parser.momenta, after[n:])
        targets |= self._renamed(parser.velocities, rates)
        for (target, _), result in zip(events.changes[k], results, strict=True):
            name, indices = target[0].entries[0]
            targets[name][indices] = result
        if any(target[0].array in parser.velocities for target, _ in events.changes[k]):
            return self._momentum(t, values, self.pointer(rates), parameters, values + n, None)
        return 0

    def _renamed(self, arrays: Sequence[Array], values: Numbers) -> dict[str, Numbers]:
        """Return the arrays of a vector by the names of other arrays of the same shapes."""
        return {each.name: part for each, part in zip(arrays, by_name(values, self.shapes).values(), strict=False)}
