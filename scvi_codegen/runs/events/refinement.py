"""Crossings of runs in double-double: located by the integrator in double, then refined to states of two words.

Between two states of a run the integrator in double finds the time of a crossing to 16 digits. From there the secant
method solves g = 0 with states of two words, which partial steps give, and g in 40 digits: two iterations suffice.

Events that change the state are located step by step: the integrator in double repeats each step from the high words
with its changes. The step in double-double then goes to the refined time of each change, from the changed state to the
next one, and to its end.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from itertools import groupby
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from scvi_codegen.common.errors import EventError, StateError, StepFailedError
from scvi_codegen.runs.events.detection import CrossingSearch
from scvi_codegen.runs.events.functions import TimedState
from scvi_codegen.runs.results.dense_output import stepped_to
from scvi_codegen.runs.states.times import WHOLE, number_until
from scvi_codegen.runs.states.words import Word, block_of, fraction_of, stacked, with_low, word_of
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed, FixedSteps, Until
from scvi_codegen.systems.event import Crossings

if TYPE_CHECKING:
    from scvi_codegen.runs.results.saved_states import Array, SavedStates
    from scvi_codegen.runs.stepping.integrator import Integrator

DIFFERENCE, LARGEST_CHANGE = 2.0**-20, 2.0**-27
"""Difference of times for the first derivative, and largest change of the time of a crossing, relative to the step."""


class RefinedCrossing(NamedTuple):
    """Crossing of an event by its number, with the time and the state in two words."""

    function: int
    t: Word
    q: Array
    p: Array
    element: int


class SavedRow(NamedTuple):
    """State at the end of a step or after a change within one, and the size of the part of the step before it."""

    at: TimedState
    size: float = 0.0
    number: int = -1
    iterations: int = 0


class RefinedSearch(CrossingSearch):
    """Crossings of the events of a stepper in double-double; arguments and attributes as of the base class."""

    def __init__(self, stepper: Any, watch: Any = None, *, terminal: bool = True) -> None:
        super().__init__(stepper._in_double, watch, terminal=terminal)
        if self.changes and self.stepper.modes:
            raise EventError(
                f"an event sets '{self.stepper.modes[0]}': events that set parameters require precision='double'"
            )
        self.precise, self.refined = stepper, list[RefinedCrossing]()
        self._partial: Memory | None = None  # run of partial steps

    def search(self, part: SavedStates, first: int = 0) -> int:
        """Search between consecutive states; see the base class."""
        numbers: dict[str, Any] = {name: np.array(getattr(part, name)) for name in ("t", "q", "p", "parameters")}
        before = len(self.recorded)
        reached = super().search(replace(cast(Any, part), **numbers), first)
        for records in self.recorded[before:]:
            self.refined += [self._refined(part, record) for record in records]
        self.recorded.clear()
        if self.ended:
            self.last = self.refined[-1][1:4]
        return reached

    def _refined(self, part: SavedStates, record: Any) -> RefinedCrossing:
        t = float(record["t"])
        k = max(0, int(number_until(part.t, t, part.forward)) - 1)
        start, h = TimedState(fraction_of(part.t[k]), part.q[k], part.p[k]), float(part.step_sizes[k])
        if self.precise.in_tau:
            h *= float(self.precise.rates(start.q, start.p, part.parameters)[0])
        return self._crossing(record, self._root(part, start, self._function(record), Fraction(t), Fraction(h)))

    def _function(self, record: Any) -> int:
        number: int = self.precise._event_functions.firsts[int(record["function"])] + _element(record)
        return number

    def _crossing(self, record: Any, at: TimedState) -> RefinedCrossing:
        return RefinedCrossing(int(record["function"]), word_of(at.t), at.q, at.p, _element(record))

    def _root(
        self, states: SavedStates | Memory, start: TimedState, function: int, guess: Fraction, h: Fraction
    ) -> TimedState:
        """Return the time of a simple zero near ``guess`` in the step from ``start``, else ``guess``, and the state.

        Two steps of the secant method, t - g(t) (t' - t) / (g(t') - g(t)): the first from the guess t_0 and
        t_0 + DIFFERENCE h, the second from its result t_1 and t_0.
        """
        here = self._moved(states, start, guess)

        def value(at: TimedState) -> Fraction:
            number = self.precise._event_functions.value(function, at, states.parameters)
            numerator, exponent = number.man_exp  # of the absolute value
            size = int(numerator) * Fraction(2**exponent if exponent >= 0 else Fraction(1, 2**-exponent))
            return size if number > 0 else -size

        try:
            near = guess + h * Fraction(DIFFERENCE)
            g_guess, g_near = value(here), value(self._moved(states, start, near))
            if not g_guess or g_guess == g_near:
                return here
            t = guess - g_guess * (near - guess) / (g_near - g_guess)
            if abs(t - guess) > abs(h) * Fraction(LARGEST_CHANGE):
                return here
            g_t = value(self._moved(states, start, t))
            if g_t != g_guess:
                t -= g_t * (t - guess) / (g_t - g_guess)
        except ArithmeticError:  # undefined beside the zero
            return here
        return self._moved(states, start, t)

    def _moved(self, states: SavedStates | Memory, start: TimedState, end: Fraction) -> TimedState:
        """Return the state after a partial step to a time."""
        if end == start.t:
            return start
        t, stepper = word_of(start.t), self.precise
        if stepper.in_tau:
            begin = with_low(np.array([float(t)]), np.array([t.low]))
            return TimedState(end, *stepped_to(states, start.q, start.p, begin, end))
        if self._partial is None:
            plan = Fixed(float(end - start.t))
            settings: dict[str, Any] = {"parameters": states.parameters, "options": states.options}
            self._partial = Memory.started(stepper, start.q, start.p, plan=plan, **settings)
        run, block = self._partial, map(block_of, (start.q, start.p))
        run._parameters[:] = states.parameters
        run._start_function(float(t), 0.0, *stepper.binding.pointers(*block))
        run._memory.t_low = t.low
        run._step_to(end)
        run.advance(1)
        return TimedState(end, run.q, run.p)

    def advance(self, run: Memory, size: int) -> Any:
        """Advance a run by at most ``size`` steps with events that change its state; see the base class."""
        plan, rows, failure = run._plan, [SavedRow(_place(run), number=run.steps)], None
        memory, watch = run.stepper.binding.buffer(run._memory), self.binding.buffer(self.watch)
        for _ in range(size):
            if self.ended or (not isinstance(plan, Fixed) and run.left_to(plan.t_end) == 0.0):
                break
            before = bytes(memory), bytes(watch)
            try:
                rows += self._step(run)
            except (EventError, StepFailedError) as error:
                memory[:], watch[:] = before
                failure = error
                break
        t, q, p = (stacked([row.at[k] if k else word_of(row.at.t) for row in rows]) for k in range(3))
        sizes = np.array([*(row.size for row in rows[1:]), plan.h if isinstance(plan, FixedSteps) else np.nan])
        iterations, numbers = (np.array([row[k] for row in rows]) for k in (3, 2))
        return (t, q, p, iterations.astype(np.int32)), sizes, numbers, failure

    def _step(self, run: Memory) -> list[SavedRow]:
        """Take one step with the changes in it; return the states after these and, unless it ended, at its end."""
        start, number, stop = _place(run), run.steps, None
        self._take(run)
        iterations, run.iterations, end = run.iterations, 0, _place(run)
        at, h, rows = start, end.t - start.t, list[SavedRow]()
        for crossings in self._located(run, start, h, number):
            guesses = [(self._function(crossing), Fraction(float(crossing["t"]))) for crossing in crossings]
            roots = [self._root(run, at, *guess, h) for guess in guesses]
            acting = [k for k, crossing in enumerate(crossings) if self.watch.acts[int(crossing["function"])]]
            stop = None if acting else roots[-1]
            if acting:  # crossings that coincide have one state
                before = roots[acting[0]]
                roots = [before] * len(crossings)
                functions = [self._function(crossings[k]) for k in acting]
                changed = self.precise._event_functions.changed
                after = changed(functions, before, run.parameters, h > 0, float(start.t))
                rows.append(SavedRow(after, float(before.t - at.t)))
                at = after
            self.refined += map(self._crossing, crossings, roots)
            self.last = self.refined[-1][1:4]
        if self.ended:
            if stop is not None:
                rows.append(SavedRow(stop, float(stop.t - at.t)))
                at = stop
            run._memory.step = number
            _set(run, at)
            return rows
        if rows:
            end = self._moved(run, at, end.t)
            _set(run, end)
        return [*rows, SavedRow(end, float(end.t - at.t), run.steps, iterations)]

    def _take(self, run: Memory) -> None:
        """Take one step, the last to the target time of fixed steps: shorter, or longer by the rounding of h."""
        memory, plan = run._memory, run._plan
        if not isinstance(plan, Until) or abs(run.left_to(plan.t_end)) >= (1.0 + WHOLE) * abs(plan.h):
            run._taken(1)
            return
        run._step_to(plan.t_end)
        run._taken(1)
        memory.t, memory.t_low = plan.t_end, 0.0
        memory.h, memory.h_low = plan.h, 0.0

    def _located(self, run: Memory, start: TimedState, h: Fraction, number: int) -> list[list[Any]]:
        """Return the crossings in a step, which the integrator in double repeats, grouped by time."""
        twin = self._twin
        twin._parameters[:] = run._parameters
        if run._options is not twin._options:
            twin._set_options(run._options)
        while True:
            twin.plan = Fixed(float(h))
            twin._begin(np.asarray(start.q), np.asarray(start.p), float(start.t))
            twin._memory.step = number
            failure = super().advance(twin, 1)[-1]
            records = self.recorded.pop()
            if failure is not None:
                raise failure
            if self.ended or twin._report.steps:
                together = groupby(records, lambda crossing: (crossing["t"], crossing["fraction"]))
                return [[*group] for _, group in together]

    @cached_property
    def _twin(self) -> Memory:
        return Memory(self.stepper)

    def crossings(self) -> tuple[Crossings, ...]:
        """Return the crossings by event, with times and states of two words."""
        states, by_event = self.precise._states, []
        for number, event in enumerate(self.stepper.events):
            mine = [crossing for crossing in self.refined if crossing.function == number]
            none = states.missing((0,)), *(states.missing((0, states.dimension)) for _ in range(2))
            t, q, p = (stacked([crossing[k] for crossing in mine]) for k in (1, 2, 3)) if mine else none
            elements = np.array([crossing.element for crossing in mine], dtype=np.int64)
            by_event.append(Crossings(event=event, t=t, q=states.named(q), p=states.named(p), element=elements))
        return tuple(by_event)


def _element(record: Any) -> int:
    return int(record["element"]) if "element" in record.dtype.names else 0


def _place(run: Memory) -> TimedState:
    return TimedState(run._exact_time, run.q, run.p)


def _set(run: Memory, at: TimedState) -> None:
    """Set the time and the state of a run; its step density begins anew."""
    memory, t = run._memory, word_of(at.t)
    memory.t, memory.t_low, memory.guess = float(t), t.low, 0
    run._q[:], run._p[:] = at.q, at.p
    if hasattr(memory, "density"):
        memory.density = 0.0


def search_of(stepper: Any, watch: Any = None, *, terminal: bool = True) -> CrossingSearch:
    """Return the search for the events of a stepper of any precision."""
    search = CrossingSearch if stepper.interface.words == 1 else RefinedSearch
    return search(stepper, watch, terminal=terminal)


def crossings_of(stepper: Integrator, states: SavedStates) -> tuple[Crossings, ...]:
    """Return the crossings of the stepper's events along a trajectory with all states saved; no event is terminal.

    Raises:
        StateError: if intermediate states were not saved.
        EventError, StepFailedError: as :meth:`CrossingSearch.search`.
    """
    lengths, spans, tolerance = states.step_sizes.copy(), np.diff(states.stepped), states.grid_tolerance[:-1]
    short = np.abs(spans) < np.abs(lengths[:-1]) - tolerance
    if short[:-1].any() or not (np.abs(spans) <= np.abs(lengths[:-1]) + tolerance).all():
        raise StateError(
            "events require all states, but this trajectory has save_every > 1 or t_eval: integrate with save_every=1"
        )
    lengths[:-1][short] = spans[short]  # an event ended the last step
    search = search_of(stepper, terminal=False)
    search.search(cast(Any, replace(cast(Any, states), step_sizes=lengths)))
    return search.crossings()
