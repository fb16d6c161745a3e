"""Runs with observers of all states: events, output at given times, fixed steps to a final time, ``observe=``.

The run advances in chunks with all states; events are searched between these states and only the requested states are
saved. States are therefore bitwise equal with and without events. A chunk is cut at the end of the run, by a terminal
event or at the final time, before the observer receives it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.native.capacity import room_for_states, too_many_states
from scvi_codegen.common.errors import EventError, StateError, StepFailedError, closest
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.driver.run_loop import end_run, record, trajectory_of
from scvi_codegen.runs.driver.singular_time import ProgressWatch
from scvi_codegen.runs.events.refinement import search_of
from scvi_codegen.runs.nouns import Save
from scvi_codegen.runs.results.dense_output import states_and_steps_at, step_sizes_at, stepped_to
from scvi_codegen.runs.results.time_transformation import part_of_step
from scvi_codegen.runs.states.times import WHOLE, number_until
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import Words, fraction_of, stacked
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Adaptive, Fixed, Until
from scvi_codegen.runs.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class StateChunk:
    """Consecutive states of a run.

    Attributes:
        run: the run, at the last state unless that is within a step.
        states: the states; the first one is the last of the previous chunk, if there is one.
        numbers: (n,) numbers of the steps that end at the states, -1 within a step.
        iterations: (n,) numbers of solver iterations since the start.
        is_first: whether the chunk consists of the initial state.
        is_last: whether the run has ended.
        within_step: whether the last state is within a step, so that the run is at the one before.
    """

    run: Memory
    states: Trajectory
    numbers: NDArray[np.int64]
    iterations: NDArray[np.int64]
    is_first: bool
    is_last: bool
    within_step: bool


class Observer:
    """Observer of a run, as passed to ``integrate(observe=)``."""

    def most_steps(self, run: Memory) -> float:
        """Return the largest number of steps of the next chunk."""
        return math.inf

    def receive(self, chunk: StateChunk) -> None:
        """Receive the next states; those of the first chunk are the initial state alone."""
        raise NotImplementedError

    def result(self) -> ArrayLike:
        """Return ``observed`` of the trajectory."""
        raise NotImplementedError


class Extremes(Observer):
    """Smallest and largest values of q and p over all states, (2, 2m)."""

    def __init__(self) -> None:
        self.values = np.empty(0)

    def functions(self, chunk: StateChunk) -> Array:
        """Return the (n, 2m) values at the states."""
        return np.concatenate([chunk.states.q, chunk.states.p], axis=1)

    def receive(self, chunk: StateChunk) -> None:
        """Include the states."""
        states = self.functions(chunk)
        rows = states if chunk.is_first else np.concatenate([self.values, states])
        self.values = np.array([rows.min(axis=0), rows.max(axis=0)])

    def result(self) -> ArrayLike:
        """Return the smallest and the largest values."""
        return self.values


class EnergyExtremes(Extremes):
    """Smallest and largest energy over all states, (2,)."""

    def functions(self, chunk: StateChunk) -> Array:
        """Return the (n,) energies of the states."""
        return chunk.states.energy()


Observe = Observer | Callable[[Any], ArrayLike] | str | None
OBSERVERS: dict[str, Callable[[], Observer]] = {
    # each is made anew for a run
    "extremes": Extremes,
    "energy": EnergyExtremes,
}
"""Observers by name, ``integrate(observe="extremes")``."""


class Saver(Observer):
    """Every n-th state and the last one.

    Args:
        save_every: steps between saved states.
        within_steps: with ``save_every=1``, also states after changes by events within steps.

    Attributes:
        rows: arrays t, q, p, step sizes, independent variables, numbers of iterations and actions (NaN unless the run
            sums them) of each chunk.
    """

    def __init__(self, save_every: int = 1, *, within_steps: bool = True) -> None:
        self.save_every, self.within_steps = checked_count(save_every, "save_every", least=1), within_steps
        self.rows: list[tuple[Array, Array, Array, Array, Array, NDArray[np.int64], Array]] = []
        self.measured, self.bytes = 0, 0

    def check_room(self, run: Memory) -> None:
        """Raise ``StepFailedError`` if the saved states fill the memory."""
        self.bytes += sum(column.nbytes for rows in self.rows[self.measured :] for column in rows)
        self.measured = len(self.rows)
        if self.bytes > room_for_states():
            raise too_many_states(sum(len(rows[0]) for rows in self.rows), run.steps, float(run.t))

    def is_saved(self, chunk: StateChunk) -> NDArray[np.bool_]:
        """Return which states of a chunk to save."""
        saved: NDArray[np.bool_] = chunk.numbers % self.save_every == 0  # states within a step only if all are saved
        saved &= self.within_steps | (chunk.numbers >= 0)
        saved[0] = chunk.is_first
        saved[-1] |= chunk.is_last
        return saved

    def receive(self, chunk: StateChunk) -> None:
        """Save the states of the output."""
        if (saved := self.is_saved(chunk)).any():
            self.save(chunk, saved)

    def save(self, chunk: StateChunk, saved: NDArray[np.bool_]) -> None:
        """Save some states of a chunk."""
        part = chunk.states
        t, q, p, sizes, stepped = (column[saved] for column in (part.t, part.q, part.p, part.step_sizes, part.stepped))
        actions = np.full(len(t), np.nan) if part.actions is None else part.actions[saved]
        self.rows.append((t, q, p, sizes, stepped, chunk.iterations[saved], actions))

    def cut_step(self, size: float) -> None:
        """Set the size of the step that follows the last state, which an event may have cut, if that is saved."""
        if self.save_every == 1 and self.rows:
            self.rows[-1][3][-1] = size

    def fields(self) -> dict[str, Any]:
        """Return further fields of the trajectory."""
        return {}


class AtTimes(Saver):
    """States at (n,) output times, sorted in the direction of the run."""

    def __init__(self, times: Array) -> None:
        super().__init__()
        self.times = times
        self.began: tuple[float, Array, Array] | None = None

    def receive(self, chunk: StateChunk) -> None:
        """Save the states at the times within the chunk, by partial steps."""
        part, forward = chunk.states, chunk.states.forward
        if chunk.is_first:
            self.began = part.initial
        left, right = forward * part.t[0], forward * part.t[-1]
        after = forward * self.times >= left if chunk.is_first else forward * self.times > left
        times = self.times[after & (forward * self.times <= right)]
        q, p, stepped = states_and_steps_at(part, times)
        before = number_until(part.t, times, forward) - 1
        unknown = np.full(len(times), np.nan)
        self.rows.append((times, q, p, step_sizes_at(part, times), stepped, chunk.iterations[before], unknown))

    def cut_step(self, size: float) -> None:
        """Output times are within steps."""

    def fields(self) -> dict[str, Any]:
        """Return the state from which the run began, which may be at none of the times."""
        return {"began": self.began}


class Observed(Saver):
    """Times of every n-th state, conserved quantities there, the states at both ends and the results of observers.

    Args:
        observer: an observer, or a function of the run, of whose results at every n-th state ``observed`` consists.
        save_every: steps between saved times.
    """

    def __init__(self, observer: Observer | Callable[[Any], ArrayLike], save_every: int) -> None:
        super().__init__(save_every)
        self.observer, self.observed, self.conserved = observer, list[Array](), list[Array]()
        self.ends: list[tuple[Array, Array]] = []

    def most_steps(self, run: Memory) -> float:
        """Return the number of steps to the next saved time, where a function is called."""
        if isinstance(self.observer, Observer):
            return self.observer.most_steps(run)
        return self.save_every - run.steps % self.save_every

    def receive(self, chunk: StateChunk) -> None:
        """Pass the states to the observer."""
        saved = self.is_saved(chunk)
        if isinstance(self.observer, Observer):
            self.observer.receive(chunk)
        elif saved.any():
            self._call(chunk)
        if not saved.any():
            return
        self.save(chunk, saved)
        t, q, p, sizes, stepped, count, actions = self.rows[-1]
        self.rows[-1] = t, q[:0], p[:0], sizes, stepped, count, actions
        self.ends = [*self.ends[:1], (q[-1], p[-1])]
        stepper, parameters = chunk.run.stepper, chunk.states.parameters
        energies = stepper._energy_parts(q, p, t, parameters)
        maps = stepper.momentum_maps(q, p, t, parameters) if stepper.momentum_map_names else np.empty((len(t), 0))
        self.conserved.extend(np.concatenate([energies, maps], axis=1))

    def _call(self, chunk: StateChunk) -> None:
        run, part = chunk.run, chunk.states
        if chunk.within_step:
            here = {"t": part.t[-1], "parameters": run.parameters, "options": run.options}
            run = type(run).started(run.stepper, part.q[-1], part.p[-1], plan=run.plan, **here)
        assert not isinstance(self.observer, Observer)
        array, when = real_array(self.observer(run), "the result of observe"), f"at t = {run.t:g}"
        if self.observed and array.shape != self.observed[0].shape:
            raise StateError(
                f"the result of observe must keep its shape: {array.shape} {when}, {self.observed[0].shape} before"
            )
        self.observed.append(array)

    def fields(self) -> dict[str, Any]:
        """Return the results."""
        observed: Any = self.observed
        if isinstance(self.observer, Observer):
            observed = real_array(self.observer.result(), "the result of observe")
        q, p = (np.concatenate([end[None] for end in states]) for states in zip(*self.ends, strict=True))
        return {"q": q, "p": p, "observed": np.array(observed), "conserved": np.array(self.conserved)}


def saver_of(save: Save) -> Saver:
    """Return the observer that saves the states that are saved, or calls its observer; StateError for others."""
    observe = save.observe
    if save.t_eval is not None:
        return AtTimes(save.t_eval)
    if observe is None:
        return Saver(save.save_every)
    if isinstance(observe, str):
        if observe not in OBSERVERS:
            names = ", ".join(OBSERVERS)
            raise StateError(f"there is no observer '{observe}'{closest(observe, OBSERVERS)} Known: {names}")
        observe = OBSERVERS[observe]()
    if not (isinstance(observe, Observer) or callable(observe)):
        raise StateError(f"observe must be a function of the run, an observer or its name, not {observe!r}")
    return Observed(observe, save.save_every)


CHUNK_NUMBERS = 2**18
"""Largest number of positions in a chunk."""
FIRST_STEPS = 64
Taken = tuple[Trajectory, NDArray[np.int64] | None, Exception | None]
"""States of a chunk, the numbers of their steps if these do not follow from the run, and the failure that ended it."""


class Observation:
    """Driver of a run whose states observers receive.

    Args:
        run: the run to advance; if its plan has fixed steps and a target time, the last step is shorter.
        saver: observer that determines the states of the trajectory.
    """

    def __init__(self, run: Memory, saver: Saver) -> None:
        self.run, self.saver = run, saver
        watch = None if run.ended else run._watch
        self.search = search_of(run.stepper, watch) if run.stepper.searched else None
        run._watch = self.search and self.search.watch
        plan = run.plan
        self.end = plan.t_end if isinstance(plan, Until) else None
        self.arrived, self.partial_steps, self.iterations = False, 0, 0

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
        unbounded = steps is None and not isinstance(plan, Fixed)
        count = math.inf if unbounded else checked_count(steps, "steps", least=0)
        self._pass_on(record(run, 0), is_first=True)
        most = max(1, CHUNK_NUMBERS // run.stepper.dimension)
        watch = None if isinstance(plan, Adaptive | Fixed) else ProgressWatch(run.stepper, plan.t_end)
        take = self._take_with_changes if self.search is not None and self.search.changes else self._take

        begin, first = run.t, run.steps

        def advance(size: int) -> int:
            before, number = run.t, run.steps
            part, numbers, failure = take(
                int(min(size, self.saver.most_steps(run), self._steps_before_end(begin, first)))
            )
            self._pass_on(part, numbers)
            self.saver.check_room(run)
            if isinstance(failure, EventError):
                failure.trajectory = self.trajectory()
            if failure is not None:
                raise failure
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
            end_run(failure, run, self.trajectory())
            raise
        trajectory = self.trajectory()
        if self.search is not None:
            self.search.warn_of_accumulation()
        if type(self.saver) is not AtTimes and not self.ended:
            run.iterations = self.iterations - int(trajectory.iterations.sum())
        return trajectory

    def _steps_before_end(self, begin: float, first: int) -> float:
        """Return a number of steps that hardly passes the final time, by the mean size of those after step ``first``.

        A chunk that passes it is taken again up to there, so the last one is short.
        """
        passed = self.run.t - begin
        if self.end is None or passed == 0.0:
            return math.inf
        return max(FIRST_STEPS, (self.run.steps - first) * (self.end - self.run.t) / passed - FIRST_STEPS)

    def _take(self, size: int) -> Taken:
        """Advance by one chunk and search it for events; a failure after a terminal event is ignored."""
        # The C run advances by whole chunks, so it may pass the final time or a terminal event. Then it is rolled back
        # to the start of the chunk and the steps up to there are recorded again, with the same bits; the memory of the
        # run (compensation terms, predictor) then belongs to the last of them. A partial step completes the motion.
        before, failure = self.run.snapshot, None
        try:
            part = record(self.run, size)
        except StepFailedError as error:
            part, failure = Trajectory.before(error), error
        if self.end is not None and (part.t[-1] - self.end) * self.run._step_size >= 0.0:
            self.run.rollback(before)
            part, failure = self._arrived(part, before), None
        if self.search is not None:
            reached = self.search.search(part, first=self.run.steps - len(part) + 1 + self.arrived)
            if self.search.ended:  # an error in a later step of the chunk is not part of the motion
                self.run.rollback(before)
                part, failure, self.arrived = record(self.run, reached), None, False
                t, q, p = self.search.last
                lengths = part.step_sizes.copy()
                if isinstance(self.run.plan, Adaptive):
                    lengths[-1] = t - part.t[-1]
                part = self._with_state(part, lengths, t, q, p, self._state_within_step(part, t)[2])
                self.run._watch = self.search.watch
        return part, None, failure

    def _take_with_changes(self, size: int) -> Taken:
        """Advance by one chunk with events that change the state."""
        assert self.search is not None  # by the caller
        run = self.run
        (t, q, p, iterations), sizes, numbers, failure = self.search.advance(run, size)
        self.arrived = self.end is not None and t[-1] == self.end
        part = trajectory_of(run, (t, run.stepper.named(q), run.stepper.named(p), iterations), sizes)
        part.transitions = self.search.transitions(self.search.recorded[-1:])
        part.modes = self.search.modes(self.search.recorded[-1:])
        return part, numbers, failure

    def _arrived(self, part: Trajectory, before: bytes) -> Trajectory:
        """Return the chunk up to the final time, with a shorter last step; the run is left before that step."""
        assert self.end is not None
        self.arrived = True
        whole = int(np.count_nonzero((self.end - part.t) * self.run._step_size >= 0.0)) - 1
        part = record(self.run, whole)
        while self.run.left_to(self.end) * self.run._step_size < 0.0:  # rounded times tie: the step before is the last
            self.run.rollback(before)
            whole -= 1
            part = record(self.run, whole)
        in_words = self.run.stepper.interface.words > 1 and self.run.stepper.interface.time_transformation is None
        if whole and in_words and 0.0 < abs(self.run.left_to(self.end)) <= WHOLE * abs(self.run._step_size):
            self.run.rollback(before)  # the last step is longer than h by its rounding error
            whole -= 1
            part = record(self.run, whole)
        q, p, tau = self._state_within_step(part, self.end)
        lengths = part.step_sizes.copy()
        lengths[-1] = self.run.left_to(self.end) if tau is None else tau - part.stepped[-1]
        # The partial step starts from the state alone, not from the run: the memory of a run holds predictors for steps
        # of size h, and its state stays at the last whole step.
        self.partial_steps = int(abs(lengths[-1]) > WHOLE * abs(self.run._step_size))
        if tau is None and lengths[-1] != 0.0:
            run = self.run
            if isinstance(q, Words):
                q, p = stepped_to(run, q, p, run._times, self.end)
            else:
                q, p = run.stepper.step(q, p, lengths[-1], run.t, run.parameters, options=run.options)
        return self._with_state(part, lengths, self.end, q, p, tau)

    def _state_within_step(self, part: Trajectory, t: float) -> tuple[Array, Array, float | None]:
        """Return the state and tau at a time in the step after a chunk; without time transformation the last state.

        Systems in transformed time are autonomous, so t is counted from the last state.
        """
        run = self.run
        if part.tau is None or (left := run.left_to(t)) == 0.0:
            return part.q[-1], part.p[-1], None if part.tau is None else float(part.tau[-1])
        span = left if run.stepper.interface.words == 1 else fraction_of(t) - run._exact_time
        q, p, fraction = part_of_step(run, 0.0, run._step_size, span, part.q[-1], part.p[-1])
        return q, p, float(part.tau[-1]) + fraction * run._step_size

    def _with_state(
        self, part: Trajectory, lengths: Array, t: float, q: Array, p: Array, tau: float | None
    ) -> Trajectory:
        """Return a chunk with one more state within a step appended."""
        made = self._made(
            np.concatenate([part.t, stacked([t])]),
            np.concatenate([part.q, q[None]]),
            np.concatenate([part.p, p[None]]),
            np.append(part.iterations, np.int32(0)),
            np.append(lengths, np.nan),
            np.append(part.stepped, t if tau is None else tau),
        )
        if part.actions is not None:
            made.actions = np.append(part.actions, part.actions[-1] + self._action_until(part, t))
        return made

    def _action_until(self, part: Trajectory, t: float) -> float:
        """Return the action of the part of a step from the last state of a chunk to a time."""
        if t == (begin := float(part.t[-1])):
            return 0.0
        settings: dict[str, Any] = {"t": begin, "parameters": self.run.parameters, "options": self.run.options}
        run = Memory.started(self.run.stepper, part.q[-1], part.p[-1], plan=Fixed(t - begin), **settings)
        run.advance(1)
        return float(run._memory.action)

    def _pass_on(self, part: Trajectory, numbers: NDArray[np.int64] | None = None, *, is_first: bool = False) -> None:
        """Pass a chunk to the saver; its steps end at the last state, unless these are their numbers."""
        if len(part) > 1:
            self.saver.cut_step(float(part.step_sizes[0]))  # known only now
        if numbers is None:
            numbers = self.run.steps - (len(part) - 1 - self.ended) + np.arange(len(part))
        iterations = self.iterations + np.cumsum(part.iterations, dtype=np.int64)
        self.iterations = int(iterations[-1])
        is_last = self.ended or self.run.arrived
        self.saver.receive(StateChunk(self.run, part, numbers, iterations, is_first, is_last, self.ended))

    def trajectory(self) -> Trajectory:
        """Return all states saved so far."""
        t, q, p, sizes, stepped, count, actions = (
            np.concatenate(arrays) for arrays in zip(*self.saver.rows, strict=True)
        )
        fields = {"q": q, "p": p, **self.saver.fields()}
        states = t, fields.pop("q"), fields.pop("p"), np.diff(count, prepend=count[:1]).astype(np.int32)
        trajectory = self._made(*states, sizes, stepped)
        trajectory.actions = actions if self.run._sums_action else None
        return replace(trajectory, **fields) if fields else trajectory

    def _made(
        self, t: Array, q: Array, p: Array, iterations: NDArray[np.int32], lengths: Array, stepped: Array
    ) -> Trajectory:
        crossings = self.search.crossings() if self.search is not None else ()
        tau = stepped if self.run.stepper.in_tau else None
        steps = self.run.steps + (self.partial_steps if self.arrived else 0)
        made = trajectory_of(self.run, (t, q, p, iterations), lengths, steps=steps, events=crossings, tau=tau)
        if self.search is not None:
            made.transitions = self.search.transitions(self.search.recorded)
            made.modes = self.search.modes(self.search.recorded)
        return made
