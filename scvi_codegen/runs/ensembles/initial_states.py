"""Validation of the initial states and parameters of ensembles."""

from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from scvi_codegen.codegen.native.cuda import Device, has_device_memory
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.events.contacts import in_first_modes
from scvi_codegen.runs.states.validation import Array, EnsembleParameters, States, check_inputs_given
from scvi_codegen.runs.states.words import stacked
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import make_consistent
from scvi_codegen.runs.stepping.state_functions import neither_or_both


def on_processor(value: Any) -> Any:
    """Return a copy on the processor of an array of a GPU, alone or in a mapping; other values unchanged."""
    if isinstance(value, Mapping):
        return {name: on_processor(entry) for name, entry in value.items()}
    return Device().copy_of(value) if has_device_memory(value) else value


def checked_ensemble(stepper: Integrator, q: States, other: States, name: str) -> tuple[Array, Array]:
    """Return validated (k, m) initial positions, and momenta or velocities ``name``."""
    positions, others = stepper._states.members(q, "q"), stepper._states.members(other, name)
    if positions.shape != others.shape:
        raise StateError(f"q and {name} must have equal shapes, not {positions.shape} and {others.shape}")
    return positions, others


def momenta_of_each(
    stepper: Integrator, q: States, p: States | None, velocity: States | None, t: float, parameters: EnsembleParameters
) -> States:
    """Return the momenta of states specified by p or by velocity, each with its own parameters."""
    if (p is None) == (velocity is None):
        raise neither_or_both(p)
    if velocity is None:
        return cast(States, p)
    positions, velocities = checked_ensemble(stepper, q, velocity, "velocity")
    t, values = stepper._states.time(t), stepper._states.parameters_of_each(parameters, len(positions))
    interface = stepper.interface
    if interface.words > 1 or interface.in_tau or interface.layout.momenta:
        starts = zip(positions, velocities, values, strict=True)
        return stacked([stepper.initial_momentum(position, v, t, value) for position, v, value in starts])
    momenta = np.empty_like(positions)  # p = dL/dv
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
    positions, momenta = checked_ensemble(stepper, q, p, "p")
    values = stepper._states.parameters_of_each(parameters, len(positions))
    if stepper.interface.constraints:
        if stepper.interface.words == 1:
            positions, momenta = (np.ascontiguousarray(each) for each in (positions, momenta))
        if stepper.interface.contacts:
            for k, start in enumerate(zip(positions.copy(), momenta.copy(), values, strict=True)):
                positions[k], momenta[k] = in_first_modes(stepper, *start[:2], t, start[2])
        else:
            make_consistent(stepper, positions, momenta, t, values)
    return positions, momenta, values
