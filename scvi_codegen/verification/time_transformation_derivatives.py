"""Checks of the derivatives of a compiled step in transformed time, dt = g dtau, including those of its duration."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.exact.solution import exact_motion
from scvi_codegen.exact.step import compiled_equations
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.runtime.sensitivity.step_derivatives import Starts
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.derivatives import BOUND, WIDTH
from scvi_codegen.verification.system_under_test import State
from scvi_codegen.verification.variable_steps import VariableSteps

__all__ = ["time_transformation_derivative_checks"]

Array = NDArray[np.float64]

JACOBIAN_ROUNDOFF = 1e-12
"""Bound on the defect of J^T Omega J = Omega: round-off of an analytic derivative."""


def time_transformation_derivative_checks(runs_tested: VariableSteps) -> Iterator[Check]:
    """Yield the checks along one direction in which all arguments change, among them the energy."""
    statement = "derivatives of a step of tau and of its duration are those of the equations (differences, 60 digits)"
    yield from checked("derivatives in tau", statement, partial(_derivative, runs_tested))
    statement = "derivatives of the energy of the start are those of its formula (60 digits)"
    yield from checked("energy surface", statement, partial(_energy_derivative, runs_tested))
    yield from checked(
        "adjoint in tau", "VJP is the transpose of JVP, times included", partial(_transpose, runs_tested)
    )
    if is_symplectic(runs_tested.tested.method, runs_tested.transformed) and not runs_tested.transformed.constraints:
        statement = "J^T Omega J = Omega, J the compiled Jacobian of a step of tau at fixed energy"
        yield from checked("symplecticity in tau", statement, partial(_symplecticity, runs_tested))


def _derivative(runs_tested: VariableSteps) -> Finding:
    """Compare the directional derivative of the end state and of its time with differences of the exact step."""
    state, direction = _first(runs_tested), _direction(runs_tested)
    outputs, scales = runs_tested.stepper._output_indices, np.append(runs_tested.tested.scales(state), state.h)
    result = _propagated(runs_tested, direction, back=False)[outputs]
    ends = [_end(runs_tested, direction * (sign * WIDTH)) for sign in (1, -1)]
    exact = ((ends[0] - ends[1]) / (2 * WIDTH)).astype(float)
    difference = np.abs((result - exact) / scales).max() / np.abs(exact / scales).max()
    return Finding(float(difference), BOUND, "relative, along one direction")


def _energy_derivative(runs_tested: VariableSteps) -> Finding:
    """Compare the directional derivative of the energy of the state with differences; relative to its largest term."""
    state, direction, m = _first(runs_tested), _direction(runs_tested), len(_first(runs_tested).q)
    values = np.array(list(runs_tested.at_energy(state).values()))
    terms = runs_tested.stepper._energy_gradient(state.q, state.p, values) * direction
    motion, count = exact_motion(runs_tested.system), len(runs_tested.system.parameters)
    energies = []
    for sign in (1, -1):
        moved = _arguments(runs_tested) + direction * (sign * WIDTH)
        at = motion.with_parameters(moved[2 * m : 2 * m + count].tolist())
        energies.append(at.energy(moved[:m], moved[m : 2 * m], mp.zero))
    exact = float((energies[0] - energies[1]) / (2 * WIDTH))
    return Finding(abs(float(terms.sum()) - exact) / float(np.abs(terms).max()), BOUND, "relative, along one direction")


def _transpose(runs_tested: VariableSteps) -> Finding:
    """Return the defect (J v, w) - (v, J^T w), where w weighs all components of the end alike."""
    v = _direction(runs_tested)
    w = np.cos(2.0 + np.arange(len(v))) / np.abs(v)
    forward, back = (_propagated(runs_tested, vector, back=which) for vector, which in ((v, False), (w, True)))
    size = max(np.abs(forward * w).max(), np.abs(v * back).max())
    return Finding(float(abs(forward @ w - v @ back) / size), BOUND, "relative, along one direction")


def _symplecticity(runs_tested: VariableSteps) -> Finding:
    """Return the defect of J^T Omega J = Omega, in units of the areas of pairs of coordinates."""
    state = _first(runs_tested)
    parameters, scales, m = runs_tested.at_energy(state), runs_tested.tested.scales(state), len(state.q)
    J = runs_tested.stepper.jacobian(state.q, state.p, state.h, state.t, parameters) * scales / scales[:, np.newaxis]
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m)) * np.outer(scales, scales)
    areas = np.tile(scales[:m] * scales[m:], 2)
    largest = float(np.abs(J).max()) ** 2
    defect = float((np.abs(J.T @ omega @ J - omega) / np.sqrt(np.outer(areas, areas))).max())
    return Finding(defect / largest, JACOBIAN_ROUNDOFF, "in units of the areas of coordinates")


def _first(runs_tested: VariableSteps) -> State:
    return runs_tested.tested.states[0]


def _direction(runs_tested: VariableSteps) -> Array:
    """Return a direction of (q, p, parameters, energy, t, h), scaled with the size of each."""
    state = _first(runs_tested)
    values = np.array(list(runs_tested.at_energy(state).values()))
    sizes = np.concatenate([runs_tested.tested.scales(state), np.where(values, values, 1.0), [state.h, state.h]])
    direction: Array = sizes * (1.5 + np.sin(1.0 + 1.7 * np.arange(len(sizes))))
    return direction


def _propagated(runs_tested: VariableSteps, vector: Array, *, back: bool) -> Array:
    """Return J v of the compiled derivative J at the energy of the state, or J^T v."""
    state = _first(runs_tested)
    starts = Starts.chain(state.q, state.p, np.array([state.t]), np.array([state.h]))
    vectors = np.zeros((2, 1, len(vector)))
    vectors[int(back)] = vector
    values = np.array(list(runs_tested.at_energy(state).values()))
    runs_tested.stepper._propagate(starts, vectors, values, None, transpose=back)
    carried: Array = vectors[int(not back), 0]
    return carried


def _arguments(runs_tested: VariableSteps) -> Array:
    state = _first(runs_tested)
    values = (*state.z, *runs_tested.at_energy(state).values(), state.t, state.h)
    return np.array([mp.mpf(float(x)) for x in values], dtype=object)


def _end(runs_tested: VariableSteps, change: Array) -> Array:
    """Return (2m + 1,) the end state of a step and its time, from perturbed arguments, in 60 digits."""
    m, moved = len(_first(runs_tested).q), (_arguments(runs_tested) + change).tolist()
    step = compiled_equations(runs_tested.transformed, runs_tested.tested.method).with_parameters(moved[2 * m : -2])
    q, p, h = moved[:m], moved[m : 2 * m], moved[-1]
    end = step(q, p, h)
    return np.array([*end.q, *end.p, moved[-2] + step.duration(end, q, p, h)], dtype=object)
