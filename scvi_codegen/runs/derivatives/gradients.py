"""Derivatives of a trajectory with respect to its initial state and parameters: tangent and adjoint propagation.

Derivatives are those of the computed map with step sizes held fixed. They are evaluated from the saved states; steps
between these are recomputed from each saved state to the next (checkpointing), so long runs need little memory.
Recomputed steps are checked against the run.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.representation import summary
from scvi_codegen.runs.derivatives.transformed_derivatives import time_of
from scvi_codegen.runs.events.saltation import Jump, jumps_within
from scvi_codegen.runs.results.recomputation import check_recomputed, steps_after, steps_between
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod, Sensitivity, Starts
from scvi_codegen.runs.stepping.step_plan import FixedSteps

MOST_STEPS = 1024
"""Largest number of steps of a segment processed at once."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Gradient:
    """Gradient of one function, or of c functions, of the states of a run.

    Attributes:
        q, p: (m,) or (m, c) derivatives with respect to the initial state.
        parameters: (k,) or (k, c) with respect to the parameters, in the order of ``stepper.parameters``.
        t: number or (c,) with respect to the initial time, which shifts all times.
        h: number or (c,) with respect to the common step size; ``None`` if step sizes differ, and with inputs.
        inputs: of a run with inputs, by name, (k, 4) or (k, 4, c) derivatives with respect to the coefficients of each
            piece that the run passes, in the order of the run: ascending powers of the time since the start of the
            piece. ``parameters`` is NaN for those of inputs.
    """

    q: Array
    p: Array
    parameters: Array
    t: Array
    h: Array | None
    inputs: dict[str, Array] = field(default_factory=dict)

    __repr__ = summary("q", "p", "parameters")


def tangents_from_directions(stepper: LinearisedMethod, directions: Array) -> Array:
    """Return (k, variables) tangents from directions of (q, p) or (q, p, parameters, t, h); else StateError."""
    size, input_size = 2 * stepper.dimension, stepper._input_size
    if directions.ndim not in (1, 2) or len(directions) not in (size, input_size):
        raise StateError(
            f"directions must have shape ({size},) or ({size}, k), of (q, p), or ({input_size},) or ({input_size}, k), "
            f"of (q, p, parameters, t, h), not {directions.shape}"
        )
    tangents = np.zeros((directions[0].size, input_size))
    tangents[:, : len(directions)] = directions.reshape(len(directions), -1).T
    return tangents


def sensitivity(states: SavedStates) -> Sensitivity:
    """Return the derivatives of all states with respect to all inputs of the run."""
    columns, _ = forward(states, np.eye(states.stepper._input_size))
    result = Sensitivity.of(columns, states.stepper.dimension, stretched=_has_fixed_step_size(states))
    return replace(result, parameters=result.parameters[..., : len(states.stepper.parameters)])  # without modes


def seeds_of(stepper: LinearisedMethod, derivatives: Array) -> Array:
    """Return (n, c, variables) adjoint seeds from (n, 2m) or (n, 2m, c) cotangents; 2m + 1 rows include the time."""
    size = derivatives.shape[1]
    seeds = np.zeros((len(derivatives), derivatives[0].size // size, stepper._input_size))
    seeds[:, :, stepper._output_indices[:size]] = derivatives.reshape(len(derivatives), size, -1).transpose(0, 2, 1)
    return seeds


def backward(states: SavedStates, seeds: Array, now: Array) -> Array:
    """Return (c, variables) adjoints at the start, from the seeds of each state and those ``now`` after the last."""
    time = time_of(states)
    states, by_ends = time.states, time.step_cotangents(seeds)
    for first, last in reversed(list(pieces(states))):
        starts, numbers = starts_of(states, first, last)
        vectors = np.zeros((len(numbers), *now.shape))
        saved = np.flatnonzero(numbers[1:] > 0) + 1
        vectors[saved] = by_ends[numbers[saved]]
        vectors[-1] += now
        propagate(states, starts, numbers, vectors, back=True)
        now = vectors[0]
    return time.initial_cotangents(now + by_ends[0], seeds)


def checked_cotangents(stepper: LinearisedMethod, count: int, cotangents: ArrayLike) -> Array:
    """Return valid (n, 2m) or (n, 2m, c) cotangents, in transformed time also with one of t; StateError for others."""
    size, derivatives = 2 * stepper.dimension, finite(cotangents, "cotangents")
    sizes = {size, len(stepper._output_indices)}
    if derivatives.ndim not in (2, 3) or derivatives.shape[0] != count or derivatives.shape[1] not in sizes:
        shape = f"({count}, {size})" + f", or ({count}, {size + 1}) with those by t," * (len(sizes) - 1)
        raise StateError(
            f"cotangents, derivatives by (q, p) of each state, must have shape {shape} or (.., c), "
            f"not {derivatives.shape}"
        )
    return derivatives


def gradient_of(states: SavedStates, columns: Array) -> Gradient:
    """Construct from (variables, ..) derivatives."""
    m = states.stepper.dimension
    return Gradient(
        q=columns[:m],
        p=columns[m : 2 * m],
        parameters=columns[2 * m : 2 * m + len(states.stepper.parameters)],
        t=columns[-2],
        h=columns[-1] if _has_fixed_step_size(states) else None,
    )


def finite(values: ArrayLike, name: str) -> Array:
    """Return a validated array of finite numbers."""
    array = real_array(values, name)
    if not np.isfinite(array).all():
        raise StateError(f"{name} must be finite")
    return array


def forward(states: SavedStates, tangents: Array) -> tuple[Array, Array]:
    """Return (n, outputs, count) tangent vectors at the states and (count, variables) at the end of the run."""
    time, outputs = time_of(states), states.stepper._output_indices
    states, now = time.states, time.initial_tangents(tangents)
    result = np.empty((len(states), len(outputs), len(now)))
    result[0] = now[:, outputs].T
    for first, last in pieces(states):
        _, numbers, vectors = tangents_from(states, first, last, now)
        saved = np.flatnonzero(numbers[1:] > 0) + 1
        result[numbers[saved]] = vectors[saved][:, :, outputs].transpose(0, 2, 1)
        now = vectors[-1]
    return time.final_tangents(result, now, tangents)


def tangents_from(states: SavedStates, first: int, last: int, start: Array) -> tuple[Starts, NDArray[np.intp], Array]:
    """Return the steps of :func:`starts_of`, and the images of tangent vectors at their start."""
    starts, numbers = starts_of(states, first, last)
    vectors = np.zeros((len(numbers), *start.shape))
    vectors[0] = start
    propagate(states, starts, numbers, vectors, back=False)
    return starts, numbers, vectors


def propagate(states: SavedStates, starts: Starts, numbers: NDArray[np.intp], vectors: Array, *, back: bool) -> None:
    """Propagate tangent or adjoint vectors along the steps of a segment and compare its step ends with the run.

    Modes, which are parameters of the steps, have no variations but those of the directions of slips in space.
    """
    jumps: dict[int, Jump] = {}
    if states.stepper.divides_steps and not states.stepper.by_steps:
        more = back or bool(vectors[..., 2 * states.stepper.dimension :].any())
        jumps = jumps_within(states, starts, numbers, all_inputs=more)
    start = jumps.pop(0, None)
    if start and not back:
        vectors[0] = vectors[0] @ start.matrix.T
    parts = list(pairwise(sorted({0, len(starts.h), *jumps})))
    for first, last in reversed(parts) if back else parts:
        if back and last in jumps:
            vectors[last] = vectors[last] @ jumps[last].matrix
        part = starts.part(first, last) if jumps else starts
        settings = part, vectors[first : last + 1], states.parameters_on_sides(part.t[0])
        if states.stepper.by_steps:
            from scvi_codegen.runs.derivatives import active_sets  # here: few runs have contacts

            whole = active_sets.step_of_event(states, numbers[-1])
            ends = active_sets.propagate_by_steps(states.stepper, *settings, transpose=back, whole=whole)
        else:
            ends = states.stepper._propagate(*settings, states.options, transpose=back)
        saved = np.concatenate([part.q, part.p], axis=1)
        if last in jumps:
            saved[-1] = jumps[last].before
            if not back:
                vectors[last] = vectors[last] @ jumps[last].matrix.T
        before = saved[:-1]
        if jumps:  # states near rest, after impacts that accumulate, are not exact relative to themselves
            before = np.maximum(np.abs(before), max(np.abs(starts.q).max(), np.abs(starts.p).max()))
        check_recomputed(states, part.t, np.concatenate(ends, axis=1), saved[1:], before)
    if start and back:
        vectors[0] = vectors[0] @ start.matrix


def pieces(states: SavedStates) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of segments whose steps are all saved, or of two consecutive saved states."""
    lengths = states.step_sizes[:-1]
    spans = steps_after(states, 0, len(states) - 1)
    several = ~(np.abs(spans) < 1.5 * np.abs(lengths))
    first = 0
    while first < len(spans):
        last = first + 1
        if not several[first]:
            ahead = several[first : first + MOST_STEPS]
            last = first + (int(np.argmax(ahead)) if ahead.any() else len(ahead))
        yield first, last
        first = last


def starts_of(states: SavedStates, first: int, last: int) -> tuple[Starts, NDArray[np.intp]]:
    """Return the steps of a segment, and (steps + 1,) indices of the saved states at their ends, -1 if not saved."""
    length, span = float(states.step_sizes[first]), float(states.stepped[last] - states.stepped[first])
    taken = last > first + 1 or steps_after(states, first, last)[0] == length
    count = 1 if taken else steps_between(length, span)
    if count == 1:
        h = steps_after(states, first, last)
        h[h == 0.0] = np.finfo(float).eps * (states.t[-1] - states.t[0])  # to a wall that a start touches: its rates
        piece = slice(first, last + 1)
        starts = Starts(states.t[first:last].copy(), h, states.q[piece].copy(), states.p[piece].copy())
        return starts, np.arange(first, last + 1)
    t, h = states.t[first] + length * np.arange(count), np.full(count, length)
    starts = Starts.chain(states.q[first], states.p[first], t, h)
    if states.stepper.by_steps:
        return starts, np.array([first, *[-1] * (count - 1), last])
    times, starts.q[1:], starts.p[1:] = states._restarted(first, length)._fill(count)
    if states.tau is not None:
        starts.t[1:] = times[:-1]
    numbers = np.full(count + 1, -1)
    numbers[[0, -1]] = first, last
    starts.q[-1], starts.p[-1] = states.q[last], states.p[last]
    return starts, numbers


def _has_fixed_step_size(states: SavedStates) -> bool:
    if not isinstance(states.plan, FixedSteps):
        return False
    spans = np.diff(states.stepped)
    steps = np.rint(spans / states.h)
    return bool((np.abs(spans - steps * states.h) <= FixedSteps.SAME * abs(states.h) * np.maximum(1.0, steps)).all())
