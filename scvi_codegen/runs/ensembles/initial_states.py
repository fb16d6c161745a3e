"""Validation of the initial states and parameters of ensembles."""

from collections.abc import Mapping
from typing import cast

import numpy as np

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import (
    Array,
    EnsembleParameters,
    States,
    check_inputs_given,
    check_lengths,
    flat_state,
    parameter_columns,
)
from scvi_codegen.runs.states.words import checked_time, split, stacked, with_low
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import make_consistent
from scvi_codegen.runs.stepping.state_functions import neither_or_both


def checked_ensemble(stepper: Integrator, q: States, p: States) -> tuple[Array, Array]:
    """Return validated (k, m) initial positions and momenta."""
    positions, momenta = _states(stepper, q, "q"), _states(stepper, p, "p")
    if positions.shape != momenta.shape:
        raise StateError(f"q and p must have equal shapes, not {positions.shape} and {momenta.shape}")
    return positions, momenta


def momenta_of_each(
    stepper: Integrator, q: States, p: States | None, velocity: States | None, t: float, parameters: EnsembleParameters
) -> States:
    """Return the momenta of states specified by p or by velocity, each with its own parameters."""
    if (p is None) == (velocity is None):
        raise neither_or_both(p)
    if velocity is None:
        return cast(States, p)
    t = checked_time(t, stepper.interface.words)
    positions = _states(stepper, q, "q")
    velocities = _states(stepper, velocity, "velocity")
    if positions.shape != velocities.shape:
        raise StateError(f"q and velocity must have equal shapes, not {positions.shape} and {velocities.shape}")
    values = parameters_of_each(stepper, parameters, len(positions))
    interface = stepper.interface
    if interface.words > 1 or interface.in_tau or interface.layout.momenta:
        states = zip(positions, velocities, values, strict=True)
        return stacked([stepper.initial_momentum(position, v, t, value) for position, v, value in states])
    momenta = np.empty_like(positions)
    done = stepper.binding.of_each("momenta", t, values, positions, velocities, momenta)
    dropped = ((momenta[:done] == 0.0) & (velocities[:done] != 0.0)).any(axis=1)
    for j in (*np.flatnonzero(dropped).tolist(), *range(done, len(momenta))):
        momenta[j] = stepper.initial_momentum(positions[j], velocities[j], t, values[j])  # may raise
    return momenta


def start_of_ensemble(
    stepper: Integrator, q: States, p: States, t: float, parameters: EnsembleParameters
) -> tuple[Array, Array, Array]:
    """Return (k, m) positions and momenta, projected onto constraints, and (k, number of parameters) parameters."""
    check_inputs_given(stepper.interface, parameters)
    positions, momenta = checked_ensemble(stepper, q, p)
    values = parameters_of_each(stepper, parameters, len(positions))
    if stepper.interface.constraints:
        if stepper.interface.words == 1:
            positions, momenta = (np.ascontiguousarray(each) for each in (positions, momenta))
        make_consistent(stepper, positions, momenta, t, values)
    return positions, momenta, values


def _states(stepper: Integrator, value: States, name: str) -> Array:
    """Return a validated (k, m) array of finite numbers."""
    value, low = split(value, name) if stepper.interface.words > 1 else (value, None)
    array = real_array(flat_state(stepper.interface, value, name), name)
    if array.ndim == 1:
        array = array[np.newaxis]
    if array.ndim != 2 or array.shape[1] != stepper.dimension or len(array) == 0:
        raise StateError(f"{name} must have shape (k, {stepper.dimension}), not {array.shape}")
    if not np.isfinite(array).all():
        j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(array)))
        raise StateError(f"{name}[{j}, {i}] ({stepper.coordinates[i]}) is {array[j, i]}: it must be finite")
    if low is None:
        return array
    words: Array = with_low(
        array, np.asarray(flat_state(stepper.interface, low, name), dtype=float).reshape(array.shape)
    )
    return words


def parameters_of_each(stepper: Integrator, argument: EnsembleParameters, count: int) -> Array:
    """Return (k, number of parameters) values: defaults overridden by name (one or k numbers each) or by an array."""
    defaults = np.asarray(stepper.defaults, dtype=float)
    if stepper.interface.words > 1:
        parts = zip(split(argument, "parameters"), (defaults, np.zeros_like(defaults)), strict=True)
        high, low = (_parameters_of_each(stepper, part, count, default) for part, default in parts)
        values: Array = with_low(high, low)
    else:
        values = _parameters_of_each(stepper, argument, count, defaults)
    for j, each in enumerate(values if stepper.interface.lengths else ()):
        check_lengths(stepper.interface, each, f" of trajectory {j}")
    return values


def _parameters_of_each(stepper: Integrator, argument: EnsembleParameters, count: int, defaults: Array) -> Array:
    names = stepper.parameters
    values = np.empty((count, len(defaults)))
    values[:] = defaults
    if isinstance(argument, Mapping):
        for name, where, value in parameter_columns(stepper.interface, argument):
            column = real_array(value, f"the parameter {name}")
            each = column.shape[:-1] if isinstance(where, slice) else column.shape
            if each not in ((), (count,)):
                raise StateError(
                    f"the parameter {name} must be one number or {count} numbers, not of shape {column.shape}"
                )
            values[:, where] = column
    elif argument is not None:
        array = real_array(argument, "parameters")
        if array.shape not in ((len(names),), (count, len(names))):
            raise StateError(f"parameters must have shape ({count}, {len(names)}), not {array.shape}")
        values[:] = array
    if not np.isfinite(values).all():
        j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(values)))
        raise StateError(f"the parameter {names[i]} of trajectory {j} is {values[j, i]}: it must be finite")
    return values
