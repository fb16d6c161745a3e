"""Steps with their derivatives: how what they end at changes with what they start from, and the transpose.

A step maps (q, p, parameters, t, h) to (q1, p1, parameters, t1, h). The derivative of that map carries changes along
a chain of steps, its transpose carries slopes back, with the same factors: all other derivatives are made from it. In
transformed time the energy, on whose level steps are taken, is one of the parameters, and t1 an integral along them.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import STATUS, SolverOptions, step_failure
from scvi_codegen.runtime.compiled_method import CompiledMethod
from scvi_codegen.runtime.inputs import Array, Parameters, check_inputs_given, checked_vector

__all__ = ["LinearisedMethod", "Sensitivity", "Starts"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensitivity:
    """How states depend on what they came from: of a step without n, of a run for each of its n states.

    Attributes:
        state: (n, 2m, 2m) derivatives of (q, p) by the (q, p) at the start.
        parameters: (n, 2m, k) by the parameters, in the order of ``stepper.parameters``.
        t: (n, 2m) by the time of the start, which moves all times.
        h: (n, 2m) by the length of all steps; ``None`` of a run whose steps have several.
        times: in transformed time the same of the times of the states, without the axis of 2m; else ``None``.
    """

    state: Array
    parameters: Array
    t: Array
    h: Array | None
    times: Sensitivity | None = None

    @classmethod
    def of(cls, columns: Array, dimension: int, *, stretched: bool = True) -> Sensitivity:
        """From (..., told, 2m + k + 2) derivatives of what is told by all that is given."""
        size = 2 * dimension
        states, times = columns[..., :size, :], columns[..., size:, :]
        told = cls._of(states, size, stretched=stretched)
        if not times.shape[-2]:
            return told
        return replace(told, times=cls._of(times[..., 0, :], size, stretched=stretched))

    @classmethod
    def _of(cls, columns: Array, size: int, *, stretched: bool) -> Sensitivity:
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
        """Numbers that a step starts from: (q, p), parameters, t and h."""
        return self.tangent.constant("GIVEN")

    @property
    def told(self) -> NDArray[np.intp]:
        """Where among these stands what a state tells: (q, p), and in transformed time, behind them, t."""
        clock = [self.given - 2] if self.interface.energy_parameter else []
        return np.array([*range(2 * self.dimension), *clock], dtype=np.intp)

    @property
    def energy_place(self) -> int:
        """The same of the energy, of which there is one in transformed time alone."""
        return 2 * self.dimension + self.parameters.index(self.interface.energy_parameter)

    @abstractmethod
    def parameters_at(self, q: Array, p: Array, parameters: Parameters = None) -> Array:
        """(k,) values in order; in transformed time the energy is that of the state (q, p) unless it is given."""

    @abstractmethod
    def has_energy(self, parameters: Parameters) -> bool:
        """Whether the energy that transformed time needs is among the parameters given; true where it needs none."""

    def check_steps_of_h(self, what: str) -> None:
        """Raise :class:`MethodError` where runs have steps of other lengths, for what is made of steps of h."""
        if self.interface.monitor:
            raise MethodError(f"{what} has steps of h, not of lengths that a monitor chooses: compile without one")
        self.check_own_time(what)

    def check_own_time(self, what: str) -> None:
        """Raise :class:`MethodError` in transformed time, for what is told of motions in their own."""
        if self.interface.energy_parameter:
            raise MethodError(
                f"{what} is told in the time of the motion, not in transformed time: compile the system itself, for "
                "steps of h, or with monitor=.. or t_end=.. for runs whose steps have their own lengths"
            )

    def level(self, q: Array, p: Array, parameters: Array) -> Array:
        """(given,) slopes of the energy of a state by all that a step starts from; 0 where time is not transformed.

        Raises:
            StateError: where the energy has none.
        """
        found, name = np.zeros(self.given), self.interface.energy_parameter
        if not name:
            return found
        others = dict(zip(self.parameters, parameters.tolist(), strict=True))
        del others[name]
        binding, values = self.tangent, self.parameters_at(q, p, others)
        status = binding.function("level")(*map(binding.pointer, (q, p, values, found)), binding.workspace())
        if status:
            raise StateError(f"how the energy of q = {q}, p = {p} changes cannot be computed ({STATUS[status]})")
        return found

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

        Symplectic to round-off where the step is; in transformed time where the energy is given: else it is that of
        (q0, p0), and changes with them. Compiled when first asked for.

        Raises:
            StepFailedError: if Newton's iteration does not converge.
        """
        m = self.dimension
        return self._columns(q, p, h, t, parameters, options, 2 * m)[: 2 * m]

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

        Inputs are parameters, five each. Where constraints have parameters, the state is held and not moved to them. In
        transformed time ``times`` tells of t1.
        """
        return Sensitivity.of(self._columns(q, p, h, t, parameters, options, self.given), self.dimension)

    def _columns(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
        count: int,
    ) -> Array:
        """(told, count) derivatives by the first of what is given."""
        q0, p0 = checked_vector(self.interface, q, "q"), checked_vector(self.interface, p, "p")
        starts = Starts.chain(q0, p0, np.array([checked_number(t, "the time t")]), np.array([checked_step(h)]))
        check_inputs_given(self.interface, parameters)
        values = self.parameters_at(q0, p0, parameters)
        vectors = np.zeros((2, count, self.given))
        vectors[0] = np.eye(count, self.given)
        if not self.has_energy(parameters):
            vectors[0, :, self.energy_place] += self.level(q0, p0, values)[:count]
        self.linearise(starts, vectors, values, options, chained=True)
        told: Array = vectors[1][:, self.told].T.copy()
        return told

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
            MethodError: where there are no second derivatives.
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
