"""Derived quantities of states: velocities, energies, momentum maps; NaN where undefined."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.representation import one_line
from scvi_codegen.runs.results.saved_states import SavedStates, in_modes
from scvi_codegen.runs.states.rotation_quantities import values_by_name
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import FixedSteps, StepPlan


def describe_run(run: Memory) -> str:
    """Return ``<Run of TITLE; t = 3 after 30 steps of 0.1, solver fixed-point>``."""
    interface, unset = run.stepper.interface, ", ".join(run._unset_inputs)
    plan = "" if isinstance(run.plan, FixedSteps) else f", t_end = {run.plan.t_end:g}"
    solved = f", solver {interface.solver}" if interface.solver else ""
    steps = f"{run.steps} steps{describe_step_size(run._step_size, run.plan, tau=interface.in_tau)}"
    waits = f", inputs not set: {unset}" if unset else ""
    return one_line(run, short_title(interface), f"t = {run.t:g} after {steps}{plan}{solved}{waits}")


def describe_states(result: SavedStates, lengths: str) -> str:
    """Return ``<Trajectory of TITLE; 31 states from t = 0 to 3, 30 steps of 0.1>``; ``lengths`` follows "steps"."""
    span = f"{len(result.t)} states from t = {result.t[0]:g} to {result.t[-1]:g}"
    return one_line(result, short_title(result.stepper.interface), f"{span}, {result.steps} steps{lengths}")


def short_title(interface: Interface) -> str:
    """Return the system and the short name of the method."""
    return f"{interface.system}, {interface.method}"


def describe_step_size(h: float, plan: StepPlan, *, tau: bool) -> str:
    """Describe the step size of a run."""
    if isinstance(plan, FixedSteps):
        return f" of {h:g} in tau" if tau else f" of {h:g}"
    return f" {plan.sizes}"


def quantities(stepper: Integrator, parameters: Array, t: Array, q: Array, p: Array) -> dict[str, Array]:
    """Return velocity (n, m), energy (n,), momentum_map (n, c) and attitudes (if there are any) of n states."""
    rows_of_states = np.flatnonzero(np.isfinite(q).all(axis=1) & np.isfinite(p).all(axis=1))
    per_time = np.full(len(t), np.nan)
    _fill(per_time, rows_of_states, lambda rows: stepper.rates(q[rows], p[rows], parameters))
    velocity = _velocities(stepper, parameters, t, q, p)
    if stepper.interface.words > 1:
        _fill(velocity, rows_of_states, lambda rows: stepper.velocity(q[rows], p[rows], t[rows], parameters))
    result = {"velocity": velocity / per_time[:, np.newaxis], "energy": np.full(len(t), np.nan)}
    _fill(result["energy"], rows_of_states, lambda rows: stepper.energy(q[rows], p[rows], t[rows], parameters))
    if names := stepper.momentum_map_names:
        result["momentum_map"] = np.full((len(t), len(names)), np.nan)
        maps = partial(stepper.momentum_maps, parameters=parameters)
        _fill(result["momentum_map"], rows_of_states, lambda rows: maps(q[rows], p[rows], t[rows]))
    return result | values_by_name(stepper.interface, q, p, result["velocity"])


def quantities_of(states: SavedStates, t: Array, q: Array, p: Array) -> dict[str, Array]:
    """Return the quantities of some of the states of a run that keeps its modes."""
    return quantities(states.stepper, states.parameters_on_sides(float(states.t[0])), t, q, p)


def quantities_in_modes(states: SavedStates) -> dict[str, Array]:
    """Return the quantities of the states of a run, with the modes after each state."""
    parts = list[dict[str, Array]]()

    def times(q: Any, p: Any, t: Array, parameters: Array) -> Array:
        parts.append(quantities(states.stepper, parameters, t, q, p))
        return t

    in_modes(states, times)
    return {name: np.concatenate([part[name] for part in parts]) if parts[1:] else parts[0][name] for name in parts[0]}


def _fill(into: Array, rows: NDArray[np.intp], compute: Callable[[NDArray[np.intp]], Array]) -> None:
    """Fill rows in one call; on failure divide them recursively, so that only failing rows stay NaN."""
    try:
        into[rows] = compute(rows)
    except StateError:
        for half in np.array_split(rows, 2) if len(rows) > 1 else ():
            _fill(into, half, compute)


def _velocities(stepper: Integrator, parameters: Array, t: Array, q: Array, p: Array) -> Array:
    """Return (n, m) velocities by unchecked C calls, for exports with many millions of states."""
    binding, (n, m) = stepper.binding, q.shape
    result = np.full((n, m), np.nan)
    if stepper.interface.words > 1:
        return result
    positions, momenta = np.ascontiguousarray(q), np.ascontiguousarray(p)
    velocity, workspace, values = binding.function("velocity"), binding.workspace(), binding.pointer(parameters)
    q0, p0, v0 = (binding.pointer(array) for array in (positions, momenta, result))
    with suppress(StateError):  # arrays of a system defined by a Hamiltonian have no velocities
        for row, time in enumerate(t.tolist()):
            if velocity(time, q0 + row * m, p0 + row * m, values, v0 + row * m, workspace):
                result[row] = np.nan
    return result
