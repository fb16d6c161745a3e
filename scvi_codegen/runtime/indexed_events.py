"""Zeros of functions of the state along a run over arrays.

A function is a formula of the grammar of sums over indices, in coordinates, velocities, momenta, parameters and t. It
is looked at after every step; where its sign changed, the step is taken again in parts, of which each is as accurate as
the method, until the zero is found to the last bit of its time (Brent's method). Two zeros within a step are not seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.indices import Array
from scvi_codegen.runtime.events import Event
from scvi_codegen.runtime.indexed_interface import IndexedInterface, Numbers, check_accesses
from scvi_codegen.runtime.indexed_memory import IndexedMark
from scvi_codegen.runtime.indexed_run import IndexedRun

if TYPE_CHECKING:
    from scvi_codegen.formulas.indexed import IndexedTerm

__all__ = ["IndexedCrossings", "IndexedSearch"]

LAST_BIT = 2.0**-52
"""Of a step."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexedCrossings:
    """The crossings of one event, in the order of the run.

    Attributes:
        event: what was looked for.
        t: (k,) times.
        q, p: (k, ..) positions and momenta by the name of their array.
    """

    event: Event
    t: Numbers
    q: Mapping[str, Numbers]
    p: Mapping[str, Numbers]

    def __len__(self) -> int:
        return len(self.t)


class IndexedSearch:
    """Looks for the zeros of functions along a run, step by step.

    Raises:
        EventError: for what is no formula, for an index that leaves its array, and where a function is not finite.
    """

    def __init__(self, run: IndexedRun, events: Sequence[Event]) -> None:
        self.run, self.events = run, tuple(events)
        self.functions = [_Function(run, event) for event in events]
        self.remaining = [int(event.terminal) for event in events]
        self.found: list[list[tuple[float, dict[str, Numbers], dict[str, Numbers]]]] = [[] for _ in events]
        self.ended = False
        self.values = self._values(run)

    def step(self) -> None:
        """One step of the run, or the part of it that leads to a terminal event."""
        run, before, values = self.run, self.run.mark, self.values
        run.advance(1)
        self.values = self._values(run)
        h = run.t - before.moments["t"] if run.goal else run.h
        crossed = [k for k, event in enumerate(self.events) if _crosses(event, values[k], self.values[k])]
        zeros = sorted((self._zero(before, k, h, values[k]), k) for k in crossed)
        for part, k in zeros:
            there = self._part(before, part * h) if part < 1.0 else run.apart(h)
            self.found[k].append((there.t, there.q, there.p))
            self.remaining[k] -= 1
            if self.remaining[k] == 0:
                self._end(before, there)
                return

    def crossings(self) -> tuple[IndexedCrossings, ...]:
        """What was found, by event."""
        names = [array.name for array in self.run.interface.coordinates]
        return tuple(
            IndexedCrossings(
                event=event,
                t=np.array([t for t, _, _ in found]),
                q={name: np.array([q[name] for _, q, _ in found]) for name in names},
                p={name: np.array([p[name] for _, _, p in found]) for name in names},
            )
            for event, found in zip(self.events, self.found, strict=True)
        )

    def _end(self, before: IndexedMark, there: IndexedRun) -> None:
        """The run stands where a terminal event ended it."""
        self.run.rewind(before)
        self.run.stand_at(there)
        self.ended = True

    def _zero(self, before: IndexedMark, k: int, h: float, old: float) -> float:
        """The part of a step after which a function first has its new sign, or is 0."""
        from scipy.optimize import brentq  # here: slow to import

        def value(part: float) -> float:
            if part in (0.0, 1.0):
                return old if part == 0.0 else self.values[k]
            return self._value(self._part(before, part * h), k)

        part, width = float(brentq(value, 0.0, 1.0, xtol=LAST_BIT, rtol=4 * LAST_BIT)), LAST_BIT
        while part < 1.0 and value(part) * old > 0.0:
            part, width = min(1.0, part + width), 2.0 * width
        return part

    def _part(self, before: IndexedMark, h: float) -> IndexedRun:
        """The state after a part of a step."""
        run = self.run.apart(h)
        run.rewind(replace(before, moments={**before.moments, "h": h}))
        run.goal = None
        run.advance(1)
        return run

    def _values(self, run: IndexedRun) -> list[float]:
        return [self._value(run, k) for k in range(len(self.events))]

    def _value(self, run: IndexedRun, k: int) -> float:
        found = self.functions[k].value(run)
        if not np.isfinite(found):
            raise EventError(f"the event function '{self.events[k].function}' is not finite at t = {run.t:.17g}")
        return found


def _crosses(event: Event, old: float, new: float) -> bool:
    """Whether a sign changed, in the direction that is looked for; zeros at the beginning of a step are none."""
    return old != 0.0 and old * new <= 0.0 and (event.direction == 0 or (new > old) == (event.direction > 0))


class _Function:
    """A function of the state."""

    def __init__(self, run: IndexedRun, event: Event) -> None:
        interface, arrays = run.interface, run.problem.arrays
        self.terms = _terms(interface, event)
        accesses = tuple((access, term.loops) for term in self.terms for _, access in term.slots)
        try:
            check_accesses(replace(interface, accesses=accesses), arrays.sizes, arrays.places)
        except ScviCodegenError as error:
            raise EventError(f"the event function '{event.function}': {error}") from error
        self.needs = {access.array.name for access, _ in accesses}

    def value(self, run: IndexedRun) -> float:
        from scvi_codegen.formulas.summed import Elements  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol

        given = run.problem.arrays
        numbers: dict[Any, float] = {symbol(TIME): run.t}
        numbers |= {symbol(name): x for name, x in zip(run.interface.parameters, given.numbers, strict=True)}
        arrays = _arrays_of(run, self.needs)
        values = (
            Elements(term.loops, given.sizes, given.places).values(term.formula, term.slots, arrays, numbers)
            for term in self.terms
        )
        return float(sum(np.sum(value) for value in values))


def _velocities(interface: IndexedInterface) -> dict[str, str]:
    """The array of velocities by that of its coordinates."""
    return {} if interface.momenta else {array.name: f"{array.name}_dot" for array in interface.coordinates}


def _momenta(interface: IndexedInterface) -> dict[str, str]:
    """The array of momenta by that of its coordinates."""
    own = [array.name for array in interface.momenta] or [f"p_{array.name}" for array in interface.coordinates]
    return dict(zip((array.name for array in interface.coordinates), own, strict=True))


def _terms(interface: IndexedInterface, event: Event) -> tuple[IndexedTerm, ...]:
    from scvi_codegen.formulas.indexed import parse_indexed  # here, because it imports SymPy
    from scvi_codegen.formulas.symbols import TIME, symbol

    axes = {array.name: array.axes for array in interface.coordinates}
    known = [*interface.coordinates, *interface.fields]
    for others in (_velocities(interface), _momenta(interface)):
        known += [Array(other, axes[name]) for name, other in others.items()]
    symbols = {name: symbol(name) for name in (*interface.parameters, TIME)}
    try:
        return parse_indexed(str(event.function), known, symbols, interface.tables)
    except ScviCodegenError as error:
        raise EventError(f"the event function '{event.function}': {error}") from error


def _arrays_of(run: IndexedRun, names: set[str]) -> dict[str, NDArray[np.float64]]:
    """Arrays of a state by name, those that occur."""
    found = {**run.q, **run.problem.arrays.fields}
    for others, state in ((_velocities(run.interface), "velocity"), (_momenta(run.interface), "p")):
        if names & set(others.values()):
            values = getattr(run, state)
            found |= {other: values[name] for name, other in others.items()}
    return found
