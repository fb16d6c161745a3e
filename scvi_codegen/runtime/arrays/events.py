"""Event detection along a run over arrays.

An event function is a formula in index notation of coordinates, velocities, momenta, parameters and t. It is evaluated
after every step. After a sign change the step is repeated in parts, each as accurate as the method, until the zero is
located to the last bit of its time (Brent's method). Two zeros within one step are missed, except when a run starts at
a zero and leaves it: a ball that bounces and returns within a step is detected.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.indices import Array
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import Numbers, check_accesses
from scvi_codegen.runtime.arrays.memory import ArraySnapshot
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.events.event import ACCUMULATED, Event

if TYPE_CHECKING:
    from scvi_codegen.formulas.arrays import ArrayTerm

__all__ = ["ArrayCrossings", "ArraySearch"]

Sample: TypeAlias = tuple[float, float]
"""Fraction of a step, and the function value there."""
LAST_BIT = 2.0**-52
"""Machine precision, relative to a step."""
TIE = 2.0**-30
"""Fraction of a step within which crossings of different events count as simultaneous."""
AT_ZERO, AT_REST = 16.0 * LAST_BIT, 4.0 * LAST_BIT
"""Fractions of the change of a function in a step: remainder of a located zero, and change explained by rounding."""
PROBES = tuple(2.0**-place for place in range(40, -1, -1))
"""Fractions of a first step at which a function that starts at a zero is evaluated."""
RATE_PART = 2.0**-50
"""Fraction of a first step over which state rates are computed from low words; shorter than any probe."""
LEAST_DIFFERENCE, RELATIVE_DIFFERENCE = 2.0**-10, 2.0**-17
"""Increments of the finite differences: fraction of the first step, and relative to the coordinates."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrayCrossings:
    """Crossings of one event, in the order of the run.

    Attributes:
        event: the event.
        t: (k,) times.
        q, p: (k, ..) positions and momenta by array name.
    """

    event: Event
    t: Numbers
    q: Mapping[str, Numbers]
    p: Mapping[str, Numbers]

    def __len__(self) -> int:
        return len(self.t)

    def chosen(self, which: NDArray[np.bool_]) -> ArrayCrossings:
        """Return the crossings selected by a (k,) boolean mask."""
        q, p = ({name: each[which] for name, each in part.items()} for part in (self.q, self.p))
        return replace(self, t=self.t[which], q=q, p=p)


class ArraySearch:
    """Search for zeros of event functions along a run, step by step.

    Raises:
        EventError: if a formula is invalid, an index leaves its array, or a function is not finite.
    """

    def __init__(self, run: ArrayRun, events: Sequence[Event]) -> None:
        self.run, self.events = run, tuple(events)
        self.functions = [_Function(run, event) for event in events]
        self.remaining = [int(event.terminal) for event in events]
        self.recorded: list[list[tuple[float, dict[str, Numbers], dict[str, Numbers]]]] = [[] for _ in events]
        self.ended = False
        self.values = self._values(run)
        self.started = False

    def step(self) -> None:
        """Take one step of the run, or the part of it up to a terminal event."""
        run, before, values = self.run, self.run.snapshot, self.values
        run.advance(1)
        self.values = self._values(run)
        low = run._run.t_low - before.run_fields["t_low"]
        h = (run.t - before.run_fields["t"]) + low if run.plan else run.h
        zeros: list[tuple[float, int, bool]] = []
        for k, event in enumerate(self.events):
            looked = [(0.0, values[k]), (1.0, self.values[k])]
            if not self.started and (between := self._leaves_zero(before, k, h, looked)):
                looked[1:1] = between
            pairs = [pair for pair in pairwise(looked) if _crosses(event, pair[0][1], pair[1][1])]
            zeros += [(self._zero(before, k, h, *pair), k, pair[1][1] > pair[0][1]) for pair in pairs]
        self.started = True
        for number, (part, k, _) in enumerate(sorted(zeros)):
            there = self._part(before, part * h) if part < 1.0 else run.copy_with_step(h)
            if self._take(k, there):
                for other, j, rises in sorted(zeros)[number + 1 :]:
                    if other - part <= TIE and self._value(there, j) * (1.0 if rises else -1.0) >= 0.0:
                        self._take(j, there)
                self._end(before, there)
                return

    def _take(self, k: int, there: ArrayRun) -> bool:
        """Record a crossing; return whether it ends the run."""
        self.recorded[k].append((there.t, there.q, there.p))
        self.remaining[k] -= 1
        return self.remaining[k] == 0

    def _leaves_zero(self, before: ArraySnapshot, k: int, h: float, ends: Sequence[Sample]) -> list[Sample]:
        """Return samples within a first step that begins at a zero, as if the run had come from the other side.

        Raises:
            EventError: if the run returns to a terminal event within a rounding error.
        """
        (_, old), (_, new) = ends
        start = self.run.copy_with_step(h)
        start.rollback(before)
        noise = self._rounding(start, k, old)
        change, doubt = self._first_change(before, start, k, h, noise)
        sign, size = 1.0 if change > 0.0 else -1.0, abs(change) + abs(new - old)
        if abs(old) > AT_ZERO * size + 8.0 * noise or sign * old > 0.0:
            return []
        if not abs(change) > AT_REST * size + 4.0 * doubt:
            return []
        samples: list[Sample] = []
        for part in PROBES[:-1]:
            value = self._value(self._part(before, part * h), k)
            if samples or abs(value) > 8.0 * noise + 4.0 * abs(old):
                samples.append((part, value))
            if len(samples) == 1 and sign * value < 0.0:
                event = self.events[k]
                if self.remaining[k] > 0 and event.direction != sign:
                    raise EventError(ACCUMULATED.format(function=event.function, t=start.t))
                return []
        return samples

    def _rounding(self, start: ArrayRun, k: int, old: float) -> float:
        """Return the change of a function when coordinates change by one ulp up or down."""
        rng, largest = np.random.default_rng(0), 0.0
        for _ in range(4):
            ulps = LAST_BIT * np.abs(start.state) * rng.choice([-1.0, 1.0], start.state.size)
            largest = max(largest, abs(self._moved(start, k, start.t, ulps) - old))
        return largest

    def _first_change(
        self, before: ArraySnapshot, start: ArrayRun, k: int, h: float, noise: float
    ) -> tuple[float, float]:
        """Return h dg/dt at the start of a step and its uncertainty; zeros if g is undefined nearby."""
        n, part, next_ = start.problem.count, RATE_PART, self._part(before, RATE_PART * h)
        low = [np.concatenate([run._numbers["carry_q"], run._numbers["carry_p"]]) for run in (start, next_)]
        along_q = ((next_.state - start.state) + (low[1] - low[0])) / part
        along_p = along_q.copy()
        along_q[n:], along_p[:n] = 0.0, 0.0
        fast = np.abs(along_q).max() or 1.0
        size = max(LEAST_DIFFERENCE, RELATIVE_DIFFERENCE * float(np.abs(start.state[:n]).max() / fast))
        try:
            by_q = self._difference(start, k, 0.0, along_q, size)
            by_rest = self._difference(start, k, h, along_p, LEAST_DIFFERENCE)
        except EventError:
            return 0.0, 0.0
        return by_q + by_rest, noise / size + (noise / LEAST_DIFFERENCE if by_rest else 0.0)

    def _difference(self, start: ArrayRun, k: int, dt: float, along: Numbers, size: float) -> float:
        """Return the central difference of a function along a direction."""
        above, below = (self._moved(start, k, start.t + part * dt, part * along) for part in (size, -size))
        return (above - below) / (2.0 * size)

    def _moved(self, start: ArrayRun, k: int, t: float, change: Numbers) -> float:
        """Return a function at a perturbed state."""
        state, when = start.state.copy(), start.t
        start.state += change
        start._run.t = t
        try:
            return self._value(start, k)
        finally:
            start.state[:] = state
            start._run.t = when

    def crossings(self) -> tuple[ArrayCrossings, ...]:
        """Return the crossings by event."""
        names = list(self.run.interface.coordinates)
        return tuple(
            ArrayCrossings(
                event=event,
                t=np.array([t for t, _, _ in points]),
                q={name: np.array([q[name] for _, q, _ in points]) for name in names},
                p={name: np.array([p[name] for _, _, p in points]) for name in names},
            )
            for event, points in zip(self.events, self.recorded, strict=True)
        )

    def _end(self, before: ArraySnapshot, there: ArrayRun) -> None:
        """Leave the run at the state of a terminal event."""
        self.run.rollback(before)
        self.run.move_to(there)
        self.ended = True

    def _zero(self, before: ArraySnapshot, k: int, h: float, left: Sample, right: Sample) -> float:
        """Return the fraction of a step, between two samples, at which a function is 0 or first has its new sign."""
        from scipy.optimize import brentq  # here: slow to import

        known = dict((left, right))

        def value(part: float) -> float:
            return known[part] if part in known else self._value(self._part(before, part * h), k)

        part, width = float(brentq(value, left[0], right[0], xtol=LAST_BIT * right[0], rtol=4 * LAST_BIT)), LAST_BIT
        while part < right[0] and value(part) * left[1] > 0.0:
            part, width = min(right[0], part + width * right[0]), 2.0 * width
        return part

    def _part(self, before: ArraySnapshot, h: float) -> ArrayRun:
        """Return the state after a partial step."""
        run = self.run.copy_with_step(h)
        run.rollback(replace(before, run_fields={**before.run_fields, "h": h}))
        run.plan = None
        run.advance(1)
        return run

    def _values(self, run: ArrayRun) -> list[float]:
        return [self._value(run, k) for k in range(len(self.events))]

    def _value(self, run: ArrayRun, k: int) -> float:
        value = self.functions[k].value(run)
        if not np.isfinite(value):
            raise EventError(f"the event function '{self.events[k].function}' is not finite at t = {run.t:.17g}")
        return value


def _crosses(event: Event, old: float, new: float) -> bool:
    """Return whether a sign changed in the direction of the event; a zero at the start of a step does not count."""
    return old != 0.0 and old * new <= 0.0 and (event.direction == 0 or (new > old) == (event.direction > 0))


class _Function:
    """Event function of the state."""

    def __init__(self, run: ArrayRun, event: Event) -> None:
        interface, arrays = run.interface, run.problem.arrays
        self.terms = _terms(interface, event)
        accesses = tuple((access, term.loops) for term in self.terms for _, access in term.slots)
        try:
            check_accesses(replace(interface.layout, accesses=accesses), arrays.sizes, arrays.places)
        except ScviCodegenError as error:
            raise EventError(f"the event function '{event.function}': {error}") from error
        self.needs = {access.array.name for access, _ in accesses}

    def value(self, run: ArrayRun) -> float:
        from scvi_codegen.formulas.numpy_values import Elements  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol

        stored = run.problem.arrays
        numbers: dict[Any, float] = {symbol(TIME): run.t}
        numbers |= {symbol(name): x for name, x in zip(run.interface.parameters, stored.numbers, strict=True)}
        arrays = _arrays_of(run, self.needs)
        values = (
            Elements(term.loops, stored.sizes, stored.places).values(term.formula, term.slots, arrays, numbers)
            for term in self.terms
        )
        return float(sum(np.sum(value) for value in values))


def _velocities(interface: Interface) -> dict[str, str]:
    """Return the names of the velocity arrays by coordinate array."""
    return {} if interface.layout.momenta else {name: f"{name}_dot" for name in interface.coordinates}


def _momenta(interface: Interface) -> dict[str, str]:
    """Return the names of the momentum arrays by coordinate array."""
    names = [array.name for array in interface.layout.momenta] or interface.momenta
    return dict(zip(interface.coordinates, names, strict=True))


def _terms(interface: Interface, event: Event) -> tuple[ArrayTerm, ...]:
    from scvi_codegen.formulas.arrays import parse_sums  # here, because it imports SymPy
    from scvi_codegen.formulas.symbols import TIME, symbol

    axes = {array.name: array.axes for array in interface.layout.coordinates}
    known = [*interface.layout.coordinates, *interface.layout.fields]
    for others in (_velocities(interface), _momenta(interface)):
        known += [Array(other, axes[name]) for name, other in others.items()]
    symbols = {name: symbol(name) for name in (*interface.parameters, TIME)}
    try:
        return parse_sums(str(event.function), known, symbols, interface.layout.tables)
    except ScviCodegenError as error:
        raise EventError(f"the event function '{event.function}': {error}") from error


def _arrays_of(run: ArrayRun, names: set[str]) -> dict[str, NDArray[np.float64]]:
    """Return the arrays of a state that occur in ``names``."""
    arrays = {**run.q, **run.problem.arrays.fields}
    for others, state in ((_velocities(run.interface), "velocity"), (_momenta(run.interface), "p")):
        if names & set(others.values()):
            values = getattr(run, state)
            arrays |= {other: values[name] for name, other in others.items()}
    return arrays
