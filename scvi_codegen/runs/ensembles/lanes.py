"""Ensembles with common fixed steps: trajectories in the SIMD lanes of blocks of C, or one after the other.

A lane whose step fails keeps its last good state. When its block has ended, the single integrator (which falls back on
Newton's iteration) continues it; if that fails too, its later states are NaN and its status gives the reason. Other
lanes are unaffected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from scvi_codegen.codegen.native.arguments import empty_array
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.runs.driver.run_loop import record
from scvi_codegen.runs.ensembles.batches import CHUNK_SECONDS, FIRST_CHUNK_STEPS, GROWTH, Batch, Rows, SuccessiveRuns
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import OK
from scvi_codegen.runs.ensembles.schedule import CommonSteps, FixedSegments
from scvi_codegen.runs.ensembles.thread_pool import StopCheck, run_jobs
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import from_block
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed
from scvi_codegen.runs.trajectory import Trajectory


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
        blocks: their memory, which has both words of numbers of two.
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
        shape, words = (len(self.steps.numbers), *self.start[0].shape), self.stepper.interface.words
        self.blocks = [empty_array((*shape[:2], words * shape[2])) for _ in "qp"]
        states: list[Array] = self.blocks if words == 1 else [*map(from_block, self.blocks)]
        self.q, self.p = states
        self.q[:] = self.p[:] = np.nan
        self.q[0], self.p[0] = self.start
        self.actions = np.full(shape[:2], np.nan) if self.stepper.sums_action else None
        if self.actions is not None:
            self.actions[0] = 0.0
        self.times = np.full(shape[:2], np.nan) if self.stepper.in_tau else None
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
        batch, steps = self.batch(), self.steps.steps
        if batch is None:
            run_jobs(
                len(self),
                lambda j, check_stop: SingleRun(self, j, self.q[0, j], self.p[0, j]).follow(check_stop),
                progress=None if progress is None else lambda done: progress(done * steps // len(self)),
                threads=threads,
            )
            return
        unit = steps / len(self)
        try:
            batch.run(progress=None if progress is None else lambda done: progress(int(done * unit)), threads=threads)
        finally:
            if isinstance(batch, SuccessiveRuns):
                self.status = batch.names
                self.done, self.fallback_steps = batch.done, batch.fallback_steps

    def batch(self) -> LaneRuns | SuccessiveRuns | None:
        """Return the trajectories as C integrates many in one call.

        ``None`` if memory of runs is not reusable, and of constraints with inputs, which single runs check for jumps.
        """
        binding = self.stepper._ensemble_binding if self.observation is None else self.observation.binding
        start = self.options, self.start, self.parameters, self.steps.t0
        steps, values_at = self.steps.fixed_segments(), self.values_at if self.steps.has_inputs else None
        if binding is not None:
            fields = {"positions": self.blocks[0], "momenta": self.blocks[1], "actions": self.actions}
            if self.stepper.interface.words > 1:
                fields["segment_end"] = steps.end
            if self.observation is not None:
                fields["observed"] = self.observation.values
            lanes = LaneRuns(binding, *start, steps, values_at, fields=fields, common=self)
            self.done = lanes.done
            return lanes
        if not self.stepper.binding.reusable or (values_at is not None and self.stepper.interface.constraints):
            return None
        return SuccessiveRuns(self.stepper, *start, steps, values_at, receive=self._store)

    def _store(self, states: Rows) -> None:
        states.put((self.q, states.q), (self.p, states.p), (self.times, states.t), (self.actions, states.actions))


class LaneRuns(Batch):
    """Trajectories in SIMD lanes, many blocks in a call; further arguments as of :class:`Batch`.

    Args:
        fields: further arrays of the C structure by name, such as ``positions``, which C fills; ``None``: not used.
        common: the trajectories whose failed lanes single runs continue; if ``None``, they are left.

    Attributes:
        memory, active: of a part, the block, and a view of the flags of its active lanes.
        left: single runs that continue the failed lanes of blocks that have ended.
    """

    def __init__(
        self, binding: Binding, *arguments: Any, fields: Mapping[str, Array | None], common: CommonRuns | None = None
    ) -> None:
        super().__init__(binding, *arguments)
        self.fields, self.common, self.width = fields, common, len(binding.new("block *").active)
        self.needs_velocities = common is not None and bool(binding.constant("NEEDS_VELOCITIES"))

    def prepare(self, first: int, end: int) -> None:
        """Set the C structure of a part, with the memory of a block."""
        super().prepare(first, end)
        self.left = list[SingleRun]()
        self.memory = self.struct.block = self.binding.new("block *")
        self.active = np.frombuffer(self.binding.buffer(self.memory.active), dtype=np.float64)
        self.active[:] = 1.0
        for name, values in self.fields.items():
            if values is not None:
                setattr(self.struct, name, self.binding.pointer(values))
        self.struct.trajectories, self.struct.pauses = len(self.q), self.struct.pauses or self.needs_velocities

    def lanes(self, name: str) -> Array:
        """Return a (m, lanes) view of a field of the block, (2 S, m, lanes) of ``memory``."""
        field = np.frombuffer(self.binding.buffer(getattr(self.memory, name)), dtype=np.float64)
        values = field.reshape(-1, len(self.memory.q), len(self.active))
        return values if len(values) > 1 else values[0]

    def begin(self) -> None:
        """Put the first trajectories into the block, so that its memory can be changed before the first step."""
        self.struct.pauses = 1
        self.take(1)
        self.enter(0)

    def advance(self, *, check_stop: StopCheck | None = None, until: Callable[[], bool] = lambda: False) -> None:
        """Advance as all calls, then the single runs."""
        super().advance(check_stop=check_stop, until=until)
        while self.left:
            self.left.pop().follow(check_stop or (lambda _: None))

    def enter(self, segment: int) -> None:
        """Set the parameters of a segment; for a new step size, start the predictor from the present velocities.

        Lanes without velocities are deactivated.
        """
        super().enter(segment)
        h, common = cast(FixedSegments, self.steps).h, self.common
        if common is None or not self.needs_velocities or (segment and h[segment] == h[segment - 1]):
            return
        at_points, q, p, t = (*map(self.lanes, ("memory", "q", "p")), float(self.memory.t))
        for lane in np.flatnonzero(self.active > 0.0).tolist():
            try:
                values = self.parameters[self.struct.next + lane]
                at_points[:, :, lane] = common.stepper.velocity(q[:, lane], p[:, lane], t, values)
            except StateError:
                self.active[lane] = 0.0

    def store(self, *, last: bool = False) -> None:
        """Remove the states after the failed steps of a block, and continue its failed lanes if it has ended."""
        if self.common is None:
            return
        common, ended, width = self.common, self.struct.segment < 0, len(self.active)
        first = (int(self.struct.next) - ended) // width * width
        for lane in np.flatnonzero(self.active[: self.struct.end - first] == 0.0).tolist():
            j, step = first + lane, int(self.memory.last_step[lane])
            common.q[common.steps.row(step) :, j] = common.p[common.steps.row(step) :, j] = np.nan
            if ended:
                q, p, *carries = (self.lanes(name)[..., lane].copy() for name in ("q", "p", "carry_q", "carry_p"))
                self.left.append(SingleRun(common, j, q, p, step, (carries[0], carries[1])))
        self.active[:] = 1.0 if ended else self.active


class SingleRun:
    """Trajectory j computed by the single integrator from its state after ``step`` steps."""

    def __init__(
        self, work: CommonRuns, j: int, q: Array, p: Array, step: int = 0, carries: tuple[Array, Array] | None = None
    ) -> None:
        self.work, self.j, self.step, self.left = work, j, step, carries is not None
        self.run: Memory | None = None
        work.done[j] = step
        segment, time = work.steps.at(step)
        values = work.values_at(segment.middle, slice(j, j + 1))[0]
        try:
            arguments: dict[str, Any] = {"t": work.steps.t0, "parameters": values, "options": work.options}
            run = Memory.started(work.stepper, q, p, plan=Fixed(segment.h), **arguments)
        except StateError:  # a sum of finite terms has overflowed
            work.status[j] = "not finite"
        else:
            if carries is not None:
                run._resume_at(step, time, carries)
            self.run = run

    def follow(self, check_stop: StopCheck) -> None:
        """Advance to the end, unless the trajectory fails."""

        def advance(size: int) -> int:
            check_stop(size)
            for chunk in self.work.steps.chunks(self.step, size):
                if chunk.entered is not None and self.run is not None:
                    values = self.work.values_at(chunk.entered.middle, slice(self.j, self.j + 1))[0]
                    self.run.update(h=chunk.entered.h, parameters=values)
                    if self.work.steps.words > 1 and chunk.entered.end is not None:
                        self.run._step_to(chunk.entered.end)
                self.step += chunk.steps
                self.advance_to(self.step, chunk.save_every)
            return size

        chunks: dict[str, Any] = {"first": FIRST_CHUNK_STEPS, "growth": GROWTH, "seconds": CHUNK_SECONDS}
        drive(advance, self.work.steps.steps - self.step, **chunks, ended=lambda: self.run is None)

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
