"""All memory of an integration under way, one plain C struct: started, advanced, saved and restored bit for bit."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runtime.inputs import Array, Parameters, checked_parameters, checked_vector
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["Memory"]


class Memory:
    """A state, and what makes the next step cheap and the sums exact.

    Attributes:
        stepper: the compiled integrator.
    """

    def __init__(self, stepper: Integrator, memory: Any, parameters: Array, options: SolverOptions | None) -> None:
        self.stepper, self._memory, self._parameters, self._options = stepper, memory, parameters, options

    @classmethod
    def started(
        cls,
        stepper: Integrator,
        q: ArrayLike,
        p: ArrayLike,
        *,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
    ) -> Self:
        """At (q, p) and t, before the first step of h."""
        interface, binding = stepper.interface, stepper.binding
        q0, p0 = checked_vector(interface, q, "q"), checked_vector(interface, p, "p")
        memory = binding.new("run *")
        binding.function("start")(
            memory, checked_number(t, "the time t"), checked_step(h), binding.pointer(q0), binding.pointer(p0)
        )
        return cls(stepper, memory, checked_parameters(interface, parameters), options)

    @classmethod
    def restored(
        cls,
        stepper: Integrator,
        saved: bytes,
        *,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
    ) -> Self:
        """Where :meth:`save` gave these bytes; StateError for bytes that no run has."""
        memory = stepper.binding.new("run *")
        buffer = stepper.binding.buffer(memory)
        if not isinstance(saved, bytes):
            raise StateError(f"a saved run is bytes, not {type(saved).__name__}")
        if len(saved) != len(buffer):
            raise StateError(f"{len(saved)} bytes are not a saved run of this stepper, which has {len(buffer)}")
        buffer[:] = saved
        _check_memory(memory)
        return cls(stepper, memory, checked_parameters(stepper.interface, parameters), options)

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
        """Time, as carried along: the sum of all steps, rounded."""
        return _time(self._memory)

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

    def resume_at(self, steps: int, time: tuple[float, float], carries: tuple[Array, Array]) -> None:
        """How a run made elsewhere goes on here: after ``steps``, at a time, with what rounding cut off it, q and p."""
        self._memory.step = steps
        self._memory.t, self._memory.t_low = time
        for i, (cut_q, cut_p) in enumerate(zip(*carries, strict=True)):
            self._memory.carry_q[i], self._memory.carry_p[i] = cut_q, cut_p

    def save(self) -> bytes:
        """All of it, for :meth:`Stepper.restore` on the same kind of machine."""
        return bytes(self.stepper.binding.buffer(self._memory))

    def rewind(self, saved: bytes) -> None:
        """Back to when :meth:`save` gave these bytes."""
        self.stepper.binding.buffer(self._memory)[:] = saved

    def skip(self, steps: int) -> None:
        """Advance by ``steps`` and keep nothing."""
        nothing = np.empty(0)
        never = self.steps + steps + 1
        status, report = self.advance(steps, never, nothing, nothing, nothing, np.empty(0, dtype=np.int32))
        if status:
            raise step_failure(status, report, step=self.steps, h=self.h)

    def advance(
        self, steps: int, every: int, t: Array, q: Array, p: Array, iterations: NDArray[np.int32]
    ) -> tuple[int, Any]:
        """By ``steps`` in one call of C, which fills the arrays with each state whose number ``every`` divides.

        Returns:
            The status, 0 unless a step failed, and the report, whose ``steps`` says how many were done.
        """
        binding = self.stepper.binding
        report = binding.new("report *")
        status = binding.function("advance")(
            self._memory,
            steps,
            every,
            binding.pointer(self._parameters),
            binding.options(self._options),
            binding.pointer(t),
            binding.pointer(q),
            binding.pointer(p),
            binding.pointer(iterations),
            report,
            binding.workspace(),
        )
        return status, report


def _time(memory: Any) -> float:
    """Of a run; version 0.1, whose text recorded runs may have, carried the start and the number of steps."""
    return float(memory.t if hasattr(memory, "t") else memory.t0 + memory.step * memory.h)


def _check_memory(memory: Any) -> None:
    """Raise :class:`StateError` for bytes that no run has."""
    numbers = [_time(memory), memory.h, *memory.q, *memory.p, *memory.carry_q, *memory.carry_p]
    counts = {"step": memory.step, "guess": memory.guess, "iterations": memory.iterations}
    sound = np.isfinite(numbers).all() and memory.h != 0.0 and all(0 <= count < 2**53 for count in counts.values())
    if not sound or memory.guess > 2:
        raise StateError(f"these bytes are not a saved run: h = {memory.h:g}, {counts}")
