"""Trajectories of an ensemble that C integrates one after the other, many in one call.

They are bitwise equal to single runs: C starts and advances the same memory of a run. A call takes a limited number of
steps, so that Python regains control about every 20 ms; C keeps the present trajectory for the next call. The first
call decides whether threads are worth starting.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.options import OUTCOMES, SolverOptions
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.ensemble.result import INTERRUPTED, OK
from scvi_codegen.runtime.ensemble.thread_pool import StopCheck, run_jobs
from scvi_codegen.runtime.run.chunks import drive

FIRST_CHUNK_STEPS = 64
"""Steps of the first call, before the speed of the steps is known."""
CHUNK_SECONDS = 0.02
"""Target duration of a call in seconds; bounds the delay of an interruption."""
GROWTH = 8.0
"""Largest ratio of successive numbers of steps of calls."""
MOST_NUMBERS, FEWEST_ROWS = 2**16, 8
"""Numbers in the memory for states of a call, and the fewest states."""
NAMES = np.array([OK, *OUTCOMES, INTERRUPTED], dtype="<U32")
"""Reasons of the end by the status of C; the last one of -1."""


class FixedSegments(NamedTuple):
    """Fixed steps in segments: their numbers of steps, strides of saved states and step sizes."""

    steps: NDArray[np.int64]
    save_every: NDArray[np.int64]
    h: Array


class Rows(NamedTuple):
    """Saved states: row and trajectory of each, times, positions, momenta and actions (NaN unless runs sum them)."""

    rows: NDArray[np.intp]
    trajectories: NDArray[np.intp]
    t: Array
    q: Array
    p: Array
    actions: Array

    def copies(self) -> Rows:
        """Return copies, in memory of their own."""
        return Rows(*self[:2], *(each.copy() for each in self[2:]))


class SuccessiveRuns:
    """Trajectories from given states, with the same fixed steps or with adaptive steps to individual times.

    Args:
        stepper, options: the integrator and its solver options.
        start: (k, m) initial positions and momenta at the time ``t``.
        parameters: (k, number of parameters) values.
        steps: segments of fixed steps, or (k,) final times of adaptive steps.
        tolerance, save_every: of adaptive steps.
        store: receives saved states after the initial ones, row 0, possibly from several threads; they are views.

    Attributes:
        status: (k,) status of C, -1 before the end of a trajectory.
        stored, done: (k,) numbers of saved states without the initial one, and of completed steps.
        fallback_steps: (k,) numbers of steps that the iteration did not solve, but its fallback.
        energies: (k, 2) energies at both ends of trajectories with adaptive steps, NaN where not computed.
    """

    def __init__(
        self,
        stepper: Integrator,
        options: SolverOptions | None,
        start: tuple[Array, Array],
        parameters: Array,
        t: float,
        steps: FixedSegments | Array,
        *,
        tolerance: float = 0.0,
        save_every: int = 1,
        store: Callable[[Rows], None],
    ) -> None:
        self.stepper, self.binding, self.options, self.t, self.steps = stepper, stepper.binding, options, t, steps
        self.q, self.p, self.parameters = (np.ascontiguousarray(each) for each in (*start, parameters))
        self.tolerance, self.save_every, self.store, count = tolerance, save_every, store, len(self.q)
        self.status = np.full(count, -1, np.int32)
        self.stored, self.done, self.fallback_steps = np.zeros((3, count), np.int64)
        self.energies = np.full((count, 2), np.nan)

    @property
    def names(self) -> NDArray[np.str_]:
        """(k,) reasons of the end."""
        return NAMES[self.status]

    @property
    def fixed(self) -> bool:
        """Return whether steps are fixed."""
        return isinstance(self.steps, FixedSegments)

    def completed(self) -> float:
        """Return the number of completed trajectories, of fixed steps with the parts of the others."""
        ended = self.status >= 0
        if not isinstance(self.steps, FixedSegments):
            return float(ended.sum())
        return float(np.where(ended, 1.0, self.done / self.steps.steps.sum()).sum())

    def run(self, *, progress: Callable[[float], None] | None, threads: int | None) -> None:
        """Integrate all trajectories; ``progress`` is called with the number of completed ones and may raise.

        The calling thread begins. If that takes longer than one chunk, it divides the rest among threads, in jobs of
        about that duration.
        """
        count, began = len(self.q), time.perf_counter()
        first = _Call(self, 0, count)
        first.advance(until=lambda: time.perf_counter() - began > CHUNK_SECONDS)
        if first.call.next < count:
            self._share(first, progress, threads)
        elif progress is not None:
            progress(self.completed())

    def _share(self, first: _Call, progress: Callable[[float], None] | None, threads: int | None) -> None:
        """Finish the trajectory begun and the following ones in threads."""
        count, begun = len(self.q), int(first.call.next) + 1
        first.call.end = begun
        size = max(1, min(begun - 1, -(-(count - begun) // 16)))  # as many as the first chunk, in 16 jobs or more
        ends = [*range(begun, count, size), count]

        def advance(job: int, check_stop: StopCheck) -> None:
            call = _Call(self, ends[job - 1], ends[job]) if job else first
            call.advance(check_stop=check_stop)

        report = None if progress is None else lambda _: progress(self.completed())
        run_jobs(len(ends), advance, progress=report, threads=threads)


class _Call:
    """Arguments of C calls for a range of trajectories, with the memory of a run.

    Args:
        work: the trajectories.
        first, end: the range.
    """

    def __init__(self, work: SuccessiveRuns, first: int, end: int) -> None:
        self.work, self.flushed, binding = work, first, work.binding
        m, each = work.q.shape[1], work.parameters.shape[1]
        self.capacity = max(FEWEST_ROWS, MOST_NUMBERS // (2 * m + 1))
        self.before = 0  # states of the first trajectory that were stored earlier
        call = self.call = binding.new("each *")
        self.runs = binding.new("run *"), binding.new("report *"), binding.options(work.options)
        call.run, call.report, call.options = self.runs
        self.workspace = call.workspace = binding.workspace(self.runs[0])
        if binding.count is None:
            self.copy = call.before = binding.new("run *")
        call.q, call.p, call.parameters = map(binding.pointer, (work.q, work.p, work.parameters))
        if isinstance(work.steps, FixedSegments):
            steps, save_every, h = work.steps
            call.segment_steps, call.segment_every = map(binding.whole_numbers, (steps, save_every))
            call.segment_h, call.segments = binding.pointer(h), len(h)
        else:
            call.t_end, call.tolerance = binding.pointer(work.steps), work.tolerance
            if work.stepper.interface.conserves_energy:
                call.energies = binding.pointer(work.energies)
        call.status = binding.integers(work.status)
        numbers = work.stored, work.done, work.fallback_steps
        call.stored, call.done, call.fallback_steps = map(binding.whole_numbers, numbers)
        call.t, call.coordinates, call.parameters_each, call.every = work.t, m, each, work.save_every
        call.next, call.end, call.segment, call.capacity = first, end, -1, self.capacity
        self.iterations = np.empty(self.capacity, np.int32)
        call.iterations = binding.integers(self.iterations)
        self.actions = np.full(self.capacity, np.nan)
        (call.actions,) = binding.pointers(self.actions)
        self.states = np.empty(self.capacity), np.empty((self.capacity, m)), np.empty((self.capacity, m))
        call.times, call.positions, call.momenta = binding.pointers(*self.states)
        self.take = binding.each(call)

    def advance(self, *, check_stop: StopCheck | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Advance the trajectories to their ends, or until ``until`` returns true; states are stored in any case."""
        call = self.call

        def take(size: int) -> int:
            if check_stop is not None:
                check_stop(size)
            taken = self.take(size)
            if call.rows + FEWEST_ROWS > self.capacity:
                self._flush()
            return taken

        try:
            drive(
                take,
                math.inf,
                first=FIRST_CHUNK_STEPS,
                growth=GROWTH,
                seconds=CHUNK_SECONDS,
                ended=lambda: call.next == call.end or until(),
            )
        finally:
            self._flush()

    def _flush(self) -> None:
        """Pass on the states in memory, with their trajectories and rows."""
        call, work, count = self.call, self.work, int(self.call.rows)
        if not count:
            return
        each = np.arange(self.flushed, min(call.next + 1, call.end))
        first = np.ones(len(each), np.int64)
        first[0] += self.before
        numbers = work.stored[each] + 1 - first
        last, t, q, p = np.cumsum(numbers), *self.states
        rows = np.arange(count) + np.repeat(first + numbers - last, numbers)
        work.store(Rows(rows, np.repeat(each, numbers), t[:count], q[:count], p[:count], self.actions[:count]))
        self.flushed = int(call.next)
        self.before = int(work.stored[self.flushed]) if self.flushed < call.end and call.segment >= 0 else 0
        call.rows = 0
