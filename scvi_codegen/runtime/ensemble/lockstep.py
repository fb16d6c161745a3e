"""Ensembles with common fixed steps: trajectories are SIMD lanes, blocks of lanes run on all cores.

With inputs or a final time there are segments of equal steps between breakpoints, whose final states are saved.

Blocks run in C without the GIL, so threads work in parallel. A lane whose step fails keeps its last good state and is
continued by the single integrator (which falls back on Newton's iteration); if that fails too, its later states are NaN
and its status gives the reason. Other lanes are unaffected. Results are bitwise equal for any number of threads.
"""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native import building
from scvi_codegen.native.arguments import checked_number, checked_step, empty_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions, checked_options
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, States, columns_of_inputs, parameter_index
from scvi_codegen.runtime.ensemble.initial_states import EnsembleParameters, start_of_ensemble
from scvi_codegen.runtime.ensemble.result import INTERRUPTED, OK, EnsembleTrajectory, Span
from scvi_codegen.runtime.ensemble.thread_pool import MOST_JOBS, PROGRESS_SECONDS, workers_of
from scvi_codegen.runtime.inputs.segments import (
    Input,
    Segment,
    inputs_of_slice,
    parameters_at,
    planned_segments,
    time_after_steps,
)
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.run_loop import record
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import times_after
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import checked_count

FIRST_CHUNK_STEPS = 64
"""Steps of the first chunk of a block, before its speed is known."""
CHUNK_SECONDS = 0.02
"""Target duration of a chunk in seconds; bounds the delay of an interruption."""
GROWTH = 8.0
"""Largest ratio of successive chunk sizes."""


class Change(NamedTuple):
    """New step size, and a function that returns the parameters of a slice of trajectories, one row each."""

    h: float
    parameters: Callable[[slice], Array]


class StepChunk(NamedTuple):
    """Chunk of steps for one call into C.

    Attributes:
        save_every: steps between saved states.
        change: new step size and parameters before the chunk, or ``None``.
    """

    steps: int
    save_every: int
    change: Change | None = None


class Ensemble:
    """Ensemble integration: arrays that blocks of trajectories fill; arguments as of ``integrate_ensemble``.

    Args:
        steps, t_end: number of steps, or final time, with a shorter step before each breakpoint and at the end.
        inputs: validated inputs, with ``t_end``.

    Attributes:
        segments: segments of equal steps.
        ends: number of steps up to the end of each segment.
        numbers: step numbers of the saved states.
    """

    def __init__(
        self,
        stepper: Integrator,
        q: States,
        p: States,
        *,
        h: float,
        steps: int | None = None,
        t_end: float | None = None,
        inputs: Mapping[str, Input] | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
    ) -> None:
        self.stepper, self.options, self.inputs, self.t_end = stepper, checked_options(options), inputs or {}, t_end
        self.h, self.t0 = checked_step(h), checked_number(t, "the time t")
        count = 0 if t_end is not None else checked_count(steps, "steps", least=0)
        self.segments = [Segment(count, self.h, (self.t0, 0.0), self.t0)]
        if t_end is not None:
            self.segments = planned_segments(self.t0, t_end, self.h, self.inputs) or self.segments
        self.ends = list(accumulate(segment.steps for segment in self.segments))
        self.steps, self.save_every = self.ends[-1], checked_count(save_every, "save_every", least=1)
        empty_array((self.steps // self.save_every + 1,))  # rejects numbers of states beyond any memory
        multiples = np.arange(0, self.steps + 1, self.save_every)
        self.numbers = multiples if t_end is None else np.union1d(multiples, self.ends)
        start_q, start_p, self.parameters = start_of_ensemble(stepper, q, p, self.t0, parameters)
        self.count = len(start_q)
        if not stepper._has_energy(parameters):
            for j in range(self.count):
                energy = parameter_index(stepper.interface, stepper.interface.energy_parameter)
                self.parameters[j, energy] = stepper.energy(start_q[j], start_p[j], 0.0, self.parameters[j])
        if self.inputs:
            self.parameters[:, columns_of_inputs(stepper.interface)] = 0.0
        self.q, self.p = (empty_array((len(self.numbers), self.count, stepper.dimension)) for _ in "qp")
        self.q[:] = self.p[:] = np.nan
        self.q[0], self.p[0] = start_q, start_p
        self.times = None
        if stepper.interface.energy_parameter:
            self.times = np.full((len(self.numbers), self.count), np.nan)
            self.times[0] = self.t0
        self.status = np.full(self.count, OK, dtype="<U32")
        self.done = np.zeros(self.count, dtype=np.int64)

    def __len__(self) -> int:
        return self.count

    @property
    def length(self) -> int:
        """Final value of ``progress``: the number of steps."""
        return self.steps

    def row(self, step: int) -> int:
        """Return the index of the first saved state after ``step`` steps."""
        return int(self.numbers.searchsorted(step, side="right"))

    def step_chunks(self, begin: int, size: int) -> Iterator[StepChunk]:
        """Split steps at breakpoints; the last step of a segment is separate if the output stride skips its state."""
        end, step = begin + size, begin
        while step < end:
            k = bisect_right(self.ends, step)
            last, entering = self.ends[k], self.t_end is not None and step == self._first(k)
            odd = self.t_end is not None and last % self.save_every != 0
            until = min(end, last - 1 if odd and step < last - 1 else last)
            save_every = last if odd and until == last else self.save_every
            yield StepChunk(until - step, save_every, self._change(self.segments[k]) if entering else None)
            step = until

    def step_data(self, step: int, j: int) -> tuple[float, tuple[float, float], Array]:
        """Return h, the time and the parameters of trajectory j after ``step`` steps."""
        k = min(bisect_right(self.ends, step), len(self.ends) - 1)
        segment = self.segments[k]
        now = time_after_steps(segment.start, segment.h, step - self._first(k))
        return segment.h, now, self._change(segment).parameters(slice(j, j + 1))[0]

    def _first(self, k: int) -> int:
        """Return the number of steps before segment k."""
        return self.ends[k] - self.segments[k].steps

    def _change(self, segment: Segment) -> Change:
        return Change(
            segment.h, partial(parameters_at, self.stepper.parameters, self.parameters, self.inputs, segment.middle)
        )

    def saved_times(self) -> Array:
        """Return the (n,) times of the saved states; tau from 0 in transformed time."""
        times, first = np.empty(len(self.numbers)), 0
        for k, segment in enumerate(self.segments):
            rows = slice(first, self.row(self.ends[k]))
            (start, low), first = segment.start if self.times is None else (0.0, 0.0), rows.stop
            high, rest = times_after(start, segment.h, self.numbers[rows] - self._first(k))
            times[rows] = high + (rest + low)
        return times

    def part(self, part: slice) -> dict[str, object]:
        """Return keyword arguments that construct the ensemble of a slice of the trajectories."""
        arguments: dict[str, object] = {
            "q": self.q[0, part],
            "p": self.p[0, part],
            "h": self.h,
            "save_every": self.save_every,
            "t": self.t0,
            "parameters": self.parameters[part],
            "options": self.options,
        }
        if self.t_end is None:
            return arguments | {"steps": self.steps}
        return arguments | {"t_end": self.t_end, "inputs": inputs_of_slice(self.inputs, part)}

    def keep(self, part: slice, trajectories: EnsembleTrajectory) -> None:
        """Store the results of a slice that was integrated elsewhere."""
        self.q[:, part], self.p[:, part], self.status[part], self.done[part] = (
            trajectories.q,
            trajectories.p,
            trajectories.status,
            trajectories.steps,
        )
        if self.times is not None:
            self.times[:, part] = trajectories.times

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all blocks with ``threads`` threads; an exception raised by ``progress`` stops them promptly.

        Afterwards, also after an exception, :meth:`result` returns what was computed.
        """
        workers = workers_of(threads)
        make, width = self.blocks()
        firsts = range(0, self.count, width)
        reached, stop = np.zeros(len(firsts)), threading.Event()

        def advance(number: int) -> None:
            block = make(firsts[number])

            def advance_chunk(size: int) -> int:
                block.advance(size)
                reached[number] += size
                return size

            drive(
                advance_chunk,
                self.steps,
                first=FIRST_CHUNK_STEPS,
                growth=GROWTH,
                seconds=CHUNK_SECONDS,
                ended=stop.is_set,
            )

        def take(piece: int) -> None:
            for number in range(piece, len(firsts), MOST_JOBS):
                advance(number)

        with ThreadPoolExecutor(workers) as pool:
            try:
                pending = {pool.submit(take, piece) for piece in range(min(len(firsts), MOST_JOBS))}
                while pending:
                    finished, pending = wait(pending, PROGRESS_SECONDS, FIRST_EXCEPTION)
                    for future in finished:
                        future.result()
                    if progress is not None:
                        progress(int(reached.mean()))
            finally:
                stop.set()
                pool.shutdown(cancel_futures=True)

    def blocks(self) -> tuple[Callable[[int], LaneBlock | _SingleBlock], int]:
        """Return a function that makes the block beginning at a trajectory, and the trajectories per block."""
        source = self.stepper.ensemble
        if source is None:
            return lambda first: _SingleBlock(self, first), 1
        binding = Binding(building.load(source, flags=self.stepper.flags), source.prefix)
        width = len(binding.new("block *").active)
        return lambda first: LaneBlock(self, first, binding), width

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories; those neither completed nor failed have the status ``"interrupted"``."""
        unfinished = (self.status == OK) & (self.done < self.steps)
        return EnsembleTrajectory(
            t=self.saved_times(),
            times=self.times,
            q=self.q,
            p=self.p,
            status=np.where(unfinished, INTERRUPTED, self.status),
            steps=self.done,
            h=self.h,
            parameters=self.parameters,
            stepper=self.stepper,
            spans=() if self.t_end is None else tuple(self._spans()),
        )

    def _spans(self) -> Iterator[Span]:
        """Yield the saved states of each segment with its parameters; a breakpoint belongs to the earlier segment."""
        first = 0
        for end, segment in zip(self.ends, self.segments, strict=True):
            yield slice(first, self.row(end)), slice(None), self._change(segment).parameters
            first = self.row(end)


class LaneBlock:
    """Trajectories in the SIMD lanes of one C block, and those that left it after a failed step."""

    def __init__(self, work: Ensemble, first: int, binding: Binding) -> None:
        self.work, self.first, self.binding = work, first, binding
        self.memory = binding.new("block *")
        binding.function("start")(self.memory, work.t0, work.h)
        self.active = np.frombuffer(binding.buffer(self.memory.active), dtype=np.float64)
        lanes = np.frombuffer(binding.buffer(self.memory.parameters), dtype=np.float64).reshape(-1, len(self.active))
        self.parameters = lanes[: work.parameters.shape[1]]
        self.count, self.step = min(len(self.active), work.count - first), 0
        self.left: dict[int, _SingleRun] = {}
        self._fill()

    def _fill(self) -> None:
        """Put a trajectory into each lane; surplus lanes repeat the last one and are inactive."""
        work, call, pointer = self.work, self.binding.function("set"), self.binding.pointer
        v = self._velocities()
        for lane in range(len(self.active)):
            k = min(lane, self.count - 1)
            j = self.first + k
            velocity = self.binding.null if v is None else pointer(v[k])
            call(self.memory, lane, pointer(work.q[0, j]), pointer(work.p[0, j]), velocity, pointer(work.parameters[j]))
        self.active[self.count :] = 0.0
        if v is not None:
            self.active[: self.count] *= np.isfinite(v).all(axis=1)

    def _velocities(self) -> Array | None:
        """Return (count, m) initial velocities if the predictor needs them, NaN where undefined; else ``None``."""
        if not self.binding.constant("NEEDS_VELOCITIES"):
            return None
        work, v = self.work, np.full((self.count, self.work.stepper.dimension), np.nan)
        for k in range(self.count):
            j = self.first + k
            with suppress(StateError):
                v[k] = work.stepper.velocity(work.q[0, j], work.p[0, j], work.t0, work.parameters[j])
        return v

    def lanes(self, name: str) -> Array:
        """Return a (m, lanes) view of a field of the block: ``q``, ``p``, ``carry_q`` or ``carry_p``."""
        field = np.frombuffer(self.binding.buffer(getattr(self.memory, name)), dtype=np.float64)
        return field.reshape(self.work.stepper.dimension, -1)

    def advance(self, size: int) -> None:
        """Advance by ``size`` steps."""
        for chunk_size in self.work.step_chunks(self.step, size):
            if chunk_size.change is not None:
                self._change(
                    chunk_size.change.h, chunk_size.change.parameters(slice(self.first, self.first + self.count))
                )
            self._advance(chunk_size.steps, chunk_size.save_every)

    def _change(self, h: float, parameters: Array) -> None:
        """Set step size and parameters; a new step size invalidates the predictor."""
        for lane, alone in self.left.items():
            alone.update(h, parameters[lane])
        self.parameters[:, : self.count] = parameters.T
        self.parameters[:, self.count :] = parameters[-1:].T
        if h == self.memory.h:
            return
        self.memory.h, self.memory.guess = h, 0
        if self.binding.constant("NEEDS_VELOCITIES"):
            self._reset_predictor(parameters)

    def _reset_predictor(self, parameters: Array) -> None:
        """Reset the predictor to the current velocities, as initially; deactivate lanes without velocities."""
        at_points = np.frombuffer(self.binding.buffer(self.memory.memory), dtype=np.float64)
        at_points = at_points.reshape(-1, self.work.stepper.dimension, len(self.active))
        q, p, t = self.lanes("q").T, self.lanes("p").T, float(self.memory.t)
        for lane in np.flatnonzero(self.active[: self.count] > 0.0):
            try:
                at_points[:, :, lane] = self.work.stepper.velocity(q[lane], p[lane], t, parameters[lane])
            except StateError:
                self.active[lane] = 0.0

    def _advance(self, size: int, save_every: int) -> None:
        work, begin, self.step = self.work, self.step, self.step + size
        if len(self.left) < self.count:
            row = work.row(begin)
            stride = work.count * work.stepper.dimension
            offset = row * stride + self.first * work.stepper.dimension if row < len(work.q) else 0
            self.binding.function("advance")(
                self.memory,
                self.count,
                size,
                save_every,
                self.binding.options(work.options),
                self.binding.pointer(work.q) + offset,
                self.binding.pointer(work.p) + offset,
                stride,
            )
        running = self.active[: self.count] > 0.0
        work.done[self.first : self.first + self.count][running] = self.step
        for lane in np.flatnonzero(~running):
            self._continue_singly(int(lane), begin, save_every)

    def _continue_singly(self, lane: int, begin: int, save_every: int) -> None:
        """Replace the states that a call from step ``begin`` stored for an inactive lane by those of a single run."""
        work, j = self.work, self.first + lane
        if lane not in self.left:
            step = int(self.memory.last_step[lane])
            q, p, *carries = (self.lanes(name)[:, lane].copy() for name in ("q", "p", "carry_q", "carry_p"))
            self.left[lane] = _SingleRun(work, j, q, p, step, (carries[0], carries[1]))
            begin = step
        rows = slice(work.row(begin), work.row(self.step))
        work.q[rows, j] = work.p[rows, j] = np.nan
        self.left[lane].advance_to(self.step, save_every)


class _SingleBlock:
    """Block of one trajectory, for methods without SIMD lanes."""

    def __init__(self, work: Ensemble, first: int) -> None:
        self.step, self.run = 0, _SingleRun(work, first, work.q[0, first], work.p[0, first])

    def advance(self, size: int) -> None:
        """Advance by ``size`` steps."""
        for chunk_size in self.run.work.step_chunks(self.step, size):
            self.step += chunk_size.steps
            if chunk_size.change is not None:
                self.run.update(chunk_size.change.h, chunk_size.change.parameters(slice(self.run.j, self.run.j + 1))[0])
            self.run.advance_to(self.step, chunk_size.save_every)


class _SingleRun:
    """Trajectory j computed by the single integrator from its state after ``step`` steps."""

    def __init__(
        self, work: Ensemble, j: int, q: Array, p: Array, step: int = 0, carries: tuple[Array, Array] | None = None
    ) -> None:
        self.work, self.j = work, j
        self.run: Memory | None = None
        work.done[j] = step
        h, time, parameters = work.step_data(step, j)
        try:
            given: dict[str, Any] = {"t": work.t0, "parameters": parameters, "options": work.options}
            run = Memory.started(work.stepper, q, p, plan=StepPlan.with_step(h), **given)
        except StateError:  # a sum of finite terms has overflowed
            work.status[j] = "not finite"
        else:
            if carries is not None:
                run._resume_at(step, time, carries)
            self.run = run

    def update(self, h: float, parameters: Array) -> None:
        """Set step size and parameters."""
        if self.run is not None:
            self.run.update(h=h, parameters=parameters)

    def advance_to(self, step: int, save_every: int) -> None:
        """Advance to step number ``step``, unless the trajectory has failed."""
        work, j, run = self.work, self.j, self.run
        if run is None:
            return
        row = work.row(run.steps)
        try:
            trajectory = record(run, step - run.steps, save_every=save_every)
        except StepFailedError as failure:
            work.status[j], trajectory, self.run = failure.status, Trajectory.before(failure), None
        work.done[j] = run.steps
        rows = slice(row, row + len(trajectory) - 1)
        work.q[rows, j], work.p[rows, j] = trajectory.q[1:], trajectory.p[1:]
        if work.times is not None:
            work.times[rows, j] = trajectory.t[1:]
