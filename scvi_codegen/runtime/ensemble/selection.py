"""Selection of the ensemble class: common fixed steps or adaptive steps of each trajectory, with or without inputs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, real_array
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, States, check_left_to_inputs
from scvi_codegen.runtime.ensemble.independent import AdaptiveEnsemble
from scvi_codegen.runtime.ensemble.initial_states import (
    EnsembleParameters,
    checked_ensemble,
    momenta_of_each,
    parameters_of_each,
)
from scvi_codegen.runtime.ensemble.lockstep import Ensemble
from scvi_codegen.runtime.inputs.segments import Input, checked_inputs, final_time, first_inner_time, parameters_at


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
) -> Ensemble | AdaptiveEnsemble:
    """Return an ensemble; arguments as of :meth:`Stepper.integrate_ensemble`.

    Raises:
        StateError: if a shape, name or number is invalid, or the stepper has a time transformation.
    """
    if inputs is not None or (h is not None and t_end is not None and steps is None):
        if t_eval is not None:
            if inputs is None:
                raise StateError("t_eval requires adaptive steps: omit h")
            raise StateError("t_eval is not supported with inputs: omit t_eval")
        interval: dict[str, Any] = {"h": h, "steps": steps, "t_end": t_end, "tolerance": tolerance}
        return _work_with_inputs(
            stepper, q, p, inputs=inputs or {}, velocity=velocity, t=t, parameters=parameters, **interval, **others
        )
    _check_no_time_transformation(stepper)
    p = momenta_of_each(stepper, q, p, velocity, t, parameters)
    common = {"t": t, "parameters": parameters, **others}
    if h is None and steps is None and t_end is not None:
        return AdaptiveEnsemble(stepper, q, p, t_end=t_end, tolerance=tolerance, t_eval=t_eval, **common)
    h, steps = _common_steps(h, steps, t_end=t_end, tolerance=tolerance, t_eval=t_eval)
    return Ensemble(stepper, q, p, h=h, steps=steps, **common)


def _common_steps(h: float | None, steps: int | None, **others: object) -> tuple[float, int]:
    """Return h and steps of a fixed-step ensemble; raise ``StateError`` for missing or contradictory arguments."""
    names = [name for name, value in others.items() if value is not None]
    if h is None or steps is None:
        raise StateError("give either h with steps or t_end (fixed step size), or t_end alone (adaptive step size)")
    if others["t_end"] is not None:
        raise StateError(f"give either steps={steps} or t_end with h, not both")
    if names:
        raise StateError(f"{names[0]} requires adaptive steps: give t_end without h and steps")
    return h, steps


def _work_with_inputs(
    stepper: Integrator,
    q: States,
    p: States | None,
    *,
    inputs: Mapping[str, Any],
    velocity: States | None = None,
    h: float | None = None,
    steps: int | None = None,
    t_end: ArrayLike | None = None,
    tolerance: float | None = None,
    t: float,
    parameters: EnsembleParameters,
    **others: Any,
) -> Ensemble | AdaptiveEnsemble:
    """Return an ensemble with inputs; arguments as of :meth:`Stepper.integrate_ensemble`.

    Raises:
        StateError: as :func:`~scvi_codegen.runtime.inputs.segments.checked_inputs`, and if the stepper has a time
            transformation.
    """
    make: partial[Ensemble] | partial[AdaptiveEnsemble]
    if h is not None:
        if tolerance is not None:
            raise StateError("tolerance requires adaptive steps: give t_end without h and steps")
        if t_end is not None and np.ndim(t_end):
            raise StateError("with h all trajectories have one t_end: give one number, or omit h (adaptive step size)")
        towards = final_time(t, h, steps, None if t_end is None else checked_number(t_end, "t_end"))
        make = partial(Ensemble, h=h, t_end=towards)
    elif t_end is None or steps is not None:
        raise StateError("give either h with steps or t_end (fixed step size), or t_end alone (adaptive step size)")
    else:
        towards = float(real_array(t_end, "t_end").flat[0])
        make = partial(AdaptiveEnsemble, t_end=t_end, tolerance=tolerance)
    data, p, start = _start_with_inputs(stepper, q, p, velocity, inputs, (t, towards), parameters)
    return make(stepper, q, p, inputs=data, t=t, parameters=start, **others)


def _start_with_inputs(
    stepper: Integrator,
    q: States,
    p: States | None,
    velocity: States | None,
    inputs: Mapping[str, Any],
    interval: tuple[float, float],
    parameters: EnsembleParameters,
) -> tuple[dict[str, Input], States, Array]:
    """Return inputs, momenta and (k, number of parameters) initial parameters; ``interval``: (start, final time).

    Raises:
        StateError: as :func:`~scvi_codegen.runtime.inputs.segments.checked_inputs`, and if the stepper has a time
            transformation.
    """
    _check_no_time_transformation(stepper)
    count = len(checked_ensemble(stepper, q, q)[0])
    data = checked_inputs(stepper.interface, inputs, count)
    check_left_to_inputs(stepper.interface, parameters)
    values = parameters_of_each(stepper, parameters, count)
    start = parameters_at(stepper.parameters, values, data, first_inner_time(*interval))
    return data, momenta_of_each(stepper, q, p, velocity, interval[0], start), start


def _check_no_time_transformation(stepper: Integrator) -> None:
    if stepper.interface.time_transformation:
        raise StateError("ensembles do not support time_transformation: compile the stepper without it")
