"""An integration under way: its memory, saved and resumed bit for bit, and the recording of its states."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.arguments import checked_count, empty_array
from scvi_codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runtime.events import Crossings
from scvi_codegen.runtime.observation import Observation
from scvi_codegen.runtime.trajectory import Trajectory

if TYPE_CHECKING:
    from scvi_codegen.runtime.stepper import Stepper

__all__ = ["Run"]

Array = NDArray[np.float64]
SLICE_SECONDS = 0.1
"""Time between looks at the keyboard (and calls of ``progress``) during an integration."""


class Run:
    """An integration under way: a state, and the memory that makes the next step cheap and the sums exact."""

    def __init__(self, stepper: Stepper, memory: Any, parameters: Array, options: SolverOptions | None) -> None:
        self.stepper, self._memory, self._parameters, self._options = stepper, memory, parameters, options

    def __reduce__(self) -> tuple[Any, ...]:
        return (_restored, (self.stepper, self.save(), self._parameters, self._options))

    @property
    def h(self) -> float:
        """Step size."""
        return float(self._memory.h)

    @property
    def parameters(self) -> Array:
        """(k,) values in the order of ``stepper.parameters``."""
        return self._parameters.copy()

    @property
    def options(self) -> SolverOptions | None:
        """When the stage equations count as solved; ``None`` for the defaults."""
        return self._options

    @property
    def t(self) -> float:
        """Time t0 + step h."""
        return float(self._memory.t0 + self._memory.step * self._memory.h)

    @property
    def steps(self) -> int:
        """Steps done since the start."""
        return int(self._memory.step)

    @property
    def q(self) -> Array:
        """(m,) positions."""
        return np.array(list(self._memory.q))

    @property
    def p(self) -> Array:
        """(m,) momenta."""
        return np.array(list(self._memory.p))

    def resume_at(self, steps: int, carries: tuple[Array, Array] | None = None) -> None:
        """Count from ``steps`` done, with what rounding had cut off q and p: how a run made elsewhere goes on here."""
        self._memory.step = steps
        if carries is not None:
            for i, (cut_q, cut_p) in enumerate(zip(*carries, strict=True)):
                self._memory.carry_q[i], self._memory.carry_p[i] = cut_q, cut_p

    def save(self) -> bytes:
        """The whole memory of the run, for :meth:`Stepper.restore` on the same kind of machine."""
        return bytes(self.stepper.binding.buffer(self._memory))

    def rewind(self, saved: bytes) -> None:
        """Back to when :meth:`save` gave these bytes."""
        self.stepper.binding.buffer(self._memory)[:] = saved

    def skip(self, steps: int) -> None:
        """Advance by ``steps`` and keep nothing."""
        self.record_states(steps, every=max(1, steps + self.steps))

    def record(self, steps: int, *, every: int = 1, progress: Callable[[int], None] | None = None) -> Trajectory:
        """Advance by ``steps`` and keep the present state and each whose step number is a multiple of ``every``.

        The events of the stepper, if it has any, are recorded; a terminal one ends the run before the step it is in.

        Raises:
            StepFailedError: with the states kept so far as ``trajectory``; the run stands before the failing step.
            EventError: where an event function is not finite.
        """
        if self.stepper.events:
            return Observation(self, every=every).advance(steps, progress)
        return self.record_states(steps, every=every, progress=progress)

    def record_states(self, steps: int, *, every: int = 1, progress: Callable[[int], None] | None = None) -> Trajectory:
        """The same without events."""
        steps = checked_count(steps, "steps", least=0)
        every = checked_count(every, "every", least=1)
        first = self.steps
        capacity = (first + steps) // every - first // every
        m = self.stepper.dimension
        t, q, p = (empty_array((capacity + 1, *shape)) for shape in ((), (m,), (m,)))
        iterations = np.zeros(capacity + 1, dtype=np.int32)
        t[0], q[0], p[0] = self.t, self.q, self.p
        filled, done, portion = 1, 0, every * max(1, 256 // every)
        while done < steps:
            size = min(portion, steps - done)
            began = time.perf_counter()
            status, report = self._advance(size, every, t[filled:], q[filled:], p[filled:], iterations[filled:])
            done += report.steps
            filled = 1 + (first + done) // every - first // every
            if status:
                kept = self.trajectory(t[:filled], q[:filled], p[:filled], iterations[:filled])
                raise step_failure(status, report, step=self.steps, h=self._memory.h, trajectory=kept)
            if progress is not None:
                progress(done)
            elapsed = max(time.perf_counter() - began, 1e-6)
            portion = every * max(1, int(min(2.0 * size, size * SLICE_SECONDS / elapsed) / every))
        return self.trajectory(t, q, p, iterations)

    def _advance(
        self, steps: int, every: int, t: Array, q: Array, p: Array, iterations: NDArray[np.int32]
    ) -> tuple[int, Any]:
        stepper = self.stepper
        report = stepper.binding.new("report *")
        status = stepper.binding.function("advance")(
            self._memory,
            steps,
            every,
            stepper.binding.pointer(self._parameters),
            stepper.binding.options(self._options),
            stepper.binding.pointer(t),
            stepper.binding.pointer(q),
            stepper.binding.pointer(p),
            stepper.binding.pointer(iterations),
            report,
            stepper.binding.workspace(),
        )
        return status, report

    def trajectory(
        self, t: Array, q: Array, p: Array, iterations: NDArray[np.int32], events: tuple[Crossings, ...] = ()
    ) -> Trajectory:
        """These states as states of this run."""
        return Trajectory(
            t=t,
            q=q,
            p=p,
            iterations=iterations,
            h=float(self._memory.h),
            parameters=self._parameters,
            stepper=self.stepper,
            options=self._options,
            events=events,
        )


def _restored(stepper: Stepper, saved: bytes, parameters: Array, options: SolverOptions | None) -> Run:
    return stepper.restore(saved, parameters=parameters, options=options)
