"""Derivatives through events that change the state: saltation matrices.

The crossing of g(z, t) = 0, z = (q, p), at which z becomes R(z, t), moves by dtau = -(g_z dz + g_t dt) / rate with the
initial data, rate = g_z X- + g_t. At a fixed time after it

    dz+ = R_z (dz + X- dtau) + R_t (dt + dtau) - X+ dtau,

where X- and X+ are the rates of the computed flow: the derivatives of the steps before and after the crossing with
respect to their sizes, so that the result is the derivative of the computed run (Aizerman & Gantmacher, Q. J. Mech.
Appl. Math. 11 (1958) 243). The impulse lambda_1 of an impact is differentiated through its energy equation.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.events.array_events import events_of_entries
from scvi_codegen.runtime.events.event import Event

if TYPE_CHECKING:
    from scvi_codegen.runtime.sensitivity.step_derivatives import Starts
    from scvi_codegen.runtime.trajectory.saved_states import SavedStates

GRAZING = 2.0**-20
"""Smallest rate of an event function relative to its gradient and the flow; below it rounding dominates 1/rate."""
SMALL_STEP = 2.0**-30
"""Fraction of a step from which the rate of the flow at a last state is computed."""
DIFFERENCE = 2.0**-7
"""Relative increment of differences of sixth order of the energy."""
WEIGHTS = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60.0
PLACES = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])


class Jump(NamedTuple):
    """Linear map of the variables (q, p, parameters, t, h) at a change of the state, and the state (2m,) before it."""

    matrix: Array
    before: Array


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
        StateError: if states within steps were not saved, if several events change the state at once, if a crossing
            grazes, or for a run backward in time.
    """
    changes = _changes(states, numbers)
    rows = [(k, row) for k, row in enumerate(numbers.tolist()) if k and row in changes]
    return {k: _jump(states, starts, k, row, *changes[row], all_inputs=all_inputs) for k, row in rows}


def _changes(states: SavedStates, numbers: NDArray[np.intp]) -> dict[int, tuple[Event, Array]]:
    """Return the event and the state before it for each of the saved states ``numbers`` at which an event acted."""
    result: dict[int, tuple[Event, Array]] = {}
    span = states.t[[numbers[0], numbers[-1]]]
    for crossings in getattr(states, "events", ()):
        if not crossings.event.changes_state:
            continue
        if states.forward < 0.0:
            raise StateError("derivatives through events that change the state require a run forward in time")
        if states.stepper.constraints or states.stepper.interface.time_transformation:
            raise StateError(
                "derivatives through events that change the state are not available with constraints, onto which the "
                "new state is projected, and with a time transformation: use free coordinates and other steps"
            )
        here = slice(*np.searchsorted(crossings.t, span, side="right").tolist())
        rows = np.searchsorted(states.t, crossings.t[here])
        if not np.array_equal(states.t[rows], crossings.t[here]):
            raise StateError(
                "derivatives through events that change the state require all states: integrate with save_every=1 and "
                "without t_eval"
            )
        for row, q, p in zip(rows.tolist(), np.asarray(crossings.q)[here], np.asarray(crossings.p)[here], strict=True):
            if row in result:
                raise StateError(
                    f"the run meets the events '{result[row][0].function}' and '{crossings.event.function}' at once at "
                    f"t = {states.t[row]:.17g}: derivatives do not exist in a corner"
                )
            result[row] = crossings.event, np.concatenate([q, p])
    return result


def _jump(
    states: SavedStates, starts: Starts, k: int, row: int, event: Event, before: Array, *, all_inputs: bool
) -> Jump:
    """Return the change of the state at the end of step k - 1 of ``starts``, in a row of the saved states."""
    stepper, parameters, options = states.stepper, states.parameters, states.options
    m, size = stepper.dimension, stepper._input_size
    t, after = float(states.t[row]), np.concatenate([states.q[row], states.p[row]])

    def products(state: Array, h: float, time: float, seeds: Array) -> Array:
        return stepper._products(state[:m], state[m:], h, time, parameters, options, seeds)[:, : 2 * m].T

    size_seed = np.eye(size)[-1:]
    start = np.concatenate([starts.q[k - 1], starts.p[k - 1]])
    arrival = products(start, float(starts.h[k - 1]), float(starts.t[k - 1]), size_seed)[:, 0]
    if row + 1 < len(states):
        h = float(states.t[row + 1] - t)
        step = products(after, h, t, np.eye(size))
        departure = np.linalg.solve(step[:, : 2 * m], step[:, -1] - step[:, -2])
    else:
        h = SMALL_STEP * float(starts.h[k - 1])
        departure = 0.5 * (products(after, h, t, size_seed) + products(after, -h, t, size_seed))[:, 0]
    formulas = event  # in the names of the coordinates of known sizes
    if stepper.origin is not None and stepper.problem is not None:
        (formulas,) = events_of_entries(stepper.origin.interface, stepper.problem, (event,))
    values = _derivatives(stepper.known.interface, formulas)(before, t, parameters)
    gradient = np.concatenate([values.gradient, np.zeros(1)])
    rate = values.gradient[: 2 * m] @ arrival + values.gradient[-1]
    steepest = np.linalg.norm(values.gradient[: 2 * m]) * np.linalg.norm(arrival) + abs(values.gradient[-1])
    if not abs(rate) > GRAZING * steepest:
        raise StateError(
            f"the event '{event.function}' is tangent to the run at t = {t:.17g}: derivatives do not exist at a "
            "grazing crossing"
        )
    change = values.map if event.restitution is None else _impact(states, event, values, before, after, t, all_inputs)
    shift = -gradient / rate
    matrix = np.eye(size)
    matrix[: 2 * m] = np.concatenate([change, np.zeros((2 * m, 1))], axis=1)
    matrix[: 2 * m] += np.outer(change[:, : 2 * m] @ arrival + change[:, -1] - departure, shift)
    return Jump(matrix, before)


class Values(NamedTuple):
    """Derivatives of an event by x = (q, p, parameters, t).

    Attributes:
        gradient: (x,) of g.
        map: (2m, x) of the new state; of an impact those of g_q, g_t and e, (m + 2, x).
        normal: (m + 2,) g_q, g_t and e of an impact.
    """

    gradient: Array
    map: Array
    normal: Array


@lru_cache(maxsize=64)
def _derivatives(interface: Interface, event: Event) -> Callable[[Array, float, Array], Values]:
    """Return a function of (q, p), t and parameters that computes the derivatives of an event."""
    import sympy  # here: slow to import, with the modules that use it

    from scvi_codegen.formulas.symbols import TIME, symbol
    from scvi_codegen.rendering.events import EventFormulas

    formulas = EventFormulas(interface, (event,))
    ((indices, values),) = formulas.changes
    z, time = (*formulas.q, *formulas.p), symbol(TIME)
    variables = (*z, *formulas.parameters, time)
    new = dict(zip(indices, values, strict=True))
    if any(index >= len(z) for index in indices) or any(
        each.free_symbols.intersection(formulas.v) for each in (*formulas.functions, *values)
    ):
        raise StateError(
            f"derivatives through the event '{event.function}' require momenta instead of velocities in its formulas"
        )
    normal = list(values) if event.restitution is not None else []
    mapped = normal or [new.get(k, each) for k, each in enumerate(z)]
    entries = [formulas.functions[0].diff(x) for x in variables]
    entries += [value.diff(x) for value in mapped for x in variables]
    function = sympy.lambdify((variables,), [*entries, *normal], cse=True)
    count = len(variables)

    def evaluate(state: Array, t: float, parameters: Array) -> Values:
        numbers = np.array(function([*state, *parameters, t]), dtype=float)
        rest = numbers[count : len(entries)].reshape(len(mapped), count)
        return Values(numbers[:count], rest, numbers[len(entries) :])

    return evaluate


def _impact(
    states: SavedStates, event: Event, values: Values, before: Array, after: Array, t: float, all_inputs: bool
) -> Array:
    """Return the (2m, x) derivative of the state after an impact by x = (q, p, parameters, t).

    F = H(q, p + lambda n) - H(q, p) + lambda g_t = 0 gives lambda_x = -F_x / F_lambda.
    """
    stepper, parameters = states.stepper, states.parameters
    m, count = stepper.dimension, values.gradient.size
    n, e = values.normal[:m], values.normal[m + 1]
    impulse = (after - before)[m:] @ n / (n @ n)
    full = 2.0 * impulse / (1.0 + e)
    q, p = before[:m], before[m:]
    ends = p, p + full * n
    v0, v1 = (np.asarray(stepper.velocity(q, each, t, parameters)) for each in ends)
    residual = full * (v1 @ values.map[:m] + values.map[m])
    residual[m : 2 * m] += v1 - v0
    residual += _energy_differences(states, q, ends, t, all_inputs)
    by = -residual / (n @ v1 + values.normal[m])
    total = 0.5 * ((1.0 + e) * by + full * values.map[m + 1])
    change = np.zeros((2 * m, count))
    change[:, : 2 * m] = np.eye(2 * m)
    change[m:] += np.outer(n, total) + impulse * values.map[:m]
    return change


def _energy_differences(states: SavedStates, q: Array, ends: tuple[Array, Array], t: float, all_inputs: bool) -> Array:
    """Return the derivatives of H(q, p1) - H(q, p0) at fixed momenta by x = (q, p, parameters, t), 0 by p."""
    stepper, parameters, m = states.stepper, states.parameters, len(q)
    result = np.zeros(2 * m + len(parameters) + 1)
    x = np.append(q, t)
    steps = DIFFERENCE * np.maximum(1.0, np.abs(x))
    shifted = (x + (np.diag(steps)[:, np.newaxis] * PLACES[:, np.newaxis])).reshape(-1, m + 1)

    def difference(values: Array) -> Array:
        first, last = (
            stepper.energy(shifted[:, :m], np.tile(p, (len(shifted), 1)), shifted[:, m], values) for p in ends
        )
        return np.asarray(last - first)

    partials = difference(parameters).reshape(m + 1, -1) @ WEIGHTS / steps
    result[:m], result[-1] = partials[:m], partials[m]
    shifted = x[np.newaxis]
    for k in range(len(parameters) if all_inputs else 0):
        step = DIFFERENCE * max(1.0, abs(parameters[k]))
        sides = [parameters + place * step * (np.arange(len(parameters)) == k) for place in PLACES]
        result[2 * m + k] = np.concatenate([difference(each) for each in sides]) @ WEIGHTS / step
    return result
