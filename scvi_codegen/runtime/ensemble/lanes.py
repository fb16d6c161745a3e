"""Blocks of an ensemble with common fixed steps: trajectories in the SIMD lanes of C, or alone.

A lane whose step fails keeps its last good state and is continued by the single integrator (which falls back on
Newton's iteration); if that fails too, its later states are NaN and its status gives the reason. Other lanes are
unaffected.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native.arguments import empty_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.ensemble.batches import (
    CHUNK_SECONDS,
    FIRST_CHUNK_STEPS,
    GROWTH,
    Batch,
    Call,
    Rows,
    SuccessiveRuns,
)
from scvi_codegen.runtime.ensemble.observation import EnsembleObservation
from scvi_codegen.runtime.ensemble.result import OK
from scvi_codegen.runtime.ensemble.schedule import CommonSteps
from scvi_codegen.runtime.ensemble.thread_pool import StopCheck, run_jobs
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.run_loop import record
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.trajectory import Trajectory


@dataclass(eq=False)
class CommonRuns:
    """Trajectories with common fixed steps: the arrays that blocks of trajectories fill.

    Attributes:
        stepper, options: the integrator and its solver options.
        start: (k, m) initial positions and momenta.
        parameters: (k, number of parameters) values.
        values_at: function that returns the parameters at a time of a slice of trajectories, one row each.
        steps: the steps.
        observation: functions of the state that are observed along the runs, or ``None``.
        q, p: (n, k, m) saved states; NaN where not reached.
        times: (n, k) times in transformed time, else ``None``.
        actions: (n, k) actions up to each state if runs sum them, NaN where unknown, else ``None``.
        status, done: reason of the end and number of completed steps of each trajectory.
        fallback_steps: numbers of steps that the iteration did not solve, but its fallback.
    """

    stepper: Integrator
    options: SolverOptions | None
    start: tuple[Array, Array]
    parameters: Array
    values_at: Callable[[float, slice], Array]
    steps: CommonSteps
    observation: EnsembleObservation | None = None

    def __post_init__(self) -> None:
        shape = (len(self.steps.numbers), *self.start[0].shape)
        self.q, self.p = empty_array(shape), empty_array(shape)
        self.q[:] = self.p[:] = np.nan
        self.q[0], self.p[0] = self.start
        self.actions = np.full(shape[:2], np.nan) if self.stepper.sums_action else None
        if self.actions is not None:
            self.actions[0] = 0.0
        self.times = np.full(shape[:2], np.nan) if self.stepper.interface.energy_parameter else None
        if self.times is not None:
            self.times[0] = self.steps.t0
        self.status, self.done = np.full(len(self), OK, dtype="<U32"), np.zeros(len(self), dtype=np.int64)
        self.fallback_steps = np.zeros_like(self.done)

    def __len__(self) -> int:
        return len(self.start[0])

    def states(self) -> tuple[Array, Array]:
        """Return the (n, k, m) saved positions and momenta."""
        return self.q, self.p

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> None:
        """Integrate all trajectories; ``progress`` is called with the number of completed steps and may raise."""
        batch, unit = self._batch(), self.steps.steps / len(self)
        if batch is None:
            self._run_blocks(progress, threads)
            return
        try:
            batch.run(progress=None if progress is None else lambda done: progress(int(done * unit)), threads=threads)
        finally:
            if isinstance(batch, SuccessiveRuns):
                self.status = np.where(batch.status >= 0, batch.names, OK)
                self.done, self.fallback_steps = batch.done, batch.fallback_steps

    def _batch(self) -> Batch | None:
        """Return the trajectories as C integrates many in one call, ``None`` if it does not."""
        stepper, binding = self.stepper, self._binding
        start = self.options, self.start, self.parameters, self.steps.t0
        if self.steps.has_inputs or stepper.in_tau or not self.steps.steps:
            return None
        if stepper.ensemble is None:
            fixed = self.steps.fixed_segments()
            return SuccessiveRuns(stepper, *start, fixed, receive=self._store) if stepper.binding.reusable else None
        if binding is None or self.observation is not None or binding.constant("NEEDS_VELOCITIES"):
            return None
        return LaneRuns(self, binding, *start, self.steps.fixed_segments())

    def _store(self, states: Rows) -> None:
        self.q[states.rows, states.trajectories], self.p[states.rows, states.trajectories] = states.q, states.p
        if self.actions is not None:
            self.actions[states.rows, states.trajectories] = states.actions

    def _run_blocks(self, progress: Callable[[int], None] | None, threads: int | None) -> None:
        _, width = self.blocks()
        reached = np.zeros(-(-len(self) // width))

        def advance(number: int, check_stop: StopCheck) -> None:
            def took(size: int) -> None:
                reached[number] = size

            self.advance_block(number * width, check_stop, took)

        report = None if progress is None else lambda _: progress(int(reached.mean()))
        run_jobs(len(reached), advance, progress=report, threads=threads)

    def advance_block(self, first: int, check_stop: StopCheck, progress: Callable[[int], None] | None = None) -> None:
        """Integrate a block to its end; ``progress`` is called with its number of completed steps."""
        block = self.blocks()[0](first)

        def advance(size: int) -> int:
            check_stop(size)
            block.advance(size)
            return size

        chunks: dict[str, Any] = {"first": FIRST_CHUNK_STEPS, "growth": GROWTH, "seconds": CHUNK_SECONDS}
        drive(advance, self.steps.steps, **chunks, ended=lambda: False, progress=progress)

    @property
    def _binding(self) -> Binding | None:
        return self.stepper._ensemble_binding if self.observation is None else self.observation.binding

    def blocks(self) -> tuple[Callable[[int], LaneBlock | SingleBlock], int]:
        """Return a function that makes the block beginning at a trajectory, and the trajectories per block."""
        binding = self._binding
        if binding is None:
            return lambda first: SingleBlock(self, first), 1
        return lambda first: LaneBlock(self, first, binding), len(binding.new("block *").active)


class LaneRuns(Batch):
    """Trajectories in SIMD lanes, of which C integrates many blocks in one call; arguments as of :class:`Batch`.

    Args:
        common: the trajectories, whose arrays C fills.
    """

    def __init__(self, common: CommonRuns, binding: Binding, *arguments: Any) -> None:
        super().__init__(binding, *arguments)
        self.common, self.width = common, len(binding.new("block *").active)
        common.done = self.done

    def call(self, first: int, end: int) -> Call:
        """Return the calls for a range of trajectories."""
        return _LaneCall(self, first, end)


class _LaneCall(Call):
    """Calls with the memory of a block; blocks with failed steps are repeated with single runs."""

    def __init__(self, work: LaneRuns, first: int, end: int) -> None:
        super().__init__(work, first, end)
        self.work, common, struct = work, work.common, self.struct
        self.block = struct.block = work.binding.new("block *")
        struct.positions, struct.momenta = map(work.binding.pointer, (common.q, common.p))
        if common.actions is not None:
            struct.actions = work.binding.pointer(common.actions)
        struct.trajectories = len(common)

    def advance(self, *, check_stop: StopCheck | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Advance as all calls; states after failed steps are NaN, until the block ends and is repeated."""
        work, common, end = self.work, self.work.common, int(self.struct.end)
        try:
            super().advance(check_stop=check_stop, until=until)
        finally:
            failed = np.flatnonzero(work.status[self.first : end] > 0) + self.first
            for j in failed.tolist():
                rows = slice(common.steps.row(int(work.done[j])), None)
                common.q[rows, j] = common.p[rows, j] = np.nan
        ended = failed[failed < self.struct.next] // work.width * work.width
        for first in np.unique(ended).tolist():
            common.advance_block(first, check_stop or (lambda _: None))
        self.first = int(self.struct.next)


class LaneBlock:
    """Trajectories in the SIMD lanes of one C block, and those that left it after a failed step."""

    def __init__(self, work: CommonRuns, first: int, binding: Binding) -> None:
        self.work, self.first, self.binding = work, first, binding
        self.memory = binding.new("block *")
        binding.function("start")(self.memory, work.steps.t0, work.steps.h)
        self.active = np.frombuffer(binding.buffer(self.memory.active), dtype=np.float64)
        lanes = np.frombuffer(binding.buffer(self.memory.parameters), dtype=np.float64).reshape(-1, len(self.active))
        self.parameters = lanes[: work.parameters.shape[1]]
        self.count, self.step = min(len(self.active), len(work) - first), 0
        self.left: dict[int, SingleRun] = {}
        self._fill()
        if work.observation is not None:
            self._advance(0, 1)  # includes the initial states

    def _fill(self) -> None:
        """Put a trajectory into each lane; surplus lanes repeat the last one and are inactive."""
        work, v, lanes = self.work, self._velocities(), np.arange(len(self.active))
        each = np.minimum(lanes, self.count - 1)
        self.lanes("q")[:], self.lanes("p")[:] = (x[0, self.first + each].T for x in (work.q, work.p))
        self.parameters[:] = work.parameters[self.first + each].T
        self.active[:] = lanes < self.count
        if v is not None:
            self._at_points()[:] = v[each].T
            self.active *= np.isfinite(v[each]).all(axis=1)

    def _velocities(self) -> Array | None:
        """Return (count, m) initial velocities if the predictor needs them, NaN where undefined; else ``None``."""
        if not self.binding.constant("NEEDS_VELOCITIES"):
            return None
        work, v = self.work, np.full((self.count, self.work.stepper.dimension), np.nan)
        for k in range(self.count):
            j = self.first + k
            with suppress(StateError):
                v[k] = work.stepper.velocity(work.q[0, j], work.p[0, j], work.steps.t0, work.parameters[j])
        return v

    def lanes(self, name: str) -> Array:
        """Return a (m, lanes) view of a field of the block: ``q``, ``p``, ``carry_q`` or ``carry_p``."""
        field = np.frombuffer(self.binding.buffer(getattr(self.memory, name)), dtype=np.float64)
        return field.reshape(self.work.stepper.dimension, -1)

    def _at_points(self) -> Array:
        """Return a (points, m, lanes) view of the values that the predictor extrapolates, of two steps."""
        values = np.frombuffer(self.binding.buffer(self.memory.memory), dtype=np.float64)
        return values.reshape(-1, self.work.stepper.dimension, len(self.active))

    def advance(self, size: int) -> None:
        """Advance by ``size`` steps."""
        for chunk in self.work.steps.chunks(self.step, size):
            if chunk.entered is not None:
                part = slice(self.first, self.first + self.count)
                self._change(chunk.entered.h, self.work.values_at(chunk.entered.middle, part))
            self._advance(chunk.steps, chunk.save_every)

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
        at_points = self._at_points()
        q, p, t = self.lanes("q").T, self.lanes("p").T, float(self.memory.t)
        for lane in np.flatnonzero(self.active[: self.count] > 0.0):
            try:
                at_points[:, :, lane] = self.work.stepper.velocity(q[lane], p[lane], t, parameters[lane])
            except StateError:
                self.active[lane] = 0.0

    def _advance(self, size: int, save_every: int) -> None:
        work, begin, self.step = self.work, self.step, self.step + size
        if len(self.left) < self.count:
            row = work.steps.row(begin)
            stride = len(work) * work.stepper.dimension
            offset = row * stride + self.first * work.stepper.dimension if row < len(work.q) else 0
            if work.actions is not None and hasattr(self.memory, "actions"):
                self.memory.actions = self.binding.pointer(work.actions) + offset // work.stepper.dimension
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
        if work.observation is not None:
            seen = np.frombuffer(self.binding.buffer(self.memory.observed), dtype=np.float64)
            here = work.observation.values[:, :, self.first : self.first + self.count]
            lanes = [lane for lane in range(self.count) if lane not in self.left]
            here[:, :, lanes] = seen.reshape(*here.shape[:2], -1)[:, :, lanes]
        for lane in np.flatnonzero(~running):
            self._continue_singly(int(lane), begin, save_every)

    def _continue_singly(self, lane: int, begin: int, save_every: int) -> None:
        """Replace the states that a call from step ``begin`` stored for an inactive lane by those of a single run."""
        work, j = self.work, self.first + lane
        if lane not in self.left:
            step = int(self.memory.last_step[lane])
            q, p, *carries = (self.lanes(name)[:, lane].copy() for name in ("q", "p", "carry_q", "carry_p"))
            self.left[lane] = SingleRun(work, j, q, p, step, (carries[0], carries[1]))
            begin = step
        rows = slice(work.steps.row(begin), work.steps.row(self.step))
        work.q[rows, j] = work.p[rows, j] = np.nan
        self.left[lane].advance_to(self.step, save_every)


class SingleBlock:
    """Block of one trajectory, for methods without SIMD lanes; other arguments as of :class:`SingleRun`."""

    def __init__(self, work: CommonRuns, first: int, *state: Array, step: int = 0, carries: Any = None) -> None:
        q, p = state or (work.q[0, first], work.p[0, first])
        self.step, self.run = step, SingleRun(work, first, q, p, step, carries)

    def advance(self, size: int) -> None:
        """Advance by ``size`` steps."""
        run = self.run
        for chunk in run.work.steps.chunks(self.step, size):
            self.step += chunk.steps
            if chunk.entered is not None:
                run.update(chunk.entered.h, run.work.values_at(chunk.entered.middle, slice(run.j, run.j + 1))[0])
            run.advance_to(self.step, chunk.save_every)


class SingleRun:
    """Trajectory j computed by the single integrator from its state after ``step`` steps."""

    def __init__(
        self, work: CommonRuns, j: int, q: Array, p: Array, step: int = 0, carries: tuple[Array, Array] | None = None
    ) -> None:
        self.work, self.j, self.left = work, j, carries is not None
        self.run: Memory | None = None
        work.done[j] = step
        segment, time = work.steps.at(step)
        values = work.values_at(segment.middle, slice(j, j + 1))[0]
        try:
            arguments: dict[str, Any] = {"t": work.steps.t0, "parameters": values, "options": work.options}
            run = Memory.started(work.stepper, q, p, plan=StepPlan(h=segment.h), **arguments)
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
        row = work.steps.row(run.steps)
        first, stride = run.steps, save_every if work.observation is None else 1
        try:
            trajectory = record(run, step - first, save_every=stride)
        except StepFailedError as failure:
            work.status[j], trajectory, self.run = failure.status, Trajectory.before(failure), None
        work.done[j], work.fallback_steps[j] = run.steps, run.fallback_steps
        saved = np.arange(1, len(trajectory))
        if work.observation is not None:
            work.observation.include(j, trajectory.t, trajectory.q, trajectory.p, run.parameters)
            saved = saved[(first + saved) % save_every == 0]
        rows = slice(row, row + len(saved))
        work.q[rows, j], work.p[rows, j] = trajectory.q[saved], trajectory.p[saved]
        if work.times is not None:
            work.times[rows, j] = trajectory.t[saved]
        if work.actions is not None:
            work.actions[rows, j] = np.nan if self.left or trajectory.actions is None else trajectory.actions[saved]
