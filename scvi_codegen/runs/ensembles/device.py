"""Ensembles with common fixed steps on a GPU: a thread is one trajectory, results stay in the memory of the device.

A trajectory whose step fails stops there. The single integrator continues it on the processor, as it does those that
leave a block of SIMD lanes (:mod:`scvi_codegen.runs.ensembles.lanes`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.cuda import DEVICES, Device, has_device_memory
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.representation import one_line
from scvi_codegen.runs.ensembles.lanes import CommonRuns, SingleRun
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import OK, EnsembleRuns, EnsembleTrajectory
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.ensembles.thread_pool import StopCheck, run_jobs
from scvi_codegen.runs.results.descriptions import short_title
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.features import check_together
from scvi_codegen.runs.stepping.integrator import Integrator

FIRST_STEPS, GROWTH = 64, 8.0
"""Steps of the first launch, and the largest ratio of those of successive ones."""
HEAD = 4
"""Numbers in front of the memory of a trajectory: time, its low word, steps for the predictor, 1 while active."""


def check_device(device: str | None, h: float | None, **others: Any) -> None:
    """Raise ``StateError`` for an unknown device, without a step size h, and for arguments that a device excludes."""
    if device not in (None, *DEVICES):
        raise StateError(f"device is {device!r}: it must be {' or '.join(map(repr, DEVICES))}, or omitted")
    check_together(device=device, adaptive=True if h is None else None, **others)


def on_processor(value: Any) -> Any:
    """Return a copy on the processor of an array of a GPU, alone or in a mapping; other values unchanged."""
    if isinstance(value, Mapping):
        return {name: on_processor(each) for name, each in value.items()}
    return Device().copy_of(value) if has_device_memory(value) else value


class DeviceRuns:
    """Trajectories with common fixed steps on a GPU; arguments as of :class:`CommonRuns`.

    Attributes:
        q, p: (n, k, m) saved states, on the device.
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
    ) -> None:
        self.stepper, self.options, self.start, self.steps = stepper, options or SolverOptions(), start, steps
        self.values_at, self.observation, self.device = values_at, observation, Device()
        source = cast(Source, stepper.ensemble if observation is None else observation.source)
        self.launch = self.device.kernels(source)
        lanes = source.contents.lanes
        assert lanes is not None  # of an ensemble
        self.points, self.needs_velocities = lanes.points, lanes.needs_velocities
        count, self.m = map(int, start[0].shape)
        self.count, device = count, self.device
        self.q, self.p = (device.empty((len(steps.numbers), *each.shape)) for each in start)
        for initial, states in zip(start, (self.q, self.p), strict=True):
            device.copy_in(initial, states)
        self.parameters = device.copied(parameters if parameters.size else np.zeros((count, 1)))
        self.h = steps.segments[0].h
        self.memory = device.copied(self._first_memory(parameters))
        self.counts = device.copied(np.zeros(count, np.int64))
        self.status, self.done = np.full(count, OK, dtype="<U32"), np.zeros(count, dtype=np.int64)
        self.fallback_steps = np.zeros_like(self.done)

    def __len__(self) -> int:
        return self.count

    @property
    def size(self) -> int:
        """Numbers in the memory of a trajectory, without observed values."""
        return HEAD + (4 + 2 * self.points) * self.m

    def states(self) -> tuple[Array, Array]:
        """Return copies of the (n, k, m) saved positions and momenta on the processor."""
        return self.device.copy_out(self.q), self.device.copy_out(self.p)

    def _first_memory(self, parameters: Array) -> Array:
        """Return (numbers, k) initial memory of the threads."""
        observed = np.empty((0, self.count)) if self.observation is None else self.observation.rows
        memory = np.zeros((self.size + len(observed), self.count))
        memory[self.size :] = observed
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
            if self.observation is not None:
                self.observation.rows[:] = self.device.copy_out(self.memory)[self.size :]
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
        solver = float(self.options.tolerance), int(self.options.max_iterations), int(self.options.absolute)
        memory = self.memory, self.parameters, *self._rows(begin), self.counts
        self.launch("thread_advance", self.count, self.count, begin, size, save_every, float(self.h), *solver, *memory)

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
