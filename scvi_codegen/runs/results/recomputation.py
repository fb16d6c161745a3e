"""Recomputation of the steps of a run from its saved states (checkpoint replay), for data that a run does not store.

Newton's iteration solves the steps again, from a linear initial guess. It may converge to another root of the stage
equations; recomputed steps that do not end in the next saved state raise an error.
"""

from collections.abc import Iterator
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import ScviCodegenError, StateError
from scvi_codegen.runs.results.dense_output import whole_steps
from scvi_codegen.runs.results.saved_states import ROUNDINGS, STEP_END_TOLERANCE, Array, SavedStates
from scvi_codegen.runs.stepping.projection import linearised, multipliers
from scvi_codegen.runs.stepping.step_plan import FixedSteps
from scvi_codegen.systems.event import Crossings, Event, Transition

REACTIONS = 4
"""Number of states of a run whose constraint forces are computed."""
SAME_TIME = 4 * float(np.finfo(float).eps)
"""Largest difference of times that are equal, relative to the largest one."""
SAME_STATE = 1e-6
"""Largest deviation of a recomputed state, relative to its largest entry; other roots are further away."""


def work_and_impulses_until(states: SavedStates) -> Array:
    """Return (n, 1 + k) work of the forces from the first state to each, and their impulses on the momentum maps."""
    stepper = states.stepper
    values = [np.zeros(1)]  # of the first state; the number of impulses of arrays is known after a step
    ends = ends_of_steps(states)
    spans = steps_after(states, 0, len(states) - 1).tolist()
    for k, (start, length, span) in enumerate(
        zip(states.t[:-1].tolist(), states.step_sizes[:-1].tolist(), spans, strict=True)
    ):
        count, q, p = steps_between(length, span), states.q[k], states.p[k]
        total = values[-1]
        step = partial(stepper.work_and_impulses, parameters=states.parameters_on_sides(start), options=states.options)
        for j in range(count):
            q, p, output = step(q, p, length if count > 1 else span, start + j * length)
            total = total + output
        values.append(total)
        recomputed = np.concatenate([q, p])[np.newaxis]
        check_recomputed(states, states.t[k : k + 1], recomputed, ends[k + 1 : k + 2], ends[k : k + 1])
    values[0] = np.zeros_like(values[-1])
    return np.array(values)


def ends_of_steps(states: SavedStates) -> Array:
    """Return (n, 2m) saved states, those after changes by events as they were before."""
    ends = np.concatenate([states.q, states.p], axis=1)
    for crossings, rows in changes_by_events(states):
        ends[rows] = np.concatenate([crossings.q, crossings.p], axis=1)
    return ends


def changes_by_events(states: SavedStates) -> Iterator[tuple[Crossings, NDArray[np.intp]]]:
    """Yield the crossings of each event that changes the state, and the rows of the states after them."""
    t, transitions = states.forward * states.t, getattr(states, "transitions", ())
    if states.stepper.interface.contacts and (not transitions or states.stepper.by_steps):
        raise StateError("this requires the located transitions of contacts, which only integrate(..) stores")
    for crossings in (*getattr(states, "events", ()), *transitions):
        times = _times_of_rows(t, states.forward * crossings.t)
        here = (t[0] <= times) & (times <= t[-1])
        rows = np.searchsorted(t, times[here])
        inside = crossings.chosen(here)
        # the time of a crossing near the end of a step is that of two states: the first may be the one before it
        after, (q, p) = np.minimum(rows + 1, len(t) - 1), (np.asarray(state) for state in (inside.q, inside.p))
        apart = [np.abs(states.q[k] - q).sum(axis=1) + np.abs(states.p[k] - p).sum(axis=1) for k in (rows, after)]
        rows = np.where((t[after] == times[here]) & (apart[0] < 0.5 * apart[1]), after, rows)
        if crossings.event.changes_state:
            if not np.array_equal(t[rows], times[here]):
                raise StateError("this requires the states after changes by events: save all states (save_every=1)")
            if np.isnan(np.asarray(inside.q)).any():
                raise StateError("this requires the states of crossings, which exceed 1 GiB: integrate in parts")
            yield inside, rows


def _times_of_rows(t: Array, times: Array) -> Array:
    """Return times of crossings, those that differ by rounding from the end of a step as that of its row."""
    row = np.searchsorted(t, times)
    before, after = t[np.maximum(row - 1, 0)], t[np.minimum(row, len(t) - 1)]
    nearest = np.where(np.abs(before - times) < np.abs(after - times), before, after)
    return np.where(np.abs(nearest - times) <= SAME_TIME * np.abs(t).max(), nearest, times)


def steps_after(states: SavedStates, first: int, last: int) -> Array:
    """Return the sizes of the steps from saved states to the next ones: as taken, or the differences of times.

    Times are rounded; a crossing can be closer than that to the end of a step.
    """
    spans, lengths = np.diff(states.stepped[first : last + 1]), states.step_sizes[first:last]
    rounding = ROUNDINGS * np.finfo(float).eps * np.abs(states.stepped[first + 1 : last + 1])
    return np.where(np.abs(spans - lengths) < FixedSteps.SAME * np.abs(lengths) + rounding, lengths, spans)


def steps_between(length: float, span: float) -> int:
    """Return the number of steps in a span; 1 for a last, shorter step."""
    if np.isnan(length):
        raise StateError("this requires states at whole steps: integrate without t_eval and with save_every=1")
    count = int(whole_steps(np.array([span]), np.array([length]), slack=STEP_END_TOLERANCE)[0])
    if count > 1 and abs(span - count * length) > STEP_END_TOLERANCE * abs(length):
        raise StateError("this requires states at whole steps: save all states (save_every=1)")
    return max(1, count)


def check_recomputed(states: SavedStates, t: Array, recomputed: Array, saved: Array, before: Array) -> None:
    """Raise :class:`StateError` for the first of n recomputed steps that converged to a spurious root.

    Deviations are relative to the largest entry of a state, since entries that are 0 contain only rounding errors, and
    to impulses of constraint forces: at rest these cancel others, whose rounding errors remain.

    Args:
        states: the run.
        t: (n,) start times of the steps.
        recomputed, saved: (n, 2m) recomputed and saved states at their ends.
        before: (n, 2m) states at their starts.
    """
    apart = recomputed - saved
    lengths = (np.einsum("ij,ij->i", x, x) for x in (apart, saved))
    near = np.less(saved.shape[1] * next(lengths), SAME_STATE**2 * next(lengths))  # sufficient, cheaper than maxima
    rows = np.flatnonzero(~near)
    sizes = np.maximum(np.abs(saved[rows]).max(axis=1), np.abs(before[rows]).max(axis=1))
    deviating = rows[~(np.abs(apart[rows]).max(axis=1) <= SAME_STATE * sizes)]
    differences = zip(np.abs(apart[deviating]).max(axis=1), t[deviating].tolist(), saved[deviating], strict=True)
    deviating = deviating[[not size <= SAME_STATE * _largest_impulse(states, *at) for size, *at in differences]]
    if deviating.size:
        raise StateError(
            f"the steps from t = {t[deviating[0]]:g}, computed again, end in another state than in the run: the stage "
            "equations have several solutions (use a smaller step size), or the motion is too sensitive between saved "
            "states (use save_every=1)"
        )


def motion_by_reactions(states: Any, t: Array, q: Array, p: Array) -> Array:
    """Return (2, m) displacements h |M^-1 j| and impulses |j| by the forces of constraints and contacts in a step.

    j = h G^T lambda in the longest step h of a run, the largest of ``REACTIONS`` states (n, m). At rest these forces
    cancel others, whose rounding errors remain: a motion is one if it is above the rounding of these.
    """
    stepper, result = states.stepper, np.zeros((2, np.shape(q)[1]))
    if not stepper.constraints:
        return result
    longest = np.fmax.reduce(np.abs(states.step_sizes), initial=0.0)
    for k in range(0, len(t), -(-len(t) // REACTIONS)):
        with suppress(StateError), np.errstate(all="ignore"):  # constraints that are dependent
            at = float(t[k])
            parameters = states.parameters_on_sides(at)
            impulse = longest * (
                multipliers(stepper, q[k], p[k], at, parameters)[0] @ linearised(stepper, at, parameters)(q[k])[1]
            )
            rates = [stepper.velocity(q[k], x, at, parameters) for x in (impulse, np.zeros_like(impulse))]
            result = np.fmax(result, np.abs([longest * (rates[0] - rates[1]), impulse]))
    return result


def _largest_impulse(states: SavedStates, t: float, state: Array) -> float:
    """Return the largest impulse of constraint forces in a step of a run at a state."""
    q, p = np.split(state[np.newaxis], 2, axis=1)
    return float(motion_by_reactions(states, np.array([t]), q, p)[1].max())


def work_until(states: SavedStates) -> Array:
    """Return (n,) work of forces and contacts from the first state to each; raises as ``work_and_impulses_until``."""
    interface = states.stepper.interface
    if not interface.contacts:
        return work_and_impulses_until(states)[:, 0]
    impacts = _exchanged_at_events(states, states.energy(), by_contacts=True)  # type: ignore[attr-defined]
    return impacts + work_and_impulses_until(states)[:, 0] if interface.exchange_names else impacts


class BeforeChange(NamedTuple):
    """State before the changes at a time, with its energy, and the events that change it."""

    t: float
    q: Array
    p: Array
    energy: float
    events: tuple[Event, ...]


def before_changes(states: SavedStates, energy: Array) -> dict[int, BeforeChange]:
    """Return by row of the saved state after changes that before the first one, with the energy of the row before."""
    result: dict[int, BeforeChange] = {}
    for crossings, rows in changes_by_events(states):
        for row, q, p, t in zip(rows.tolist(), crossings.q, crossings.p, crossings.t.tolist(), strict=True):
            value = states.stepper.energy(q, p, t, states.parameters_on_sides(float(states.t[row - 1])))
            now, other = BeforeChange(t, q, p, value, (crossings.event,)), result.get(row)
            if other is not None:
                later = abs(value - energy[row - 1]) >= abs(other.energy - energy[row - 1])  # NaN: no
                now = (other if later else now)._replace(events=(*other.events, crossings.event))
            result[row] = now
    return result


def _exchanged_at_events(states: SavedStates, energy: Array, *, by_contacts: bool) -> Array:
    """Return (n,) energy exchanged until each state at transitions of contacts, or at other events."""
    changes = np.zeros_like(energy)
    for row, before in before_changes(states, energy).items():
        if by_contacts == any(isinstance(event, Transition) for event in before.events) and np.isfinite(before.energy):
            changes[row] = energy[row] - before.energy
    total: Array = np.cumsum(changes)
    return total


def exchanged_energy(states: Any, energy: Array) -> Array | None:
    """Return (n,) work of forces and energy exchanged at events; ``None`` if the states do not determine it."""
    interface = states.stepper.interface
    if interface.changes_energy and not interface.balances_energy:
        return None
    try:
        total = _exchanged_at_events(states, energy, by_contacts=False)
        return total + states.work() if interface.changes_energy or interface.contacts else total
    except ScviCodegenError:
        return None  # the method or the states do not determine the work, or there is no compiler
