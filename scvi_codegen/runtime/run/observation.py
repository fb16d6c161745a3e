"""Runs with events, with output at given times, or with fixed steps to a final time.

The run advances in chunks with all states; events are searched between these states and only the requested states are
saved. States are therefore bitwise equal with and without events.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import EventError, StateError, StepFailedError
from scvi_codegen.native.arguments import real_array
from scvi_codegen.runtime.events.detection import CrossingSearch
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.run_loop import record, trajectory_of
from scvi_codegen.runtime.run.singular_time import ProgressWatch
from scvi_codegen.runtime.run.times import WHOLE
from scvi_codegen.runtime.trajectory.dense_output import states_and_steps_at, step_sizes_at
from scvi_codegen.runtime.trajectory.time_transformation import part_of_step
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import checked_count

Array = NDArray[np.float64]
CHUNK_NUMBERS = 2**18
"""Largest number of positions in a chunk."""
FIRST_STEPS = 64


class Observation:
    """Recorder of a run with events or with output at given times.

    Args:
        run: the run to advance; if its plan has fixed steps and a target time, the last step is shorter.
        save_every: without ``times``, save the present state and those whose step number is a multiple of this.
        times: (n,) output times, sorted in the direction of the run.
        observe: function of the run that returns the data to save instead of the states between first and last.
        within_steps: with ``save_every=1``, save also states after changes by events within steps.
    """

    def __init__(
        self,
        run: Memory,
        *,
        save_every: int = 1,
        times: Array | None = None,
        observe: Callable[[Any], ArrayLike] | None = None,
        within_steps: bool = True,
    ) -> None:
        self.run, self.save_every, self.times = run, checked_count(save_every, "save_every", least=1), times
        self.within_steps = within_steps
        self.search = CrossingSearch(run.stepper, None if run.ended else run._watch) if run.stepper.events else None
        run._watch = self.search and self.search.watch
        plan = run.plan
        self.end = plan.t_end if plan.fixed and math.isfinite(plan.t_end) else None
        self.arrived, self.partial_steps = False, 0
        self.states: list[tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]] = []
        self.iterations, self.observe = 0, observe
        self.observed: list[Array] = []
        self.conserved: list[Array] = []
        self.ends: list[tuple[Array, Array]] = []

    @property
    def ended(self) -> bool:
        """Return whether the run ended within a step, by a terminal event or at its final time."""
        return self.arrived or (self.search is not None and self.search.ended)

    def advance(
        self, steps: int | None, progress: Callable[[int], None] | None = None, stop: Callable[[], bool] = lambda: False
    ) -> Trajectory:
        """Advance by ``steps`` (``None``: to the end) or to a terminal event; return the saved states.

        ``stop`` is called after each chunk and ends the run if it returns true.

        Raises:
            StepFailedError: if a step fails; ``trajectory`` has the saved states, the run is left before that step.
            EventError: if an event function is not finite.
        """
        run, plan = self.run, self.run.plan
        unbounded = steps is None and math.isfinite(plan.t_end)
        count = math.inf if unbounded else checked_count(steps, "steps", least=0)
        self._keep(record(run, 0), first=True)
        most = max(1, CHUNK_NUMBERS // run.stepper.dimension)
        watch = None if plan.adaptive or not math.isfinite(plan.t_end) else ProgressWatch(run.stepper, plan.t_end)

        def advance(size: int) -> int:
            before, number = run.t, run.steps
            self._advance_chunk(size if self.observe is None else min(size, self.save_every - number % self.save_every))
            if watch is not None:
                watch.check_progress(before, run.t, run.steps - number, run.steps)
            return run.steps - number

        try:
            drive(
                advance,
                count,
                first=min(FIRST_STEPS, most),
                most=most,
                ended=lambda: run.arrived or self.ended or stop(),
                progress=progress,
            )
        except StepFailedError as failure:
            failure.trajectory = self.trajectory()
            raise
        trajectory = self.trajectory()
        if self.search is not None:
            self.search.warn_of_accumulation()
        if self.times is None and not self.ended:
            run.iterations = self.iterations - int(trajectory.iterations.sum())
        return trajectory

    def _advance_chunk(self, size: int) -> None:
        """Advance by one chunk, search it for events and save it; a failure after a terminal event is ignored."""
        if self.search is not None and self.search.changes:
            self._advance_with_changes(self.search, size)
            return
        # The C run advances by whole chunks, so it may pass the final time or a terminal event. Then it is rolled back
        # to the start of the chunk and the steps up to there are recorded again, with the same bits; the memory of the
        # run (compensation terms, predictor) then belongs to the last of them. A partial step completes the motion.
        before, failure = self.run.snapshot, None
        try:
            part = record(self.run, size)
        except StepFailedError as error:
            part, failure = Trajectory.before(error), error
        if self.end is not None and (part.t[-1] - self.end) * self.run.h >= 0.0:
            self.run.rollback(before)
            part, failure = self._arrived(part, before), None
        if self.search is not None:
            reached = self.search.search(part, first=self.run.steps - len(part) + 1 + self.arrived)
            if self.search.ended:  # an error in a later step of the chunk is not part of the motion
                self.run.rollback(before)
                part, failure, self.arrived = record(self.run, reached), None, False
                t, q, p = self.search.last
                part = self._with_state(part, part.step_sizes, t, q, p, self._state_within_step(part, t)[2])
                self.run._watch = self.search.watch
        self._keep(part)
        if failure is not None:
            raise failure

    def _advance_with_changes(self, search: CrossingSearch, size: int) -> None:
        """Advance by one chunk with events that change the state."""
        run = self.run
        (t, q, p, iterations), lengths, numbers, failure = search.advance(run, size)
        self.arrived = self.end is not None and t[-1] == self.end
        if self.times is None and self.save_every == 1 and len(t) > 1:
            self.states[-1][3][-1] = lengths[0]  # known only now: an event may have cut this step
        part = trajectory_of(run, (t, run.stepper.named(q), run.stepper.named(p), iterations), lengths)
        self._keep(part, numbers=numbers)
        if isinstance(failure, EventError):
            failure.trajectory = self.trajectory()
        if failure is not None:
            raise failure

    def _arrived(self, part: Trajectory, before: bytes) -> Trajectory:
        """Return the chunk up to the final time, with a shorter last step; the run is left before that step."""
        assert self.end is not None
        self.arrived = True
        whole = int(np.count_nonzero((self.end - part.t) * self.run.h >= 0.0)) - 1
        part = record(self.run, whole)
        while self.run.left_to(self.end) * self.run.h < 0.0:  # rounded times tie: the previous step is the last one
            self.run.rollback(before)
            whole -= 1
            part = record(self.run, whole)
        q, p, tau = self._state_within_step(part, self.end)
        lengths = part.step_sizes.copy()
        lengths[-1] = self.run.left_to(self.end) if tau is None else tau - part.stepped[-1]
        # The partial step starts from the state alone, not from the run: the memory of a run holds predictors for steps
        # of size h, and its state stays at the last whole step.
        self.partial_steps = int(abs(lengths[-1]) > WHOLE * abs(self.run.h))
        if tau is None and lengths[-1] != 0.0:
            run = self.run
            q, p = run.stepper.step(q, p, lengths[-1], run.t, run.parameters, options=run.options)
        return self._with_state(part, lengths, self.end, q, p, tau)

    def _state_within_step(self, part: Trajectory, t: float) -> tuple[Array, Array, float | None]:
        """Return the state and tau at a time in the step after a chunk; without time transformation the last state.

        Systems in transformed time are autonomous, so t is counted from the last state.
        """
        if part.tau is None or (left := self.run.left_to(t)) == 0.0:
            return part.q[-1], part.p[-1], None if part.tau is None else float(part.tau[-1])
        run = self.run
        q, p, x = part_of_step(run.stepper, 0.0, run.h, left, part.q[-1], part.p[-1], run.parameters, run.options)
        return q, p, float(part.tau[-1]) + x * run.h

    def _with_state(
        self, part: Trajectory, lengths: Array, t: float, q: Array, p: Array, tau: float | None
    ) -> Trajectory:
        """Return a chunk with one more state within a step appended."""
        return self._made(
            np.append(part.t, t),
            np.concatenate([part.q, [q]]),
            np.concatenate([part.p, [p]]),
            np.append(part.iterations, np.int32(0)),
            np.append(lengths, np.nan),
            np.append(part.stepped, t if tau is None else tau),
        )

    def _keep(self, part: Trajectory, *, first: bool = False, numbers: NDArray[np.int64] | None = None) -> None:
        """Save the requested states of a chunk; its first state is already saved unless ``first``.

        ``numbers`` are those of the steps that end at the states, -1 for states within a step.
        """
        total = self.iterations + np.cumsum(part.iterations, dtype=np.int64)
        self.iterations = int(total[-1])
        if self.times is not None:
            self._keep_times(part, total, first=first)
            return
        number = self.run.steps - (len(part) - 1 - self.ended) + np.arange(len(part)) if numbers is None else numbers
        wanted = number % self.save_every == 0  # states within a step only if all are saved
        wanted &= self.within_steps | (number >= 0)
        wanted[0] = first
        wanted[-1] |= self.ended or self.run.arrived
        q, p = part.q[wanted], part.p[wanted]
        if self.observe is not None and len(q):
            run = self.run
            if self.ended:
                here = {"t": part.t[-1], "parameters": run.parameters, "options": run.options}
                run = type(run).started(run.stepper, part.q[-1], part.p[-1], plan=run.plan, **here)
            assert self.observe is not None  # by the caller
            array, when = real_array(self.observe(run), "the result of observe"), f"at t = {run.t:g}"
            if self.observed and array.shape != self.observed[0].shape:
                raise StateError(
                    f"the result of observe must keep its shape: {array.shape} {when}, {self.observed[0].shape} before"
                )
            self.observed.append(array)
            end, stepper = part[-1:], self.run.stepper
            maps = end.momentum_maps() if stepper.momentum_map_names else np.empty((1, 0))
            self.conserved.append(np.concatenate([end.energies, maps], axis=1)[0])
            self.ends = [*self.ends[:1], (q[-1], p[-1])]
            q, p = q[:0], p[:0]
        if wanted.any():
            self.states.append((part.t[wanted], q, p, part.step_sizes[wanted], part.stepped[wanted], total[wanted]))

    def _keep_times(self, part: Trajectory, total: NDArray[np.int64], *, first: bool) -> None:
        assert self.times is not None
        forward = part.forward
        left, right = forward * part.t[0], forward * part.t[-1]
        after = forward * self.times >= left if first else forward * self.times > left
        times = self.times[after & (forward * self.times <= right)]
        q, p, stepped = states_and_steps_at(part, times)
        behind = np.searchsorted(forward * part.t, forward * times, side="right") - 1
        self.states.append((times, q, p, step_sizes_at(part, times), stepped, total[behind]))

    def trajectory(self) -> Trajectory:
        """Return all states saved so far."""
        t, q, p, lengths, stepped, total = (np.concatenate(arrays) for arrays in zip(*self.states, strict=True))
        iterations = np.diff(total, prepend=total[:1]).astype(np.int32)
        if self.observe is None:
            return self._made(t, q, p, iterations, lengths, stepped)
        q, p = (np.array(each) for each in zip(*self.ends, strict=True))
        trajectory = self._made(t, q, p, iterations, lengths, stepped)
        return replace(trajectory, observed=np.array(self.observed), conserved=np.array(self.conserved))

    def _made(
        self, t: Array, q: Array, p: Array, iterations: NDArray[np.int32], lengths: Array, stepped: Array
    ) -> Trajectory:
        crossings = self.search.crossings() if self.search is not None else ()
        tau = stepped if self.run.stepper.interface.energy_parameter else None
        steps = self.run.steps + (self.partial_steps if self.arrived else 0)
        return trajectory_of(self.run, (t, q, p, iterations), lengths, steps=steps, events=crossings, tau=tau)
