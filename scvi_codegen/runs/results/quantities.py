"""Derived quantities of states: velocities, energies, momentum maps; NaN where undefined."""

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.results.saved_states import SavedStates, in_modes, parameters_on_sides
from scvi_codegen.runs.states.rotation_quantities import values_by_name
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator


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
    return quantities(states.stepper, parameters_on_sides(states, float(states.t[0])), t, q, p)


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
