"""Run loop: advance a run in chunks and save every k-th state, so that Python regains control regularly."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.arguments import empty_array
from scvi_codegen.native.options import step_failure
from scvi_codegen.runtime.events import Crossings
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.memory import Memory, fill
from scvi_codegen.runtime.singular_time import ProgressWatch, lost_energy_surface
from scvi_codegen.runtime.step_plan import StepPlan
from scvi_codegen.runtime.times import times_after
from scvi_codegen.runtime.trajectory import Trajectory
from scvi_codegen.validation.counts import checked_count

__all__ = ["CALL_SECONDS", "first_step_size", "record", "record_states", "record_until", "trajectory_of"]

CALL_SECONDS = 0.1
"""Target duration of a C call in seconds; bounds the delay of Ctrl-C and of ``progress``."""


def record(
    memory: Memory, steps: int | None, *, save_every: int = 1, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Record ``steps`` steps, or up to the target time of adaptive steps (all steps to it if ``steps`` is omitted)."""
    if memory.plan is None:
        return record_states(memory, checked_count(steps, "steps", least=0), save_every=save_every, progress=progress)
    count = None if steps is None else checked_count(steps, "steps", least=0)
    return record_until(memory, count, save_every=save_every, progress=progress)


def record_states(
    memory: Memory, steps: int, *, save_every: int = 1, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Advance by ``steps``; save the present state and those whose step number is a multiple of ``save_every``.

    Raises:
        StepFailedError: if a step fails; ``trajectory`` has the saved states, the run is left before that step.
    """
    steps = checked_count(steps, "steps", least=0)
    save_every = checked_count(save_every, "save_every", least=1)
    first = memory.steps
    capacity = (first + steps) // save_every - first // save_every
    m = memory.stepper.dimension
    t, q, p = (empty_array((capacity + 1, *shape)) for shape in ((), (m,), (m,)))
    iterations = np.zeros(capacity + 1, dtype=np.int32)
    t[0], q[0], p[0] = memory.t, memory.q, memory.p
    filled, done, chunk_size = 1, 0, save_every * max(1, 256 // save_every)
    while done < steps:
        size = min(chunk_size, steps - done)
        began = time.perf_counter()
        status, report = fill(memory, size, save_every, t[filled:], q[filled:], p[filled:], iterations[filled:])
        done += report.steps
        filled = 1 + (first + done) // save_every - first // save_every
        if status:
            kept = trajectory_of(
                memory,
                t[:filled],
                q[:filled],
                p[:filled],
                iterations[:filled],
                tau=_tau(memory, first, save_every, filled),
            )
            raise step_failure(status, report, step=memory.steps, h=memory.h, kept=kept)
        if progress is not None:
            progress(done)
        elapsed = max(time.perf_counter() - began, 1e-6)
        chunk_size = save_every * max(1, int(min(2.0 * size, size * CALL_SECONDS / elapsed) / save_every))
    found = trajectory_of(memory, t, q, p, iterations, tau=_tau(memory, first, save_every, len(t)))
    memory.longest = float(np.abs(np.diff(found.t)).max(initial=memory.longest))
    if found.tau is not None and (failure := lost_energy_surface(found, memory.longest)):
        failure.trajectory = found
        raise failure
    return found


def _tau(memory: Memory, first: int, save_every: int, count: int) -> Array | None:
    """Return tau after ``first`` steps and at the following multiples of ``save_every``; 0 at the start."""
    if not memory.stepper.interface.energy_parameter:
        return None
    numbers = np.append(first, save_every * (first // save_every + np.arange(1, count)))
    return times_after(0.0, memory.h, numbers)[0]


def record_until(
    memory: Memory, steps: int | None = None, *, save_every: int = 1, progress: Callable[[int], None] | None = None
) -> Trajectory:
    """Advance to the target time, or by ``steps``; save every ``save_every``-th state, the present and the final one.

    Raises:
        StepFailedError: if a step fails or underflows; ``trajectory`` has the saved states.
    """
    save_every = checked_count(save_every, "save_every", least=1)
    pieces = [_Piece.of(memory)]
    done, chunk_size = 0, 256 * save_every
    watch = ProgressWatch(memory.stepper, memory.plan.t_end if memory.plan and memory.plan.tau else None)
    while not memory.arrived and (steps is None or done < steps):
        size, began, before = (
            chunk_size if steps is None else min(chunk_size, steps - done),
            time.perf_counter(),
            memory.t,
        )
        piece = _Piece.empty(memory, size // save_every + 2)
        status, report = fill(memory, size, save_every, *piece)
        pieces.append(piece.first(report.stored))
        done += report.steps
        if status:
            raise step_failure(status, report, step=memory.steps, h=memory.h, kept=_joined(memory, pieces, save_every))
        if failure := watch.check_progress(before, memory.t, report.steps, memory.steps):
            failure.trajectory = _joined(memory, pieces, save_every)
            raise failure
        if progress is not None:
            progress(done)
        elapsed = max(time.perf_counter() - began, 1e-6)
        chunk_size = save_every * max(1, int(min(2.0 * size, size * CALL_SECONDS / elapsed) / save_every))
    return _joined(memory, pieces, save_every)


class _Piece(NamedTuple):
    """States, and solver iterations since the previous state."""

    t: Array
    q: Array
    p: Array
    iterations: NDArray[np.int32]

    @classmethod
    def empty(cls, memory: Memory, room: int) -> _Piece:
        m = memory.stepper.dimension
        t, q, p = (empty_array((room, *shape)) for shape in ((), (m,), (m,)))
        return cls(t, q, p, np.zeros(room, dtype=np.int32))

    def first(self, count: int) -> _Piece:
        return _Piece(self.t[:count], self.q[:count], self.p[:count], self.iterations[:count])

    @classmethod
    def of(cls, memory: Memory) -> _Piece:
        """Return the present state."""
        return cls(np.array([memory.t]), memory.q[np.newaxis], memory.p[np.newaxis], np.zeros(1, dtype=np.int32))


def _joined(memory: Memory, pieces: Sequence[_Piece], save_every: int) -> Trajectory:
    """Return the trajectory of an adaptive run; step sizes are known if every state is saved."""
    t, q, p, iterations = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    lengths = np.full(len(t), np.nan)
    if save_every == 1:
        lengths[:-1] = np.diff(t)
    return trajectory_of(memory, t, q, p, iterations, step_sizes=lengths)


def trajectory_of(
    memory: Memory,
    t: Array,
    q: Array,
    p: Array,
    iterations: NDArray[np.int32],
    *,
    steps: int | None = None,
    step_sizes: Array | None = None,
    events: tuple[Crossings, ...] = (),
    tau: Array | None = None,
) -> Trajectory:
    """Return a trajectory of these states with the data of the run; by default each precedes a step of h."""
    step_error, worst_step_time = memory.step_error
    return Trajectory(
        t=t,
        q=q,
        p=p,
        iterations=iterations,
        step_sizes=np.broadcast_to(memory.h, t.shape) if step_sizes is None else step_sizes,
        h=memory.h if memory.plan is None else first_step_size(memory.plan, t),
        plan=memory.plan,
        steps=memory.steps if steps is None else steps,
        rejected_steps=memory.rejected_steps,
        step_error=step_error,
        worst_step_time=worst_step_time,
        parameters=memory.parameters,
        stepper=memory.stepper,
        options=memory.options,
        events=events,
        tau=tau,
    )


def first_step_size(plan: StepPlan, t: Array) -> float:
    """Return the first step size between states of an adaptive run, or the direction of the run."""
    return float(t[1] - t[0] if len(t) > 1 else plan.t_end - t[0])
