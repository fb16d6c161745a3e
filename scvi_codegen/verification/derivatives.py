"""Checks of the derivatives of a compiled step: Jacobian, its transpose, and second derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.sensitivity.step_derivatives import Starts
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.system_under_test import State, SystemUnderTest

__all__ = ["derivative_checks"]

Array = NDArray[np.float64]

BOUND = 1e-10
"""Bound on relative differences of directional derivatives, and of products relative to their largest terms."""
WIDTH = mp.mpf(10) ** -15
"""Relative perturbation of the arguments for differences in 60 digits."""
MAX_HESSIAN_COORDINATES = 4
"""Largest number of coordinates for which second derivatives are compiled; it takes long for more."""


def derivative_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change."""
    statement = "derivatives with respect to state, parameters, t and h are those of the equations (60 digits)"
    yield from checked("derivatives", statement, partial(_derivative, tested))
    yield from checked("adjoint", "VJP is the transpose of JVP", partial(_transpose, tested))
    statement = "second derivatives of a function of the end are those of the equations (differences, 60 digits)"
    yield from checked("second derivatives", statement, partial(_second, tested))
    yield from checked("Hessian", "the Hessian is symmetric", partial(_symmetry, tested))


def _derivative(tested: SystemUnderTest) -> Finding | None:
    """Compare the directional derivative of the end state with differences of the exact step."""
    if not _differentiable(tested):
        return None
    state = tested.states[0]
    scales, direction = tested.scales(state), _direction(tested, state)
    exact, m = _by_differences(tested, state, direction), len(state.q)
    difference = 0.0
    for stepper in _steppers(tested):
        result = _propagated(tested, stepper, state, direction, back=False)[: len(scales)]
        difference = max(
            difference, *(np.abs((result - exact) / scales)[part].max() for part in (slice(m), slice(m, None)))
        )
    return Finding(float(difference / np.abs(exact / scales).max()), BOUND, "relative, along one direction")


def _transpose(tested: SystemUnderTest) -> Finding | None:
    """Return the defect (J v, w) - (v, J^T w), where w weighs all components of the end alike."""
    if not _differentiable(tested):
        return None
    state = tested.states[0]
    v = _direction(tested, state)
    w = np.cos(2.0 + np.arange(len(v))) / np.abs(v)
    difference = 0.0
    for stepper in _steppers(tested):
        forward, back = (
            _propagated(tested, stepper, state, vector, back=which) for vector, which in ((v, False), (w, True))
        )
        size = max(np.abs(forward * w).max(), np.abs(v * back).max())
        difference = max(difference, float(abs(forward @ w - v @ back) / size))
    return Finding(difference, BOUND, "relative, along one direction")


def _steppers(tested: SystemUnderTest) -> list[Stepper]:
    """Return the stepper under test and the one with Newton's method alone, which factorises the Jacobian."""
    others = [tested.newton] if tested.newton and tested.newton is not tested.stepper else []
    return [tested.stepper, *others]


def _differentiable(tested: SystemUnderTest) -> bool:
    """Return True if the stepper has derivatives; those of generated folders have none."""
    try:
        return tested.stepper._input_size > 0
    except MethodError:
        return False


def _second(tested: SystemUnderTest) -> Finding | None:
    """Compare the second derivative along two directions with differences of the exact step."""
    if not _has_second_derivatives(tested):
        return None
    state = tested.states[0]
    u, v = _direction(tested, state), _direction(tested, state, 2.3)
    hessian = _hessian(tested, state)
    exact = _second_derivative_by_differences(tested, state, u, v)
    size = np.abs(u) @ np.abs(hessian) @ np.abs(v)
    return Finding(float(abs(u @ hessian @ v - exact) / size) if size else 0.0, BOUND, "relative, along two directions")


def _symmetry(tested: SystemUnderTest) -> Finding | None:
    """Return the largest asymmetry of the Hessian relative to its largest entry, in scaled arguments."""
    if not _has_second_derivatives(tested):
        return None
    state = tested.states[0]
    sizes = np.abs(_direction(tested, state))
    hessian = _hessian(tested, state) * np.outer(sizes, sizes)
    return Finding(
        float(np.abs(hessian - hessian.T).max() / (np.abs(hessian).max() or 1.0)), BOUND, "relative, all entries"
    )


def _has_second_derivatives(tested: SystemUnderTest) -> bool:
    """Return True if the stepper has second derivatives and few coordinates."""
    if not _differentiable(tested) or tested.system.dimension > MAX_HESSIAN_COORDINATES:
        return False
    try:
        tested.stepper._second_derivatives  # noqa: B018
    except MethodError:
        return False
    return True


def _weights(tested: SystemUnderTest, state: State) -> Array:
    """Return (2m,) weights of a scalar function of the end state, to which all components contribute alike."""
    scales = tested.scales(state)
    weights: Array = (1.3 + np.cos(2.0 + np.arange(len(scales)))) / scales
    return weights


def _hessian(tested: SystemUnderTest, state: State) -> Array:
    """Return the compiled Hessian (n, n) of the weighted sum of the end state, n the number of arguments."""
    stepper, parameters = tested.stepper, np.array(list(tested.parameters.values()))
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    size = stepper._input_size
    changes, vectors = np.zeros((2, size, size)), np.zeros((2, 2, size, size))
    changes[0], vectors[1, 0, :, : 2 * len(state.q)] = np.eye(size), _weights(tested, state)
    stepper._propagate(starts, changes, parameters, None)
    stepper._second_order_adjoint(starts, changes, vectors, parameters, None)
    hessian: Array = vectors[0, 1]
    return hessian


def _second_derivative_by_differences(tested: SystemUnderTest, state: State, u: Array, v: Array) -> float:
    """Return the second derivative of the weighted sum along u and v, by differences in 60 digits."""
    weights = [mp.mpf(weight) for weight in _weights(tested, state)]
    total = mp.zero
    for sign, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        total += sign * other * mp.fdot(weights, _end(tested, state, (sign * u + other * v) * WIDTH))
    return float(total / (4 * WIDTH**2))


def _direction(tested: SystemUnderTest, state: State, phase: float = 1.0) -> Array:
    """Return a direction of (q, p, parameters, t, h), scaled with the size of each."""
    values = np.array(list(tested.parameters.values()))
    sizes = np.concatenate([tested.scales(state), np.where(values, values, 1.0), [state.h, state.h]])
    direction: Array = sizes * (1.5 + np.sin(phase + 1.7 * np.arange(len(sizes))))
    return direction


def _propagated(tested: SystemUnderTest, stepper: Stepper, state: State, vector: Array, *, back: bool) -> Array:
    """Return J v of the compiled Jacobian J, or J^T v."""
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    vectors = np.zeros((2, 1, len(vector)))
    vectors[int(back)] = vector
    stepper._propagate(starts, vectors, np.array(list(tested.parameters.values())), None, transpose=back)
    carried: Array = vectors[int(not back), 0]
    return carried


def _by_differences(tested: SystemUnderTest, state: State, direction: Array) -> Array:
    """Return the directional derivative of the end state, by differences in 60 digits."""
    ends = [_end(tested, state, direction * (sign * WIDTH)) for sign in (1, -1)]
    derivative: Array = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
    return derivative


def _end(tested: SystemUnderTest, state: State, change: Array) -> Array:
    """Return (2m,) the end state of a step from perturbed arguments, in 60 digits."""
    step, m = tested.derived(), len(state.q)
    arguments = np.array([mp.mpf(x) for x in (*state.z, *tested.parameters.values(), state.t, state.h)], dtype=object)
    moved = (arguments + change).tolist()
    end = step.with_parameters(moved[2 * m : -2])(moved[:m], moved[m : 2 * m], moved[-1], moved[-2])
    return np.array([*end.q, *end.p], dtype=object)
