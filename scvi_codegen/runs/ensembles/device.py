"""Ensembles on a GPU: a thread is one trajectory, results stay in the memory of the device.

A trajectory whose step fails stops there. With common fixed steps the single integrator continues it on the processor,
as it does those that leave a block of SIMD lanes (:mod:`scvi_codegen.runs.ensembles.lanes`); with adaptive steps it
repeats it from the start.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.cuda import DEVICES, Device, constant, has_device_memory
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import POINT_THREADS, Source
from scvi_codegen.codegen.variants import ThreadPerTrajectory
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.common.representation import one_line
from scvi_codegen.common.validation import LARGEST_COUNT
from scvi_codegen.runs.ensembles.batches import CHUNK_SECONDS, Rows, SuccessiveRuns
from scvi_codegen.runs.ensembles.lanes import CommonRuns, SingleRun
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import INTERRUPTED, OK, EnsembleRuns, EnsembleTrajectory
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.ensembles.thread_pool import StopCheck, run_jobs
from scvi_codegen.runs.results.descriptions import short_title
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.step_plan import Adaptive, absolute_tolerances

FIRST_STEPS, GROWTH = 64, 8.0
"""Steps of the first launch, and the largest ratio of those of successive ones."""
FEWEST_COORDINATES = 7
"""Number of coordinates from which on :data:`POINT_THREADS` threads share a trajectory, if its steps allow it."""
HEAD = 4
"""Numbers in front of the memory of a trajectory: time, its low word, steps for the predictor, 1 while active."""


def check_device(device: str) -> None:
    """Raise ``StateError`` for an unknown device."""
    if device not in DEVICES:
        raise StateError(f"device is {device!r}: it must be {' or '.join(map(repr, DEVICES))}, or omitted")


def on_processor(value: Any) -> Any:
    """Return a copy on the processor of an array of a GPU, alone or in a mapping; other values unchanged."""
    if isinstance(value, Mapping):
        return {name: on_processor(each) for name, each in value.items()}
    return Device().copy_of(value) if has_device_memory(value) else value


def options_of(options: SolverOptions) -> tuple[float, int, int]:
    """Return the solver options as arguments of kernels."""
    return float(options.tolerance), int(options.max_iterations), int(options.absolute)


class ThreadRecord(Protocol):
    """Records of the threads of an ensemble besides states, or instead of them.

    Attributes:
        source: of the ensemble.
        rows: (numbers, k) initial values in the memory of the threads, which are replaced by the final ones.
        saved: (k, numbers) initial values of what is saved instead of positions, or ``None``.
    """

    source: Source
    saved: Array | None

    @property
    def rows(self) -> Array:
        """Values in the memory of the threads, which change in place."""


class DeviceRuns:
    """Trajectories with common fixed steps on a GPU; arguments as of :class:`CommonRuns`.

    Attributes:
        q, p: (n, k, m) saved states, on the device; with a record that is saved instead, (n, k, numbers) and nothing.
        times, actions: ``None``: all trajectories have the same times, and no action is summed.
        status, done, fallback_steps: as of :class:`CommonRuns`.
    """

    times = actions = None

    def __init__(
        self,
        stepper: Integrator,
        options: SolverOptions | None,
        start: tuple[Array, Array],
        parameters: Array,
        values_at: Callable[[float, slice], Array],
        steps: CommonSteps,
        observation: EnsembleObservation | None = None,
        *,
        record: ThreadRecord | None = None,
        source: Source | None = None,
    ) -> None:
        self.stepper, self.options, self.start, self.steps = stepper, options or SolverOptions(), start, steps
        self.values_at, self.observation, self.device = values_at, observation, Device()
        record = self.record = record or observation
        self.values = parameters
        source = source or cast(Source, stepper.ensemble if record is None else record.source)
        self.launch = self.device.kernels(source)
        count, self.m = map(int, start[0].shape)
        self.count, device = count, self.device
        saved = start if record is None or record.saved is None else (record.saved, np.empty((0, 0)))
        self.q, self.p = (device.empty((len(steps.numbers), *each.shape)) for each in saved)
        for initial, states in zip(saved, (self.q, self.p), strict=True):
            device.copy_in(initial, states)
        self.parameters = device.copied(parameters if parameters.size else np.zeros((count, 1)))
        self.h = steps.segments[0].h
        self._begin(source)
        self.counts = device.copied(np.zeros(count, np.int64))
        self.status, self.done = np.full(count, OK, dtype="<U32"), np.zeros(count, dtype=np.int64)
        self.fallback_steps = np.zeros_like(self.done)

    def __len__(self) -> int:
        return self.count

    @property
    def size(self) -> int:
        """Numbers in the memory of a trajectory, without observed values."""
        return HEAD + (4 + 2 * self.points) * self.m

    def _begin(self, source: Source) -> None:
        """Prepare the memory of the threads."""
        self.points = constant(source, "S")
        self.needs_velocities = bool(constant(source, f"{source.prefix.upper()}_NEEDS_VELOCITIES"))
        self.memory = self.device.copied(self._first_memory(self.values))

    def states(self) -> tuple[Array, Array]:
        """Return copies of the (n, k, m) saved positions and momenta on the processor."""
        return self.device.copy_out(self.q), self.device.copy_out(self.p)

    def _first_memory(self, parameters: Array) -> Array:
        """Return (numbers, k) initial memory of the threads."""
        recorded = np.empty((0, self.count)) if self.record is None else self.record.rows
        memory = np.zeros((self.size + len(recorded), self.count))
        memory[self.size :] = recorded
        memory[0], memory[3] = self.steps.t0, 1.0
        for i, states in enumerate(self.start):
            memory[HEAD + i * self.m : HEAD + (i + 1) * self.m] = states.T
        self._reset_predictor(memory, parameters)
        return memory

    def _reset_predictor(self, memory: Array, parameters: Array) -> None:
        """Discard the stored values of the last steps; where the predictor needs them, use the present velocities."""
        memory[2] = 0.0
        if not self.needs_velocities:
            return
        m, stored = self.m, memory[HEAD + 4 * self.m : self.size].reshape(2 * self.points, self.m, -1)
        q, p, running = memory[HEAD : HEAD + m].T, memory[HEAD + m : HEAD + 2 * m].T, memory[3] > 0.0
        if running.all() and (parameters == parameters[0]).all():  # in one call
            with suppress(StateError):
                stored[:] = self.stepper.velocity(q, p, memory[0], parameters[0]).T
                return
        for j in np.flatnonzero(running):
            memory[3, j] = 0.0
            with suppress(StateError):
                stored[:, :, j] = self.stepper.velocity(q[j], p[j], memory[0, j], parameters[j])
                memory[3, j] = 1.0

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> None:
        """Integrate all trajectories; then continue those that failed on the processor, with ``threads`` threads."""
        step = 0

        def advance(size: int) -> int:
            nonlocal step
            for chunk in self.steps.chunks(step, size):
                if chunk.entered is not None:
                    self._enter(chunk.entered.h, self.values_at(chunk.entered.middle, slice(None)))
                self._advance(step, chunk.steps, chunk.save_every)
                step += chunk.steps
            return size

        try:
            drive(advance, self.steps.steps, first=FIRST_STEPS, growth=GROWTH, ended=lambda: False, progress=progress)
        finally:
            self.done = self.device.copy_out(self.counts)
            if self.record is not None:
                self.record.rows[:] = self.device.copy_out(self.memory)[self.size :]
        if self.record is self.observation:
            self._continue(np.flatnonzero(self.done < self.steps.steps), threads)

    def _enter(self, h: float, parameters: Array) -> None:
        """Set step size and parameters; a new step size invalidates the predictor."""
        device = self.device
        if parameters.size:
            device.copy_in(parameters, self.parameters)
        if h != self.h:
            self.h, memory = h, device.copy_out(self.memory)
            self._reset_predictor(memory, parameters)
            device.copy_in(memory, self.memory)

    def _rows(self, begin: int) -> Iterator[np.uint64]:
        """Yield the places of the positions and of the momenta that are saved first after a step."""
        size = self.steps.row(begin) * self.count * self.q.shape[2] * self.q.dtype.itemsize
        yield from (np.uint64(each.ptr + size) for each in (self.q, self.p))

    def _advance(self, begin: int, size: int, save_every: int) -> None:
        options, states = self.options, self._rows(begin)
        numbers = options_of(options)
        memory = self.memory, self.parameters, *states, self.counts
        self.launch("thread_advance", self.count, self.count, begin, size, save_every, float(self.h), *numbers, *memory)

    def _continue(self, failed: NDArray[np.intp], threads: int | None) -> None:
        """Continue trajectories from their last good states on the processor, and store their states on the device."""
        if not failed.size:
            return
        memory = self.device.copy_out(self.memory)[HEAD : HEAD + 4 * self.m, failed]
        q, p, *carries = (np.ascontiguousarray(each.T) for each in memory.reshape(4, self.m, -1))

        def values_at(time: float, part: slice) -> Array:
            return self.values_at(time, slice(None))[failed][part]

        start = self.start[0][failed], self.start[1][failed]
        initial = values_at(self.steps.segments[0].middle, slice(None))
        observation = None if self.observation is None else self.observation.part(failed)
        work = CommonRuns(self.stepper, self.options, start, initial, values_at, self.steps, observation)

        def advance(j: int, check_stop: StopCheck) -> None:
            step = int(self.done[failed[j]])
            SingleRun(work, j, q[j], p[j], step, (carries[0][j], carries[1][j])).follow(check_stop)

        run_jobs(len(failed), advance, progress=None, threads=threads)
        self.status[failed], self.done[failed] = work.status, work.done
        self.fallback_steps[failed] = work.fallback_steps
        if observation is not None and self.observation is not None:
            self.observation.values[:, :, failed] = observation.values
        which, rows = self.device.copied(failed.astype(np.int64)), len(work.q)
        for target, values in ((self.q, work.q), (self.p, work.p)):
            arguments = self.count, rows, len(failed), which, self.device.copied(values), target
            self.launch("thread_replace", rows * len(failed), *arguments)


class PointRuns(DeviceRuns):
    """Trajectories with equal steps on a GPU, each by :data:`POINT_THREADS` threads with one point of a step each."""

    def _begin(self, source: Source) -> None:
        device, size = self.device, self.device.copied(np.zeros(1, np.int64))
        self.launch("thread_size", 1, size)
        self.memory = device.empty((int(device.copy_out(size)[0]) * POINT_THREADS * self.count,), np.uint8)
        self.initial = [device.copied(each) for each in self.start]

    def _advance(self, begin: int, size: int, save_every: int) -> None:
        plan = self.count, begin, size, save_every, float(self.steps.t0), float(self.h), *options_of(self.options)
        arrays = self.memory, *self.initial, self.parameters, *self._rows(begin), self.counts
        self.launch("thread_points", POINT_THREADS * self.count, *plan, *arrays)

    def _continue(self, failed: NDArray[np.intp], threads: int | None) -> None:
        """Repeat trajectories on the processor, and store their states on the device."""
        if not failed.size:
            return
        start, values = (self.start[0][failed], self.start[1][failed]), self.values[failed]
        work = CommonRuns(self.stepper, self.options, start, values, lambda _, part: values[part], self.steps)
        work.run(progress=None, threads=threads)
        self.status[failed], self.done[failed] = work.status, work.done
        for target, saved in ((self.q, work.q), (self.p, work.p)):
            states = self.device.copy_out(target)
            states[:, failed] = saved
            self.device.copy_in(states, target)


class AdaptiveDeviceRuns:
    """Trajectories with adaptive steps on a GPU; arguments as of :class:`SuccessiveRuns`.

    Each launch takes a number of steps. Threads of a warp wait for each other, so the trajectories of the next launch
    are those that have not ended, sorted by the number of steps that they still need at their present rate.

    Attributes:
        q, p: (2, k, m) initial and final states, on the device.
        t, status, done: (k,) times that were reached, reasons of the end, and numbers of completed steps.
    """

    def __init__(
        self,
        stepper: Integrator,
        options: SolverOptions | None,
        start: tuple[Array, Array],
        parameters: Array,
        t0: float,
        t_end: Array,
        *,
        plan: Adaptive,
    ) -> None:
        source = stepper._variants[ThreadPerTrajectory()]
        if source is None:
            raise MethodError(
                f"adaptive steps on a GPU are not available for '{stepper.title}': they require a fixed-point "
                "iteration with forces at two or more stages, as of SVI and Gauss methods; give h and steps, or omit "
                "device"
            )
        self.stepper, self.options, self.start = stepper, options, start
        self.values, self.t0, self.t_end, self.plan = parameters, t0, t_end, plan
        device = self.device = Device()
        self.launch, count = device.kernels(source), len(t_end)
        self.q, self.p = (device.copied(np.stack([each, each])) for each in start)
        self.t, self.status = np.full(count, t0), np.full(count, OK, dtype="<U32")
        self.done = np.zeros(count, np.int64)

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> None:
        """Integrate all trajectories; then repeat those whose steps failed on the processor, in ``threads`` threads."""
        device, count = self.device, len(self.done)
        size, codes, reached = (device.copied(np.full(n, -1)) for n in (1, count, count))
        self.launch("thread_size", 1, size)
        runs = device.empty((int(device.copy_out(size)[0]) * count,), np.uint8)
        ends = (np.uint64(each.ptr + each.dtype.itemsize * count * each.shape[2]) for each in (self.q, self.p))
        parameters = device.copied(self.values if self.values.size else np.zeros((count, 1)))
        numbers = (0.0, 0, 0) if self.options is None else options_of(self.options)
        arrays = runs, parameters, device.copied(self.t), *ends, codes, reached
        control = self._control()
        t_end, left, steps, first, status = (
            device.copied(self.t_end),
            np.arange(count),
            FIRST_STEPS,
            1,
            np.full(count, -1),
        )
        try:
            while left.size:
                began, which = time.perf_counter(), device.copied(left)
                plan = len(left), which, first, steps, float(self.t0), t_end, *control, *numbers
                self.launch("thread_advance_to", len(left), *plan, *arrays)
                status, self.t, self.done = map(device.copy_out, (codes, arrays[2], reached))
                if progress is not None:
                    progress(int(np.count_nonzero(status >= 0)))
                left = self._sorted(np.flatnonzero(status < 0))
                first, slow = 0, time.perf_counter() - began > CHUNK_SECONDS
                steps = steps if slow else int(GROWTH) * steps
        finally:
            self.status[status < 0] = INTERRUPTED
            if (status != 0).any():
                self._replace(status, threads)

    def _control(self) -> tuple[Any, ...]:
        """Return the step control as arguments of the kernel, the last of which is on the device, or 0 for NULL."""
        plan, absolute = self.plan, np.uint64(0)
        if plan.absolute_tolerance != ():
            values = absolute_tolerances(self.stepper.interface, self.stepper.dimension, plan.absolute_tolerance)
            absolute = self.device.copied(values)
        first = math.nan if plan.first_step is None else plan.first_step
        return float(plan.tolerance), float(plan.max_step), first, absolute

    def _sorted(self, left: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return trajectories in the order of the numbers of steps that they still need at their present rate."""
        passed, rest = np.abs(self.t - self.t0)[left], np.abs(self.t_end - self.t)[left]
        return left[np.argsort(rest * self.done[left] / np.where(passed > 0.0, passed, 1.0), kind="stable")]

    def _replace(self, status: NDArray[np.int64], threads: int | None) -> None:
        """Repeat the failed trajectories on the processor; final states are NaN where they are unknown."""
        failed = np.flatnonzero(status > 0)
        finals = [self.device.copy_out(each) for each in (self.q, self.p)]
        for each in finals:
            each[1, status != 0] = np.nan

        def store(states: Rows) -> None:
            trajectories = states.indices()[1]
            for each, values in zip(finals, (states.q, states.p), strict=True):
                each[1, failed[trajectories]] = values
            self.t[failed[trajectories]] = states.t

        if failed.size:
            again = SuccessiveRuns(
                self.stepper,
                self.options,
                (self.start[0][failed], self.start[1][failed]),
                self.values[failed],
                self.t0,
                self.t_end[failed],
                plan=self.plan,
                save_every=LARGEST_COUNT,
                receive=store,
            )
            again.run(progress=None, threads=threads)
            self.status[failed], self.done[failed] = again.names, again.done
        for target, each in zip((self.q, self.p), finals, strict=True):
            self.device.copy_in(each, target)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DeviceEnsemble(EnsembleRuns):
    """States of k trajectories in the memory of a GPU, the initial state first; the rest is on the processor.

    Attributes:
        q, p: (n, k, m) positions and momenta, NaN after a failure; arrays of the device with ``__dlpack__``, for
            ``cupy.from_dlpack(runs.q)`` and ``torch.from_dlpack``.
    """

    q: Any
    p: Any
    _to_host: Callable[[], EnsembleTrajectory] = field(repr=False)

    def __repr__(self) -> str:
        states = f"{len(self.t)} states of each of {len(self)} trajectories on a GPU, {np.count_nonzero(self.ok)} ok"
        return one_line(self, short_title(self.stepper.interface), states)

    def to_host(self) -> EnsembleTrajectory:
        """Return a copy in the memory of the processor, with energies, plots and files."""
        return self._to_host()
