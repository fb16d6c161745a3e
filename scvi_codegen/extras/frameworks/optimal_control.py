"""Optimal control by discrete mechanics (DMOC): the step equations are the constraints of a nonlinear program.

Unknowns are the states (q, p) between steps, the stages and inputs of each step, the velocities at both ends, and the
duration if it is free. The program is a map of one step, so that CasADi differentiates a step and not the trajectory.
Its solution is a trajectory of the variational integrator: momentum maps on which no input acts are conserved.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.api.checks import Kind, checked_count, checks_arguments
from scvi_codegen.api.methods import Discretisation, Method
from scvi_codegen.api.states import Array, checked_number, real_array
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.common.errors import ControlError, MethodError, StateError, closest, imported
from scvi_codegen.extras.frameworks.casadi import EndConditions, casadi_step, own_parameters
from scvi_codegen.methods import as_method

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
"""Options that suppress the output of IPOPT."""


@dataclass(frozen=True)
class NonlinearProgram:
    """Unknowns and constraints as symbols and expressions of CasADi, each a matrix.

    Attributes:
        ca: module ``casadi``.
        unknowns: symbols by name.
        limits: least and largest values of unknowns by name; other unknowns are unbounded.
        constraints: expressions, each with least and largest value.
        cost: expression to minimise.
    """

    ca: Any
    unknowns: dict[str, Any]
    limits: dict[str, tuple[Any, Any]]
    constraints: list[tuple[Any, float, float]]
    cost: Any

    def solved(self, first: Mapping[str, Any], options: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Solve by IPOPT from initial values by name; return the solution and the solver's statistics."""
        program = {"x": self.x, "f": self.cost, "g": self.residual}
        solver = self.ca.nlpsol("program", "ipopt", program, {**QUIET, **options})
        limits = {name: self.limits.get(name, (-np.inf, np.inf)) for name in self.unknowns}
        low = self._vector({name: low for name, (low, _) in limits.items()})
        high = self._vector({name: high for name, (_, high) in limits.items()})
        least = np.concatenate([np.full(g.numel(), least) for g, least, _ in self.constraints])
        largest = np.concatenate([np.full(g.numel(), largest) for g, _, largest in self.constraints])
        result = solver(x0=self._vector(first), lbx=low, ubx=high, lbg=least, ubg=largest)
        return result, solver.stats()

    def split(self, vector: Any) -> dict[str, Array]:
        """Return the values of the unknowns by name, each in its shape."""
        flat, result, begin = np.asarray(vector).ravel(), {}, 0
        for name, symbol in self.unknowns.items():
            result[name] = flat[begin : begin + symbol.numel()].reshape(symbol.shape, order="F")
            begin += symbol.numel()
        return result

    @cached_property
    def x(self) -> Any:
        """Vector of all unknowns."""
        return self.ca.veccat(*self.unknowns.values())

    @cached_property
    def residual(self) -> Any:
        """Vector of all constraints."""
        return self.ca.veccat(*(expression for expression, _, _ in self.constraints))

    def _vector(self, values: Mapping[str, Any]) -> Array:
        parts = [np.broadcast_to(values[name], symbol.shape).ravel("F") for name, symbol in self.unknowns.items()]
        return np.concatenate(parts)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ControlledMotion:
    """Trajectory of n steps with its inputs.

    Attributes:
        t, q, p: (n + 1,), (n + 1, m), (n + 1, m) times and states, those of the integrator with these inputs.
        coefficients: (n, degree + 1) of each input by name, in Bernstein form, one row a step.
        coordinates: names.
        cost: minimum of the cost: the integral and the cost of the end.
        costates: (n, 2 m) derivatives of the remaining cost with respect to q and p, at all times but the first.
        iterations, status, solved: iterations of IPOPT, its return status, and True on success.
        unknowns, equations: size of the nonlinear program; inequalities and end conditions count as equations.
    """

    t: Array
    q: Array
    p: Array
    coefficients: dict[str, Array]
    coordinates: tuple[str, ...]
    cost: float
    costates: Array
    iterations: int
    status: str
    solved: bool
    unknowns: int
    equations: int

    @property
    def h(self) -> float:
        """Step size."""
        return float((self.t[-1] - self.t[0]) / (len(self.t) - 1))

    @property
    def inputs(self) -> dict[str, PPoly]:
        """Inputs as functions of time, in the form that :meth:`Stepper.integrate` takes."""
        from scipy.interpolate import BPoly, PPoly  # here: slow to import

        return {
            name: PPoly.from_bernstein_basis(BPoly(coefficients.T, self.t))
            for name, coefficients in self.coefficients.items()
        }

    @property
    def guess(self) -> dict[str, Any]:
        """Positions, mean inputs of the steps and duration: an initial guess for a further problem."""
        result: dict[str, Any] = dict(zip(self.coordinates, self.q.T, strict=True))
        result |= {name: coefficients.mean(axis=1) for name, coefficients in self.coefficients.items()}
        return {**result, "duration": float(self.t[-1] - self.t[0])}

    def __repr__(self) -> str:
        shown = np.format_float_scientific(self.cost, precision=6, trim="-") if self.cost else "0"
        return (
            f"<motion of {len(self.t) - 1} steps to t = {self.t[-1]:.6g}, cost {shown}, {self.iterations} iterations>"
        )


ZERO = 1e-16
"""Relative size below which components of the result are set to 0; constraints would otherwise be violated."""

Conditions = Mapping[str, Any]
"""Formulas with their values, or with least and largest value, ``None`` for no bound."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Optimal control problem, as described in :func:`optimal_control`."""

    ca: Any
    system: MechanicalSystem
    method: Method
    steps: int
    duration: tuple[float, float]
    cost: str
    bounds: Conditions
    degree: int
    t: float
    parameters: Array
    start: Conditions
    end: Conditions
    end_cost: str

    @property
    def between(self) -> dict[str, tuple[float, float]]:
        """Bounds on formulas other than inputs."""
        return {text: interval(text, value) for text, value in self.bounds.items() if text not in self.system.inputs}

    def program(self) -> NonlinearProgram:
        """Return the nonlinear program; the step equations come first, as their multipliers are the costates."""
        ca, m, n, count = self.ca, self.system.dimension, self.steps, len(self.system.inputs)
        step = casadi_step(self.system, self.method, degree=self.degree, along=[self.cost, *self.between])
        if self.degree >= (points := step.size2_out("along")):
            raise MethodError(
                f"inputs of degree {self.degree} have {self.degree + 1} coefficients per step, but the quadrature of "
                f"{self.method.name} has {points} points: use degree {points - 1} or less, or more points"
            )
        states, stages = ca.MX.sym("states", 2 * m, n + 1), ca.MX.sym("stages", step.size1_in("stages"), n)
        inputs, ends = ca.MX.sym("inputs", count, n * (self.degree + 1)), ca.MX.sym("velocities", m, 2)
        duration = ca.MX.sym("duration")
        q, p, parameters = states[:m, :], states[m:, :], self.parameters
        times = self.t + ca.DM(range(n)).T * duration / n
        repeated = ca.repmat(ca.vertcat(parameters, duration / n), 1, n)
        arguments = (q[:, :-1], p[:, :-1], stages, inputs, repeated[:-1, :], times, repeated[-1, :])
        q1, p1, residual, along, integrals = step.map(n)(*arguments)
        first = (q[:, 0], ends[:, 0], p[:, 0], self.t, parameters)
        last = (q[:, -1], ends[:, 1], p[:, -1], self.t + duration, parameters)
        return NonlinearProgram(
            ca=ca,
            unknowns={"states": states, "stages": stages, "inputs": inputs, "velocities": ends, "duration": duration},
            limits={"inputs": self._input_limits(), "duration": self.duration},
            constraints=[
                (states[:, 1:] - ca.vertcat(q1, p1), 0.0, 0.0),
                (residual, 0.0, 0.0),
                *([(self.ends.constraint_residual(*first), 0.0, 0.0)] if self.system.constraints else []),
                *self._at_end(first, self.start),
                *self._at_end(last, self.end),
                *((along[row, :], *self.between[text]) for row, text in enumerate(self.between, 1)),
            ],
            cost=ca.sum2(integrals[0, :]) + self.ends.formula(self.end_cost)(*last),
        )

    def _input_limits(self) -> tuple[Array, Array]:
        """Return least and largest values, a row for each input."""
        result = [interval(name, self.bounds.get(name, (None, None))) for name in self.system.inputs]
        return np.array([[least] for least, _ in result]), np.array([[largest] for _, largest in result])

    def _at_end(self, side: Sequence[Any], conditions: Conditions) -> Iterator[tuple[Any, float, float]]:
        """Yield the Legendre transform and the conditions at one end."""
        yield self.ends.legendre(*side), 0.0, 0.0
        for text, value in conditions.items():
            yield self.ends.formula(text)(*side), *interval(text, value)

    @cached_property
    def ends(self) -> EndConditions:
        """Formulas at both ends."""
        return EndConditions(self.ca, self.system)

    def first(self, guess: Mapping[str, Any]) -> dict[str, Any]:
        """Return initial values of all unknowns: positions as guessed, momenta and stages computed from them."""
        system, n = self.system, self.steps
        names = [q.name for q in system.coordinates]
        check_known(guess, (*names, *system.inputs, "duration"), "coordinate or input")
        duration = checked_number(guess.get("duration", sum(self.duration) / 2), "the duration guessed")
        fractions = np.linspace(0.0, 1.0, n + 1)
        times = self.t + fractions * duration
        q = np.array([_resampled(name, guess.get(name, self._between_ends(name)), fractions) for name in names])
        v = np.gradient(q, times, axis=1)
        moving = zip(q.T, v.T, times, strict=True)
        p = np.hstack([self.ends.momentum(self.ca.DM(x), x_dot, t, self.parameters).full() for x, x_dot, t in moving])
        spots = (np.arange(n)[:, np.newaxis] + (np.linspace(0.0, 1.0, self.degree + 1) if self.degree else 0.5)).ravel()
        stages = Discretisation(system, self.method).equations
        return {
            "states": np.concatenate([q, p]),
            "stages": np.concatenate(stages.straight(q[:, :-1], np.diff(q) * n / duration, p[:, :-1], duration / n)),
            "inputs": np.array([_resampled(name, guess.get(name, 0.0), spots / n) for name in system.inputs]),
            "velocities": v[:, [0, -1]],
            "duration": duration,
        }

    def _between_ends(self, name: str) -> list[float]:
        """Return the values of a coordinate at both ends as the conditions determine them, or 0."""
        limits = [interval(name, side[name]) for side in (self.start, self.end) if name in side]
        values = [sum(limit) / 2 for limit in limits if np.isfinite(limit).all()]
        return values if len(values) == 2 else (values or [0.0]) * 2

    def motion(self, program: NonlinearProgram, result: Any, stats: Mapping[str, Any]) -> ControlledMotion:
        """Return the solution from that of ``casadi.nlpsol``, with multipliers of the step equations as costates."""
        m, n = self.system.dimension, self.steps
        unknowns = program.split(result["x"])
        states = unknowns["states"]  # (2m, n + 1)
        largest = np.abs(states).max(axis=1, keepdims=True)
        states[np.abs(states) < ZERO * largest] = 0.0
        # CasADi's Lagrangian is f + lam_g . g. The first 2 m n equations are g_k = z_(k+1) - F(z_k), z = (q, p), a
        # column for each step; F without its stages. With lambda_k = -lam_g it is stationary in z_k where
        # lambda_(k-1) = (dF/dz_k)^T lambda_k + df/dz_k (without bounds): the discrete adjoint equation.
        step_multipliers = np.asarray(result["lam_g"]).ravel()[: 2 * m * n]
        costates = -step_multipliers.reshape(n, 2 * m)
        bernstein_coefficients = unknowns["inputs"].reshape(len(self.system.inputs), n, self.degree + 1)
        return ControlledMotion(
            t=self.t + np.linspace(0.0, unknowns["duration"].item(), n + 1),
            q=states[:m].T,
            p=states[m:].T,
            coefficients=dict(zip(self.system.inputs, bernstein_coefficients, strict=True)),
            coordinates=tuple(coordinate.name for coordinate in self.system.coordinates),
            cost=float(result["f"]),
            costates=costates,
            iterations=int(stats["iter_count"]),
            status=str(stats["return_status"]),
            solved=bool(stats["success"]),
            unknowns=program.x.numel(),
            equations=program.residual.numel(),
        )


def interval(name: str, value: Any) -> tuple[float, float]:
    """Return least and largest value of a condition or bound; StateError unless one or two ascending numbers."""
    if not isinstance(value, tuple | list):
        number = checked_number(value, name)
        return number, number
    if len(value) != 2:
        raise StateError(f"{name} must be a number, or two numbers (least, largest), not {value!r}")
    ends = zip(value, (-np.inf, np.inf), strict=True)
    least, largest = (none if end is None else checked_number(end, name) for end, none in ends)
    if least > largest:
        raise StateError(f"{name}: the lower bound {least:g} exceeds the upper bound {largest:g}")
    return least, largest


def check_known(values: Mapping[str, Any], names: Sequence[str], kind: str) -> None:
    """Raise :class:`StateError` for a name that is not known."""
    for name in values:
        if name not in names:
            raise StateError(f"there is no {kind} '{name}'{closest(name, names)} There are: {', '.join(names)}")


def _resampled(name: str, values: Any, times: Array) -> Array:
    """Return values at equidistant points of [0, 1], or one number, interpolated linearly at ``times``."""
    array = np.atleast_1d(real_array(values, f"the guess of {name}"))
    if array.ndim != 1 or not np.isfinite(array).all():
        raise StateError(f"the guess of {name} must be a finite number, or a list of them from start to end")
    return (
        np.interp(times, np.linspace(0.0, 1.0, len(array)), array) if len(array) > 1 else np.full(len(times), array[0])
    )


@checks_arguments(StateError, system=MechanicalSystem.KIND, start=Kind.MAPPING, end=Kind.MAPPING, bounds=Kind.MAPPING)
def optimal_control(
    system: MechanicalSystem,
    method: Method | str,
    *,
    steps: int,
    duration: float | tuple[float, float],
    start: Conditions,
    end: Conditions,
    cost: str = "0",
    end_cost: str = "0",
    bounds: Conditions | None = None,
    degree: int = 0,
    t: float = 0.0,
    parameters: Mapping[str, float] | None = None,
    guess: Mapping[str, Any] | None = None,
    options: Mapping[str, Any] | None = None,
) -> ControlledMotion:
    """Minimise a cost over inputs, subject to the dynamics, conditions at both ends and bounds between.

    A nonlinear program with exact sparse Hessian is solved by IPOPT (through CasADi, extra ``casadi``). Conditions are
    ``{formula: number}`` or ``{formula: (least, largest)}``, with ``None`` for no bound.

    Args:
        system: system with inputs.
        method: an SVI, SCVI or Gauss method, or its name.
        steps: number of steps of equal size.
        duration: duration of the trajectory; two numbers, least and largest, to optimise it.
        start, end: conditions in coordinates, velocities, momenta (``p_`` and the coordinate), t and parameters, in
            addition to the constraints of the system: fix what these leave free.
        cost: formula in coordinates, velocities, inputs, parameters and t, integrated by the method's quadrature.
        end_cost: formula without inputs, also with momenta, evaluated at the end and added to the integral.
        bounds: by name of an input, everywhere; for formulas as in the cost, at the points of the quadrature.
        degree: degree of inputs within a step, 0 (constant) to 3.
        t: initial time.
        parameters: values by name, others keep their defaults.
        guess: initial guess by name of a coordinate, an input or "duration": a number, or values at equidistant times;
            by default interpolated between conditions, 0 and the mean. A :attr:`ControlledMotion.guess` fits any number
            of steps.
        options: options of ``casadi.nlpsol``, as ``{"ipopt.max_iter": 500}``.

    Raises:
        ControlError: if IPOPT finds no solution; its ``motion`` is the last iterate.
        ExpressionError: for a formula outside the grammar.
        MethodError: for systems without inputs, and methods without a quadrature along a curve.
        MissingLibraryError: without CasADi.
        StateError: for unknown names, or invalid bounds.

    Source: S. Ober-Bloebaum, O. Junge, J. E. Marsden, ESAIM: COCV 17 (2011) 322; C. M. Campos, S. Ober-Bloebaum,
    E. Trelat, Discrete and Continuous Dynamical Systems 35 (2015) 4193.
    """
    ca = imported("casadi", "casadi")
    if not system.inputs:
        raise MethodError(f"'{system.name}' has no inputs: define it with inputs=[..] that its forces contain")
    shortest, longest = interval("duration", duration)
    if not 0 < shortest <= longest < np.inf:
        raise StateError(f"duration must be a positive number, or two numbers (least, largest), not {duration}")
    task = Task(
        ca=ca,
        system=system,
        method=as_method(method, system),
        steps=checked_count(steps, "steps", least=1),
        duration=(shortest, longest),
        start=start,
        end=end,
        cost=cost,
        end_cost=end_cost,
        bounds=bounds or {},
        degree=degree,
        t=checked_number(t, "t"),
        parameters=_parameter_values(system, parameters or {}),
    )
    program = task.program()
    motion = task.motion(program, *program.solved(task.first(guess or {}), options or {}))
    if not motion.solved:
        raise ControlError(
            f"no optimal control was found: IPOPT ended with {motion.status} after {motion.iterations} iterations; try "
            "a better guess, a longer duration or wider bounds",
            motion,
        )
    return motion


def _parameter_values(system: MechanicalSystem, changed: Mapping[str, float]) -> Array:
    values = {name.name: value for name, value in own_parameters(system).items()}
    check_known(changed, tuple(values), "parameter")
    return np.array([checked_number(value, name) for name, value in {**values, **changed}.items()])
