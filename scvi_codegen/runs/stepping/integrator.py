"""Compiled method for one system: single steps and the discrete Lagrangian as pure functions of their arguments."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runs.states.validation import Array, Parameters, States, check_step_given
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod


class Integrator(LinearisedMethod):
    """Computations of a compiled method."""

    def step(
        self,
        q: States,
        p: States,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """Return the state after one step from (q, p) at t to t + h, a pure function of its arguments.

        Args:
            q, p: (m,) positions and momenta.

            h: step size, negative to integrate backward; step of tau in transformed time.
            t: time.
            parameters: values by name (others have their defaults) or all in order.
            options: convergence criterion of the solver.

        Returns:
            (q1, p1), each (m,).

        Raises:
            StateError: if a shape or name is invalid, or a number is not finite.
            ContactError: for contacts whose modes are not among the parameters.
            StepFailedError: if the stage equations cannot be solved.
        """
        q0, p0 = self._states.pair(q, p)
        check_step_given(self.interface, parameters)
        arrays = [*map(self._states.block, (q0, p0, self._parameters_at(q0, p0, parameters)))]
        q1, p1 = np.empty_like(arrays[0]), np.empty_like(arrays[1])
        t = self._states.time(t)
        self._solve(self.binding, "step", self._time_argument(t), h, arrays, options, (q1, p1))
        return self.named(self._states.numbers(q1)), self.named(self._states.numbers(p1))

    def _solve(
        self,
        binding: Binding,
        name: str,
        t: Any,
        h: float,
        inputs: Sequence[Array],
        options: SolverOptions | None,
        results: Sequence[Array],
    ) -> None:
        """Solve the equations of a step in C and fill the arrays ``results``; raise ``StepFailedError`` on failure."""
        report = binding.new("report *")
        status = binding.function(name)(
            t,
            checked_step(h),
            *map(binding.pointer, inputs),
            binding.options(options),
            *map(binding.pointer, results),
            report,
            binding.workspace(),
        )
        if status:
            raise step_failure(status, report, step=0, h=h, failures=binding.failures)

    def discrete_lagrangian(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> float:
        """Return L_d(q0, q1), the approximate action of the curve from q0 at t to q1 at t + h; paper (25), (33).

        Raises:
            MethodError: if the method has no discrete Lagrangian.
            StepFailedError: if the boundary-value problem is not solved.
        """
        return self._discrete_legendre(q0, q1, h, t, parameters, options)[2]

    def discrete_legendre_minus(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """Return F-: (q0, q1) -> (q0, p0 = -D1 L_d(q0, q1)); paper, 1.2. Raises as :meth:`discrete_lagrangian`."""
        return self._states.vector(q0, "q0"), self._discrete_legendre(q0, q1, h, t, parameters, options)[0]

    def discrete_legendre_plus(
        self,
        q0: ArrayLike,
        q1: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array]:
        """Return F+: (q0, q1) -> (q1, p1 = D2 L_d(q0, q1)); paper, 1.2. Raises as :meth:`discrete_lagrangian`."""
        return self._states.vector(q1, "q1"), self._discrete_legendre(q0, q1, h, t, parameters, options)[1]

    def work_and_impulses(
        self,
        q: States,
        p: States,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> tuple[Array, Array, Array]:
        """Return the state after a step, the work of the forces in it, and their impulses on ``impulse_names``.

        The integrals of f . v and f . xi along the curve of the step use the method's own quadrature. Returned are q1
        (m,), p1 (m,) and (1 + k,) values. J1 - J0 equals the impulse to round-off for SVI and related methods (forced
        discrete Noether theorem).

        Raises:
            MethodError: if no forces act, or the method has no curve of positions.
            StepFailedError: if Newton's iteration does not converge.
        """
        if self.known is not self:
            return self.known.work_and_impulses(q, p, h, t, self._parameters(parameters), options=options)
        if not self.interface.exchange_names:
            require(self, "work")
        check_step_given(self.interface, parameters)
        state = *self._states.pair(q, p), self._parameters(parameters)
        q1, p1, values = *np.empty((2, self.dimension)), np.empty(len(self.interface.exchange_names) + 1)
        name = "work_and_impulses"
        t = checked_number(t, "t")
        self._solve(self.binding.with_function(name), name, t, h, state, options, (q1, p1, values))
        return q1, p1, values[:-1]

    def step_positions(
        self,
        q_previous: ArrayLike,
        q_current: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        options: SolverOptions | None = None,
    ) -> Array:
        """Solve the discrete Euler-Lagrange equation (4): (q_{k-1} at t, q_k at t + h) -> q_{k+1} at t + 2 h.

        Raises as :meth:`discrete_lagrangian`.
        """
        q, p = self.discrete_legendre_plus(q_previous, q_current, h, t, parameters, options=options)
        return self.step(q, p, h, t + h, parameters, options=options)[0]

    def _discrete_legendre(
        self, q0: ArrayLike, q1: ArrayLike, h: float, t: float, parameters: Parameters, options: SolverOptions | None
    ) -> tuple[Array, Array, float]:
        if self.known is not self:
            return self.known._discrete_legendre(q0, q1, h, t, self._parameters(parameters), options)
        if not self.interface.has_action:
            require(self, "discrete_lagrangian")
        check_step_given(self.interface, parameters)
        ends = self._states.vector(q0, "q0"), self._states.vector(q1, "q1"), self._parameters(parameters)
        p0, p1, action = *np.empty((2, self.dimension)), np.empty(1)
        binding = self.binding.with_function("discrete_legendre")
        t = checked_number(t, "t")
        self._solve(binding, "discrete_legendre", t, h, ends, options, (p0, p1, action))
        return p0, p1, float(action[0])
