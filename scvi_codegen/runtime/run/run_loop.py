"""Run loop: advance in chunks of bounded duration, and save every k-th state of a run."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import lru_cache, partial
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.native.arguments import empty_array
from scvi_codegen.runtime.core.validation import BINARY64, FEW, Array
from scvi_codegen.runtime.events.event import Crossings
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.singular_time import ProgressWatch, check_energy_surface
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import times_after
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import checked_count

States = tuple[Array, Array, Array, NDArray[np.int32]]
NATIVE_DOUBLE, INT32 = struct.Struct("d"), np.dtype(np.int32)
SEQUENCES, NUMBERS = (list, tuple), frozenset((float, int, np.float64))
"""Types of states, and of their entries, that are converted without NumPy."""
FIRST_STEPS = 256
"""Number of saved states of the first C call, before the speed of the steps is known."""


def record(
    memory: Memory,
    steps: int | None,
    *,
    save_every: int = 1,
    progress: Callable[[int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Trajectory:
    """Advance by ``steps``; save the present state and those whose step number is a multiple of ``save_every``.

    Adaptive steps end at the target time, whose state is saved as well; ``steps`` may then be omitted. The run ends
    early if ``stop``, which is called before each chunk of steps, returns true.

    Raises:
        StepFailedError: if a step fails; ``trajectory`` has the saved states, the run is left before that step.
    """
    count = None if steps is None and not memory._plan.h else checked_count(steps, "steps", least=0)
    if type(save_every) is not int or save_every != 1:
        save_every = checked_count(save_every, "save_every", least=1)
    first, filled, status = memory._memory.step, 0, 0
    if progress is None and stop is None and memory._rows is not None and not memory._has_tau:
        trajectory, filled, status = _in_one_call(memory, memory._rows, first, count, save_every)
        if trajectory is not None:
            return trajectory
    recorder = _StateRecorder(memory, save_every, count, first, filled)
    try:
        recorder.check(status)
        drive(
            recorder.advance,
            math.inf if count is None else count,
            first=1 if stop else recorder.first_size,
            ended=lambda: memory.arrived or bool(stop and stop()),
            progress=progress,
        )
    except StepFailedError as failure:
        failure.trajectory = recorder.trajectory()
        raise
    trajectory = recorder.trajectory()
    if trajectory.tau is not None:
        memory.longest = float(np.abs(np.diff(trajectory.t)).max(initial=memory.longest))
        check_energy_surface(trajectory, memory.longest)
    return trajectory


def _in_one_call(
    memory: Memory, rows: StateRows, first: int, steps: int | None, save_every: int
) -> tuple[Trajectory | None, int, int]:
    """Record a short run by one C call; return the trajectory if the run has ended, number of states and status.

    No states: a longer run, or one that has arrived. Otherwise the recording continues after these states.
    """
    h, most = memory._plan.h, FIRST_STEPS * save_every
    size = most if steps is None else steps
    if size > most:
        return None, 0, 0
    if first:
        rows.begin_checked(memory.t, memory._q, memory._p)
    if not h and rows.time == memory._plan.t_end:
        return None, 0, 0
    if memory._unset_inputs and size:
        memory.check_inputs()
    status = memory._advance_function(*memory._plan_arguments, size, save_every, *memory._in_rows)
    filled = 1 + (memory._memory.step // save_every - first // save_every if h else memory._report.stored)
    if status or (steps is None and memory._report.steps == size):
        return None, filled, status
    states = rows.copies(filled)
    if h:
        step_sizes = _repeated(h, filled)
    else:
        step_sizes = rows.step_sizes() if save_every == 1 else _differences(states[0], whole=False)
    memory._times_in_rows = states[0]
    return trajectory_of(memory, states, step_sizes), filled, status


class StateRows:
    """Memory for the times, positions, momenta and iterations of states of a run.

    Attributes:
        states: the arrays.
        starts, next: pointers to their first and to their second rows.
    """

    __slots__ = (
        *("_count", "_difference", "_p", "_pack", "_pointers", "_q", "_steps", "_t", "_views"),
        *("next", "shape", "starts", "states"),
    )

    def __init__(self, memory: Memory, rows: int) -> None:
        m, binding = len(memory._q), memory.stepper.binding
        t, q, p = empty_array((rows,)), empty_array((rows, m)), empty_array((rows, m))
        self.states: States = t, q, p, np.zeros(rows, INT32)
        self.starts = *binding.pointers(t, q, p), binding.integers(self.states[3])
        first: Any = map(memoryview, (t, q[0], p[0]))  # faster to assign to than arrays
        self._t, self._q, self._p = first
        self._pointers = self.starts[1:3]
        self.shape = (m,) if m <= FEW else None  # of vectors that are checked as lists, faster than as arrays
        self._pack = struct.Struct(f"{m}d").pack_into
        self.next, self._count, self._views = self.after(1), 0, self.states

    def begin(self, t: float, q: Any, p: Any) -> tuple[Any, Any] | None:
        """Set the first state; return pointers to it, ``None`` unless q and p are short vectors of finite numbers."""
        kind = type(q)
        if kind is not type(p) or self.shape is None:
            return None
        if kind is np.ndarray:
            if not (q.shape == p.shape == self.shape and q.dtype is p.dtype is BINARY64):
                return None
            q, p = q.tolist(), p.tolist()  # lists are checked and copied faster than short arrays
        elif kind not in SEQUENCES or not NUMBERS.issuperset(map(type, q + p)):
            return None
        try:
            if isfinite(sum(q, sum(p))):
                self._pack(self._q, 0, *q)
                self._pack(self._p, 0, *p)
                self._t[0] = t
                return self._pointers
        except (OverflowError, struct.error):  # of an integer above all floats; of another number of entries
            pass
        return None

    @property
    def time(self) -> Any:
        """Time of the first state."""
        return self._t[0]

    def begin_checked(self, t: float, q: Array, p: Array) -> tuple[Any, Any]:
        """Set the first state and return pointers to it."""
        self._t[0] = t
        try:
            self._q[:] = q
            self._p[:] = p
        except ValueError:  # unaligned arrays, which memory views do not copy
            self.states[1][0], self.states[2][0] = q, p
        return self._pointers

    def after(self, row: int) -> tuple[Any, ...]:
        """Return pointers to a row."""
        (t, q, p, iterations), begin = self.starts, row * self.states[1].shape[1]
        return t + row, q + begin, p + begin, iterations + row

    def copies(self, count: int) -> States:
        """Return copies of the first rows."""
        if count != self._count:
            self._count, self._views, self._steps = count, self.first(count), np.full(count, math.nan)
            t = self._views[0]
            self._difference = partial(np.subtract, t[1:], t[:-1], self._steps[:-1])
        t, q, p, iterations = self._views
        return t.copy(), q.copy(), p.copy(), iterations.copy()

    def step_sizes(self) -> Array:
        """Return the steps that follow the states of :meth:`copies`, NaN for the last one."""
        self._difference()
        return self._steps.copy()

    def first(self, count: int) -> States:
        """Return the first rows, in the same memory."""
        t, q, p, iterations = self.states
        return t[:count], q[:count], p[:count], iterations[:count]


class _StateRecorder:
    """Present state of a run, and every ``save_every``-th of the following ones, in arrays that C fills.

    The number of states is known for fixed steps; for adaptive steps each chunk has arrays of its own.
    """

    __slots__ = ("earlier", "filled", "first", "first_size", "memory", "rows", "save_every", "watch")

    def __init__(self, memory: Memory, save_every: int, steps: int | None, first: int, filled: int) -> None:
        plan = memory._plan
        self.memory, self.save_every, self.first, self.filled = memory, save_every, first, filled or 1
        if plan.h:
            assert steps is not None  # by the caller
            self.first_size = save_every * max(1, FIRST_STEPS // save_every)
            rows = (first + steps) // save_every - first // save_every + 1
        else:
            self.first_size = FIRST_STEPS * save_every
            rows = min(FIRST_STEPS, (self.first_size if steps is None else steps) // save_every) + 3
        kept: StateRows | None = memory._rows
        self.rows = kept if kept is not None and rows <= len(kept.states[0]) else StateRows(memory, rows)
        if not filled:
            self.rows.begin_checked(memory.t, memory._q, memory._p)
        self.earlier: list[States] = []
        self.watch = ProgressWatch(memory.stepper, plan.t_end) if plan.tau else None

    def advance(self, size: int) -> int:
        """Take ``size`` steps, fewer if the target time is reached; return their number."""
        memory, save_every, watch = self.memory, self.save_every, self.watch
        to_end = not memory._plan.h
        before = None if watch is None else memory.t
        if to_end and self.filled + size // save_every + 2 > len(self.rows.states[0]):
            self.earlier.append(self._states())
            self.rows, self.filled = StateRows(memory, size // save_every + 2), 0
        rows, filled = self.rows, self.filled
        status = memory._advance(size, save_every, rows.next if filled == 1 else rows.after(filled))
        report = memory._report
        if to_end:
            self.filled += report.stored
        else:
            self.filled = 1 + memory._memory.step // save_every - self.first // save_every
        self.check(status)
        steps: int = report.steps
        if watch is not None and before is not None:
            watch.check_progress(before, memory.t, steps, memory.steps)
        return steps

    def check(self, status: int) -> None:
        """Raise :class:`StepFailedError` for the status of a failed step."""
        if status:
            raise self.memory._failure(status)

    def _states(self) -> States:
        """Return the rows in use; copies if most are not, or if the run uses the memory again."""
        rows, count = self.rows, self.filled
        capacity = len(rows.states[0])
        if rows is self.memory._rows or 2 * count <= capacity:
            return rows.copies(count)
        return rows.states if count == capacity else rows.first(count)

    def trajectory(self) -> Trajectory:
        """Return the states saved so far."""
        memory, states = self.memory, self._states()
        if self.earlier:
            t, q, p, iterations = map(np.concatenate, zip(*self.earlier, states, strict=True))
            states = t, q, p, iterations
        if not memory._plan.h:
            return trajectory_of(memory, states, _differences(states[0], whole=self.save_every == 1))
        tau, h = None, memory._memory.h
        if memory.stepper.interface.energy_parameter:
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
    plan, stepper, run = memory._plan, memory.stepper, memory._memory
    step_error = math.nan if memory._step_error is None else memory._step_error()
    # attribute by attribute: with 16 keywords the call of a class takes five times as long
    trajectory = Trajectory.__new__(Trajectory)
    t, q, p, trajectory.iterations = states
    if stepper.shapes is not None:
        q, p = stepper.named(q), stepper.named(p)
    trajectory.t, trajectory.q, trajectory.p, trajectory.step_sizes = t, q, p, step_sizes
    trajectory.h = plan.h or first_step_size(plan, t)
    trajectory.plan, trajectory.stepper, trajectory.options = plan, stepper, memory._options
    trajectory.steps = run.step if steps is None else steps
    trajectory.rejected_steps = 0 if plan.h or plan.tau else run.rejected
    if step_error >= 0.0:
        trajectory.step_error, trajectory.worst_step_time = step_error, run.error_t
    else:
        trajectory.step_error = trajectory.worst_step_time = math.nan
    trajectory.parameters, trajectory.events, trajectory.tau = memory._parameters.copy(), events, tau
    trajectory.confirmation = trajectory.observed = trajectory.conserved = None
    trajectory.pieces = ()
    return trajectory


@lru_cache(maxsize=64)
def _repeated(value: float, count: int) -> Array:
    """Return a read-only array of one number without memory for each; ``numpy.broadcast_to`` is ten times slower."""
    return np.ndarray((count,), BINARY64, NATIVE_DOUBLE.pack(value), 0, (0,))


def _differences(t: Array, *, whole: bool) -> Array:
    """Return the steps that follow states, NaN for the last one and unless all states are saved."""
    step_sizes = np.empty(len(t))
    if whole:
        np.subtract(t[1:], t[:-1], step_sizes[:-1])
        step_sizes[-1] = math.nan
    else:
        step_sizes.fill(math.nan)
    return step_sizes


def first_step_size(plan: StepPlan, t: Array) -> float:
    """Return the first step size between states of an adaptive run, or the direction of the run; NaN without states."""
    if len(t) == 0:
        return math.nan
    return t.item(1) - t.item(0) if len(t) > 1 else plan.t_end - t.item(0)
