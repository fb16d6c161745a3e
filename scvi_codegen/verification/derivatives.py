"""Checks of the derivatives of a compiled step: Jacobian, its transpose, and second derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError
from scvi_codegen.runtime.linearised import Starts
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.subject import State, Subject

__all__ = ["derivative_checks"]

Array = NDArray[np.float64]

BOUND = 1e-10
"""Bound on relative differences of directional derivatives, and of products relative to their largest terms."""
WIDTH = mp.mpf(10) ** -15
"""Relative perturbation of the arguments for differences in 60 digits."""
MOST_BENT = 4
"""Largest number of coordinates for which second derivatives are compiled; it takes long for more."""


def derivative_checks(subject: Subject) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change."""
    promise = "derivatives with respect to state, parameters, t and h are those of the equations (60 digits)"
    yield from checked("derivatives", promise, partial(_derivative, subject))
    yield from checked("adjoint", "VJP is the transpose of JVP", partial(_transpose, subject))
    promise = "second derivatives of a function of the end are those of the equations (differences, 60 digits)"
    yield from checked("second derivatives", promise, partial(_second, subject))
    yield from checked("Hessian", "the Hessian is symmetric", partial(_symmetry, subject))


def _derivative(subject: Subject) -> Finding | None:
    """Compare the directional derivative of the end state with differences of the exact step."""
    if not _differentiable(subject):
        return None
    state = subject.states[0]
    scales, direction = subject.scales(state), _direction(subject, state)
    exact, m = _by_differences(subject, state, direction), len(state.q)
    apart = 0.0
    for stepper in _steppers(subject):
        found = _carried(subject, stepper, state, direction, back=False)[: len(scales)]
        apart = max(apart, *(np.abs((found - exact) / scales)[part].max() for part in (slice(m), slice(m, None))))
    return Finding(float(apart / np.abs(exact / scales).max()), BOUND, "relative, along one direction")


def _transpose(subject: Subject) -> Finding | None:
    """Return the defect (J v, w) - (v, J^T w), where w weighs all components of the end alike."""
    if not _differentiable(subject):
        return None
    state = subject.states[0]
    v = _direction(subject, state)
    w = np.cos(2.0 + np.arange(len(v))) / np.abs(v)
    apart = 0.0
    for stepper in _steppers(subject):
        forward, back = (
            _carried(subject, stepper, state, vector, back=which) for vector, which in ((v, False), (w, True))
        )
        size = max(np.abs(forward * w).max(), np.abs(v * back).max())
        apart = max(apart, float(abs(forward @ w - v @ back) / size))
    return Finding(apart, BOUND, "relative, along one direction")


def _steppers(subject: Subject) -> list[Stepper]:
    """Return the stepper under test and the one with Newton's method alone, which factorises the Jacobian."""
    others = [subject.newton] if subject.newton and subject.newton is not subject.stepper else []
    return [subject.stepper, *others]


def _differentiable(subject: Subject) -> bool:
    """Return True if the stepper has derivatives; those of generated folders have none."""
    try:
        return subject.stepper._input_size > 0
    except MethodError:
        return False


def _second(subject: Subject) -> Finding | None:
    """Compare the second derivative along two directions with differences of the exact step."""
    if not _bends(subject):
        return None
    state = subject.states[0]
    u, v = _direction(subject, state), _direction(subject, state, 2.3)
    bent = _hessian(subject, state)
    exact = _bent_by_differences(subject, state, u, v)
    size = np.abs(u) @ np.abs(bent) @ np.abs(v)
    return Finding(float(abs(u @ bent @ v - exact) / size) if size else 0.0, BOUND, "relative, along two directions")


def _symmetry(subject: Subject) -> Finding | None:
    """Return the largest asymmetry of the Hessian relative to its largest entry, in scaled arguments."""
    if not _bends(subject):
        return None
    state = subject.states[0]
    sizes = np.abs(_direction(subject, state))
    bent = _hessian(subject, state) * np.outer(sizes, sizes)
    return Finding(float(np.abs(bent - bent.T).max() / (np.abs(bent).max() or 1.0)), BOUND, "relative, all entries")


def _bends(subject: Subject) -> bool:
    """Return True if the stepper has second derivatives and few coordinates."""
    if not _differentiable(subject) or subject.system.dimension > MOST_BENT:
        return False
    try:
        subject.stepper._second_derivatives  # noqa: B018
    except MethodError:
        return False
    return True


def _weights(subject: Subject, state: State) -> Array:
    """Return (2m,) weights of a scalar function of the end state, to which all components contribute alike."""
    scales = subject.scales(state)
    weights: Array = (1.3 + np.cos(2.0 + np.arange(len(scales)))) / scales
    return weights


def _hessian(subject: Subject, state: State) -> Array:
    """Return the compiled Hessian (n, n) of the weighted sum of the end state, n the number of arguments."""
    stepper, parameters = subject.stepper, np.array(list(subject.parameters.values()))
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    size = stepper._input_size
    changes, vectors = np.zeros((2, size, size)), np.zeros((2, 2, size, size))
    changes[0], vectors[1, 0, :, : 2 * len(state.q)] = np.eye(size), _weights(subject, state)
    stepper._propagate(starts, changes, parameters, None)
    stepper._second_order_adjoint(starts, changes, vectors, parameters, None)
    bent: Array = vectors[0, 1]
    return bent


def _bent_by_differences(subject: Subject, state: State, u: Array, v: Array) -> float:
    """Return the second derivative of the weighted sum along u and v, by differences in 60 digits."""
    weights = [mp.mpf(weight) for weight in _weights(subject, state)]
    total = mp.zero
    for sign, other in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        total += sign * other * mp.fdot(weights, _end(subject, state, (sign * u + other * v) * WIDTH))
    return float(total / (4 * WIDTH**2))


def _direction(subject: Subject, state: State, phase: float = 1.0) -> Array:
    """Return a direction of (q, p, parameters, t, h), scaled with the size of each."""
    values = np.array(list(subject.parameters.values()))
    sizes = np.concatenate([subject.scales(state), np.where(values, values, 1.0), [state.h, state.h]])
    direction: Array = sizes * (1.5 + np.sin(phase + 1.7 * np.arange(len(sizes))))
    return direction


def _carried(subject: Subject, stepper: Stepper, state: State, vector: Array, *, back: bool) -> Array:
    """Return J v of the compiled Jacobian J, or J^T v."""
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    vectors = np.zeros((2, 1, len(vector)))
    vectors[int(back)] = vector
    stepper._propagate(starts, vectors, np.array(list(subject.parameters.values())), None, transpose=back)
    carried: Array = vectors[int(not back), 0]
    return carried


def _by_differences(subject: Subject, state: State, direction: Array) -> Array:
    """Return the directional derivative of the end state, by differences in 60 digits."""
    ends = [_end(subject, state, direction * (sign * WIDTH)) for sign in (1, -1)]
    slope: Array = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
    return slope


def _end(subject: Subject, state: State, change: Array) -> Array:
    """Return (2m,) the end state of a step from perturbed arguments, in 60 digits."""
    step, m = subject.derived(), len(state.q)
    given = np.array([mp.mpf(x) for x in (*state.z, *subject.parameters.values(), state.t, state.h)], dtype=object)
    moved = (given + change).tolist()
    end = step.with_parameters(moved[2 * m : -2])(moved[:m], moved[m : 2 * m], moved[-1], moved[-2])
    return np.array([*end.q, *end.p], dtype=object)
