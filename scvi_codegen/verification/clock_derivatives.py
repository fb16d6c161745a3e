"""Checks of the derivatives of a compiled step in transformed time, dt = g dtau, including those of its duration."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.exact.motion import exact_motion
from scvi_codegen.exact.step import compiled_equations
from scvi_codegen.methods.method import is_symplectic
from scvi_codegen.runtime.linearised import Starts
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.derivatives import BOUND, WIDTH
from scvi_codegen.verification.pace import Pace
from scvi_codegen.verification.subject import State

__all__ = ["clock_derivative_checks"]

Array = NDArray[np.float64]

ROUGHNESS = 1e-12
"""Bound on the defect of J^T Omega J = Omega: round-off of an analytic derivative."""


def clock_derivative_checks(pace: Pace) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change, among them the energy."""
    promise = "derivatives of a step of tau and of its duration are those of the equations (differences, 60 digits)"
    yield from checked("derivatives in tau", promise, partial(_derivative, pace))
    promise = "derivatives of the energy of the start are those of its formula (60 digits)"
    yield from checked("energy surface", promise, partial(_level, pace))
    yield from checked("adjoint in tau", "VJP is the transpose of JVP, times included", partial(_transpose, pace))
    if is_symplectic(pace.subject.method, pace.transformed) and not pace.transformed.constraints:
        promise = "J^T Omega J = Omega, J the compiled Jacobian of a step of tau at fixed energy"
        yield from checked("symplecticity in tau", promise, partial(_symplecticity, pace))


def _derivative(pace: Pace) -> Finding:
    """Compare the directional derivative of the end state and of its time with differences of the exact step."""
    state, direction = _first(pace), _direction(pace)
    told, scales = pace.stepper._output_indices, np.append(pace.subject.scales(state), state.h)
    found = _carried(pace, direction, back=False)[told]
    ends = [_end(pace, direction * (sign * WIDTH)) for sign in (1, -1)]
    exact = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
    apart = np.abs((found - exact) / scales).max() / np.abs(exact / scales).max()
    return Finding(float(apart), BOUND, "relative, along one direction")


def _level(pace: Pace) -> Finding:
    """Compare the directional derivative of the energy of the state with differences; relative to its largest term."""
    state, direction, m = _first(pace), _direction(pace), len(_first(pace).q)
    values = np.array(list(pace.at_level(state).values()))
    terms = pace.stepper._energy_gradient(state.q, state.p, values) * direction
    motion, own = exact_motion(pace.system), len(pace.system.parameters)
    energies = []
    for sign in (1, -1):
        moved = _given(pace) + direction * (sign * WIDTH)
        at = motion.with_parameters(moved[2 * m : 2 * m + own].tolist())
        energies.append(at.energy(moved[:m], moved[m : 2 * m], mp.zero))
    exact = float((energies[0] - energies[1]) / (2 * WIDTH))
    return Finding(abs(float(terms.sum()) - exact) / float(np.abs(terms).max()), BOUND, "relative, along one direction")


def _transpose(pace: Pace) -> Finding:
    """Return the defect (J v, w) - (v, J^T w), where w weighs all components of the end alike."""
    v = _direction(pace)
    w = np.cos(2.0 + np.arange(len(v))) / np.abs(v)
    forward, back = (_carried(pace, vector, back=which) for vector, which in ((v, False), (w, True)))
    size = max(np.abs(forward * w).max(), np.abs(v * back).max())
    return Finding(float(abs(forward @ w - v @ back) / size), BOUND, "relative, along one direction")


def _symplecticity(pace: Pace) -> Finding:
    """Return the defect of J^T Omega J = Omega, in units of the areas of pairs of coordinates."""
    state = _first(pace)
    parameters, scales, m = pace.at_level(state), pace.subject.scales(state), len(state.q)
    J = pace.stepper.jacobian(state.q, state.p, state.h, state.t, parameters) * scales / scales[:, np.newaxis]
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m)) * np.outer(scales, scales)
    areas = np.tile(scales[:m] * scales[m:], 2)
    largest = float(np.abs(J).max()) ** 2
    defect = float((np.abs(J.T @ omega @ J - omega) / np.sqrt(np.outer(areas, areas))).max())
    return Finding(defect / largest, ROUGHNESS, "in units of the areas of coordinates")


def _first(pace: Pace) -> State:
    return pace.subject.states[0]


def _direction(pace: Pace) -> Array:
    """Return a direction of (q, p, parameters, energy, t, h), scaled with the size of each."""
    state = _first(pace)
    values = np.array(list(pace.at_level(state).values()))
    sizes = np.concatenate([pace.subject.scales(state), np.where(values, values, 1.0), [state.h, state.h]])
    direction: Array = sizes * (1.5 + np.sin(1.0 + 1.7 * np.arange(len(sizes))))
    return direction


def _carried(pace: Pace, vector: Array, *, back: bool) -> Array:
    """Return J v of the compiled derivative J at the energy of the state, or J^T v."""
    state = _first(pace)
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    vectors = np.zeros((2, 1, len(vector)))
    vectors[int(back)] = vector
    values = np.array(list(pace.at_level(state).values()))
    pace.stepper._propagate(starts, vectors, values, None, transpose=back)
    carried: Array = vectors[int(not back), 0]
    return carried


def _given(pace: Pace) -> Array:
    state = _first(pace)
    values = (*state.z, *pace.at_level(state).values(), state.t, state.h)
    return np.array([mp.mpf(float(x)) for x in values], dtype=object)


def _end(pace: Pace, change: Array) -> Array:
    """Return (2m + 1,) the end state of a step and its time, from perturbed arguments, in 60 digits."""
    m, moved = len(_first(pace).q), (_given(pace) + change).tolist()
    step = compiled_equations(pace.transformed, pace.subject.method).with_parameters(moved[2 * m : -2])
    q, p, h = moved[:m], moved[m : 2 * m], moved[-1]
    end = step(q, p, h)
    return np.array([*end.q, *end.p, moved[-2] + step.duration(end, q, p, h)], dtype=object)
