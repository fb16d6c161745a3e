"""Steps with their derivatives: how what they end at changes with what they start from, and the transpose.

A step maps (q, p, parameters, t, h) to (q1, p1, parameters, t + h, h). The derivative of that map carries changes along
a chain of steps, its transpose carries slopes back, with the same factors: all other derivatives are made from it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import MethodError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runtime.compiled_method import CompiledMethod
from scvi_codegen.runtime.inputs import Array, Parameters, check_inputs_given, checked_parameters, checked_vector

__all__ = ["LinearisedMethod", "Sensitivity", "Starts"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensitivity:
    """How states depend on what they came from: of a step without n, of a run for each of its n states.

    Attributes:
        state: (n, 2m, 2m) derivatives of (q, p) by the (q, p) at the start.
        parameters: (n, 2m, k) by the parameters, in the order of ``stepper.parameters``.
        t: (n, 2m) by the time of the start, which moves all times.
        h: (n, 2m) by the length of all steps; ``None`` of a run whose steps have several.
    """

    state: Array
    parameters: Array
    t: Array
    h: Array | None

    @classmethod
    def of(cls, columns: Array, dimension: int, *, stretched: bool = True) -> Sensitivity:
        """From (..., 2m, 2m + k + 2) derivatives by all that is given."""
        size = 2 * dimension
        return cls(
            state=columns[..., :size],
            parameters=columns[..., size:-2],
            t=columns[..., -2],
            h=columns[..., -1] if stretched else None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Starts:
    """Where n steps start, and where the last ends.

    Attributes:
        t, h: (n,) times and lengths.
        q, p: (n + 1, m) states.
    """

    t: Array
    h: Array
    q: Array
    p: Array

    @classmethod
    def chain(cls, q: Array, p: Array, t: Array, h: Array) -> Starts:
        """Of steps that follow each other from (q, p); the other states are not known yet."""
        starts = cls(np.ascontiguousarray(t), np.ascontiguousarray(h), *np.empty((2, len(h) + 1, len(q))))
        starts.q[0], starts.p[0] = q, p
        return starts

    def part(self, first: int, last: int) -> Starts:
        """Of the steps from ``first`` until before ``last``: the same memory."""
        steps, states = slice(first, last), slice(first, last + 1)
        return Starts(self.t[steps], self.h[steps], self.q[states], self.p[states])


class LinearisedMethod(CompiledMethod):
    """A compiled method with the derivatives of its steps, in a library of their own, compiled when first asked for."""

    @property
    def given(self) -> int:
        """Numbers that a step starts from: (q, p), parameters, t and h; MethodError where there are no derivatives."""
        return self.tangent.constant("GIVEN")

    def check_steps_of_h(self, what: str) -> None:
        """Raise :class:`MethodError` where runs have steps of other lengths, for what is made of steps of h."""
        if self.interface.monitor:
            raise MethodError(f"{what} has steps of h, not of lengths that a monitor chooses: compile without one")

    def jacobian(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> Array:
        """d(q1, p1) / d(q0, p0) of a step, (2m, 2m), exact: of the map that its equations define.

        Symplectic to round-off where the step is. Compiled when first asked for.

        Raises:
            MethodError: in transformed time.
            StepFailedError: if Newton's iteration does not converge.
        """
        return self._columns(q, p, h, t, parameters, options, 2 * self.dimension)[2]

    def sensitivity(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> Sensitivity:
        """Derivatives of (q1, p1) by the state, the parameters, the time and the length of a step, as :meth:`jacobian`.

        Inputs are parameters, five each. Where constraints have parameters, the state is held and not moved to them.
        """
        return Sensitivity.of(self._columns(q, p, h, t, parameters, options, self.given)[2], self.dimension)

    def _columns(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
        count: int,
    ) -> tuple[Array, Array, Array]:
        """(q1, p1) and (2m, count) derivatives by the first of what is given."""
        q0, p0 = checked_vector(self.interface, q, "q"), checked_vector(self.interface, p, "p")
        starts = Starts.chain(q0, p0, np.array([checked_number(t, "the time t")]), np.array([checked_step(h)]))
        check_inputs_given(self.interface, parameters)
        values = checked_parameters(self.interface, parameters)
        vectors = np.zeros((2, count, self.given))
        vectors[0] = np.eye(count, self.given)
        q1, p1 = self.linearise(starts, vectors, values, options, chained=True)
        return q1[0], p1[0], vectors[1, :, : 2 * self.dimension].T.copy()

    def linearise(
        self,
        starts: Starts,
        vectors: Array,
        parameters: Array,
        options: SolverOptions | None,
        *,
        chained: bool = False,
        back: bool = False,
    ) -> tuple[Array, Array]:
        """Carry vectors along steps, in place.

        Args:
            starts: of n steps.
            vectors: (n + 1, count, 2m + k + 2) changes of (q, p, parameters, t, h): to those in i + 1 is added what
                step i makes of those in i.
            parameters: (k,) values in order.
            options: as of a step.
            chained: whether the steps follow each other: all states of ``starts`` but the first are written.
            back: by the transpose: to those in i is added what step i makes of those in i + 1, slopes by what is given.

        Returns:
            (n, m) positions and momenta at the ends of the steps, solved anew.

        Raises:
            MethodError: in transformed time.
            StepFailedError: if Newton's iteration does not converge.
        """
        binding, m = self.tangent, self.dimension
        report = binding.new("report *")
        q1, p1 = (starts.q[1:], starts.p[1:]) if chained else np.empty((2, len(starts.h), m))
        status = binding.function("linearise")(
            len(starts.h),
            *map(binding.pointer, (starts.t, starts.h, starts.q, starts.p, parameters)),
            binding.options(options),
            int(back),
            vectors.shape[1],
            binding.pointer(vectors),
            *map(binding.pointer, (q1, p1)),
            report,
            binding.workspace(),
        )
        if status:
            failed = int(report.steps) if not back else len(starts.h) - 1 - int(report.steps)
            raise step_failure(status, report, step=failed, h=float(starts.h[failed]))
        return q1, p1

    def bend(
        self, starts: Starts, changes: Array, vectors: Array, parameters: Array, options: SolverOptions | None
    ) -> None:
        """Carry slopes back along steps, in place, and how they change where what the steps start from does.

        Args:
            starts: of n steps.
            changes: (n, count, 2m + k + 2) of (q, p, parameters, t, h) of each step, as :meth:`linearise` carries them.
            vectors: (n + 1, 2, count, 2m + k + 2) slopes and their changes: to those in i is added what step i makes of
                those in i + 1.
            parameters, options: as of :meth:`linearise`.

        Raises:
            MethodError: in transformed time.
            StepFailedError: if Newton's iteration does not converge.
        """
        binding = self.curvature
        report = binding.new("report *")
        status = binding.function("bend")(
            len(starts.h),
            *map(binding.pointer, (starts.t, starts.h, starts.q, starts.p, parameters)),
            binding.options(options),
            vectors.shape[2],
            *map(binding.pointer, (changes, vectors)),
            report,
            binding.workspace(),
        )
        if status:
            failed = len(starts.h) - 1 - int(report.steps)
            raise step_failure(status, report, step=failed, h=float(starts.h[failed]))
