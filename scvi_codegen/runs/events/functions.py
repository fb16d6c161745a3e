"""Functions of events, and the changes of the state by them, in 40 digits: the states have two words.

An impact changes p by lambda n, n = g_q, projected onto the constraints: p1 = P(p + lambda n). It conserves energy if
the mean of n.v + g_t between 0 and lambda is 0: this is the derivative of the energy by lambda, without the work of
moving constraints. The impulse is (1 + e) lambda / 2, with the coefficient of restitution e. The mean is computed by
Gauss quadrature, with one point if the kinetic energy is quadratic, and its zero by Newton's method.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from scvi_codegen.common.errors import EventError
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import DIGITS, low_words, two_words, with_low, word, word_of
from scvi_codegen.runs.stepping.projection import projected
from scvi_codegen.systems.event import JAMMED, Event

if TYPE_CHECKING:
    from scvi_codegen.runs.stepping.integrator import Integrator


class TimedState(NamedTuple):
    """Time and state of two words."""

    t: Fraction
    q: Array
    p: Array


POINTS = (1, 2, 4, 8, 16, 32)
"""Numbers of points of the quadratures of a mean, in the order of their use."""
EQUAL = 2.0**-100
"""Difference of two quadratures, and rate of approach that is rounding, relative to the sum of |n_i v_i|."""
SOLVED = 2.0**-90
"""Last correction of an impulse, relative to it."""
MOST_CORRECTIONS, MOST_ROUNDS = 30, 40
"""Largest number of corrections of an impulse, and of passes over the walls of a corner, twice those in double."""


class EventFunctions:
    """Functions of events that are evaluated in 40 digits.

    Args:
        stepper: integrator in double-double.
        events: the events.
    """

    def __init__(self, stepper: Integrator, events: Sequence[Event]) -> None:
        from scvi_codegen.codegen.rendering.events import EventFormulas
        from scvi_codegen.systems.formulas.expressions import Tape  # here, because it imports SymPy
        from scvi_codegen.systems.formulas.symbols import TIME, symbol

        formulas = EventFormulas(stepper.interface, events)
        symbols = [*formulas.q, *formulas.p, *formulas.v, symbol(TIME), *formulas.parameters]
        self.firsts = np.cumsum([0, *formulas.elements]).tolist()
        self.tapes = [Tape([function], symbols) for function in formulas.functions]
        self.indices = [indices for indices, _ in formulas.changes]
        self.new_values = [Tape(values, symbols) for _, values in formulas.changes]
        self.events = [event for event, count in zip(events, formulas.elements, strict=True) for _ in range(count)]
        self.is_impact = [event.restitution is not None for event in self.events]
        moving = set(formulas.v)
        pairs = zip(formulas.functions, formulas.changes, strict=True)
        of_changes = [[function, *values] for function, (_, values) in pairs]
        self.velocities = [any(moving & formula.free_symbols for formula in group) for group in of_changes]
        self.stepper = stepper

    def value(self, number: int, at: TimedState, parameters: Array) -> Any:
        """Return the value of a function at a state; raise ``ArithmeticError`` outside its domain."""
        return self._values(self.tapes[number], number, at, parameters)[0]

    def _values(self, tape: Any, number: int, at: TimedState, parameters: Array) -> list[Any]:
        from scvi_codegen.common.precision import mp

        v = self._velocity(at, parameters) if self.velocities[number] else at.q
        with mp.workdps(DIGITS):
            arguments = [x for vector in (at.q, at.p, v, parameters) for x in _numbers(vector)]
            arguments.insert(3 * len(at.q), mp.mpf(at.t.numerator) / at.t.denominator)
            values: list[Any] = tape(arguments)
        return values

    def _velocity(self, at: TimedState, parameters: Array) -> Array:
        velocity: Array = self.stepper._transformed("velocity", word_of(at.t), at.q, at.p, parameters.copy())
        return velocity

    def changed(
        self, numbers: Sequence[int], at: TimedState, parameters: Array, forward: bool, begin: float
    ) -> TimedState:
        """Return the state after simultaneous crossings of functions, the impacts repeated while a wall is approached.

        Args:
            numbers: of the functions, in the order of their changes.
            at: state before them.
            parameters: of the run.
            forward: whether the run is forward in time; a run backward undoes impacts.
            begin: start of the step, for the message.

        Raises:
            EventError: if the impacts do not end.
        """
        for number in numbers:
            at = self._change(number, at, parameters, forward)
        walls = [number for number in numbers if self.is_impact[number]]
        if len(walls) < 2:
            return at
        for _ in range(MOST_ROUNDS):
            before = at
            for number in walls:
                at = self._change(number, at, parameters, forward)
            if at.p is before.p:
                return at
        raise EventError(JAMMED.format(function=self.events[min(walls)].title, t=begin))

    def _change(self, number: int, at: TimedState, parameters: Array, forward: bool) -> TimedState:
        """Return the state after a change; the same arrays for a wall that is not approached."""
        stepper, m = self.stepper, len(at.q)
        values = self._values(self.new_values[number], number, at, parameters)
        if self.is_impact[number]:
            return at._replace(p=self._impact(at, parameters, values, forward))
        by_velocity = any(index >= 2 * m for index in self.indices[number])
        state = [at.q.copy(), at.p.copy(), self._velocity(at, parameters) if by_velocity else at.p]
        for index, value in zip(self.indices[number], values, strict=True):
            state[index // m][index % m] = word(*two_words(value, "a value of then="))
        if by_velocity:
            state[1] = stepper.momentum(state[0], state[2], word_of(at.t), parameters)
        q, p, _ = state
        return TimedState(at.t, *projected(stepper, q, p, word_of(at.t), parameters)[:2])

    def _impact(self, at: TimedState, parameters: Array, values: list[Any], forward: bool) -> Array:
        """Return the momenta after an impact; the same array if the wall is not approached.

        ``values``: g_q, g_t and the coefficient of restitution.
        """
        from scvi_codegen.common.precision import mp

        stepper, momenta_before, m = self.stepper, _numbers(at.p), len(at.q)
        normal, by_time, restitution = values[:m], values[m], values[m + 1]

        def momenta(impulse: Any) -> Array:
            moved = [x + impulse * n for x, n in zip(momenta_before, normal, strict=True)]
            high = [float(x) for x in moved]
            words: Array = with_low(np.array(high), np.array([float(x - y) for x, y in zip(moved, high, strict=True)]))
            return projected(stepper, at.q, words, word_of(at.t), parameters)[1]

        def terms(impulse: Any) -> list[Any]:
            moved = at._replace(p=momenta(impulse)) if impulse else at
            v = _numbers(self._velocity(moved, parameters))
            return [by_time, *(n * x for n, x in zip(normal, v, strict=True))]

        def rate(impulse: Any) -> Any:
            return mp.fsum(terms(impulse))

        with mp.workdps(DIGITS):
            size = mp.fsum(map(abs, terms(0)))
            first = rate(0)
            if not (first if forward else -first) < -EQUAL * size:
                return at.p
            derivative = rate(mp.one) - first
            impulse, before = -2 * first / derivative, mp.inf
            for _ in range(MOST_CORRECTIONS):
                mean = _mean(rate, impulse, EQUAL * size)
                change = mean * impulse / (rate(impulse) - mean)
                if not abs(change) < before:
                    break
                impulse, before = impulse - change, abs(change)
            if not before <= max(SOLVED * abs(impulse), EQUAL * size / abs(derivative)):
                raise EventError(
                    f"the impulse of the impact at t = {float(at.t):.17g} did not converge: use a smaller step"
                )
            return momenta((1 + (restitution if forward else 1 / restitution)) * impulse / 2)


def _numbers(values: Array) -> list[Any]:
    """Return numbers of two words in the context of the tables."""
    from scvi_codegen.common.precision import mp

    words = zip(np.asarray(values).tolist(), low_words(values).tolist(), strict=True)
    return [mp.mpf(high) + low if low else mp.mpf(high) for high, low in words]


def _mean(function: Callable[[Any], Any], end: Any, tolerance: Any) -> Any:
    """Return the mean of a function between 0 and ``end`` by Gauss quadratures of which two agree."""
    from scvi_codegen.common.precision import mp
    from scvi_codegen.methods.tables.quadrature import gauss_legendre

    value = before = mp.inf
    for count in POINTS:
        rule = gauss_legendre(count)
        value = mp.fdot(rule.unit_weights, [function(x * end) for x in rule.abscissae])
        if abs(value - before) <= tolerance:
            break
        before = value
    return value
