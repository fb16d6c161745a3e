"""Validation of the arguments of ensembles: common fixed steps or adaptive steps, with or without inputs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, real_array
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import States, check_left_to_inputs
from scvi_codegen.runtime.ensemble.ensemble import Ensemble
from scvi_codegen.runtime.ensemble.initial_states import (
    EnsembleParameters,
    checked_ensemble,
    momenta_of_each,
    parameters_of_each,
)
from scvi_codegen.runtime.inputs.segments import Input, checked_inputs, final_time, first_inner_time, parameters_at

EITHER = "give either h with steps or t_end (fixed step size), or t_end alone (adaptive step size)"


def ensemble_work(
    stepper: Integrator,
    q: States,
    p: States | None,
    *,
    inputs: Mapping[str, Any] | None = None,
    velocity: States | None = None,
    h: float | None = None,
    steps: int | None = None,
    t_end: ArrayLike | None = None,
    tolerance: float | None = None,
    t_eval: ArrayLike | None = None,
    t: float,
    parameters: EnsembleParameters,
    **others: Any,
) -> Ensemble:
    """Return an ensemble; arguments as of :meth:`Stepper.integrate_ensemble`.

    Raises:
        StateError: if a shape, name or number is invalid, or the stepper has a time transformation.
    """
    if inputs is not None and t_eval is not None:
        raise StateError("t_eval is not supported with inputs: omit t_eval")
    if h is not None:
        end = _end_of_common_steps(t, h, steps, t_end, inputs, tolerance=tolerance, t_eval=t_eval)
        steps, t_end = (steps, None) if end is None else (None, end)
    elif t_end is None or steps is not None:
        raise StateError(EITHER)
    if stepper.interface.time_transformation:
        raise StateError("ensembles do not support time_transformation: compile the stepper without it")
    data: dict[str, Input] | None = None
    if inputs is not None:
        count = len(checked_ensemble(stepper, q, q)[0])
        data = checked_inputs(stepper.interface, inputs, count)
        check_left_to_inputs(stepper.interface, parameters)
        inside = first_inner_time(t, float(real_array(0.0 if t_end is None else t_end, "t_end").flat[0]))
        parameters = parameters_at(stepper.parameters, parameters_of_each(stepper, parameters, count), data, inside)
    p = momenta_of_each(stepper, q, p, velocity, t, parameters)
    plan: dict[str, Any] = {"h": h, "steps": steps, "t_end": t_end, "tolerance": tolerance, "t_eval": t_eval}
    return Ensemble(stepper, q, p, inputs=data, t=t, parameters=parameters, **plan, **others)


def _end_of_common_steps(
    t: float, h: float, steps: int | None, t_end: ArrayLike | None, inputs: object, **adaptive: object
) -> float | None:
    """Return the final time of fixed steps, ``None`` if their number suffices.

    Raises:
        StateError: for missing or contradictory arguments.
    """
    if steps is None and t_end is None and inputs is None:
        raise StateError(EITHER)
    if steps is not None and t_end is not None and inputs is None:
        raise StateError(f"give either steps={steps} or t_end with h, not both")
    for name, value in adaptive.items():
        if value is not None:
            raise StateError(f"{name} requires adaptive steps: give t_end without h and steps")
    if t_end is not None and np.ndim(t_end):
        raise StateError("with h all trajectories have one t_end: give one number, or omit h (adaptive step size)")
    if inputs is None and t_end is None:
        return None
    return final_time(t, h, steps, None if t_end is None else checked_number(t_end, "t_end"))
