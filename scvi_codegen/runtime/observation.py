"""Runs of which more is wanted than every so-many-th state: events, or states at given times.

The run itself is the plain one, a portion at a time with all its states; the events are looked for between them, what
is wanted is kept, and the rest forgotten. So states are the same, bit for bit, with events and without.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StepFailedError
from scvi_codegen.runtime.dense_output import lengths_at, states_at
from scvi_codegen.runtime.event_search import CrossingSearch
from scvi_codegen.runtime.memory import Memory
from scvi_codegen.runtime.portions import SLICE_SECONDS, record, trajectory_of
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["Observation"]

Array = NDArray[np.float64]
NUMBERS = 2**18
"""Of positions in a portion."""
FIRST_STEPS = 64


class Observation:
    """What is kept of a run.

    Args:
        run: to be advanced.
        every: keep the present state and each whose step number is a multiple of this, if no times are given.
        times: (n,) sorted as the run goes; keep the states at these.
    """

    def __init__(self, run: Memory, *, every: int = 1, times: Array | None = None) -> None:
        self.run, self.every, self.times = run, checked_count(every, "every", least=1), times
        self.search = CrossingSearch(run.stepper) if run.stepper.events else None
        self.states: list[tuple[Array, Array, Array, Array, NDArray[np.int64]]] = []
        self.iterations = 0

    def advance(self, steps: int | None, progress: Callable[[int], None] | None = None) -> Trajectory:
        """Advance by ``steps`` (to the goal), or to the step in which a terminal event ends the run; that is not taken.

        Raises:
            StepFailedError: with what was kept as ``trajectory``; the run stands before the failing step.
            EventError: where an event function is not finite.
        """
        goal = self.run.goal
        most_steps = np.inf if steps is None and goal else checked_count(steps, "steps", least=0)
        self._keep(record(self.run, 0), first=True)
        most = max(1, NUMBERS // self.run.stepper.dimension)
        portion, done = min(FIRST_STEPS, most), 0
        while done < most_steps and not self.run.arrived:
            size, began = int(min(portion, most_steps - done)), time.perf_counter()
            try:
                self._portion(size)
            except StepFailedError as failure:
                failure.trajectory = self.trajectory()
                raise
            if self.search is not None and self.search.ended:
                break
            done += size
            if progress is not None:
                progress(done)
            elapsed = max(time.perf_counter() - began, 1e-6)
            portion = max(1, min(most, 2 * size, int(size * SLICE_SECONDS / elapsed)))
        return self.trajectory()

    def _portion(self, size: int) -> None:
        """A portion of the run, its events and what is kept of it; a step that fails after a terminal event is none."""
        before, failure = self.run.save(), None
        try:
            part = record(self.run, size)
        except StepFailedError as error:
            part, failure = Trajectory.before(error), error
        if self.search is not None:
            reached = self.search.search(part, first=self.run.steps - len(part) + 1)
            if self.search.ended:
                self.run.rewind(before)
                part, failure = self._ended(record(self.run, reached)), None
        self._keep(part)
        if failure is not None:
            raise failure

    def _ended(self, part: Trajectory) -> Trajectory:
        """The part with the state at which the event ended it."""
        assert self.search is not None
        last = self.search.found[-1][-1:]
        return self._made(
            np.append(part.t, last["t"]),
            np.concatenate([part.q, last["q"]]),
            np.concatenate([part.p, last["p"]]),
            np.append(part.iterations, np.int32(0)),
            np.append(part.lengths, np.nan),
        )

    def _keep(self, part: Trajectory, *, first: bool = False) -> None:
        """What is wanted of a part, whose first state was dealt with unless it is the first of all."""
        ended = self.search is not None and self.search.ended
        total = self.iterations + np.cumsum(part.iterations, dtype=np.int64)
        self.iterations = int(total[-1])
        if self.times is not None:
            self._keep_times(part, total, first=first)
            return
        number = self.run.steps - (len(part) - 1 - ended) + np.arange(len(part))
        wanted = number % self.every == 0
        wanted[0] = first
        wanted[-1] |= ended or self.run.arrived
        self.states.append((part.t[wanted], part.q[wanted], part.p[wanted], part.lengths[wanted], total[wanted]))

    def _keep_times(self, part: Trajectory, total: NDArray[np.int64], *, first: bool) -> None:
        assert self.times is not None
        forward = part.forward
        left, right = forward * part.t[0], forward * part.t[-1]
        after = forward * self.times >= left if first else forward * self.times > left
        times = self.times[after & (forward * self.times <= right)]
        q, p = states_at(part, times)
        behind = np.searchsorted(forward * part.t, forward * times, side="right") - 1
        self.states.append((times, q, p, lengths_at(part, times), total[behind]))

    def trajectory(self) -> Trajectory:
        """All that was kept so far."""
        t, q, p, lengths, total = (np.concatenate(arrays) for arrays in zip(*self.states, strict=True))
        return self._made(t, q, p, np.diff(total, prepend=total[:1]).astype(np.int32), lengths)

    def _made(self, t: Array, q: Array, p: Array, iterations: NDArray[np.int32], lengths: Array) -> Trajectory:
        crossings = self.search.crossings() if self.search is not None else ()
        return trajectory_of(self.run, t, q, p, iterations, lengths=lengths, events=crossings)
