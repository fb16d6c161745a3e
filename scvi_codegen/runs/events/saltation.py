"""Derivatives through events that change the state: saltation matrices.

The crossing of g(z, t) = 0, z = (q, p), at which z becomes R(z, t), moves by dtau = -(g_z dz + g_t dt) / rate with the
initial data, rate = g_z X- + g_t. At a fixed time after it

    dz+ = R_z (dz + X- dtau) + R_t (dt + dtau) - X+ dtau,

where X- and X+ are the rates of the computed flow: the derivatives of the steps before and after the crossing with
respect to their sizes, so that the result is the derivative of the computed run (Aizerman & Gantmacher, Q. J. Mech.
Appl. Math. 11 (1958) 243). The impulse lambda_1 of an impact is differentiated through its energy equation. Constraints
add the derivative of the projection P of the new state, p+ = P(q, p + lambda g_q). At a transition of a contact R is
its impact and the projection onto the constraints of the new modes (:mod:`~scvi_codegen.runs.events.contact_changes`);
R and g, which contains multipliers, are differentiated by differences.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import REASONS
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.events.contact_changes import Rows, change_at, kept_direction, slip_of
from scvi_codegen.runs.results.dense_output import states_at
from scvi_codegen.runs.results.recomputation import changes_by_events, steps_after
from scvi_codegen.runs.states.times import WHOLE
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import projected, roots_of_masses
from scvi_codegen.runs.stepping.step_plan import FixedSteps
from scvi_codegen.systems.event import Event, Kink, Transition

if TYPE_CHECKING:
    from scvi_codegen.runs.results.saved_states import SavedStates
    from scvi_codegen.runs.stepping.step_derivatives import Starts

GRAZING = 2.0**-20
"""Smallest rate of an event function relative to its gradient and the flow; below it rounding dominates 1/rate."""
GRAZING_IMPACT = 2.0**-36
"""The same of a contact that closes under a load: impacts of a body that comes to rest are slow."""
TOUCH = GRAZING**2
"""Part of values beside it below which a minimum of abs(g) grazes: g = rate s + s^2/2 has the least value -rate^2/2."""
SAMPLES, RISES = 17, 4.0
"""Samples between which a minimum is sought, and least ratio of the second ones beside it. N intervals of which 4 are
kept cost N / log(N / 4), least at N = 4 e, and 6 % more at 16, whose places are exact. For g = c + s^2 the ratio is at
least (c + 9/4) / (c + 1/4) in squared intervals: 9 at a graze, and less than 4 only if c > 5/12, which is seen."""
SMALL_STEP = 2.0**-15
"""Fraction of a step from which the rate of the flow at a last state is computed."""
DIFFERENCE = 2.0**-10
"""Increment of differences of sixth order, relative to parameters, and to the momenta of the run."""
OF_STEP = 0.25
"""Increments of the time and of positions relative to their mean change in a step; of positions at least DIFFERENCE."""
ADMISSIBLE = 0.5
"""Singular values of the derivative of a projection are at least 1, or 0 for inadmissible directions."""
SAME_STATE = 1e-6
"""Relative difference up to which the state after an event is that of its formulas, without impacts of contacts."""
CONTINUOUS = 1e-9
"""Largest difference of the rates of both sides of a kink that is rounding: the flow has no jump there."""
AT_KINK = 1e-9
"""Part of the distance from a kink at the start of an iteration below which its end is at the kink."""
SOON, LEAVES = 1e-6, 1e-4
"""Part of a step by which states move straight on, and change of u by a whole one, relative to other values of u, by
which a state leaves a kink, as a ball that returns to it at the end of its first step."""
BEYOND = 2.0**1000
"""Mode of a side, beyond all values of u."""
WEIGHTS = np.array([1.0, -9.0, 45.0]) / 60.0
PLACES = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])


class Jump(NamedTuple):
    """Linear map of the variables (q, p, parameters, t, h) at a change of the state, and the state (2m,) before it."""

    matrix: Array
    before: Array


class Place(NamedTuple):
    """Run and time of a change, parameters with the modes there, and whether derivatives by them are required."""

    states: SavedStates
    t: float
    parameters: Array
    all_inputs: bool


def jumps_within(
    states: SavedStates, starts: Starts, numbers: NDArray[np.intp], *, all_inputs: bool
) -> dict[int, Jump]:
    """Return the changes of the state at the ends of consecutive steps by the index of the step's end.

    Args:
        states: saved states with the crossings of their run.
        starts: consecutive steps.
        numbers: (steps + 1,) indices of the saved states at their ends.
        all_inputs: whether derivatives with respect to parameters are required.

    Raises:
        StateError: if states within steps were not saved, if several events change the state at once, or if a crossing
            grazes.
    """
    stepper, slides = states.stepper, _directions(states.stepper)
    changes, jumps = (_turns(states, numbers) if slides else {}) | _changes(states, numbers), {}
    _check_grazes(states, numbers, states.t[[*changes]])
    for k, row in enumerate(numbers.tolist()):
        if row in changes and k:
            jumps[k] = _jump(states, starts, k, row, *changes[row], all_inputs=all_inputs)
        elif slides and row > 0 < k:
            jumps[k] = _end_of_part(states, starts, k, row)
    if stepper.modes and numbers[0] == 0:
        t, state = float(states.t[0]), np.concatenate([states.q[0], states.p[0]])
        rows = [len(states) - 1, 0, min(1, len(states) - 1)]
        ends = np.concatenate([states.q[rows], states.p[rows]], axis=1)
        check_sides(stepper, ends, states.t[rows].tolist(), float(starts.h[0]), states.parameters_on_sides(t))
        here = Place(states, t, states.parameters_on_sides(t), all_inputs)
        matrix = _with_directions(here, np.eye(stepper._input_size), state, 0.0 * here.parameters)
        matrix[:, [len(state) + column for column in stepper.mode_columns]] = 0.0
        jumps[0] = Jump(matrix, state)
    return jumps


def check_sides(stepper: Integrator, states: Array, t: Sequence[float], h: float, parameters: Array) -> None:
    """Raise :class:`StateError` if states rest at a kink beside which steps have different derivatives.

    Args:
        stepper, h, parameters: of the steps.
        states: (n, 2m) one for the sizes of kinks, and those at rest.
        t: n times.
    """
    if not any(isinstance(event, Kink) for event in stepper.searched):
        return
    positions, momenta = np.split(states, 2, axis=1)
    at, soon = [*zip(positions, momenta, t, strict=True)], SOON * h
    before, *at_rest = (abs(_event_values(stepper, q, p, time, parameters)) for q, p, time in at)
    moved = ((q + soon * stepper.velocity(q, p, time, parameters), p, time + soon) for q, p, time in at[1:])
    rates = np.max([abs(_event_values(stepper, *state, parameters)) for state in moved], axis=0) / SOON
    after, q, p = np.max(at_rest, axis=0), positions[-1], momenta[-1]
    for kink in stepper.searched:
        if not isinstance(kink, Kink):
            continue
        n = _number(stepper, kink)
        if after[n] <= AT_KINK * before[n] and rates[n] <= LEAVES * before[n]:
            column = np.arange(len(parameters)) == stepper.interface.parameters.index(kink.mode)
            sides = (np.where(column, side, parameters) for side in (-BEYOND, BEYOND))
            below, above = (stepper.jacobian(q, p, h, t[-1], at) for at in sides)
            if abs(above - below).max() > CONTINUOUS * abs(above).max():
                raise StateError(
                    f"the motion rests at a kink of its equations, {kink.title} = 0: "
                    "derivatives with respect to its state are undefined, as those of both sides differ. Give a state "
                    "beside it"
                )


def _check_grazes(states: SavedStates, numbers: NDArray[np.intp], changed: Array) -> None:
    """Raise :class:`StateError` if a function whose crossings change the state or its rate touches 0 without crossing.

    Derivatives are infinite on the side where it crosses. Zeros of time alone, events with ``where``, and those of
    arrays of run-time sizes are left out.
    """
    if not states.stepper.binding.has("event_values"):
        return
    stepper, first, last = states.stepper, max(numbers[0] - 1, 0), min(numbers[-1] + 2, len(states))
    own = [event for event in stepper.events for _ in stepper._events_of_entries(event)]
    events = [*own, *stepper.searched[len(stepper.events) :]]

    def values(t: Array, q: Array, p: Array) -> Array:
        at = zip(q, p, t.tolist(), strict=True)
        return np.array([_event_values(stepper, *state, states.parameters_on_sides(state[-1])) for state in at])

    t = states.t[first:last]
    if not isinstance(states.plan, FixedSteps):  # adaptive steps may be as long as the motion from zero to zero
        t = np.interp(np.arange(3 * len(t) - 2) / 3.0, np.arange(len(t)), t)
    g = values(t, *states_at(states, t))
    size = np.abs(g)
    least = (size[1:-1] <= np.minimum(size[:-2], size[2:])) & (g[:-2] * g[2:] > 0.0)
    for row, k in np.argwhere(least).tolist():
        event, ends, scale = events[k], t[row : row + 3 : 2], size[row : row + 3, k].max()
        closes = not isinstance(event, Transition) or event.kind == "closes"
        near_change = np.isin(t[row : row + 3], changed).any() or not np.diff(t[row : row + 3]).all()
        if near_change or event.where or not (event.changes_state and closes):
            continue
        near = np.array([math.inf, scale])
        while near.min() > TOUCH * scale and near[[0, -1]].min() >= RISES * near.min() * (len(near) > 2):
            times = np.linspace(ends[0], ends[1], SAMPLES)
            near = np.abs(values(times, *states_at(states, times))[:, k])
            beside = np.clip(near.argmin(), 2, SAMPLES - 3) + np.array([-2, 2])
            ends, near = times[beside], near[beside[0] : beside[1] + 1]
        place = Place(states, float(ends.mean()), states.parameters_on_sides(float(ends.mean())), False)
        if near.min() <= TOUCH * scale and _jumps_at(place, event, k):
            raise _graze(event, place.t)


def _jumps_at(here: Place, event: Event, k: int) -> bool:
    """Return whether a zero of function k would change the state or its rate at a place, and depends on the state."""
    states, stepper, name = here.states, here.states.stepper, getattr(event, "mode", None)
    (q,), (p,) = states_at(states, np.array([here.t]))
    moved = _event_values(stepper, 2.0 * q + 1.0, 2.0 * p + 1.0, here.t, here.parameters)[k]
    if name is None or event.is_wall or moved == _event_values(stepper, q, p, here.t, here.parameters)[k]:
        return name is None or event.is_wall
    other, h = here.parameters.copy(), SMALL_STEP**2 * abs(states.h)
    other[stepper.interface.parameters.index(name)] *= -1.0
    by_size = np.eye(stepper._input_size)[-1:]
    sides = (here.parameters, other)
    rates = [stepper._products(q, p, h, here.t, side, states.options, by_size)[0, : 2 * len(q)] for side in sides]
    return bool(np.linalg.norm(rates[1] - rates[0]) > GRAZING * np.linalg.norm(rates[0]))


def _graze(event: Event, t: float) -> StateError:
    return StateError(
        f"the event {event.title} is tangent to the run at t = {t:.17g}: derivatives do not exist at a grazing "
        "crossing, on whose two sides they differ. Change the initial state or a parameter, or end the run before"
    )


def _end_of_part(states: SavedStates, starts: Starts, k: int, row: int) -> Jump:
    """Return the change at the end of a part of a step, whose size is fixed: dh lengthens the last part alone."""
    stepper, size, steps = states.stepper, states.stepper._input_size, abs((states.t[row] - states.t[0]) / states.h)
    matrix, by_size = np.eye(size), np.eye(size)[-1]
    if isinstance(states.plan, FixedSteps) and row + 1 < len(states) and abs(steps - round(steps)) > WHOLE * steps:
        start, t = (starts.q[k - 1], starts.p[k - 1], float(starts.h[k - 1])), float(starts.t[k - 1])
        ends = stepper._products(*start, t, states.parameters_on_sides(t), states.options, by_size[np.newaxis])
        matrix = _moved_back(matrix, ends[0, : 2 * stepper.dimension], by_size)
    return Jump(matrix, np.concatenate([starts.q[k], starts.p[k]]))


def _with_directions(later: Place, matrix: Array, state: Array, before: Array) -> Array:
    """Return the derivative of the variables at a change with that of the directions d = u/|u| that slips then keep.

    The parameters S^2 d and d change by (1 - d d^T) du / |u|; ``before`` are the parameters before the change.
    """
    stepper, (q, p) = later.states.stepper, np.split(state, 2)
    for k, places in _directions(stepper):
        rows, (start, ahead) = [len(state) + place for place in places], later.parameters[places].reshape(2, 2)
        if np.array_equal(before[places], later.parameters[places]):
            continue
        matrix[rows] = 0.0
        if start.any():
            vector = kept_direction(stepper, k, state, later.t, later.parameters)
            by = _differences(vector, later, q, p) @ np.delete(matrix, -1, axis=0)
            turned = (by - np.outer(ahead, ahead @ by)) / np.linalg.norm(vector(q, p, later.t, later.parameters))
            matrix[rows] = np.concatenate([np.linalg.norm(start) * turned, turned])
    return matrix


def _directions(stepper: Integrator) -> list[tuple[int, list[int]]]:
    """Return the contacts with slip in space, and the places of the directions that these keep in the parameters."""
    contacts = enumerate(stepper.interface.contacts)
    return [
        (k, [*map(stepper.interface.parameters.index, item.directions[1:])]) for k, item in contacts if item.slips == 2
    ]


def _changes(states: SavedStates, numbers: NDArray[np.intp]) -> dict[int, tuple[Event, Array]]:
    """Return the event, of entries, and the state before it for each of ``numbers`` at which an event acted."""
    result: dict[int, tuple[Event, Array]] = {}
    for crossings, rows in changes_by_events(states):
        here = (numbers[0] < rows) & (rows <= numbers[-1])
        entry_events = states.stepper._events_of_entries(crossings.event) if here.any() else ()
        entries = (crossings.element[here], crossings.q[here], crossings.p[here])
        for row, element, q, p in zip(rows[here].tolist(), *entries, strict=True):
            if row in result:
                raise StateError(
                    f"the run meets the events {result[row][0].title} and {crossings.event.title} at once at "
                    f"t = {states.t[row]:.17g}: derivatives do not exist in a corner"
                )
            result[row] = entry_events[element], np.concatenate([q, p])
    return result


def _turns(states: SavedStates, numbers: NDArray[np.intp]) -> dict[int, tuple[Event, Array]]:
    """Return the changes between slip in space that keeps its direction and one that does not, as events."""
    result: dict[int, tuple[Event, Array]] = {}
    history = getattr(states, "modes", None)
    if history is None or not np.isin(history.t, states.t).all():
        raise StateError("this requires the states where slips in space change: save all states (save_every=1)")
    for k, places in _directions(states.stepper):
        event = Transition(function="1", contact=k, kind="turns", gap="slip")
        for row in np.searchsorted(states.t, history.t).tolist():
            old, new = (states.parameters_on_sides(float(states.t[n]))[places[:2]] for n in (row - 1, row))
            if numbers[0] < row <= numbers[-1] and not np.array_equal(old, new):
                result[row] = event, np.concatenate([states.q[row], states.p[row]])
    return result


def _jump(
    states: SavedStates, starts: Starts, k: int, row: int, event: Event, before: Array, *, all_inputs: bool
) -> Jump:
    """Return the change of the state at the end of step k - 1 of ``starts``, in a row of the saved states.

    With the module's equation, dz+ = R_x dx + (R_z X- + R_t - X+) dtau, dtau = -g_x dx / (g_z X- + g_t), for
    x = (q, p, parameters, t).
    """
    stepper, options = states.stepper, states.options
    m, size = stepper.dimension, stepper._input_size
    t, after = float(states.t[row]), np.concatenate([states.q[row], states.p[row]])
    sides = (states.parameters_on_sides(time) for time in (float(starts.t[k - 1]), t))
    here, later = (Place(states, t, parameters, all_inputs) for parameters in sides)

    def products(state: Array, h: float, time: float, seeds: Array) -> Array:
        sides = states.parameters_on_sides(time)
        return stepper._products(state[:m], state[m:], h, time, sides, options, seeds)[:, : 2 * m].T

    start = np.concatenate([starts.q[k - 1], starts.p[k - 1]])
    arrival = products(start, float(starts.h[k - 1]), float(starts.t[k - 1]), np.eye(size)[-1:])[:, 0]
    at_end = row + 1 == len(states)
    h = SMALL_STEP * states.forward * abs(states.h) if at_end else float(steps_after(states, row, row + 1)[0])
    # the change divides a step of fixed size if the part after or before it is shorter than h
    short = abs(h) < (1.0 - WHOLE) * abs(states.h) or abs(starts.h[k - 1]) < WHOLE * abs(states.h)
    divided = float(not at_end and isinstance(states.plan, FixedSteps) and short)
    # a start moved along the flow has the same end: Phi(z + X+ s, t + s, h - s) = Phi(z, t, h), hence
    # Phi_z X+ = Phi_h - Phi_t, solved for X+ = departure + basis y
    step = products(after, h, t, np.eye(size))
    # tangent vectors are admissible: departure + the range of the derivative of the projection
    onto = _projection(later._replace(all_inputs=False), after)[1]
    directions, sizes, _ = np.linalg.svd(onto[:, : 2 * m])
    departure, basis = onto[:, -1], directions[:, sizes > ADMISSIBLE]
    moved = step[:, -1] - step[:, -2] - step[:, : 2 * m] @ departure
    departure = departure + basis @ np.linalg.lstsq(step[:, : 2 * m] @ basis, moved)[0]
    # dh of a divided step is added to both of its parts, but lengthens only the second: without that of the first,
    # which the crossing makes X+ dh, and without its dt = dh
    back, matrix = divided * np.eye(size)[-1], np.eye(size)
    if type(event) is Kink and np.linalg.norm(departure - arrival) <= CONTINUOUS * np.linalg.norm(arrival):
        return Jump(_moved_back(matrix, departure, back), before)
    values, rate = _crossing(here, event, (before, after), later.parameters, arrival)
    gradient = np.concatenate([values.gradient, np.zeros(1)])
    if event.is_wall:
        change = _impact(here, later, values, before, after)
    elif isinstance(event, Transition):
        change = values.map
    else:
        projected_state, by = _projection(later, values.value)
        if np.linalg.norm(projected_state - after) > SAME_STATE * np.linalg.norm(after):
            raise StateError(
                f"{event.title} at t = {t:.17g} with impacts of contacts, or one without collision: derivatives "
                "through them are not available"
            )
        change = by[:, : 2 * m] @ values.map
        change[:, 2 * m :] += by[:, 2 * m :]
    crossing_time = -gradient / rate  # dtau = crossing_time (dx, dh)
    matrix[: 2 * m] = np.outer(change[:, : 2 * m] @ arrival + change[:, -1], crossing_time)
    matrix[: 2 * m, :-1] += change
    matrix[-2] += crossing_time
    matrix = _with_directions(later, matrix, after, here.parameters)
    return Jump(_moved_back(matrix, departure, back + crossing_time), before)


def _moved_back(matrix: Array, departure: Array, time: Array) -> Array:
    """Return the derivative of the variables before a time along the flow, by that after it."""
    matrix[: len(departure)] -= np.outer(departure, time)
    matrix[-2] -= time
    return matrix


class Values(NamedTuple):
    """Derivatives of an event by x = (q, p, parameters, t).

    Attributes:
        gradient: (x,) of g.
        map: (2m, x) of the new state; of an impact those of g_q, g_t and e, (m + 2, x).
        value: (2m,) new state; of an impact (m + 2,) g_q, g_t and e.
    """

    gradient: Array
    map: Array
    value: Array


def _crossing(
    here: Place, event: Event, ends: tuple[Array, Array], new_parameters: Array, arrival: Array
) -> tuple[Values, float]:
    """Return the derivatives of an event between two states, and its rate where that of the state is ``arrival``."""
    size, values = len(arrival), None
    if isinstance(event, Transition):
        values = _at_transition(here, event, ends, new_parameters)
    states, t = here.states, here.t
    if values is None:
        formulas = _derivatives(states.stepper.known.interface, event)
        values = formulas(ends[0], t, here.parameters) if formulas else _of_velocities(here, event, ends[0])
    rate = values.gradient[:size] @ arrival + values.gradient[-1]
    steepest, least = np.linalg.norm(values.gradient[:size]) * np.linalg.norm(arrival), GRAZING
    if isinstance(event, Transition) and not _rises(here, event, ends[0]):
        # gradients by momenta, of multipliers, have another size
        typical = np.abs(np.diff(np.hstack([states.q, states.p]), axis=0)).mean(axis=0) / np.diff(states.t).mean()
        steepest = np.abs(values.gradient[:size]) @ np.maximum(np.abs(arrival), typical)
        least = GRAZING_IMPACT if event.kind == "closes" else GRAZING
    if not abs(rate) > least * (steepest + abs(values.gradient[-1])):
        raise _graze(event, t)
    return values, float(rate)


def _rises(here: Place, event: Transition, state: Array) -> bool:
    """Return whether a contact closes that would open without forces, of a motion that passes by."""
    stepper = here.states.stepper
    normal = stepper.interface.contacts[event.contact].normal
    return event.kind == "closes" and bool(Rows.at(stepper, state, here.t, here.parameters).second[normal] > 0.0)


@lru_cache(maxsize=64)
def _derivatives(interface: Interface, event: Event) -> Callable[[Array, float, Array], Values] | None:
    """Return a function of (q, p), t and parameters, derivatives of an event; ``None`` where it contains velocities."""
    import sympy  # here: slow to import, with the modules that use it

    from scvi_codegen.codegen.rendering.events import EventFormulas
    from scvi_codegen.systems.formulas.symbols import TIME, symbol

    formulas = EventFormulas(interface, (event,))
    ((indices, values),) = formulas.changes
    z, time = (*formulas.q, *formulas.p), symbol(TIME)
    variables = (*z, *formulas.parameters, time)
    new = dict(zip(indices, values, strict=True))
    symbols = set[Any]().union(*(formula.free_symbols for formula in (*formulas.functions, *values)))
    if symbols & {*formulas.multipliers}:
        raise StateError(
            f"derivatives through the event {event.title} require formulas without multipliers: state the constraint "
            "force as a formula of positions, velocities and time"
        )
    if symbols & {*formulas.v} or any(index >= len(z) for index in indices):
        return None
    mapped = list(values) if event.is_wall else [new.get(k, unchanged) for k, unchanged in enumerate(z)]
    entries = [formulas.functions[0].diff(x) for x in variables]
    entries += [value.diff(x) for value in mapped for x in variables]
    function = sympy.lambdify((variables,), [*entries, *mapped], cse=True)
    count = len(variables)

    def evaluate(state: Array, t: float, parameters: Array) -> Values:
        numbers = np.array(function([*state, *parameters, t]), dtype=float)
        rest = numbers[count : len(entries)].reshape(len(mapped), count)
        return Values(numbers[:count], rest, numbers[len(entries) :])

    return evaluate


def _at_transition(here: Place, event: Transition, ends: tuple[Array, Array], new_parameters: Array) -> Values:
    """Return the derivatives of a transition of a contact, by differences of sixth order."""
    stepper = here.states.stepper
    if event.kind == "turns":
        slip, (q, p) = slip_of(stepper, event.contact), np.split(ends[0], 2)
        gradient = slip(q, p, here.t, here.parameters) @ _differences(slip, here, q, p)
        return Values(gradient, np.eye(len(ends[0]), len(gradient)), ends[0])
    number = _number(stepper, event)
    largest = np.abs(np.asarray(here.states.p)).max(axis=0)
    change = change_at(stepper, event, *ends, here.t, (here.parameters, new_parameters), largest)

    def mapped(q: Array, p: Array, t: float, parameters: Array) -> Array:
        """Return the function of the transition, and the state after it."""
        values = _event_values(stepper, q, p, t, parameters)
        return np.append(values[number], change(q, p, t, parameters))

    by = _differences(mapped, here, *np.split(ends[0], 2))
    return Values(by[0], by[1:], ends[1])


def _event_values(stepper: Integrator, q: Array, p: Array, t: float, parameters: Array) -> Array:
    """Return the functions of all entries of events, then of transitions and kinks."""
    binding, count = stepper.binding, sum(len(stepper._events_of_entries(own)) - 1 for own in stepper.events)
    values = np.zeros(count + len(stepper.searched))
    blocks = [binding.pointer(np.ascontiguousarray(part)) for part in (q, p, parameters)]
    if status := binding.function("event_values")(t, *blocks, binding.pointer(values), binding.workspace()):
        raise StateError(f"the functions of events at t = {t:.17g} are undefined: {REASONS[status]}")
    return values


def _number(stepper: Integrator, event: Event) -> int:
    """Return the index of a transition or kink among all functions."""
    entries = sum(len(stepper._events_of_entries(own)) - 1 for own in stepper.events)
    return entries + stepper.searched.index(event)


@lru_cache(maxsize=64)
def _formulas(interface: Interface, event: Event) -> tuple[Callable[..., list[float]], list[int]]:
    """Return a function of (q, p, v), parameters and t, [g, new values], and the places of these in (q, p, v)."""
    import sympy

    from scvi_codegen.codegen.rendering.events import EventFormulas
    from scvi_codegen.systems.formulas.symbols import TIME, symbol

    formulas = EventFormulas(interface, (event,))
    ((indices, values),) = formulas.changes
    variables = (*formulas.q, *formulas.p, *formulas.v, *formulas.parameters, symbol(TIME))
    return sympy.lambdify((variables,), [formulas.functions[0], *values], cse=True), list(indices)


def _of_velocities(here: Place, event: Event, before: Array) -> Values:
    """Return the derivatives of an event whose formulas contain velocities, by differences of sixth order.

    A new velocity sets the momenta to those of the new position and of all velocities, the others unchanged.
    """
    stepper, m = here.states.stepper, len(before) // 2
    function, indices = _formulas(stepper.known.interface, event)

    def mapped(q: Array, p: Array, t: float, parameters: Array) -> Array:
        """Return g and the new state; of an impact g, g_q, g_t and e."""
        state = np.concatenate([q, p, np.asarray(stepper.velocity(q, p, t, parameters))])
        g, *new = function([*state, *parameters, t])
        if event.is_wall:
            return np.array([g, *new])
        state[indices] = new
        if max(indices, default=0) >= 2 * m:
            state[m : 2 * m] = stepper.momentum(state[:m], state[2 * m :], t, parameters)
        return np.append(g, state[: 2 * m])

    q, p = np.split(before, 2)
    by, value = _differences(mapped, here, q, p), mapped(q, p, here.t, here.parameters)
    return Values(by[0], by[1:], value[1:])


def _impact(here: Place, later: Place, values: Values, before: Array, after: Array) -> Array:
    """Return the (2m, x) derivative of the state after an impact or a refraction by x = (q, p, parameters, t).

    With n = g_q, u = p + lambda n and p1 = P(q, u), F = H1(q, p1) - H(q, p) + lambda g_t - (p1 - u).v1 = 0 gives
    lambda_x = -F_x / F_lambda; the last term is the work of moving constraints. Its root lambda_1 is the impulse
    without loss, that of restitution e is lambda = lambda_1 (1 + e) / 2. The terms v1.p1_x and v1.p1_lambda cancel:

        F_x = lambda (v1.n_x + g_tx) + (v1 - v0).p_x + (H1(q, p1) - H(q, p))_x - (p1 - u).v1_x,
        F_lambda = v1.n + g_t - (p1 - u).v1_lambda,

    where H is differentiated at fixed momenta. H1 and P are those of the side after a refraction, whose e is 1.
    """
    stepper, t = here.states.stepper, here.t
    m, count = stepper.dimension, values.gradient.size
    n, e, e_by, (q, p) = values.value[:m], values.value[m + 1], values.map[m + 1], np.split(before, 2)
    if here.states.forward < 0.0:  # a run backward in time undoes the impact
        e, e_by = 1.0 / e, -e_by / e**2
    # P_u maps G^T mu to 0, and the change of p, lambda n + G^T mu, to lambda P_u n
    onto = _projection(later._replace(all_inputs=False), after)[1][m:, m : 2 * m]
    impulse = float((onto @ (after - before)[m:]) @ (onto @ n) / ((onto @ n) @ (onto @ n)))
    full = 2.0 * impulse / (1.0 + e)

    def changed(impulse: float) -> tuple[Array, Array, Array]:
        """Return P(q, p + lambda n), its derivative by x at constant lambda, and by lambda."""
        state, by = _projection(later, np.concatenate([q, p + impulse * n]))
        onto = by[m:, m : 2 * m]
        return state[m:], by[m:] + impulse * onto @ values.map[:m], onto @ n

    p1, p1_by, p1_by_impulse = changed(full)
    ends = [(p, here.parameters), (p1, later.parameters)]
    v0, v1 = (np.asarray(stepper.velocity(q, momenta, t, parameters)) for momenta, parameters in ends)
    residual = full * (v1 @ values.map[:m] + values.map[m])
    residual[m : 2 * m] += v1 - v0
    residual += _energy_differences(here, q, ends)
    residual_by_impulse = n @ v1 + values.value[m]
    if stepper.constraints:
        work = (p1 - p - full * n) @ _differences(stepper.velocity, later, q, p1)
        by_momentum = work[m : 2 * m].copy()
        work[m : 2 * m] = 0.0
        residual -= work + by_momentum @ p1_by
        residual_by_impulse -= by_momentum @ p1_by_impulse
    # lambda_x = (lambda_1 e_x + (1 + e) lambda_1x) / 2
    impulse_by = 0.5 * (full * e_by - (1.0 + e) * residual / residual_by_impulse)
    _, by, by_impulse = changed(impulse)
    return np.vstack([np.eye(m, count), by + np.outer(by_impulse, impulse_by)])


def _projection(here: Place, state: Array) -> tuple[Array, Array]:
    """Return the projection of a state onto the constraints, and its (2m, x) derivative; without constraints 1."""
    stepper, t, parameters = here.states.stepper, here.t, here.parameters
    if not stepper.constraints:
        return state, np.eye(len(state), len(state) + len(parameters) + 1)

    def onto(q: Array, p: Array, t: float, values: Array) -> Array:
        return np.concatenate(projected(stepper, q, p, t, values)[:2])

    q, p = np.split(state, 2)
    return onto(q, p, t, parameters), _differences(onto, here, q, p)


def _differences(function: Callable[[Array, Array, float, Array], Array], here: Place, q: Array, p: Array) -> Array:
    """Return the (.., x) derivative of a function of q, p, t and parameters by differences of sixth order.

    Momenta change relative to the largest of the run in units of the roots of masses. Modes are held fixed.
    """
    states, t, parameters, all_inputs = here
    m, stepper = len(q), states.stepper
    x, moved = np.concatenate([q, p, parameters, [t]]), _increments(states)
    steps, roots = DIFFERENCE * np.where(x == 0.0, 1.0, np.abs(x)), roots_of_masses(stepper, q, t, parameters)
    steps[:m], steps[-1] = moved[:-1], moved[-1]
    steps[m : 2 * m] = DIFFERENCE * roots * (np.abs(np.asarray(states.p) / roots).max() or 1.0)
    columns = np.zeros((len(x), len(function(q, p, t, parameters))))
    fixed = {2 * m + column for column in stepper.mode_columns}
    varied = [k for k in range(2 * m, len(x) - 1) if k not in fixed] if all_inputs else []
    for k in (*range(2 * m), *varied, -1):
        step, values = steps[k], np.tile(x, (len(PLACES), 1))
        values[:, k] += step * PLACES
        at = [np.asarray(function(y[:m], y[m : 2 * m], float(y[-1]), y[2 * m : -1])) for y in values]
        columns[k] = _central_differences(np.stack(at, axis=-1)) / step
    return columns.T


def _increments(states: SavedStates) -> Array:
    """Return the (m + 1,) increments of q and t, which do not depend on their origins, as windings of angles do."""
    by_q, by_t = (np.abs(np.diff(np.asarray(x), axis=0)).mean(axis=0) for x in (states.q, states.t))
    return np.append(np.maximum(DIFFERENCE, OF_STEP * by_q), OF_STEP * by_t)


def _energy_differences(here: Place, q: Array, ends: list[tuple[Array, Array]]) -> Array:
    """Return the derivatives of H1(q, p1) - H(q, p) at fixed momenta by x = (q, p, parameters, t), 0 by p."""
    states, t, parameters, all_inputs = here
    stepper, m = states.stepper, len(q)
    result = np.zeros(2 * m + len(parameters) + 1)
    x, steps = np.append(q, t), _increments(states)
    shifted = (x + (np.diag(steps)[:, np.newaxis] * PLACES[:, np.newaxis])).reshape(-1, m + 1)

    def difference(changes: Array | float) -> Array:
        first, last = (
            stepper.energy(shifted[:, :m], np.tile(p, (len(shifted), 1)), shifted[:, m], values + changes)
            for p, values in ends
        )
        return np.asarray(last - first)

    partials = _central_differences(difference(0.0).reshape(m + 1, -1)) / steps
    result[:m], result[-1] = partials[:m], partials[m]
    shifted = x[np.newaxis]
    for k in range(len(parameters) if all_inputs else 0):
        step = DIFFERENCE * max(1.0, abs(parameters[k]))
        sides = [place * step * (np.arange(len(parameters)) == k) for place in PLACES]
        result[2 * m + k] = _central_differences(np.concatenate([difference(side) for side in sides])) / step
    return result


def _central_differences(values: Array) -> Array:
    """Return the sixth-order differences of values at ``PLACES``, exactly 0 if these are equal."""
    return np.asarray((values[..., :2:-1] - values[..., :3]) @ WEIGHTS)
