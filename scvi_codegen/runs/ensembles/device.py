"""Ensembles with common fixed steps on a GPU: a thread is one trajectory, results stay in the memory of the device.

A trajectory whose step fails stops there. The single integrator continues it on the processor, as it does those that
leave a block of SIMD lanes (:mod:`scvi_codegen.runs.ensembles.lanes`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.cuda import Device
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.representation import one_line
from scvi_codegen.runs.ensembles.lanes import CommonRuns, Departure, follow
from scvi_codegen.runs.ensembles.result import EnsembleRuns, EnsembleTrajectory
from scvi_codegen.runs.ensembles.thread_pool import StopCheck, run_jobs
from scvi_codegen.runs.results.quantities import short_title
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.chunks import drive

FIRST_STEPS, GROWTH = 64, 8.0
"""Steps of the first launch, and the largest ratio of those of successive ones."""
HEAD = 4
"""Numbers in front of the memory of a trajectory: time, its low word, steps for the predictor, 1 while active."""


class DeviceRuns(CommonRuns):
    """Trajectories with common fixed steps on a GPU; ``q`` and ``p`` are arrays of the device."""

    q: Any
    p: Any

    def _allocate(self) -> None:
        """Create the arrays on the device, with the initial states, and the memory of the threads."""
        stepper, device, q = self.ensemble.stepper, Device(), self.ensemble.q
        source = cast(Source, stepper.ensemble if self.observation is None else self.observation.source)
        self.device, self.launch = device, device.kernels(source)
        lanes = source.contents.lanes
        assert lanes is not None  # of an ensemble
        self.stored, self.needs_velocities = lanes.stored, lanes.needs_velocities
        self.count, self.m = map(int, q.shape)
        self.q, self.p = (device.empty((len(self.steps.numbers), *q.shape)) for _ in "qp")
        device.copy_in(q, self.q)
        device.copy_in(self.ensemble.p, self.p)
        parameters = self.ensemble.parameters
        self.parameters = device.copied(parameters if parameters.size else np.zeros((self.count, 1)))
        self.h = self.steps.segments[0].h
        self.memory = device.copied(self._first_memory(parameters))
        self.counts = device.copied(np.zeros(self.count, np.int64))

    @property
    def size(self) -> int:
        """Numbers in the memory of a trajectory, without observed values."""
        return HEAD + (4 + 2 * self.stored) * self.m

    def states(self) -> tuple[Array, Array]:
        """Return copies of the (n, k, m) saved positions and momenta on the processor."""
        return self.device.copy_out(self.q), self.device.copy_out(self.p)

    def _first_memory(self, parameters: Array) -> Array:
        """Return (numbers, k) initial memory of the threads."""
        observed = np.empty((0, self.count)) if self.observation is None else self.observation.rows
        memory = np.zeros((self.size + len(observed), self.count))
        memory[self.size :] = observed
        memory[0], memory[3] = self.steps.t0, 1.0
        for i, states in enumerate((self.ensemble.q, self.ensemble.p)):
            memory[HEAD + i * self.m : HEAD + (i + 1) * self.m] = states.T
        self._reset_predictor(memory, parameters)
        return memory

    def _reset_predictor(self, memory: Array, parameters: Array) -> None:
        """Discard the stored values of the last steps; where the predictor needs them, use the present velocities."""
        memory[2] = 0.0
        if not self.needs_velocities:
            return
        m, stored = self.m, memory[HEAD + 4 * self.m : self.size].reshape(2 * self.stored, self.m, -1)
        q, p, running = memory[HEAD : HEAD + m].T, memory[HEAD + m : HEAD + 2 * m].T, memory[3] > 0.0
        if running.all() and (parameters == parameters[0]).all():  # in one call
            with suppress(StateError):
                stored[:] = self.ensemble.stepper.velocity(q, p, memory[0], parameters[0]).T
                return
        for j in np.flatnonzero(running):
            memory[3, j] = 0.0
            with suppress(StateError):
                stored[:, :, j] = self.ensemble.stepper.velocity(q[j], p[j], memory[0, j], parameters[j])
                memory[3, j] = 1.0

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all trajectories; then continue those that failed on the processor, with ``threads`` threads."""
        step = 0

        def advance(size: int) -> int:
            nonlocal step
            for chunk in self.steps.chunks(step, size):
                if chunk.entered is not None:
                    self._enter(chunk.entered.h, self.ensemble.values_at(chunk.entered.middle))
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
        yield from (np.uint64(states.ptr + size) for states in (self.q, self.p))

    def _advance(self, begin: int, size: int, save_every: int) -> None:
        options = self.ensemble.settings.options or SolverOptions()
        solver = float(options.tolerance), int(options.max_iterations), int(options.absolute)
        memory = self.memory, self.parameters, *self._rows(begin), self.counts
        self.launch("thread_advance", self.count, self.count, begin, size, save_every, float(self.h), *solver, *memory)

    def _continue(self, failed: NDArray[np.intp], threads: int | None) -> None:
        """Continue trajectories from their last good states on the processor, and store their states on the device."""
        if not failed.size:
            return
        memory = self.device.copy_out(self.memory)[HEAD : HEAD + 4 * self.m, failed]
        q, p, *low = (np.ascontiguousarray(values.T) for values in memory.reshape(4, self.m, -1))
        observation = None if self.observation is None else self.observation.part(failed)
        work = CommonRuns(self.ensemble.some(failed), observation)

        def advance(j: int, check_stop: StopCheck) -> None:
            follow(work, Departure(j, int(self.done[failed[j]]), q[j], p[j], (low[0][j], low[1][j])), check_stop)

        run_jobs(len(failed), advance, progress=None, threads=threads)
        self.status[failed], self.done[failed] = work.status, work.done
        self.fallback_steps[failed] = work.fallback_steps
        if observation is not None and self.observation is not None:
            self.observation.values[:, :, failed] = observation.values
        which, rows = self.device.copied(failed.astype(np.int64)), len(work.q)
        for target, values in ((self.q, work.q), (self.p, work.p)):
            arguments = self.count, rows, len(failed), which, self.device.copied(values), target
            self.launch("thread_replace", rows * len(failed), *arguments)

    def device_result(self) -> DeviceEnsemble:
        """Return the trajectories, whose states stay in the memory of the device."""
        return DeviceEnsemble(q=self.q, p=self.p, _to_host=self.result, **self.about())


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
