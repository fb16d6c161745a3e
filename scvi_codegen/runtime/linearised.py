"""Derivatives of steps: Jacobian-vector and vector-Jacobian products along a chain of steps.

A step maps (q, p, parameters, t, h) to (q1, p1, parameters, t1, h). The Jacobian of this map propagates tangent vectors
along a chain of steps and its transpose propagates cotangents back, with the same factorisation; all other derivatives
are composed of these. In transformed time the energy is one of the parameters, and t1 is an integral along the step.
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
    """Derivatives of states with respect to their initial data: of one step without n, of a run for each of n states.

    Attributes:
        state: (n, 2m, 2m) with respect to the initial (q, p).
        parameters: (n, 2m, k) with respect to the parameters, in the order of ``stepper.parameters``.
        t: (n, 2m) with respect to the initial time, which shifts all times.
        h: (n, 2m) with respect to the common step size; ``None`` if step sizes differ.
        times: in transformed time the derivatives of the times of the states, without the axis of 2m; else ``None``.
    """

    state: Array
    parameters: Array
    t: Array
    h: Array | None
    times: Sensitivity | None = None

    @classmethod
    def of(cls, columns: Array, dimension: int, *, stretched: bool = True) -> Sensitivity:
        """Construct from (..., told, 2m + k + 2) derivatives of outputs with respect to all variables."""
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
    """Initial data of n steps, and the end of the last.

    Attributes:
        t, h: (n,) times and step sizes.
        q, p: (n + 1, m) states.
    """

    t: Array
    h: Array
    q: Array
    p: Array

    @classmethod
    def chain(cls, q: Array, p: Array, t: Array, h: Array) -> Starts:
        """Construct for consecutive steps from (q, p), with memory for the other states."""
        starts = cls(np.ascontiguousarray(t), np.ascontiguousarray(h), *np.empty((2, len(h) + 1, len(q))))
        starts.q[0], starts.p[0] = q, p
        return starts

    def part(self, first: int, last: int) -> Starts:
        """Return a view of the steps ``first`` to ``last`` - 1."""
        steps, states = slice(first, last), slice(first, last + 1)
        return Starts(self.t[steps], self.h[steps], self.q[states], self.p[states])


class LinearisedMethod(CompiledMethod):
    """Compiled method with the derivatives of its steps, in a separate library that is compiled on first use."""

    @property
    def given(self) -> int:
        """Number of variables of a step: (q, p), parameters, t and h."""
        return self.tangent.constant("GIVEN")

    @property
    def told(self) -> NDArray[np.intp]:
        """Indices of the outputs among the variables: (q, p), and in transformed time also t."""
        clock = [self.given - 2] if self.interface.energy_parameter else []
        return np.array([*range(2 * self.dimension), *clock], dtype=np.intp)

    @property
    def energy_place(self) -> int:
        """Index of the energy parameter of transformed time among the variables."""
        return 2 * self.dimension + self.parameters.index(self.interface.energy_parameter)

    @abstractmethod
    def parameters_at(self, q: Array, p: Array, parameters: Parameters = None) -> Array:
        """Return (k,) values in order; in transformed time the energy defaults to that of the state (q, p)."""

    @abstractmethod
    def has_energy(self, parameters: Parameters) -> bool:
        """Return whether the parameters contain the energy required by transformed time, or none is required."""

    def check_steps_of_h(self, what: str) -> None:
        """Raise :class:`MethodError` for steppers whose step size is not the fixed h."""
        if self.interface.monitor:
            raise MethodError(f"{what} has steps of h, not of lengths that a monitor chooses: compile without one")
        self.check_own_time(what)

    def check_own_time(self, what: str) -> None:
        """Raise :class:`MethodError` in transformed time."""
        if self.interface.energy_parameter:
            raise MethodError(
                f"{what} is told in the time of the motion, not in transformed time: compile the system itself, for "
                "steps of h, or with monitor=.. or t_end=.. for runs whose steps have their own lengths"
            )

    def level(self, q: Array, p: Array, parameters: Array) -> Array:
        """Return the (given,) gradient of the energy of a state by all variables; 0 if time is not transformed.

        Raises:
            StateError: if the gradient is undefined.
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
        """Return the (2m, 2m) Jacobian d(q1, p1) / d(q0, p0) of one step, exact for the computed map.

        It is symplectic to round-off if the step is. In transformed time this holds if the energy is passed as a
        parameter; otherwise it is the energy of (q0, p0) and varies with them. Compiled on first use.

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
        """Return the derivatives of (q1, p1) with respect to the state, the parameters, t and h of a step.

        Raises as :meth:`jacobian`. Inputs are parameters, five each. If constraints depend on parameters, the initial
        state is not projected again. In transformed time ``times`` contains the derivatives of t1.
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
        """Return (told, count) derivatives with respect to the first ``count`` variables."""
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
        """Propagate tangent vectors (JVP) or cotangents (VJP) along steps, in place.

        Args:
            starts: initial data of n steps.
            vectors: (n + 1, count, 2m + k + 2) variations of (q, p, parameters, t, h): the image of row i under step i
                is added to row i + 1.
            parameters: (k,) values in order.
            options: solver options.
            chained: whether the steps are consecutive: all states of ``starts`` but the first are computed and stored.
            back: apply the transpose: the image of row i + 1 is added to row i.

        Returns:
            (n, m) recomputed positions and momenta at the ends of the steps.

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
        """Propagate cotangents and their tangents (second-order adjoints) back along steps, in place.

        Args:
            starts: initial data of n steps.
            changes: (n, count, 2m + k + 2) tangent vectors at the start of each step, as of :meth:`linearise`.
            vectors: (n + 1, 2, count, 2m + k + 2) cotangents and their tangents: the image of row i + 1 under step i
                is added to row i.
            parameters, options: as of :meth:`linearise`.

        Raises:
            MethodError: if second derivatives are unavailable.
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
