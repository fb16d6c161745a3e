"""Crossings of runs in double-double: located by the integrator in double, then refined to states of two words.

Between two states of a run the integrator in double finds the time of a crossing to 16 digits. From there the secant
method solves g = 0 with states of two words, which partial steps give, and g in 40 digits: two iterations suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.runtime.core.words import DIGITS, Word, as_mpmath, missing, stacked, word
from scvi_codegen.runtime.events.detection import CrossingSearch
from scvi_codegen.runtime.events.event import Crossings, Event
from scvi_codegen.runtime.trajectory.dense_output import stepped_to

if TYPE_CHECKING:
    from scvi_codegen.runtime.core.integrator import Integrator
    from scvi_codegen.runtime.trajectory.saved_states import Array, SavedStates

DIFFERENCE, LARGEST_CHANGE = 2.0**-20, 2.0**-27
"""Difference of times for the first derivative, and largest change of the time of a crossing, relative to the step."""


class RefinedCrossing(NamedTuple):
    """Crossing of an event by its number, with the time and the state in two words."""

    function: int
    t: Word
    q: Array
    p: Array
    element: int


class EventFunctions:
    """Functions of events that are evaluated in 40 digits.

    Args:
        stepper: integrator in double-double.
        events: the events.
    """

    def __init__(self, stepper: Integrator, events: Sequence[Event]) -> None:
        from scvi_codegen.formulas.expressions import Tape  # here, because it imports SymPy
        from scvi_codegen.formulas.symbols import TIME, symbol
        from scvi_codegen.rendering.events import EventFormulas

        formulas = EventFormulas(stepper.interface, events)
        symbols = [*formulas.arguments, symbol(TIME), *formulas.parameters]
        self.firsts = np.cumsum([0, *formulas.elements]).tolist()
        self.tapes = [Tape([function], symbols) for function in formulas.functions]
        self.velocities = [not function.free_symbols.isdisjoint(formulas.v) for function in formulas.functions]
        self.stepper = stepper

    def value(self, number: int, q: Array, p: Array, t: Fraction, parameters: Array) -> Any:
        """Return the value of a function at a state; raise ``ArithmeticError`` outside its domain."""
        from scvi_codegen.tables.precision import mp

        v = self.stepper.velocity(q, p, float(t), parameters) if self.velocities[number] else q
        with mp.workdps(DIGITS):
            words = [mp.mpf(x) for each in (q, p, v, parameters) for x in as_mpmath(each)]
            words.insert(3 * len(q), mp.mpf(t.numerator) / t.denominator)
            return self.tapes[number](words)[0]


class RefinedSearch(CrossingSearch):
    """Crossings of the events of a stepper in double-double; arguments and attributes as of the base class."""

    def __init__(self, stepper: Any, watch: Any = None, *, terminal: bool = True) -> None:
        super().__init__(stepper._in_double, watch, terminal=terminal)
        self.precise, self.refined = stepper, list[RefinedCrossing]()

    def search(self, part: SavedStates, first: int = 0) -> int:
        """Search between consecutive states; see the base class."""
        numbers: dict[str, Any] = {name: np.array(getattr(part, name)) for name in ("t", "q", "p", "parameters")}
        known = len(self.recorded)
        reached = super().search(replace(cast(Any, part), **numbers), first)
        for records in self.recorded[known:]:
            self.refined += [self._refined(part, record) for record in records]
        self.recorded.clear()
        if self.ended:
            self.last = self.refined[-1][1:4]
        return reached

    def _refined(self, part: SavedStates, record: Any) -> RefinedCrossing:
        number = int(record["function"])
        element = int(record["element"]) if "element" in record.dtype.names else 0
        t, forward = float(record["t"]), part.forward
        k = max(0, int(np.searchsorted(forward * np.asarray(part.t), forward * t, side="right")) - 1)
        function = self.precise._event_functions.firsts[number] + element
        end, q, p = self._root(part, k, function, Fraction(t), Fraction(float(part.step_sizes[k])))
        high = float(end)
        return RefinedCrossing(number, word(high, float(end - Fraction(high))), q, p, element)

    def _root(
        self, part: SavedStates, k: int, function: int, start: Fraction, h: Fraction
    ) -> tuple[Fraction, Array, Array]:
        """Return the time of a simple zero near ``start`` in the step from state k, else ``start``, and the state."""
        q, p = self._state(part, k, start)

        def value(t: Fraction, q: Array, p: Array) -> Fraction:
            numerator, exponent = self.precise._event_functions.value(function, q, p, t, part.parameters).man_exp
            return Fraction(int(numerator)) * Fraction(2**exponent if exponent >= 0 else Fraction(1, 2**-exponent))

        try:
            near = start + h * Fraction(DIFFERENCE)
            first, second = value(start, q, p), value(near, *self._state(part, k, near))
            if not first or first == second:
                return start, q, p
            t = start - first * (near - start) / (second - first)
            if abs(t - start) > abs(h) * Fraction(LARGEST_CHANGE):
                return start, q, p
            last = value(t, *self._state(part, k, t))
            if last != first:
                t -= last * (t - start) / (last - first)
        except ArithmeticError:  # undefined beside the zero
            return start, q, p
        return t, *self._state(part, k, t)

    def _state(self, part: SavedStates, k: int, end: Fraction) -> tuple[Array, Array]:
        if float(end) == float(part.t[k]) and not float(end - Fraction(float(part.t[k]))):
            return part.q[k], part.p[k]
        return stepped_to(part, part.q[k], part.p[k], part.t[k : k + 1], end)

    def crossings(self) -> tuple[Crossings, ...]:
        """Return the crossings by event, with times and states of two words."""
        named, found = self.precise.named, []
        for number, event in enumerate(self.stepper.events):
            mine = [each for each in self.refined if each.function == number]
            none = missing((0,), 2), *(missing((0, self.precise.dimension), 2) for _ in range(2))
            t, q, p = (stacked([each[k] for each in mine]) for k in (1, 2, 3)) if mine else none
            elements = np.array([each.element for each in mine], dtype=np.int64)
            found.append(Crossings(event=event, t=t, q=named(q), p=named(p), element=elements))
        return tuple(found)


class WithEventsInDouble:
    """Mixin of integrators in double-double, whose events are located by an integrator in double."""

    _doubles: Callable[[], Any] | None = None
    """Function that returns the integrator in double, without events."""
    interface: Any
    events: tuple[Event, ...]

    @property
    def _in_double(self) -> Any:
        """The integrator in double with the same events."""
        if self._doubles is None:
            raise MethodError(
                "events= with precision='double-double' require the integrator in double, which a loaded or pickled "
                "stepper lacks: compile the system"
            )
        return self._doubles().with_events(self.events)

    @cached_property
    def _event_functions(self) -> EventFunctions:
        """The functions of the events in 40 digits."""
        return EventFunctions(cast(Any, self), self.events)


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
