"""Validation of the initial states and parameters of ensembles."""

from typing import cast

import numpy as np

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array, EnsembleParameters, States, check_inputs_given
from scvi_codegen.runs.states.words import stacked
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import make_consistent
from scvi_codegen.runs.stepping.state_functions import neither_or_both


def checked_ensemble(stepper: Integrator, q: States, p: States) -> tuple[Array, Array]:
    """Return validated (k, m) initial positions and momenta."""
    positions, momenta = stepper._states.members(q, "q"), stepper._states.members(p, "p")
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
    states = stepper._states
    t, positions, velocities = states.time(t), states.members(q, "q"), states.members(velocity, "velocity")
    if positions.shape != velocities.shape:
        raise StateError(f"q and velocity must have equal shapes, not {positions.shape} and {velocities.shape}")
    values = stepper._states.parameters_of_each(parameters, len(positions))
    interface = stepper.interface
    if interface.words > 1 or interface.in_tau or interface.layout.momenta:
        starts = zip(positions, velocities, values, strict=True)
        return stacked([stepper.initial_momentum(position, v, t, value) for position, v, value in starts])
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
    values = stepper._states.parameters_of_each(parameters, len(positions))
    if stepper.interface.constraints:
        if stepper.interface.words == 1:
            positions, momenta = (np.ascontiguousarray(each) for each in (positions, momenta))
        make_consistent(stepper, positions, momenta, t, values)
    return positions, momenta, values
