"""The derivative of the compiled step by all it starts from, and its transpose."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodError
from scvi_codegen.runtime.linearised import Starts
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.subject import State, Subject

__all__ = ["derivative_checks"]

Array = NDArray[np.float64]

BOUND = 1e-10
"""Of the change of the end in parts of its size; of the products compared, to their largest terms."""
WIDTH = mp.mpf(10) ** -15


def derivative_checks(subject: Subject) -> Iterator[Check]:
    """Along one direction in which nothing stands still: a slope that is wrong shows there."""
    promise = "a step changes by its start, parameters, time and h as its equations do (differences in 60 digits)"
    yield from checked("derivatives", promise, partial(_derivative, subject))
    yield from checked("adjoint", "the transposed derivative is that", partial(_transpose, subject))


def _derivative(subject: Subject) -> Finding | None:
    """The change of the end along the direction."""
    if not _differentiable(subject):
        return None
    state = subject.states[0]
    scales, direction = subject.scales(state), _direction(subject, state)
    found = _carried(subject, state, direction, back=False)[: len(scales)]
    exact, m = _by_differences(subject, state, direction), len(state.q)
    parts = (slice(m), slice(m, None))
    apart = max(np.abs((found - exact) / scales)[part].max() for part in parts)
    return Finding(float(apart / np.abs(exact / scales).max()), BOUND, "relative, along one direction")


def _transpose(subject: Subject) -> Finding | None:
    """(J v, w) - (v, J^T w), w weighing all parts of the end alike."""
    if not _differentiable(subject):
        return None
    state = subject.states[0]
    v = _direction(subject, state)
    w = np.cos(2.0 + np.arange(len(v))) / np.abs(v)
    forward, back = (_carried(subject, state, vector, back=which) for vector, which in ((v, False), (w, True)))
    size = max(np.abs(forward * w).max(), np.abs(v * back).max())
    return Finding(float(abs(forward @ w - v @ back) / size), BOUND, "relative, along one direction")


def _differentiable(subject: Subject) -> bool:
    """Whether the artefact has derivatives; those of generated folders have none."""
    try:
        return subject.stepper.given > 0
    except MethodError:
        return False


def _direction(subject: Subject, state: State) -> Array:
    """Of (q, p, parameters, t, h), each in parts of its size."""
    values = np.array(list(subject.parameters.values()))
    sizes = np.concatenate([subject.scales(state), np.where(values, values, 1.0), [state.h, state.h]])
    direction: Array = sizes * (1.5 + np.sin(1.0 + 1.7 * np.arange(len(sizes))))
    return direction


def _carried(subject: Subject, state: State, vector: Array, *, back: bool) -> Array:
    """What the compiled derivative, or its transpose, makes of a vector."""
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    vectors = np.zeros((2, 1, len(vector)))
    vectors[int(back)] = vector
    subject.stepper.linearise(starts, vectors, np.array(list(subject.parameters.values())), None, back=back)
    carried: Array = vectors[int(not back), 0]
    return carried


def _by_differences(subject: Subject, state: State, direction: Array) -> Array:
    """Of the equations in 60 digits."""
    step, m = subject.derived(), len(state.q)
    given = np.array([mp.mpf(x) for x in (*state.z, *subject.parameters.values(), state.t, state.h)], dtype=object)
    ends = []
    for sign in (1, -1):
        moved = given + direction * (sign * WIDTH)
        end = step.with_parameters(moved[2 * m : -2])(moved[:m], moved[m : 2 * m], moved[-1], moved[-2])
        ends.append(np.array([*end.q, *end.p], dtype=object))
    slope: Array = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
    return slope
