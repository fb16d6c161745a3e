"""Run loop: advance in chunks of bounded duration, and save every k-th state of a run."""

import math
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from math import isfinite
from typing import Any, cast

import numpy as np

from scvi_codegen.codegen.native.arguments import BINARY64, empty_array
from scvi_codegen.codegen.native.capacity import room_for_states, too_many_states
from scvi_codegen.common.errors import ScviCodegenError, StepFailedError
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.accuracy.local_error import tolerable_change
from scvi_codegen.runs.driver.singular_time import ProgressWatch, check_energy_surface
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.validation import FEW, NUMBERS, SEQUENCES, Array, evaluation
from scvi_codegen.runs.states.words import block_of, from_block
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.noise import report_of
from scvi_codegen.runs.stepping.step_plan import Adaptive, FixedSteps, InTau, StepPlan
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings
from scvi_codegen.systems.formulas.symbols import DOT

NEAR = 0.1
"""Distance from an end, relative to the range, within which an argument at the last state is named."""


def end_run(failure: StepFailedError, run: Memory, trajectory: Trajectory) -> None:
    """Give a failure the states before it, and once the argument of a table that leaves its range."""
    if failure.trajectory is None:
        failure.args = (f"{failure}{_left_range(run)}",)
    failure.trajectory = trajectory


def _left_range(run: Memory) -> str:
    stepper, t, q, p = run.stepper, run.t, np.array(run.q), np.array(run.p)
    interface = stepper.interface
    if not interface.ranges:
        return ""
    values = {"t": float(t), **dict(zip(interface.parameters, run.parameters, strict=True))}
    values |= {**dict(zip(interface.momenta, p, strict=False)), **dict(zip(interface.coordinates, q, strict=False))}
    with suppress(ScviCodegenError):
        v = stepper.velocity(q, p, t, run.parameters)
        values |= {name + DOT: rate for name, rate in zip(interface.coordinates, v, strict=True)}
    for call, argument, *ends in interface.ranges:
        with suppress(ScviCodegenError, ArithmeticError, KeyError):
            evaluate, names = evaluation(argument)
            u, (low, high) = evaluate([float(values[name]) for name in names]), map(float, ends)
            if not low + NEAR * (high - low) < u < high - NEAR * (high - low):
                return (
                    f". The table {call} is given for {low:g} <= {argument} <= {high:g}; before this step {argument} = "
                    f'{u:.6g}: extend it, or give it outside="constant" or "linear"'
                )
    return ""


States = tuple[Any, ...]
"""Times, positions, momenta, iterations and, of a run that sums it, the action."""
NATIVE_DOUBLE, INT32 = struct.Struct("d"), np.dtype(np.int32)
GROWTH = 8.0
"""Largest ratio of successive numbers of steps of calls that save few states."""


def record(
    memory: Memory,
    steps: int | None,
    *,
    save_every: int = 1,
    progress: Callable[[int], None] | None = None,
    stop: Callable[[], bool] | None = None,
    filled: int = 0,
    status: int = 0,
) -> Trajectory:
    """Advance by ``steps``; save the present state and those whose step number is a multiple of ``save_every``.

    Adaptive steps end at the target time, whose state is saved as well; ``steps`` may then be omitted. The run ends
    early if ``stop``, which is called before each chunk of steps, returns true. ``filled``: states of the run that its
    memory for short runs already contains; ``status``: of the step after them.

    Raises:
        StepFailedError: if a step fails; ``trajectory`` has the saved states, the run is left before that step.
    """
    count = None if steps is None and memory._h is None else checked_count(steps, "steps", least=0)
    if type(save_every) is not int or save_every != 1:
        save_every = checked_count(save_every, "save_every", least=1)
    recorder = _StateRecorder(memory, save_every, count, filled)
    try:
        if status:
            raise memory._failure(status)
        if progress is None and stop is None and count is not None and count <= recorder.first_size:
            if count and not memory.arrived:  # one chunk
                recorder.advance(count)
        else:
            drive(
                recorder.advance,
                math.inf if count is None else count,
                first=1 if stop else recorder.first_size,
                growth=GROWTH if save_every > 1 else 2.0,
                ended=lambda: memory.arrived or bool(stop and stop()),
                progress=progress,
            )
    except StepFailedError as failure:
        end_run(failure, memory, recorder.trajectory())
        raise
    trajectory = recorder.trajectory()
    if trajectory.tau is not None:
        memory.longest = float(np.abs(np.diff(trajectory.t)).max(initial=memory.longest))
        check_energy_surface(trajectory, memory.longest)
    return trajectory


class StateRows:
    """Memory for the times, positions, momenta and iterations of states of a run.

    Attributes:
        states: the arrays; of a run that sums the action, also its values.
        starts: pointers to their first rows.
    """

    def __init__(self, memory: Memory, rows: int) -> None:
        binding, self.words = memory.stepper.binding, memory.stepper.interface.words
        m = self.words * len(memory._q)
        t = empty_array((rows,) if self.words == 1 else (rows, self.words))
        q, p = empty_array((rows, m)), empty_array((rows, m))
        actions = (np.zeros(rows),) if memory._sums_action else ()
        self.states: States = t, q, p, np.zeros(rows, INT32), *actions
        self.starts = *binding.pointers(t, q, p), binding.integers(self.states[3]), *binding.pointers(*actions)

    def after(self, row: int) -> tuple[Any, ...]:
        """Return pointers to a row."""
        (t, q, p, *others), begin = self.starts, row * self.states[1].shape[1]
        return t + self.words * row, q + begin, p + begin, *(column + row for column in others)

    def first(self, count: int) -> States:
        """Return the first rows, in the same memory; copies of numbers of two words."""
        t, q, p, *others = (column[:count] for column in self.states)
        return (t, q, p, *others) if self.words == 1 else (*_numbers(t, q, p), *others)

    def copies(self, count: int) -> States:
        """Return copies of the first rows."""
        return tuple(column.copy() for column in self.first(count))


class ShortRuns(StateRows):
    """Memory of runs of few saved states by the plan of a run, each recorded by one C call."""

    def __init__(self, memory: Memory) -> None:
        rows = memory._first_saved + 3
        super().__init__(memory, rows)
        stepper, m = memory.stepper, len(memory._q)
        self._states, self._kind = stepper._states, (0, cast("float | None", None))
        self.shape = (m,) if m <= FEW else None  # of vectors that are checked as lists, faster than as arrays
        self._start, self._sizes = np.empty(1 + 2 * m), np.full(rows, math.nan)
        self._pack = partial(struct.Struct(f"{1 + 2 * m}d").pack_into, cast(Any, self._start), 0)
        self.call, self._count = memory._new_call(*self.starts), 2 * m
        self.way = 0, 0  # measures_growth and begins_by of the call
        self.call.start, self.call.sizes = stepper.binding.pointers(self._start, self._sizes)
        self.call.has_energies = stepper.interface.conserves_energy and not stepper.changes_states
        self.has_mesh, self.plan = stepper.interface.layout.mesh is not None, cast("StepPlan | None", None)
        self.integrate = stepper.binding.call("integrate", self.call)
        self.results = stepper.binding.results(self.call)

    def begin(self, t: float, q: Any, p: Any, name: str = "p") -> None:
        """Set the initial state; raise :class:`StateError` unless q and p, or what it is, are (m,) finite numbers."""
        numbers: list[Any] = []
        for vector in (q, p):
            if type(vector) is np.ndarray:
                if vector.shape == self.shape and vector.dtype is BINARY64:
                    numbers += vector.tolist()
            elif type(vector) in SEQUENCES and NUMBERS.issuperset(map(type, vector)):
                numbers += vector if (len(vector),) == self.shape else ()
        try:
            if len(numbers) == self._count and isfinite(sum(numbers)):
                self._pack(t, *numbers)
                return
        except (OverflowError, struct.error):  # of an integer above all floats
            pass
        self._start[0], self._start[1:] = t, np.concatenate(self._states.pair(q, p, name))

    def set_plan(self, plan: StepPlan) -> None:
        """Set the changes of the energy, or errors of steps, of which C makes a remark."""
        self.plan, self.call.tolerable = plan, tolerable_change(plan)

    def recorded(self, count: int, h: float | None, save_every: int) -> tuple[States, Array]:
        """Return copies of the first states and of the steps that follow them."""
        if (count, h) != self._kind:
            self._kind, self._views = (count, h), self.first(count)
            self._sizes_of_kind = _repeated(h, count) if h is not None else self._sizes[:count]
        (t, q, p, iterations), sizes = self._views, self._sizes_of_kind
        if h is None:
            if save_every != 1:
                return (t.copy(), q.copy(), p.copy(), iterations.copy()), _repeated(math.nan, count)
            sizes[-1] = math.nan
            sizes = sizes.copy()
        return (t.copy(), q.copy(), p.copy(), iterations.copy()), sizes


def _numbers(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    """Return times (n, 2) and states (n, 2m) of two words as numbers, contiguous copies."""
    return from_block(t)[:, 0].copy(), from_block(q).copy(), from_block(p).copy()


class _StateRecorder:
    """Present state of a run, and every ``save_every``-th of the following ones, in arrays that C fills.

    The number of states is known for fixed steps; for adaptive steps each chunk has arrays of its own.
    """

    def __init__(self, memory: Memory, save_every: int, steps: int | None, filled: int) -> None:
        plan, first = memory._plan, 0 if filled else memory._memory.step
        self.memory, self.save_every, self.first, self.filled = memory, save_every, first, filled or 1
        self.first_size = min(memory._first_saved * save_every, memory._longest_first)
        if memory._h is not None:
            assert steps is not None  # by the caller
            rows = (first + steps) // save_every - first // save_every + 1
        else:
            rows = min(memory._first_saved, (self.first_size if steps is None else steps) // save_every) + 3
        kept: StateRows | None = memory._rows
        self.rows = kept if kept is not None and rows <= len(kept.states[0]) else StateRows(memory, rows)
        if not filled:
            t, q, p, _, *actions = self.rows.states
            t[0] = memory.t if self.rows.words == 1 else (memory.t, memory._memory.t_low)
            q[0], p[0] = map(block_of, (memory._q, memory._p))
            for sums in actions:
                sums[0] = memory._memory.action
        self.earlier: list[States] = []
        self.bytes = 0
        self.watch = ProgressWatch(memory.stepper, plan.t_end) if isinstance(plan, InTau) else None

    def advance(self, size: int) -> int:
        """Take ``size`` steps, fewer if the target time is reached; return their number."""
        memory, save_every, watch = self.memory, self.save_every, self.watch
        to_end = memory._h is None
        before = None if watch is None else memory.t
        if to_end and self.filled + size // save_every + 2 > len(self.rows.states[0]):
            self.earlier.append(self._states())
            self.bytes += sum(column.nbytes for column in self.earlier[-1])
            if self.bytes > room_for_states():
                self.filled = 0
                raise too_many_states(sum(len(states[0]) for states in self.earlier), memory.steps, float(memory.t))
            self.rows, self.filled = StateRows(memory, size // save_every + 2), 0
        rows, filled = self.rows, self.filled
        status = memory._advance(size, save_every, rows.after(filled))
        report = memory._report
        if to_end:
            self.filled += report.stored
        else:
            self.filled = 1 + memory._memory.step // save_every - self.first // save_every
        if status:
            raise memory._failure(status)
        steps: int = report.steps
        if watch is not None and before is not None:
            watch.check_progress(before, memory.t, steps, memory.steps)
        return steps

    def _states(self) -> States:
        """Return the rows in use; copies if most are not, or if the run uses the memory again."""
        rows, count = self.rows, self.filled
        capacity = len(rows.states[0])
        if rows is self.memory._rows or 2 * count <= capacity:
            return rows.copies(count)
        return rows.states if count == capacity and rows.words == 1 else rows.first(count)

    def trajectory(self) -> Trajectory:
        memory, states = self.memory, self._states()
        if self.earlier:
            states = tuple(map(np.concatenate, zip(*self.earlier, states, strict=True)))
        if memory._h is None:
            return trajectory_of(memory, states, _differences(states[0], whole=self.save_every == 1))
        tau, h = None, memory._memory.h
        if memory.stepper.in_tau:
            numbers = self.save_every * (self.first // self.save_every + np.arange(len(states[0])))
            numbers[0] = self.first
            tau = times_after(0.0, h, numbers)[0]
        return trajectory_of(memory, states, _repeated(h, len(states[0])), tau=tau)


def trajectory_of(
    memory: Memory,
    states: States,
    step_sizes: Array,
    *,
    steps: int | None = None,
    events: tuple[Crossings, ...] = (),
    tau: Array | None = None,
) -> Trajectory:
    """Return a trajectory of these states with the data of the run."""
    run, error = memory._memory, math.nan if memory._step_error is None else memory._step_error()
    done, rejected = run.step if steps is None else steps, run.rejected if isinstance(memory._plan, Adaptive) else 0
    error_t, fallbacks = run.error_t if error >= 0.0 else 0.0, memory.fallback_steps
    trajectory = plain_trajectory(memory, states, step_sizes, done, error, error_t, rejected, fallbacks)
    trajectory.events, trajectory.tau = events, tau
    return trajectory


def plain_trajectory(
    memory: Memory,
    states: States,
    step_sizes: Array,
    steps: int,
    error: float,
    error_t: float,
    rejected: int,
    fallbacks: int,
) -> Trajectory:
    """Return a trajectory without events.

    Its attributes are set one by one, because a call of the class with 16 keywords takes five times as long.
    """
    plan, stepper = memory._plan, memory.stepper
    trajectory = Trajectory.__new__(Trajectory)
    t, q, p, trajectory.iterations, *actions = states
    trajectory.actions = actions[0] if actions else None
    if stepper.shapes is not None:
        q, p = stepper.named(q), stepper.named(p)
    trajectory.t, trajectory.q, trajectory.p, trajectory.step_sizes = t, q, p, step_sizes
    trajectory.h = plan.h if isinstance(plan, FixedSteps) else first_step_size(plan, t)
    trajectory.plan, trajectory.stepper, trajectory.options = plan, stepper, memory._options
    trajectory.steps, trajectory.rejected_steps, trajectory.fallback_steps = steps, rejected, fallbacks
    if error >= 0.0:
        trajectory.step_error, trajectory.worst_step_time = error, error_t
    else:
        trajectory.step_error = trajectory.worst_step_time = math.nan
    trajectory.parameters = memory._parameters.copy()
    trajectory.events = trajectory.transitions = trajectory.pieces = ()
    trajectory.bath = report_of(memory._memory) if memory._takes_noise else None
    trajectory.modes = trajectory.tau = trajectory.confirmation = trajectory.observed = trajectory.conserved = None
    trajectory.began = None
    return trajectory


@lru_cache(maxsize=64)
def _repeated(value: float, count: int) -> Array:
    """Return a read-only array of one number without memory for each; ``numpy.broadcast_to`` is ten times slower."""
    return np.ndarray((count,), BINARY64, NATIVE_DOUBLE.pack(value), 0, (0,))


def _differences(t: Array, *, whole: bool) -> Array:
    """Return the steps that follow states, NaN for the last one and unless all states are saved."""
    if not whole:
        return _repeated(math.nan, len(t))
    step_sizes = np.empty(len(t))
    np.subtract(t[1:], t[:-1], step_sizes[:-1])
    step_sizes[-1] = math.nan
    return step_sizes


def first_step_size(plan: Adaptive | InTau, t: Array) -> float:
    """Return the first step size between states of an adaptive run, or the direction of the run; NaN without states."""
    count = len(t)
    if count > 1:
        return t.item(1) - t.item(0)
    return plan.t_end - t.item(0) if count else math.nan
