"""Run loop: advance in chunks of bounded duration, and save every k-th state of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from struct import Struct

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.native.arguments import empty_array
from scvi_codegen.native.options import step_failure
from scvi_codegen.runtime.core.validation import BINARY64, Array
from scvi_codegen.runtime.events.event import Crossings
from scvi_codegen.runtime.run.chunks import drive
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.singular_time import ProgressWatch, check_energy_surface
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import times_after
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import checked_count

NATIVE_DOUBLE, INT32 = Struct("d"), np.dtype(np.int32)
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
    count = None if steps is None and memory._plan is not None else checked_count(steps, "steps", least=0)
    save_every = checked_count(save_every, "save_every", least=1)
    recorder = _StateRecorder(memory, save_every, count)
    try:
        drive(
            recorder.advance,
            math.inf if count is None else count,
            first=1 if stop else recorder.first_size,
            ended=memory.has_arrived if stop is None else lambda: memory.has_arrived() or stop(),
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


class _StateRecorder:
    """Present state of a run, and every ``save_every``-th of the following ones, in arrays that C fills.

    The number of states is known for fixed steps; for adaptive steps each chunk has arrays of its own.
    """

    def __init__(self, memory: Memory, save_every: int, steps: int | None) -> None:
        self.memory, self.save_every, self.first, plan = memory, save_every, memory.steps, memory._plan
        self.earlier: list[tuple[Array, Array, Array, NDArray[np.int32]]] = []
        if plan is None:
            assert steps is not None  # by the caller
            self.first_size = save_every * max(1, FIRST_STEPS // save_every)
            self._allocate((self.first + steps) // save_every - self.first // save_every + 1)
        else:
            self.first_size = FIRST_STEPS * save_every
            self._allocate(min(FIRST_STEPS, (self.first_size if steps is None else steps) // save_every) + 3)
        self.t[0], self.q[0], self.p[0], self.filled = memory.t, memory._q, memory._p, 1
        self.watch = ProgressWatch(memory.stepper, plan.t_end) if plan and plan.tau else None

    def _allocate(self, rows: int) -> None:
        m, binding = len(self.memory._q), self.memory.stepper.binding
        self.t, self.q, self.p = empty_array((rows,)), empty_array((rows, m)), empty_array((rows, m))
        self.iterations, self.filled = np.zeros(rows, INT32), 0
        self.starts = *binding.pointers(self.t, self.q, self.p), binding.integers(self.iterations)

    def advance(self, size: int) -> int:
        """Take ``size`` steps, fewer if the target time is reached; return their number."""
        memory, save_every = self.memory, self.save_every
        plan, watch, rows = memory._plan, self.watch, size // save_every + 2
        before = None if watch is None else memory.t
        if plan is not None and self.filled + rows > len(self.t):
            self.earlier.append(self._states())
            self._allocate(rows)
        filled, (t, q, p, iterations) = self.filled, self.starts
        start = filled * self.q.shape[1]
        status = memory._advance(size, save_every, (t + filled, q + start, p + start, iterations + filled))
        report = memory._report
        if plan is None:
            self.filled = 1 + memory.steps // save_every - self.first // save_every
        else:
            self.filled += report.stored
        if status:
            raise step_failure(status, report, step=memory.steps, h=memory.h)
        steps: int = report.steps
        if watch is not None and before is not None:
            watch.check_progress(before, memory.t, steps, memory.steps)
        return steps

    def _states(self) -> tuple[Array, Array, Array, NDArray[np.int32]]:
        """Return the rows in use; copies if most are not."""
        k, t, q, p, iterations = self.filled, self.t, self.q, self.p, self.iterations
        if k == len(t):
            return t, q, p, iterations
        if 2 * k > len(t):
            return t[:k], q[:k], p[:k], iterations[:k]
        return t[:k].copy(), q[:k].copy(), p[:k].copy(), iterations[:k].copy()

    def trajectory(self) -> Trajectory:
        """Return the states saved so far."""
        memory, save_every = self.memory, self.save_every
        t, q, p, iterations = self._states()
        if self.earlier:
            blocks = zip(*self.earlier, (t, q, p, iterations), strict=True)
            t, q, p, iterations = map(np.concatenate, blocks)
        if memory._plan is not None:
            step_sizes = np.empty(len(t))
            if save_every == 1:
                np.subtract(t[1:], t[:-1], step_sizes[:-1])
                step_sizes[-1] = math.nan
            else:
                step_sizes.fill(math.nan)
            return trajectory_of(memory, t, q, p, iterations, step_sizes=step_sizes)
        tau = None
        if memory.stepper.interface.energy_parameter:
            numbers = save_every * (self.first // save_every + np.arange(len(t)))
            numbers[0] = self.first
            tau = times_after(0.0, memory.h, numbers)[0]
        return trajectory_of(memory, t, q, p, iterations, tau=tau)


def trajectory_of(
    memory: Memory,
    t: Array,
    q: Array,
    p: Array,
    iterations: NDArray[np.int32],
    *,
    steps: int | None = None,
    step_sizes: Array | None = None,
    events: tuple[Crossings, ...] = (),
    tau: Array | None = None,
) -> Trajectory:
    """Return a trajectory of these states with the data of the run; by default each precedes a step of h."""
    plan, h, stepper, step_error = memory._plan, memory.h, memory.stepper, memory.step_error
    if stepper.shapes is not None:
        q, p = stepper.named(q), stepper.named(p)
    return Trajectory(
        t=t,
        q=q,
        p=p,
        iterations=iterations,
        step_sizes=_repeated(h, len(t)) if step_sizes is None else step_sizes,
        h=h if plan is None else first_step_size(plan, t),
        plan=plan,
        steps=memory.steps if steps is None else steps,
        rejected_steps=memory.rejected_steps,
        step_error=step_error,
        worst_step_time=memory._memory.error_t if step_error >= 0.0 else np.nan,
        parameters=memory.parameters,
        stepper=stepper,
        options=memory._options,
        events=events,
        tau=tau,
    )


def _repeated(value: float, count: int) -> Array:
    """Return a read-only array of one number without memory for each; ``numpy.broadcast_to`` is ten times slower."""
    return np.ndarray((count,), BINARY64, NATIVE_DOUBLE.pack(value), 0, (0,))


def first_step_size(plan: StepPlan, t: Array) -> float:
    """Return the first step size between states of an adaptive run, or the direction of the run."""
    return float(t[1] - t[0] if len(t) > 1 else plan.t_end - t[0])
