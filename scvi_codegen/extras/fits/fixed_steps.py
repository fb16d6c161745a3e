"""Tangent vectors along consecutive steps of prescribed sizes, through events that change the state."""

from itertools import pairwise

import numpy as np

from scvi_codegen.api.states import Array, Fixed, Starts
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import EventError
from scvi_codegen.runs.stepper import Stepper


def tangents_along(
    stepper: Stepper,
    state: Array,
    t: Array,
    h: Array,
    tangents: Array,
    parameters: Array,
    options: SolverOptions | None = None,
    size_variations: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return the states at the ends of steps, and tangent vectors there.

    Args:
        stepper: with its events.
        state: (2m,) initial state.
        t, h: (n,) times and sizes of consecutive steps.
        tangents: (count, variables) initial variations of (q, p, parameters, t, h).
        parameters: values in order.
        size_variations: (n, count) variations of the step sizes, which are those in ``tangents`` by default.

    Returns:
        (n + 1, 2m) states, (n + 1, count, 2m) variations and (count, variables) final variations.
    """
    m, size, count = stepper.dimension, len(state), len(h)
    if not stepper.divides_steps:
        starts, vectors = Starts.chain(state[:m], state[m:], t, h), np.zeros((count + 1, *tangents.shape))
        vectors[0] = tangents
        if size_variations is not None:  # the variation of h of each step is added to that of the step before
            vectors[0, :, -1], vectors[1:-1, :, -1] = size_variations[0], np.diff(size_variations, axis=0)
        stepper.products.propagate(starts, vectors, parameters, options)
        return np.concatenate([starts.q, starts.p], axis=1), vectors[..., :size], vectors[-1]
    states, vectors = np.empty((count + 1, size)), np.empty((count + 1, len(tangents), size))
    states[0], vectors[0] = state, tangents[:, :size]
    others = np.flatnonzero(np.abs(np.diff(h)) > Fixed.SAME * np.abs(h[1:])) + 1
    for first, last in pairwise([0, *others.tolist(), count]):
        length, start = float(h[first]), states[first]
        if size_variations is not None:
            tangents = np.concatenate([tangents[:, :-1], size_variations[first][:, np.newaxis]], axis=1)
        plan = Fixed(length)
        run = stepper.products.run_by(
            plan, start[:m], start[m:], t=float(t[first]), parameters=parameters, options=options
        )
        trajectory = run._recorded(last - first)
        ends = plan.times(float(t[first]), np.arange(1, last - first + 1))
        if trajectory.t[-1] < ends[-1] - 0.5 * length:
            raise EventError(f"events end the run at t = {trajectory.t[-1]:g}, before its last time {ends[-1]:g}")
        rows = np.searchsorted(trajectory.t, ends + Fixed.SAME * length, side="right") - 1
        states[first + 1 : last + 1] = np.concatenate([trajectory.q, trajectory.p], axis=1)[rows]
        if len(tangents):  # derivatives of changes of the state are dear
            part, tangents = trajectory.tangents_at(tangents)
            vectors[first + 1 : last + 1] = part[rows].transpose(0, 2, 1)
    return states, vectors, tangents
