"""Trajectories of an ensemble that C integrates, many in one call: one after the other, or in blocks of SIMD lanes.

A call takes a limited number of steps, so that Python regains control about every 20 ms; C keeps the present trajectory
or block for the next call. The first call decides whether threads are worth starting. Trajectories that C integrates
one after the other are bitwise equal to single runs: C starts and advances the same memory of a run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.capacity import TOO_MANY_STATES
from scvi_codegen.codegen.native.options import OUTCOMES
from scvi_codegen.common.thread_pool import StopCheck, run_jobs
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.ensembles.ensemble import Ensemble
from scvi_codegen.runs.ensembles.result import INTERRUPTED, OK
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import Word, block_of
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.step_plan import step_control

FIRST_CHUNK_STEPS = 64
"""Steps of the first call, before the speed of the steps is known."""
CHUNK_SECONDS = 0.02
"""Target duration of a call in seconds; bounds the delay of an interruption."""
GROWTH = 8.0
"""Largest ratio of successive numbers of steps of calls."""
MOST_NUMBERS, FEWEST_ROWS = 2**16, 8
"""Numbers in the memory for states of a call, and the fewest states."""
NAMES = np.array([OK, *OUTCOMES, TOO_MANY_STATES, INTERRUPTED], dtype="<U32")
"""Reasons of the end by the status of C, or of a trajectory with too many states; the last one of -1."""
FULL = len(OUTCOMES) + 1
"""Status of a trajectory with too many states."""


class Rows(NamedTuple):
    """Saved states of successive trajectories.

    Attributes:
        trajectories, first, numbers: (k,) trajectories, their first rows and their numbers of rows.
        t, q, p, actions: one row per state; actions are empty unless runs sum them.
        tau: its values in transformed time, where they do not follow from the number of steps, else empty.
    """

    trajectories: NDArray[np.intp]
    first: NDArray[np.int64]
    numbers: NDArray[np.int64]
    t: Array
    q: Array
    p: Array
    actions: Array
    tau: Array = np.empty(0)

    def copies(self, shift: int) -> Rows:
        """Return copies, in memory of their own, of which other rows are the first ones."""
        return Rows(self.trajectories, self.first + shift, self.numbers, *(values.copy() for values in self[3:]))

    def indices(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the row and the trajectory of each state."""
        before = self.first + self.numbers - self.numbers.cumsum()  # a state's row minus its place in this memory
        rows = before.repeat(self.numbers)
        return rows + np.arange(len(rows)), self.trajectories.repeat(self.numbers)


class Batch:
    """Trajectories of an ensemble as C integrates them.

    Parts of it (:meth:`part`), which threads integrate, share all arrays and have a C structure of their own, whose
    memory they release when they end.

    Args:
        binding: the compiled integrator.
        ensemble: the trajectories.

    Attributes:
        segments: the fixed steps, ``None`` for adaptive steps.
        q, p, parameters: contiguous initial states and present parameters; numbers of two words have both.
        width: number of trajectories that C integrates at the same time.
        status: (k,) status of C, -1 before the end of a trajectory.
        done: (k,) numbers of completed steps.
        struct: of a part, the arguments of C calls.
    """

    width = 1
    struct: Any

    def __init__(self, binding: Binding, ensemble: Ensemble) -> None:
        self.binding, self.ensemble = binding, ensemble
        self.segments = None if ensemble.fixed is None else ensemble.fixed.fixed_segments
        numbers = ensemble.q, ensemble.p, ensemble.parameters
        self.q, self.p, self.parameters = (np.ascontiguousarray(block_of(values)) for values in numbers)
        self.parameters = self.parameters.copy()  # which inputs change
        self.status = np.full(len(self.q), -1, np.int32)
        self.done = np.zeros(len(self.q), np.int64)

    def part(self, first: int, end: int) -> Self:
        """Return the part of a range of trajectories, before its first call."""
        part = object.__new__(type(self))
        part.__dict__.update(self.__dict__)  # as copy.copy, in a fifth of its time
        part.prepare(first, end)
        return part

    def prepare(self, first: int, end: int) -> None:
        """Set the C structure of a part."""
        binding, struct, t0 = self.binding, self.binding.new("each *"), self.ensemble.t0
        self.struct, self.solver = struct, binding.options(self.ensemble.settings.options)
        struct.options = self.solver
        struct.q, struct.p, struct.parameters = map(binding.pointer, (self.q, self.p, self.parameters))
        if self.segments is not None:
            steps, save_every, h, *_ = self.segments
            struct.segment_steps, struct.segment_every = map(binding.whole_numbers, (steps, save_every))
            struct.segment_h, struct.segments = binding.pointer(h), len(h)
        struct.status, struct.done = binding.integers(self.status), binding.whole_numbers(self.done)
        struct.t, struct.next, struct.end, struct.segment = t0, first, end, -1
        if isinstance(t0, Word):
            struct.t_low = t0.low
        struct.pauses = bool(self.ensemble.inputs)
        self.ensemble.noise.store(struct)
        self.take = binding.each(struct)

    def completed(self) -> float:
        """Return the number of completed trajectories, of fixed steps with the parts of the others."""
        ended = self.status >= 0
        if self.segments is None:
            return float(ended.sum())
        return float(np.where(ended, 1.0, self.done / self.segments.steps.sum()).sum())

    def run(self, *, progress: Callable[[float], None] | None, threads: int | None) -> None:
        """Integrate all trajectories; ``progress`` is called with the number of completed ones and may raise.

        The calling thread begins. If that takes longer than one chunk, it divides the rest among threads, in jobs of
        about that duration.
        """
        if threads is not None:
            checked_count(threads, "threads", least=1)
        count, began = len(self.q), time.perf_counter()
        first = self.part(0, count)
        first.advance(until=lambda: time.perf_counter() - began > CHUNK_SECONDS)
        if first.struct.next < count:
            self._share(first, progress, threads)
        elif progress is not None:
            progress(self.completed())

    def _share(self, first: Self, progress: Callable[[float], None] | None, threads: int | None) -> None:
        """Finish the trajectories begun and the following ones in threads."""
        count, width = len(self.q), self.width
        begun = first.struct.end = min(int(first.struct.next) + width, count)
        size = max(1, min(begun // width - 1, -(-(count - begun) // (16 * width))))  # like the first chunk, or 16 jobs
        ends = [*range(begun, count, size * width), count]

        def advance(job: int, check_stop: StopCheck) -> None:
            part = self.part(ends[job - 1], ends[job]) if job else first
            part.advance(check_stop=check_stop)

        report = None if progress is None else lambda _: progress(self.completed())
        run_jobs(len(ends), advance, progress=report, threads=threads)

    def advance(self, *, check_stop: StopCheck | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Advance a part to its end, or until ``until`` returns true; states are stored in any case."""

        def take(size: int) -> int:
            if check_stop is not None:
                check_stop(size)
            taken = self.take(size)
            if self.struct.entered:
                self.enter(self.struct.segment)
            self.limit()
            self.store()
            return taken

        try:
            chunks: dict[str, Any] = {"first": FIRST_CHUNK_STEPS, "growth": GROWTH, "seconds": CHUNK_SECONDS}
            drive(take, math.inf, **chunks, ended=lambda: self.struct.next == self.struct.end or until())
        finally:
            self.store(last=True)

    def enter(self, segment: int) -> None:
        """Set the parameters of the present trajectories in a segment."""
        if self.ensemble.inputs and self.segments is not None:
            first = int(self.struct.next)
            present = slice(first, min(first + self.width, len(self.q)))
            self.parameters[present] = self.ensemble.values_at(float(self.segments.middle[segment]), present)

    def limit(self) -> None:
        """End the present trajectory if it has too many states."""

    def store(self, *, last: bool = False) -> None:
        """Pass on the states in memory, if it is nearly full or after the last call."""


class SuccessiveRuns(Batch):
    """Trajectories that C integrates one after the other.

    Args:
        ensemble: the trajectories.
        receive: receives saved states after the initial ones, row 0, possibly from several threads; they are views.
        save_every: of adaptive steps.
        most_states: number of states with which a trajectory ends.

    Attributes:
        stored: (k,) numbers of saved states without the initial one.
        fallback_steps: (k,) numbers of steps that the iteration did not solve, but its fallback.
        energies: (k, 2) energies at both ends of trajectories with adaptive steps, NaN where not computed.
    """

    def __init__(
        self, ensemble: Ensemble, receive: Callable[[Rows], None], *, save_every: int = 1, most_states: float = math.inf
    ) -> None:
        super().__init__(ensemble.stepper.binding, ensemble)
        interface = ensemble.stepper.interface
        self.words, self.conserves_energy = interface.words, interface.conserves_energy and interface.words == 1
        self.receive, self.save_every, self.most_states = receive, save_every, most_states
        self.stored, self.fallback_steps = np.zeros((2, len(self.q)), np.int64)
        self.energies = np.empty((0, 2)) if self.segments else np.full((len(self.q), 2), np.nan)

    @property
    def names(self) -> NDArray[np.str_]:
        """(k,) reasons of the end."""
        return NAMES[self.status]

    def prepare(self, first: int, end: int) -> None:
        """Set the C structure of a part, with the memory of a run and for states."""
        super().prepare(first, end)
        binding, struct, stepper, m = self.binding, self.struct, self.ensemble.stepper, self.q.shape[1]
        self.flushed = first
        self.capacity = max(FEWEST_ROWS, MOST_NUMBERS // (2 * m + 1))
        self.before = 0  # states of the first trajectory that were stored earlier
        self.runs = binding.new("run *"), binding.new("report *")
        struct.run, struct.report = self.runs
        self.workspace = struct.workspace = binding.workspace(self.runs[0])
        if binding.count is None:
            self.run_before = struct.before = binding.new("run *")
        if self.segments is not None:
            struct.segment_end = binding.pointer(self.segments.end)
        else:
            assert self.ensemble.plan is not None  # by the caller
            struct.t_end = binding.pointer(self.ensemble.ends)
            self.control = step_control(stepper, self.ensemble.plan)
            struct.control = self.control[0]
            if self.conserves_energy:
                struct.energies = binding.pointer(self.energies)
        struct.stored, struct.fallback_steps = map(binding.whole_numbers, (self.stored, self.fallback_steps))
        struct.coordinates, struct.parameters_each, struct.every = m, self.parameters.shape[1], self.save_every
        struct.words, struct.capacity = self.words, self.capacity
        self.iterations = np.empty(self.capacity, np.int32)
        struct.iterations = binding.integers(self.iterations)
        self.actions = np.full(self.capacity, np.nan) if stepper.sums_action else np.empty(0)
        struct.actions = binding.pointer(self.actions)
        self.states = tuple(np.empty((self.capacity, numbers)) for numbers in (self.words, m, m))
        struct.times, struct.positions, struct.momenta = binding.pointers(*self.states)

    def limit(self) -> None:
        """End the present trajectory if it has too many states."""
        call = self.struct
        if call.next < call.end and call.segment >= 0 and self.stored[call.next] > self.most_states:
            self.status[call.next], call.segment = FULL, -1
            call.next += 1

    def store(self, *, last: bool = False) -> None:
        """Pass on the states in memory, with their trajectories and rows."""
        call, count = self.struct, int(self.struct.rows)
        if not count or (not last and count + FEWEST_ROWS <= self.capacity):
            return
        trajectories = np.arange(self.flushed, min(call.next + 1, call.end))
        first = np.ones(len(trajectories), np.int64)
        first[0] += self.before
        numbers = self.stored[trajectories] + 1 - first
        t, q, p = (self.ensemble.stepper._states.numbers(block[:count]) for block in self.states)
        self.receive(Rows(trajectories, first, numbers, t[:, 0], q, p, self.actions[:count]))
        self.flushed = int(call.next)
        self.before = int(self.stored[self.flushed]) if self.flushed < call.end and call.segment >= 0 else 0
        call.rows = 0
