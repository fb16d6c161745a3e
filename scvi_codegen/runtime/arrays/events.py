"""Event detection along a run over arrays.

An event function is a formula in index notation of coordinates, velocities, momenta, parameters and t. It is evaluated
after every step. After a sign change the step is repeated in parts, each as accurate as the method, until the zero is
located to the last bit of its time (Brent's method). Two zeros within one step are missed, except when a run starts at
a zero and leaves it: a ball that bounces and returns within a step is detected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.indices import Array
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import Numbers, check_accesses
from scvi_codegen.runtime.events.event import ACCUMULATED, Crossings, Event
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.saved_states import SavedStates

if TYPE_CHECKING:
    from scvi_codegen.formulas.arrays import ArrayTerm

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


class ArraySearch:
    """Search for zeros of a stepper's event functions between consecutive states of runs over arrays.

    Args:
        stepper: the stepper, with its events.
        crossed: numbers of earlier crossings of each event; none by default.
        terminal: whether terminal events end the search.

    Attributes:
        ended: whether a terminal event occurred; ``recorded[-1]`` is its crossing or one at the same time.
        recorded: number of the event, t, q and p of each crossing, in the order of the run.

    Raises:
        EventError: if a formula is invalid, or an index leaves its array.
    """

    def __init__(self, stepper: Any, crossed: Sequence[int] = (), *, terminal: bool = True) -> None:
        self.stepper, self.events = stepper, stepper.events
        self.functions = [_Function(stepper, event) for event in self.events]
        self.remaining = [
            (int(event.terminal) - (crossed[k] if crossed and event.terminal else 0)) * terminal
            for k, event in enumerate(self.events)
        ]
        self.recorded: list[tuple[int, float, Numbers, Numbers]] = []
        self.ended = self.started = False

    @property
    def last(self) -> tuple[float, Numbers, Numbers]:
        """Time, positions and momenta of the last crossing."""
        return self.recorded[-1][1:]

    def search(self, part: SavedStates, first: int = 0) -> int:
        """Search between consecutive states of a trajectory; return the number of steps before the search ended.

        Raises:
            EventError: if an event function is not finite.
            StepFailedError: if a partial step fails.
        """
        values = self._values(_Step(part, 0), 0.0)
        for number in range(len(part) - 1):
            step = _Step(part, number)
            before, values = values, self._values(step, 1.0)
            if self._search_step(step, before, values):
                self.ended = True
                return number
        return len(part) - 1

    def _search_step(self, step: _Step, before: Sequence[float], after: Sequence[float]) -> bool:
        """Record the crossings within a step; return whether a terminal event ends the run there."""
        zeros: list[tuple[float, int, bool]] = []
        for k, event in enumerate(self.events):
            looked = [(0.0, before[k]), (1.0, after[k])]
            if not self.started and (between := self._leaves_zero(step, k, looked)):
                looked[1:1] = between
            pairs = [pair for pair in pairwise(looked) if _crosses(event, pair[0][1], pair[1][1])]
            zeros += [(self._zero(step, k, *pair), k, pair[1][1] > pair[0][1]) for pair in pairs]
        self.started = True
        for number, (part, k, _) in enumerate(sorted(zeros)):
            if self._take(k, step, part):
                for other, j, rises in sorted(zeros)[number + 1 :]:
                    if other - part <= TIE and self._value(step, part, j) * (1.0 if rises else -1.0) >= 0.0:
                        self._take(j, step, part)
                return True
        return False

    def _take(self, k: int, step: _Step, part: float) -> bool:
        """Record a crossing; return whether it ends the run."""
        self.recorded.append((k, *step.state(part)))
        self.remaining[k] -= 1
        return self.remaining[k] == 0

    def _leaves_zero(self, step: _Step, k: int, ends: Sequence[Sample]) -> list[Sample]:
        """Return samples within a first step that begins at a zero, as if the run had come from the other side.

        Raises:
            EventError: if the run returns to a terminal event within a rounding error.
        """
        (_, old), (_, new) = ends
        noise = self._rounding(step, k, old)
        change, doubt = self._first_change(step, k, noise)
        sign, size = 1.0 if change > 0.0 else -1.0, abs(change) + abs(new - old)
        if abs(old) > AT_ZERO * size + 8.0 * noise or sign * old > 0.0:
            return []
        if not abs(change) > AT_REST * size + 4.0 * doubt:
            return []
        samples: list[Sample] = []
        for part in PROBES[:-1]:
            value = self._value(step, part, k)
            if samples or abs(value) > 8.0 * noise + 4.0 * abs(old):
                samples.append((part, value))
            if len(samples) == 1 and sign * value < 0.0:
                event = self.events[k]
                if self.remaining[k] > 0 and event.direction != sign:
                    raise EventError(ACCUMULATED.format(function=event.function, t=step.t))
                return []
        return samples

    def _rounding(self, step: _Step, k: int, old: float) -> float:
        """Return the change of a function when coordinates change by one ulp up or down."""
        rng, largest = np.random.default_rng(0), 0.0
        for _ in range(4):
            ulps = LAST_BIT * np.abs(step.start) * rng.choice([-1.0, 1.0], step.start.size)
            largest = max(largest, abs(self._moved(step, k, 0.0, ulps) - old))
        return largest

    def _first_change(self, step: _Step, k: int, noise: float) -> tuple[float, float]:
        """Return h dg/dt at the start of a step and its uncertainty; zeros if g is undefined nearby."""
        n, run = step.start.size // 2, step.run(RATE_PART)
        along_q = ((np.concatenate([run.q, run.p]) - step.start) + np.concatenate(run._compensation)) / RATE_PART
        along_p = along_q.copy()
        along_q[n:], along_p[:n] = 0.0, 0.0
        fast = np.abs(along_q).max() or 1.0
        size = max(LEAST_DIFFERENCE, RELATIVE_DIFFERENCE * float(np.abs(step.start[:n]).max() / fast))
        try:
            by_q = self._difference(step, k, 0.0, along_q, size)
            by_rest = self._difference(step, k, step.h, along_p, LEAST_DIFFERENCE)
        except EventError:
            return 0.0, 0.0
        return by_q + by_rest, noise / size + (noise / LEAST_DIFFERENCE if by_rest else 0.0)

    def _difference(self, step: _Step, k: int, dt: float, along: Numbers, size: float) -> float:
        """Return the central difference of a function along a direction."""
        above, below = (self._moved(step, k, part * dt, part * along) for part in (size, -size))
        return (above - below) / (2.0 * size)

    def _moved(self, step: _Step, k: int, dt: float, change: Numbers) -> float:
        """Return a function at a perturbed initial state."""
        q, p = np.split(step.start + change, 2)
        return self._at(k, step.t + dt, q, p, step.states.parameters)

    def crossings(self) -> tuple[Crossings, ...]:
        """Return the crossings by event."""
        named, empty = self.stepper.named, np.empty((0, self.stepper.dimension))
        by_event: list[list[tuple[float, Numbers, Numbers]]] = [
            [crossing[1:] for crossing in self.recorded if crossing[0] == k] for k in range(len(self.events))
        ]
        return tuple(
            Crossings(
                event=event,
                t=np.array([t for t, _, _ in mine]),
                q=named(np.array([q for _, q, _ in mine]) if mine else empty),
                p=named(np.array([p for _, _, p in mine]) if mine else empty),
            )
            for event, mine in zip(self.events, by_event, strict=True)
        )

    def _zero(self, step: _Step, k: int, left: Sample, right: Sample) -> float:
        """Return the fraction of a step, between two samples, at which a function is 0 or first has its new sign."""
        from scipy.optimize import brentq  # here: slow to import

        known = dict((left, right))

        def value(part: float) -> float:
            return known[part] if part in known else self._value(step, part, k)

        part, width = float(brentq(value, left[0], right[0], xtol=LAST_BIT * right[0], rtol=4 * LAST_BIT)), LAST_BIT
        while part < right[0] and value(part) * left[1] > 0.0:
            part, width = min(right[0], part + width * right[0]), 2.0 * width
        return part

    def _values(self, step: _Step, part: float) -> list[float]:
        return [self._value(step, part, k) for k in range(len(self.events))]

    def _value(self, step: _Step, part: float, k: int) -> float:
        return self._at(k, *step.state(part), step.states.parameters)

    def _at(self, k: int, t: float, q: Numbers, p: Numbers, parameters: Numbers) -> float:
        value = self.functions[k].value(t, q, p, parameters)
        if not np.isfinite(value):
            raise EventError(f"the event function '{self.events[k].function}' is not finite at t = {t:.17g}")
        return value


class _Step:
    """Step between two saved states, and states within it."""

    def __init__(self, states: SavedStates, number: int) -> None:
        self.states, self.number, self.t = states, number, float(states.t[number])
        self.start = np.concatenate([states.q[number], states.p[number]])
        controlled = not states.plan.fixed or number + 1 == len(states)
        self.h = (
            0.0
            if number + 1 == len(states)
            else float(states.t[number + 1] - self.t if controlled else states.step_sizes[number])
        )

    def state(self, part: float) -> tuple[float, Numbers, Numbers]:
        """Return t, q and p after a fraction of the step."""
        if part in (0.0, 1.0):
            row = self.number + int(part)
            return float(self.states.t[row]), np.array(self.states.q[row]), np.array(self.states.p[row])
        run = self.run(part)
        return run.t, run.q, run.p

    def run(self, part: float) -> Memory:
        """Return a run after a fraction of the step."""
        q, p = np.split(self.start, 2)
        given: dict[str, Any] = {"t": self.t, "parameters": self.states.parameters, "options": self.states.options}
        run = Memory.started(self.states.stepper, q, p, plan=StepPlan.with_step(part * self.h), **given)
        run.advance(1)
        return run


def _crosses(event: Event, old: float, new: float) -> bool:
    """Return whether a sign changed in the direction of the event; a zero at the start of a step does not count."""
    return old != 0.0 and old * new <= 0.0 and (event.direction == 0 or (new > old) == (event.direction > 0))


class _Function:
    """Event function of the state."""

    def __init__(self, stepper: Any, event: Event) -> None:
        self.stepper, self.interface, arrays = stepper, stepper.origin.interface, stepper.problem
        self.terms = _terms(self.interface, event)
        accesses = tuple((access, term.loops) for term in self.terms for _, access in term.slots)
        try:
            check_accesses(replace(self.interface.layout, accesses=accesses), arrays.sizes, arrays.places)
        except ScviCodegenError as error:
            raise EventError(f"the event function '{event.function}': {error}") from error
        self.needs = {access.array.name for access, _ in accesses}

    def value(self, t: float, q: Numbers, p: Numbers, parameters: Numbers) -> float:
        from scvi_codegen.formulas.numpy_values import Elements  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol

        known, stored = self.stepper.parameters_by_name(parameters), self.stepper.problem
        numbers: dict[Any, float] = {symbol(TIME): t}
        numbers |= {symbol(name): known[name] for name in self.interface.parameters}
        arrays = self._arrays(t, q, p, parameters) | known
        values = (
            Elements(term.loops, stored.sizes, stored.places).values(term.formula, term.slots, arrays, numbers)
            for term in self.terms
        )
        return float(sum(np.sum(value) for value in values))

    def _arrays(self, t: float, q: Numbers, p: Numbers, parameters: Numbers) -> dict[str, Any]:
        """Return the arrays of a state that the function uses."""
        stepper = self.stepper
        arrays: dict[str, Any] = stepper.arrays(q)
        momenta, velocities = _momenta(self.interface), _velocities(self.interface)
        if self.needs & set(momenta.values()):
            arrays |= {momenta[name]: each for name, each in stepper.arrays(p).items()}
        if self.needs & set(velocities.values()):
            moving = stepper.arrays(stepper.velocity(q, p, t, parameters))
            arrays |= {velocities[name]: each for name, each in moving.items()}
        return arrays


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
