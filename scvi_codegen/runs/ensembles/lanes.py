"""Ensembles with common fixed steps in the SIMD lanes of blocks of C.

A lane whose step fails keeps its last good state. When its block has ended, the single integrator (which falls back on
Newton's iteration) continues it; if that fails too, its later states are NaN and its status gives the reason. Other
lanes are unaffected.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, cast

import numpy as np

from scvi_codegen.codegen.native.arguments import empty_array
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.common.thread_pool import StopCheck
from scvi_codegen.runs.driver.run_loop import record
from scvi_codegen.runs.ensembles.batches import CHUNK_SECONDS, FIRST_CHUNK_STEPS, GROWTH, Batch
from scvi_codegen.runs.ensembles.ensemble import Ensemble
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import INTERRUPTED, OK, EnsembleTrajectory
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed
from scvi_codegen.runs.trajectory import Trajectory


class CommonRuns:
    """Trajectories in SIMD lanes: the arrays of all states, which C and single runs fill.

    Args:
        ensemble: the trajectories, with common fixed steps.
        binding: of their lanes.
        observation: functions of the state that are observed along the runs, or ``None``.

    Attributes:
        steps: the steps.
        q, p: (n, k, m) saved states; NaN where not reached.
        blocks: their memory, which has both words of numbers of two.
        actions: (n, k) actions up to each state if runs sum them, NaN where unknown, else ``None``.
        status, done: reason of the end and number of completed steps of each trajectory.
        fallback_steps: numbers of steps that the iteration did not solve, but its fallback.
    """

    def __init__(self, ensemble: Ensemble, binding: Binding, observation: EnsembleObservation | None = None) -> None:
        self.ensemble, self.binding, self.observation = ensemble, binding, observation
        self.steps = cast(CommonSteps, ensemble.fixed)
        count = len(ensemble)
        self.status = np.full(count, OK, dtype="<U32")
        self.done, self.fallback_steps = np.zeros((2, count), np.int64)
        self.actions: Array | None = None
        stepper = ensemble.stepper
        (count, m), words = ensemble.q.shape, stepper.interface.words
        shape = len(self.steps.numbers), count
        self.blocks = [empty_array((*shape, words * m)) for _ in "qp"]
        self.q, self.p = map(stepper._states.numbers, self.blocks)
        self.q[1:] = self.p[1:] = np.nan
        self.q[0], self.p[0] = ensemble.q, ensemble.p
        if stepper.sums_action:
            self.actions = np.full(shape, np.nan)
            self.actions[0] = 0.0

    def __len__(self) -> int:
        return len(self.ensemble)

    @property
    def length(self) -> int:
        """Final value of ``progress``: the number of steps."""
        return self.steps.steps

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all trajectories as :meth:`IndividualRuns.run`; ``progress`` is called with the number of steps."""
        unit = self.steps.steps / len(self)
        self.batch().run(
            progress=None if progress is None else lambda done: progress(int(done * unit)), threads=threads
        )

    def batch(self) -> LaneRuns:
        """Return the trajectories as C integrates many in one call."""
        fields = {"positions": self.blocks[0], "momenta": self.blocks[1]}
        if self.actions is not None:
            fields["actions"] = self.actions
        if self.observation is not None:
            fields["observed"] = self.observation.values
        lanes = LaneRuns(self.binding, self.ensemble, fields, common=self)
        self.done = lanes.done
        return lanes

    def keep(self, part: slice, trajectories: EnsembleTrajectory) -> None:
        """Store the results of a slice that was integrated elsewhere."""
        self.q[:, part], self.p[:, part] = trajectories.q, trajectories.p
        self.status[part], self.done[part] = trajectories.status, trajectories.steps
        self.fallback_steps[part] = cast(Array, trajectories.fallback_steps)
        if self.actions is not None:
            self.actions[:, part] = trajectories.actions
        if self.observation is not None:
            self.observation.keep(part, cast(Array, trajectories.observed))

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories; unfinished ones are ``"interrupted"``."""
        ensemble, status, unfinished = self.ensemble, self.status, self.done < self.steps.steps
        if unfinished.any():
            status = np.where(unfinished & (status == OK), INTERRUPTED, status)
        return EnsembleTrajectory(
            t=self.steps.t.copy(),
            q=self.q,
            p=self.p,
            status=status,
            steps=self.done,
            h=self.steps.h,
            parameters=ensemble.parameters,
            initial=(ensemble.t0, ensemble.q, ensemble.p),
            stepper=ensemble.stepper,
            observed=None if self.observation is None else self.observation.result(),
            actions=self.actions,
            fallback_steps=self.fallback_steps,
            messages=self.steps.failures(status, self.done),
            spans=tuple(self.steps.spans(ensemble.values_at) if ensemble.inputs else ()),
        )


class LaneRuns(Batch):
    """Trajectories in SIMD lanes, many blocks in a call; further arguments as of :class:`Batch`.

    Args:
        fields: further arrays of the C structure by name, such as ``positions``, which C fills.
        common: the trajectories whose failed lanes single runs continue; if ``None``, they are left.

    Attributes:
        number: type of the numbers in the memory of a block.
        keeps_unknowns: whether the memory of a block contains the unknowns of the last step, as that of a single run.
        memory, active: of a part, the block, and a view of the flags of its active lanes.
        left: failed lanes of blocks that have ended, which single runs continue.
    """

    def __init__(
        self, binding: Binding, ensemble: Ensemble, fields: Mapping[str, Array], common: CommonRuns | None = None
    ) -> None:
        super().__init__(binding, ensemble)
        self.fields, self.common, self.width = fields, common, len(binding.new("block *").active)
        self.number: Any = np.float32 if ensemble.settings.precision == "single" else np.float64
        self.needs_velocities = common is not None and bool(binding.constant("NEEDS_VELOCITIES"))
        self.keeps_unknowns = bool(ensemble.stepper.interface.constraints)

    def prepare(self, first: int, end: int) -> None:
        """Set the C structure of a part, with the memory of a block."""
        super().prepare(first, end)
        self.left = list[Departure]()
        self.memory = self.struct.block = self.binding.new("block *")
        self.active = np.frombuffer(self.binding.buffer(self.memory.active), dtype=self.number)
        self.active[:] = 1.0
        for name, values in self.fields.items():
            setattr(self.struct, name, self.binding.pointer(values))
        if self.segments is not None and self.ensemble.stepper.interface.words > 1:
            self.struct.segment_end = self.binding.pointer(self.segments.end)
        self.struct.trajectories, self.struct.pauses = len(self.q), self.struct.pauses or self.needs_velocities

    def lanes(self, name: str) -> Array:
        """Return a (m, lanes) view of a field of the block, (2 S, m, lanes) of ``memory``."""
        field = np.frombuffer(self.binding.buffer(getattr(self.memory, name)), dtype=self.number)
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
            follow(cast(CommonRuns, self.common), self.left.pop(), check_stop or (lambda _: None))

    def enter(self, segment: int) -> None:
        """Set the parameters of a segment; for a new step size, start the predictor from the present velocities.

        Lanes without velocities are deactivated.
        """
        super().enter(segment)
        if not self.needs_velocities or self.segments is None:
            return
        h = self.segments.h
        if segment and h[segment] == h[segment - 1]:
            return
        at_points, q, p, t = (*map(self.lanes, ("memory", "q", "p")), float(self.memory.t))
        for lane in np.flatnonzero(self.active > 0.0).tolist():
            try:
                values = self.parameters[self.struct.next + lane]
                at_points[:, :, lane] = self.ensemble.stepper.velocity(q[:, lane], p[:, lane], t, values)
            except StateError:
                self.active[lane] = 0.0

    def store(self, *, last: bool = False) -> None:
        """Remove the states after the failed steps of a block, and note its failed lanes if it has ended."""
        if self.common is None:
            return
        common, ended, width = self.common, self.struct.segment < 0, len(self.active)
        first = (int(self.struct.next) - ended) // width * width
        for lane in (self.active[: self.struct.end - first] == 0.0).nonzero()[0].tolist():
            j, step = first + lane, int(self.memory.last_step[lane])
            row = common.steps.row(step)
            common.q[row:, j] = common.p[row:, j] = np.nan
            if ended:
                self.done[j] = step
                q, p, *low = (
                    self.lanes(name)[..., lane].astype(np.float64) for name in ("q", "p", "carry_q", "carry_p")
                )
                continued = step and common.steps.at(step)[0].h == common.steps.at(step - 1)[0].h
                unknowns = (
                    self.lanes("memory")[..., lane].ravel().astype(np.float64)
                    if self.keeps_unknowns and continued
                    else None
                )
                self.left.append(Departure(j, step, q, p, (low[0], low[1]), unknowns))
        self.active[:] = 1.0 if ended else self.active


class Departure(NamedTuple):
    """State from which the single integrator continues a trajectory.

    Attributes:
        j: the trajectory.
        step: number of completed steps.
        q, p: (m,) state.
        low: compensation of the sums of q and p by the lane that the trajectory has left.
        unknowns: of the last step, if a single run predicts the next step by them.
    """

    j: int
    step: int
    q: Array
    p: Array
    low: tuple[Array, Array]
    unknowns: Array | None = None


def follow(common: CommonRuns, departure: Departure, check_stop: StopCheck) -> None:
    """Integrate a trajectory by the single integrator to the end, unless it fails, and store its states."""
    (j, step, *_), ensemble, steps = departure, common.ensemble, common.steps
    common.done[j] = step
    run = _started(common, departure)
    if run is None:
        return

    def values_at(t: float) -> Array:
        return cast(Array, ensemble.values_at(t, slice(j, j + 1))[0])

    def advance(size: int) -> int:
        nonlocal step
        check_stop(size)
        for chunk in steps.chunks(step, size):
            if common.status[j] != OK:
                break
            if chunk.entered is not None:
                run.update(h=chunk.entered.h, parameters=values_at(chunk.entered.middle))
                if steps.words > 1 and chunk.entered.end is not None:
                    run._step_to(chunk.entered.end)
            step += chunk.steps
            _advance(common, departure, run, step, chunk.save_every)
        return size

    chunks: dict[str, Any] = {"first": FIRST_CHUNK_STEPS, "growth": GROWTH, "seconds": CHUNK_SECONDS}
    drive(advance, steps.steps - step, **chunks, ended=lambda: common.status[j] != OK)


def _started(common: CommonRuns, departure: Departure) -> Memory | None:
    """Return the memory of a single run; ``None`` if its start is not finite."""
    ensemble, (j, step, q, p, low, unknowns) = common.ensemble, departure
    segment, time = common.steps.at(step)
    parameters = ensemble.values_at(segment.middle, slice(j, j + 1))[0]
    arguments: dict[str, Any] = {"t": ensemble.t0, "parameters": parameters, "options": ensemble.settings.options}
    arguments["noise"] = ensemble.noise._replace(trajectory=ensemble.noise.trajectory + j)
    try:
        run = Memory.started(ensemble.stepper, q, p, plan=Fixed(segment.h), **arguments)
    except StateError:  # a sum of finite terms has overflowed
        common.status[j] = "not finite"
        return None
    run._resume_at(step, time, low, unknowns)
    return run


def _advance(common: CommonRuns, departure: Departure, run: Memory, step: int, save_every: int) -> None:
    """Advance a single run to step number ``step``, or to its last step before a failure, and store its states."""
    j, first, observation = departure.j, run.steps, common.observation
    row = common.steps.row(first)
    try:
        trajectory = record(run, step - first, save_every=save_every if observation is None else 1)
    except StepFailedError as failure:
        common.status[j], trajectory = failure.status, Trajectory.before(failure)
    common.done[j], common.fallback_steps[j] = run.steps, run.fallback_steps
    saved = np.arange(1, len(trajectory))
    if observation is not None:
        observation.include(j, trajectory.t, trajectory.q, trajectory.p, run.parameters)
        saved = saved[(first + saved) % save_every == 0]
    rows = slice(row, row + len(saved))
    common.q[rows, j], common.p[rows, j] = trajectory.q[saved], trajectory.p[saved]
    if common.actions is not None:
        common.actions[rows, j] = np.nan
