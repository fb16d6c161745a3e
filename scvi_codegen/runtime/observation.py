"""Runs of which more is wanted than every so-many-th state: events, or states at given times.

The run itself is the plain one, a portion at a time with all its states; the events are looked for between them, what
is wanted is kept, and the rest forgotten. So states are the same, bit for bit, with events and without.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.given.counts import checked_count
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.runtime.clock import part_of_step
from scvi_codegen.runtime.dense_output import lengths_at, states_and_steps_at, times_of_run
from scvi_codegen.runtime.event_search import CrossingSearch
from scvi_codegen.runtime.memory import Memory
from scvi_codegen.runtime.portions import SLICE_SECONDS, record, trajectory_of
from scvi_codegen.runtime.stalling import Watch
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["Observation", "observed_until"]

Array = NDArray[np.float64]
NUMBERS = 2**18
"""Of positions in a portion."""
FIRST_STEPS = 64


class Observation:
    """What is kept of a run.

    Args:
        run: to be advanced.
        save_every: keep the present state and each whose step number is a multiple of this, if no times are given.
        times: (n,) sorted as the run goes; keep the states at these.
        end: of steps of h, also in transformed time, where the run ends, by a last step that is shorter.
    """

    def __init__(
        self, run: Memory, *, save_every: int = 1, times: Array | None = None, end: float | None = None
    ) -> None:
        self.run, self.save_every, self.times = run, checked_count(save_every, "save_every", least=1), times
        self.search = CrossingSearch(run.stepper, run._crossed) if run.stepper.events else None
        self.end, self.arrived = end, False
        self.states: list[tuple[Array, Array, Array, Array, Array, NDArray[np.int64]]] = []
        self.iterations = 0

    @property
    def ended(self) -> bool:
        """Whether the run ended inside of a step, which is not taken: by a terminal event, or where it was to end."""
        return self.arrived or (self.search is not None and self.search.ended)

    def advance(
        self,
        steps: int | None,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> Trajectory:
        """Advance by ``steps`` (``None``: to the end), or to the step in which a terminal event ends the run.

        ``stop`` is asked after each portion whether to end there.

        Raises:
            StepFailedError: with what was kept as ``trajectory``; the run stands before the failing step.
            EventError: where an event function is not finite.
        """
        goal = self.run.goal
        on = steps is None and (goal or self.end is not None)
        most_steps = np.inf if on else checked_count(steps, "steps", least=0)
        self._keep(record(self.run, 0), first=True)
        most = max(1, NUMBERS // self.run.stepper.dimension)
        portion, done = min(FIRST_STEPS, most), 0
        watch = Watch(self.run.stepper, self.end if goal is None else goal.t_end if goal.tau else None)
        while done < most_steps and not self.run.arrived and not stop():
            size, began = int(min(portion, most_steps - done)), time.perf_counter()
            before = self.run.t, self.run.steps
            try:
                self._portion(size)
                if failure := watch.halt(before[0], self.run.t, self.run.steps - before[1], self.run.steps):
                    raise failure
            except StepFailedError as failure:
                failure.trajectory = self.trajectory()
                raise
            if self.ended:
                break
            done += size
            if progress is not None:
                progress(done)
            elapsed = max(time.perf_counter() - began, 1e-6)
            portion = max(1, min(most, 2 * size, int(size * SLICE_SECONDS / elapsed)))
        found = self.trajectory()
        if self.times is None and not self.ended:
            self.run.iterations = self.iterations - int(found.iterations.sum())
        return found

    def _portion(self, size: int) -> None:
        """A portion of the run, its events and what is kept of it; a step that fails after a terminal event is none."""
        before, failure = self.run.save(), None
        try:
            part = record(self.run, size)
        except StepFailedError as error:
            part, failure = Trajectory.before(error), error
        if self.end is not None and (part.t[-1] - self.end) * self.run.h >= 0.0:
            self.run.rewind(before)
            part, failure = self._arrived(part, before), None
        if self.search is not None:
            reached = self.search.search(part, first=self.run.steps - len(part) + 1 + self.arrived)
            if self.search.ended:
                self.run.rewind(before)
                part, failure, self.arrived = self._ended(record(self.run, reached)), None, False
        self._keep(part)
        if failure is not None:
            raise failure

    def _ended(self, part: Trajectory) -> Trajectory:
        """The part with the state at which the event ended it."""
        assert self.search is not None
        last = self.search.found[-1][-1]
        _, _, tau = self._inside(part, float(last["t"]))
        return self._closed(part, part.lengths, last["t"], last["q"], last["p"], tau)

    def _arrived(self, part: Trajectory, before: bytes) -> Trajectory:
        """The part up to the end, by a last step of such a length; the run stands before that step."""
        assert self.end is not None
        self.arrived = True
        whole = int(np.count_nonzero((self.end - part.t) * self.run.h >= 0.0)) - 1
        part = record(self.run, whole)
        while self.run.left_to(self.end) * self.run.h < 0.0:  # rounded times tie: it is the step before
            self.run.rewind(before)
            whole -= 1
            part = record(self.run, whole)
        q, p, tau = self._inside(part, self.end)
        lengths = part.lengths.copy()
        lengths[-1] = self.run.left_to(self.end) if tau is None else tau - part.stepped[-1]
        if tau is None:
            run = self.run
            q, p = run.stepper.step(q, p, lengths[-1], run.t, run.parameters, options=run.options)
        return self._closed(part, lengths, self.end, q, p, tau)

    def _inside(self, part: Trajectory, t: float) -> tuple[Array, Array, float | None]:
        """The state at a time in the step that follows a part, and its tau; of plain time the last state.

        Systems in transformed time do not depend on t, so that it is counted from the last state.
        """
        if part.tau is None or (left := self.run.left_to(t)) == 0.0:
            return part.q[-1], part.p[-1], None if part.tau is None else float(part.tau[-1])
        run = self.run
        q, p, x = part_of_step(run.stepper, 0.0, run.h, left, part.q[-1], part.p[-1], run.parameters, run.options)
        return q, p, float(part.tau[-1]) + x * run.h

    def _closed(self, part: Trajectory, lengths: Array, t: float, q: Array, p: Array, tau: float | None) -> Trajectory:
        """A part with one more state, inside of a step."""
        return self._made(
            np.append(part.t, t),
            np.concatenate([part.q, [q]]),
            np.concatenate([part.p, [p]]),
            np.append(part.iterations, np.int32(0)),
            np.append(lengths, np.nan),
            np.append(part.stepped, t if tau is None else tau),
        )

    def _keep(self, part: Trajectory, *, first: bool = False) -> None:
        """What is wanted of a part, whose first state was dealt with unless it is the first of all."""
        total = self.iterations + np.cumsum(part.iterations, dtype=np.int64)
        self.iterations = int(total[-1])
        if self.times is not None:
            self._keep_times(part, total, first=first)
            return
        number = self.run.steps - (len(part) - 1 - self.ended) + np.arange(len(part))
        wanted = number % self.save_every == 0
        wanted[0] = first
        wanted[-1] |= self.ended or self.run.arrived
        q, p = part.q[wanted], part.p[wanted]
        self.states.append((part.t[wanted], q, p, part.lengths[wanted], part.stepped[wanted], total[wanted]))

    def _keep_times(self, part: Trajectory, total: NDArray[np.int64], *, first: bool) -> None:
        assert self.times is not None
        forward = part.forward
        left, right = forward * part.t[0], forward * part.t[-1]
        after = forward * self.times >= left if first else forward * self.times > left
        times = self.times[after & (forward * self.times <= right)]
        q, p, stepped = states_and_steps_at(part, times)
        behind = np.searchsorted(forward * part.t, forward * times, side="right") - 1
        self.states.append((times, q, p, lengths_at(part, times), stepped, total[behind]))

    def trajectory(self) -> Trajectory:
        """All that was kept so far."""
        t, q, p, lengths, stepped, total = (np.concatenate(arrays) for arrays in zip(*self.states, strict=True))
        return self._made(t, q, p, np.diff(total, prepend=total[:1]).astype(np.int32), lengths, stepped)

    def _made(
        self, t: Array, q: Array, p: Array, iterations: NDArray[np.int32], lengths: Array, stepped: Array
    ) -> Trajectory:
        crossings = self.search.crossings() if self.search is not None else ()
        tau = stepped if self.run.stepper.interface.energy_parameter else None
        return trajectory_of(self.run, t, q, p, iterations, lengths=lengths, events=crossings, tau=tau)


def observed_until(
    run: Memory,
    t_end: float,
    steps: int | None,
    save_every: int,
    t_eval: ArrayLike | None,
    progress: Callable[[int], None] | None,
) -> Trajectory:
    """The trajectory of a run by steps of h to t_end, the last shorter, with the states kept that are asked for."""
    end = checked_number(t_end, "the time t_end")
    if steps is not None:
        raise StateError(f"the run ends after steps={steps} or at t_end={end:g}: give one of the two")
    if (end - run.t) * run.h < 0.0:
        raise StateError(f"steps of h = {run.h:g} do not lead from t = {run.t:g} to t_end = {end:g}")
    times = None if t_eval is None else times_of_run(t_eval, run.t, end)
    return Observation(run, save_every=save_every, times=times, end=end).advance(None, progress)
