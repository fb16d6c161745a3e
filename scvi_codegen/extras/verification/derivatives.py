"""Checks of the derivatives of a compiled step: Jacobian, its transpose, and second derivatives.

A step in transformed time, dt = g dtau, has its duration as a further result, and the energy as a further parameter.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array, Starts
from scvi_codegen.common.errors import MethodError
from scvi_codegen.extras.exact.solution import exact_motion
from scvi_codegen.extras.exact.step import compiled_equations
from scvi_codegen.extras.verification.certificate import Check, Finding, checked
from scvi_codegen.extras.verification.system_under_test import BOUND, ROUND_OFF, State, SystemUnderTest, canonical_form
from scvi_codegen.extras.verification.variable_steps import VariableSteps
from scvi_codegen.runs.stepper import Stepper

WIDTH = mp.mpf(10) ** -15
"""Relative perturbation of the arguments for differences in 60 digits."""
LEAST = 1e-2
"""Least derivative, in units of the scales, with which errors are compared; constraints may leave no motion at all."""
MAX_HESSIAN_COORDINATES = 4
"""Largest number of coordinates for which second derivatives are compiled; it takes long for more."""


@dataclass(frozen=True)
class _Map:
    """Step as a function of its arguments (q, p, parameters, t, h), at a state: compiled, and in 60 digits."""

    stepper: Stepper
    state: State
    parameters: Array
    scales: Array  # sizes of the results
    outputs: NDArray[np.int_]  # indices of the results among the arguments
    end: Callable[[list[Number]], Array]
    fixed: Sequence[int] = ()  # parameters that are modes

    def direction(self, phase: float = 1.0) -> Array:
        """Return a direction in which all arguments but modes change, each scaled with its size."""
        values, m = self.parameters, len(self.state.q)
        h = self.state.h
        sizes = np.concatenate([self.scales[: 2 * m], np.where(values, values, 1.0), [h, h]])
        sizes[[2 * m + column for column in self.fixed]] = 0.0
        return np.asarray(sizes * (1.5 + np.sin(phase + 1.7 * np.arange(len(sizes)))))

    def propagated(self, vector: Array, *, back: bool) -> Array:
        """Return J v of the compiled Jacobian J, or J^T v."""
        vectors = np.zeros((2, 1, len(vector)))
        vectors[int(back)] = vector
        self.stepper.products.propagate(_starts(self.state), vectors, self.parameters, None, transpose=back)
        return np.asarray(vectors[int(not back), 0])

    def moved_end(self, change: Array) -> Array:
        """Return the results for perturbed arguments, in 60 digits."""
        return self.end((self.arguments + change).tolist())

    @property
    def arguments(self) -> Array:
        values = (*self.state.z, *self.parameters, self.state.t, self.state.h)
        return np.array([mp.mpf(float(x)) for x in values], dtype=object)

    def derivative_error(self) -> float:
        """Return the relative error of the derivative along :meth:`direction`, compared with differences."""
        direction = self.direction()
        result = self.propagated(direction, back=False)[self.outputs]
        ends = [self.moved_end(direction * (sign * WIDTH)) for sign in (1, -1)]
        exact = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
        return float(np.abs((result - exact) / self.scales).max() / max(np.abs(exact / self.scales).max(), LEAST))

    def transpose_error(self) -> float:
        """Return the defect (J v, w) - (v, J^T w), where w weighs all components of the end alike."""
        v = self.direction()
        w = np.cos(2.0 + np.arange(len(v))) / np.where(v, np.abs(v), np.inf)
        forward, back = (self.propagated(vector, back=which) for vector, which in ((v, False), (w, True)))
        size = max(np.abs(forward * w).max(), np.abs(v * back).max(), LEAST)
        return float(abs(forward @ w - v @ back) / size)


def _starts(state: State) -> Starts:
    return Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))


def _map_of(tested: SystemUnderTest, stepper: Stepper) -> _Map:
    state, m = tested.states[0], tested.system.dimension

    def end(arguments: list[Number]) -> Array:
        ends, key = tested.ends_in_digits, tuple(arguments)
        if key not in ends:
            step = tested.derived().with_parameters(arguments[2 * m : -2])
            result = step(arguments[:m], arguments[m : 2 * m], arguments[-1], arguments[-2])
            ends[key] = np.array([*result.q, *result.p], dtype=object)
        return ends[key]

    values = np.array(list(tested.parameters.values()))
    return _Map(stepper, state, values, tested.scales(state), np.arange(2 * m), end, tested.stepper.mode_columns)


def _map_in_tau(runs: VariableSteps) -> _Map:
    """Return the step of tau from the first state at its energy; its results include the time."""
    tested, m = runs.tested, runs.system.dimension
    state = tested.states[0]

    def end(arguments: list[Number]) -> Array:
        step = compiled_equations(runs.transformed, tested.method).with_parameters(arguments[2 * m : -2])
        q, p, h = arguments[:m], arguments[m : 2 * m], arguments[-1]
        result = step(q, p, h)
        return np.array([*result.q, *result.p, arguments[-2] + step.duration(result, q, p, h)], dtype=object)

    values = np.array(list(runs.at_energy(state).values()))
    scales = np.append(tested.scales(state), state.h)
    return _Map(runs.stepper, state, values, scales, np.asarray(runs.stepper._output_indices), end)


def derivative_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change."""
    statement = "derivatives with respect to state, parameters, t and h are those of the equations (60 digits)"
    yield from checked("derivatives", statement, partial(_largest, tested, _Map.derivative_error))
    yield from checked("adjoint", "VJP is the transpose of JVP", partial(_largest, tested, _Map.transpose_error))
    statement = "second derivatives of a function of the end are those of the equations (differences, 60 digits)"
    yield from checked("second derivatives", statement, partial(_second, tested))
    yield from checked("Hessian", "the Hessian is symmetric", partial(_symmetry, tested))


def _largest(tested: SystemUnderTest, error: Callable[[_Map], float]) -> Finding | None:
    if not _differentiable(tested):
        return None
    errors = [error(_map_of(tested, stepper)) for stepper in tested.steppers]
    return Finding(max(errors), BOUND, "relative, along one direction")


def _differentiable(tested: SystemUnderTest) -> bool:
    """Return True if the stepper has derivatives; those of generated folders have none."""
    try:
        return tested.stepper.products.tangents > 0
    except MethodError:
        return False


def _second(tested: SystemUnderTest) -> Finding | None:
    if not _has_second_derivatives(tested):
        return None
    step = _map_of(tested, tested.stepper)
    u, v, hessian = step.direction(), step.direction(2.3), _hessian(step)
    weights = [mp.mpf(weight) for weight in _weights(step)]
    total = mp.zero
    for sign, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        total += sign * other * mp.fdot(weights, step.moved_end((sign * u + other * v) * WIDTH))
    exact = float(total / (4 * WIDTH**2))
    size = max(float(np.abs(u) @ np.abs(hessian) @ np.abs(v)), LEAST)
    return Finding(float(abs(u @ hessian @ v - exact) / size), BOUND, "relative, along two directions")


def _symmetry(tested: SystemUnderTest) -> Finding | None:
    """Return the largest asymmetry of the Hessian relative to its largest entry, in scaled arguments."""
    if not _has_second_derivatives(tested):
        return None
    step = _map_of(tested, tested.stepper)
    sizes = np.abs(step.direction())
    hessian = _hessian(step) * np.outer(sizes, sizes)
    largest = max(float(np.abs(hessian).max()), LEAST)
    return Finding(float(np.abs(hessian - hessian.T).max()) / largest, BOUND, "relative, all entries")


def _has_second_derivatives(tested: SystemUnderTest) -> bool:
    """Return True if the stepper has second derivatives and few coordinates."""
    if not _differentiable(tested) or tested.system.dimension > MAX_HESSIAN_COORDINATES:
        return False
    try:
        tested.stepper._second_derivatives  # noqa: B018
    except MethodError:
        return False
    return True


def _weights(step: _Map) -> Array:
    """Return (2m,) weights of a scalar function of the end state, to which all components contribute alike."""
    return np.asarray((1.3 + np.cos(2.0 + np.arange(len(step.scales)))) / step.scales)


def _hessian(step: _Map) -> Array:
    """Return the compiled Hessian (n, n) of the weighted sum of the end state, n the number of arguments."""
    size, starts = step.stepper.products.tangents, _starts(step.state)
    changes, vectors = np.zeros((2, size, size)), np.zeros((2, 2, size, size))
    changes[0], vectors[1, 0, :, : len(step.scales)] = np.eye(size), _weights(step)
    step.stepper.products.propagate(starts, changes, step.parameters, None)
    step.stepper._second_order_adjoint(starts, changes, vectors, step.parameters, None)
    return np.asarray(vectors[0, 1])


def time_transformation_derivative_checks(runs: VariableSteps) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change, among them the energy."""
    statement = "derivatives of a step of tau and of its duration are those of the equations (differences, 60 digits)"
    yield from checked("derivatives in tau", statement, partial(_in_tau, runs, _Map.derivative_error))
    statement = "derivatives of the energy of the start are those of its formula (60 digits)"
    yield from checked("energy surface", statement, partial(_energy_derivative, runs))
    statement = "VJP is the transpose of JVP, times included"
    yield from checked("adjoint in tau", statement, partial(_in_tau, runs, _Map.transpose_error))
    if Discretisation(runs.transformed, runs.tested.method).symplectic and not runs.transformed.constraints:
        statement = "J^T Omega J = Omega, J the compiled Jacobian of a step of tau at fixed energy"
        yield from checked("symplecticity in tau", statement, partial(_symplecticity, runs))


def _in_tau(runs: VariableSteps, error: Callable[[_Map], float]) -> Finding:
    return Finding(error(_map_in_tau(runs)), BOUND, "relative, along one direction")


def _energy_derivative(runs: VariableSteps) -> Finding:
    """Compare the directional derivative of the energy of the state with differences; relative to its largest term."""
    step = _map_in_tau(runs)
    state, direction, m = step.state, step.direction(), len(step.state.q)
    terms = step.stepper._energy_gradient(state.q, state.p, step.parameters) * direction
    motion, count = exact_motion(runs.system), len(runs.system.parameters)
    energies = []
    for sign in (1, -1):
        moved = step.arguments + direction * (sign * WIDTH)
        shifted = motion.with_parameters(moved[2 * m : 2 * m + count].tolist())
        energies.append(shifted.energy(moved[:m], moved[m : 2 * m], mp.zero))
    exact = float((energies[0] - energies[1]) / (2 * WIDTH))
    return Finding(abs(float(terms.sum()) - exact) / float(np.abs(terms).max()), BOUND, "relative, along one direction")


def _symplecticity(runs: VariableSteps) -> Finding:
    """Return the defect of J^T Omega J = Omega, in units of the areas of pairs of coordinates."""
    state = runs.tested.states[0]
    parameters, scales, m = runs.at_energy(state), runs.tested.scales(state), len(state.q)
    J = runs.stepper.jacobian(state.q, state.p, state.h, state.t, parameters) * scales / scales[:, np.newaxis]
    omega = canonical_form(m) * np.outer(scales, scales)
    areas = np.tile(scales[:m] * scales[m:], 2)
    largest = float(np.abs(J).max()) ** 2
    defect = float((np.abs(J.T @ omega @ J - omega) / np.sqrt(np.outer(areas, areas))).max())
    return Finding(defect / largest, ROUND_OFF, "in units of the areas of coordinates")
