"""States of an integration, kept every so many steps, a portion at a time so that the keyboard is heard."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.native.arguments import empty_array
from scvi_codegen.native.options import step_failure
from scvi_codegen.runtime.events import Crossings
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.memory import Memory
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["SLICE_SECONDS", "record_states", "trajectory_of"]

SLICE_SECONDS = 0.1
"""Time between looks at the keyboard (and calls of ``progress``) during an integration."""


def record_states(
    memory: Memory, steps: int, *, every: int = 1, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Advance by ``steps`` and keep the present state and each whose step number is a multiple of ``every``.

    Raises:
        StepFailedError: with the states kept so far as ``trajectory``; the memory stands before the failing step.
    """
    steps = checked_count(steps, "steps", least=0)
    every = checked_count(every, "every", least=1)
    first = memory.steps
    capacity = (first + steps) // every - first // every
    m = memory.stepper.dimension
    t, q, p = (empty_array((capacity + 1, *shape)) for shape in ((), (m,), (m,)))
    iterations = np.zeros(capacity + 1, dtype=np.int32)
    t[0], q[0], p[0] = memory.t, memory.q, memory.p
    filled, done, portion = 1, 0, every * max(1, 256 // every)
    while done < steps:
        size = min(portion, steps - done)
        began = time.perf_counter()
        status, report = memory.advance(size, every, t[filled:], q[filled:], p[filled:], iterations[filled:])
        done += report.steps
        filled = 1 + (first + done) // every - first // every
        if status:
            kept = trajectory_of(memory, t[:filled], q[:filled], p[:filled], iterations[:filled])
            raise step_failure(status, report, step=memory.steps, h=memory.h, kept=kept)
        if progress is not None:
            progress(done)
        elapsed = max(time.perf_counter() - began, 1e-6)
        portion = every * max(1, int(min(2.0 * size, size * SLICE_SECONDS / elapsed) / every))
    return trajectory_of(memory, t, q, p, iterations)


def trajectory_of(
    memory: Memory,
    t: Array,
    q: Array,
    p: Array,
    iterations: NDArray[np.int32],
    *,
    lengths: Array | None = None,
    events: tuple[Crossings, ...] = (),
) -> Trajectory:
    """These states as states of this integration, each before a step of h if no lengths are given."""
    return Trajectory(
        t=t,
        q=q,
        p=p,
        iterations=iterations,
        lengths=np.broadcast_to(memory.h, t.shape) if lengths is None else lengths,
        h=memory.h,
        parameters=memory.parameters,
        stepper=memory.stepper,
        options=memory.options,
        events=events,
    )
