"""Derivatives of steps: Jacobian-vector and vector-Jacobian products along a chain of steps.

A step maps (q, p, parameters, t, h) to (q1, p1, parameters, t1, h). The Jacobian of this map propagates tangent vectors
along a chain of steps and its transpose propagates cotangents back, with the same factorisation; all other derivatives
are composed of these. In transformed time the energy is one of the parameters, and t1 is an integral along the step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.codegen.native.options import NOT_CONVERGED, REASONS, STATUS, SolverOptions, step_failure
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.representation import summary
from scvi_codegen.runs.states.validation import Array, Parameters, check_step_given
from scvi_codegen.runs.stepping.state_functions import StateFunctions


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

    __repr__ = summary("state", "parameters")

    @classmethod
    def of(cls, columns: Array, dimension: int, *, stretched: bool = True) -> Sensitivity:
        """Construct from (..., outputs, 2m + k + 2) derivatives of outputs with respect to all variables."""
        size = 2 * dimension
        states, times = columns[..., :size, :], columns[..., size:, :]
        described = cls._of(states, size, stretched=stretched)
        if not times.shape[-2]:
            return described
        return replace(described, times=cls._of(times[..., 0, :], size, stretched=stretched))

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
        chained: whether the steps are consecutive; propagating tangent vectors then computes all states but the first.
    """

    t: Array
    h: Array
    q: Array
    p: Array
    chained: bool = False

    @classmethod
    def chain(cls, q: Array, p: Array, t: Array, h: Array) -> Starts:
        """Construct for consecutive steps from (q, p), with memory for the other states."""
        states = np.empty((2, len(h) + 1, len(q)))
        states[:, 0] = q, p
        return cls(np.ascontiguousarray(t), np.ascontiguousarray(h), states[0], states[1], chained=True)

    @property
    def arrays(self) -> tuple[Array, ...]:
        """Times, step sizes, positions and momenta, as C takes them."""
        return self.t, self.h, self.q, self.p

    def part(self, first: int, last: int) -> Starts:
        """Return a view of the steps ``first`` to ``last`` - 1."""
        steps, states = slice(first, last), slice(first, last + 1)
        return Starts(self.t[steps], self.h[steps], self.q[states], self.p[states], self.chained)


class Curves(NamedTuple):
    """What a method keeps of n steps.

    Attributes:
        values: (n, m, k) forces or velocities at the points of the steps; NaN where they are unknown.
        abscissae: (k,) of the points; k = 0: none.
    """

    values: Array
    abscissae: Array


class LinearisedMethod(StateFunctions):
    """Compiled method with the derivatives of its steps, in a separate library that is compiled on first use."""

    @property
    def _input_size(self) -> int:
        """Number of variables of a step: (q, p), parameters, t and h."""
        return self.tangent.constant("STEP_INPUTS")

    @property
    def _output_indices(self) -> NDArray[np.intp]:
        """Indices of the outputs among the variables: (q, p), and in transformed time also t."""
        clock = [self._input_size - 2] if self.in_tau else []
        return np.array([*range(2 * self.dimension), *clock], dtype=np.intp)

    @property
    def _energy_index(self) -> int:
        """Index of the energy parameter of transformed time among the variables."""
        return 2 * self.dimension + self.interface.energy_index

    def _energy_gradient(self, q: Array, p: Array, parameters: Array) -> Array:
        """Return the (variables,) gradient of the energy of a state, 0 unless time is transformed; or StateError."""
        gradient, name = np.zeros(self._input_size), self.interface.energy_parameter
        if name is None:
            return gradient
        others = dict(zip(self.interface.parameters, parameters.tolist(), strict=True))
        del others[name]
        binding, values = self.tangent, self._parameters_at(q, p, others)
        status = binding.function("energy_gradient")(
            *map(binding.pointer, (q, p, values, gradient)), binding.workspace()
        )
        if status:
            raise StateError(f"the energy gradient at q = {q}, p = {p} cannot be computed: {REASONS[status]}")
        return gradient

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
        return self._products(q, p, h, t, parameters, options, np.eye(2 * m))[:, : 2 * m].T.copy()

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
        products = self._products(q, p, h, t, parameters, options, np.eye(self._input_size))
        return Sensitivity.of(products[:, self._output_indices].T.copy(), self.dimension)

    def jvp(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        tangents: ArrayLike,
        options: SolverOptions | None = None,
    ) -> Array:
        """Return the product of :meth:`jacobian` and tangent vectors, without forming the matrix.

        Args:
            q, p, h, t, parameters, options: as of :meth:`step`.
            tangents: (2m,) or (k, 2m) variations of (q0, p0).

        Returns:
            Variations of (q1, p1), of the shape of ``tangents``.
        """
        seeds = self._seeds(tangents, "tangents")
        products = self._products(q, p, h, t, parameters, options, np.atleast_2d(seeds))
        return products[:, : 2 * self.dimension].reshape(seeds.shape)

    def vjp(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float = 0.0,
        parameters: Parameters = None,
        *,
        cotangents: ArrayLike,
        options: SolverOptions | None = None,
    ) -> Array:
        """Return the product of the transpose of :meth:`jacobian` and cotangents, without forming the matrix.

        Args:
            q, p, h, t, parameters, options: as of :meth:`step`.
            cotangents: (2m,) or (k, 2m) derivatives of functions of (q1, p1).

        Returns:
            Their derivatives with respect to (q0, p0), of the shape of ``cotangents``.
        """
        seeds = self._seeds(cotangents, "cotangents")
        products = self._products(q, p, h, t, parameters, options, np.atleast_2d(seeds), transpose=True)
        return products[:, : 2 * self.dimension].reshape(seeds.shape)

    def _seeds(self, values: ArrayLike, name: str) -> Array:
        array, size = real_array(values, name), 2 * self.dimension
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise StateError(f"{name} must have the shape ({size},) or (k, {size}), not {array.shape}")
        return array

    def _products(
        self,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None,
        seeds: Array,
        *,
        transpose: bool = False,
    ) -> Array:
        """Return (count, variables) products of the derivative of a step, or its transpose, and (count, ..) vectors.

        Entries of the vectors that are left out are 0. In transformed time an energy that is not given depends on the
        initial state.
        """
        q0, p0 = self._states.pair(q, p)
        starts = Starts.chain(q0, p0, np.array([checked_number(t, "t")]), np.array([checked_step(h)]))
        check_step_given(self.interface, parameters)
        values = self._parameters_at(q0, p0, parameters)
        vectors, size = np.zeros((2, len(seeds), self._input_size)), seeds.shape[1]
        vectors[int(transpose), :, :size] = seeds
        own_energy = not self._has_energy(parameters)
        if own_energy and not transpose:
            vectors[0, :, self._energy_index] += seeds @ self._energy_gradient(q0, p0, values)[:size]
        self._propagate(starts, vectors, values, options, transpose=transpose)
        products: Array = vectors[int(not transpose)]
        if own_energy and transpose:
            products += np.outer(products[:, self._energy_index], self._energy_gradient(q0, p0, values))
        return products

    def _propagate(
        self,
        starts: Starts,
        vectors: Array,
        parameters: Array,
        options: SolverOptions | None,
        *,
        transpose: bool = False,
    ) -> tuple[Array, Array]:
        """Propagate tangent vectors (JVP), or cotangents (VJP), along steps, in place.

        Args:
            starts: initial data of n steps.
            vectors: (n + 1, count, 2m + k + 2) variations of (q, p, parameters, t, h): the image of row i under step i
                is added to row i + 1.
            parameters: (k,) values in order.
            transpose: apply the transpose: the image of row i + 1 is added to row i.

        Returns:
            (n, m) recomputed positions and momenta at the ends of the steps.
        """
        binding, m = self.tangent, self.dimension
        report = binding.new("report *")
        chained = starts.chained and not transpose
        q1, p1 = (starts.q[1:], starts.p[1:]) if chained else np.empty((2, len(starts.h), m))
        status = binding.function("linearise")(
            len(starts.h),
            *map(binding.pointer, (*starts.arrays, parameters)),
            binding.options(options),
            int(transpose),
            vectors.shape[1],
            binding.pointer(vectors),
            *map(binding.pointer, (q1, p1)),
            report,
            binding.workspace(),
        )
        if status:
            failed = int(report.steps) if not transpose else len(starts.h) - 1 - int(report.steps)
            if np.abs(vectors[np.isfinite(vectors)]).max(initial=0.0) > 1e250:  # overflow
                raise StateError("derivatives exceed the largest double: use a shorter run, or lyapunov_exponents()")
            raise step_failure(status, report, step=failed, h=float(starts.h[failed]))
        return q1, p1

    def _errors(
        self, starts: Starts, parameters: Array, sizes: Array, limits: Array, before: Array, errors: Array
    ) -> tuple[int, Curves]:
        """Find the errors of n steps of a run of another method beside steps of this one.

        Args:
            starts: the steps and the states of the run.
            parameters: as of :meth:`_propagate`.
            sizes: (2m,) sizes of positions and momenta.
            limits: changes of errors relative to changes of momenta, and differences of such changes by halved steps
                relative to them and in addition to the state, below which steps are resolved.
            before: (2m,) error of the first state.
            errors: (2m, n) errors of the others, a view of rows of contiguous numbers.

        Returns:
            The number of steps until one that is not resolved, and the curves.
        """
        count, abscissae, pointer = len(starts.h), self._abscissae, self.binding.pointer
        curves = Curves(np.empty((count, self.dimension, len(abscissae))), abscissae)
        arrays = *starts.arrays, sizes, limits, before, curves.values
        into = self._columns(errors)
        status, steps, report = self._call_steps("errors", parameters, None, count, *map(pointer, arrays), *into)
        if status:
            raise step_failure(status, report, step=steps, h=float(starts.h[steps]))
        return steps, curves

    @cached_property
    def _abscissae(self) -> Array:
        """(k,) abscissae of the points at which steps keep forces or velocities; k = 0: none."""
        store, count = self.binding.function("call_abscissae"), self.binding.numbers("int *")
        store(self.binding.null, count)
        abscissae = np.empty(count[0])
        store(self.binding.pointer(abscissae), count)
        return abscissae

    def _transport_by_differences(
        self,
        starts: Starts,
        vectors: Array,
        deviations: Array,
        parameters: Array,
        sizes: Array,
        rounding: float,
        seed: int,
    ) -> None:
        """As :meth:`_transport_roundings`, by steps from neighbouring states; (2m,) sizes.

        Positions on a constraint are functions of each other, with the size of the motion of all, and so are momenta:
        the height of a pendulum moves by the square of the swing.
        """
        sizes = np.where(sizes > 0.0, sizes, sizes.max() or 1.0)
        if self.interface.constraints:
            sizes = np.repeat(sizes.reshape(2, -1).max(axis=1), self.dimension)
        pointer, after = self.binding.pointer, np.empty_like(vectors)
        steps = map(pointer, (*starts.arrays, sizes))
        settings = len(vectors), rounding, seed, pointer(vectors), pointer(after), *self._columns(deviations)
        status, _, report = self._call_steps("differences", parameters, None, len(starts.h), *steps, *settings)
        if status:
            raise step_failure(status, report, step=0, h=float(starts.h[0]))
        vectors[:] = after

    def _columns(self, results: Array) -> tuple[Any, ...]:
        """Return arguments of C for a (2m, n) array of columns: the distance of its rows, and the first row."""
        return results.strides[0] // results.itemsize, self.binding.pointer(results[0])

    def _call_steps(self, name: str, parameters: Array, options: SolverOptions | None, *arguments: Any) -> Any:
        """Call a function of C that takes steps from states of its own; return its status, steps and report."""
        binding = self.binding
        run, call, report = map(binding.new, ("run *", "call *", "report *"))
        settings, workspace = binding.options(options), binding.workspace(run)
        call.run, call.parameters, call.options = run, binding.pointer(parameters), settings
        call.report, call.workspace = report, workspace
        call.coordinates = self.dimension
        status = binding.call(name, call)(*arguments)
        return status, int(call.steps), report

    def _transport_roundings(
        self,
        starts: Starts,
        curves: Curves,
        vectors: Array,
        deviations: Array,
        parameters: Array,
        left: float,
        rounding: float,
        seed: int,
    ) -> int:
        """Transport samples of rounding errors along saved states by iterations.

        Args:
            starts: n steps and their (n + 1, m) states.
            curves: those of a finer method, along which vectors are transported.
            vectors: (count, 2m) at the first state, replaced by those at the last one that is reached.
            deviations: (2m, n) root mean squares of the vectors after each step, a view of rows of contiguous numbers.
            parameters: as of :meth:`_propagate`.
            left: relative change of vectors that the iterations of a step leave.
            rounding: relative rounding errors of positions at which forces are evaluated and of increments, which the
                vectors receive with random signs.
            seed: of the signs.

        Returns:
            The number of steps, fewer than n if an iteration fails.
        """
        binding, size = self.tangent, 2 * self.dimension
        report, ends = binding.new("report *"), np.zeros((2, len(vectors), self._input_size))
        ends[0, :, :size] = vectors
        status = binding.function("transport_roundings")(
            len(starts.h),
            *map(binding.pointer, (*starts.arrays, parameters)),
            binding.null,
            len(curves.abscissae),
            *map(binding.pointer, (curves.abscissae, curves.values)),
            len(vectors),
            left,
            rounding,
            seed,
            binding.pointer(ends),
            *self._columns(deviations),
            report,
            binding.workspace(),
        )
        steps = int(report.steps)
        vectors[:] = ends[steps % 2, :, :size]
        if status and STATUS[status] != NOT_CONVERGED:
            raise step_failure(status, report, step=steps, h=float(starts.h[steps]))
        return steps

    def _second_order_adjoint(
        self, starts: Starts, changes: Array, vectors: Array, parameters: Array, options: SolverOptions | None
    ) -> None:
        """Propagate cotangents and their tangents (second-order adjoints) back along steps, in place.

        Args:
            starts: initial data of n steps.
            changes: (n, count, 2m + k + 2) tangent vectors at the start of each step, as of :meth:`_propagate`.
            vectors: (n + 1, 2, count, 2m + k + 2) cotangents and their tangents: the image of row i + 1 under step i
                is added to row i.
            parameters, options: as of :meth:`_propagate`.
        """
        binding = self._second_derivatives
        report = binding.new("report *")
        status = binding.function("second_order")(
            len(starts.h),
            *map(binding.pointer, (*starts.arrays, parameters)),
            binding.options(options),
            vectors.shape[2],
            *map(binding.pointer, (changes, vectors)),
            report,
            binding.workspace(),
        )
        if status:
            failed = len(starts.h) - 1 - int(report.steps)
            raise step_failure(status, report, step=failed, h=float(starts.h[failed]))
