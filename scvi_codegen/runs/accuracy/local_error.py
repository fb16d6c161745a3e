"""Warnings at the end of a run: steps too large for the motion, conserved energies that change, unresolved fields."""

import math
import sys
from typing import Any, Final

import numpy as np

from scvi_codegen.common.errors import AccuracyWarning, StateError, warn
from scvi_codegen.runs.accuracy.resolution import warn_of_unresolved_fields
from scvi_codegen.runs.accuracy.size import LOST, RESOLVED, roundoff
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted
from scvi_codegen.runs.results.energy import energy_reason
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Adaptive, FixedSteps

TOLERABLE_ERROR: Final = 1e-3
"""Largest relative error of a step, and largest relative change of the energy of a run, without a warning."""

SUMMED: Final = 10.0
"""Tolerances of an adaptive run by which its energy may change without a warning, by judgement; at most ``LOST``."""

ADAPTIVE_REMEDY: Final = ", or use adaptive steps (t_end= without h)"

MOST_CHECKED: Final = 1000
"""Largest number of trajectories of an ensemble whose energy is checked."""

ERROR_AMPLIFIED: Final = (
    "although every step met the tolerance: errors of steps accumulate, and unstable motions amplify them. Reduce the "
    "tolerance; near collisions use regularised coordinates, too"
)
FIXED_STEP_REMEDY: Final = (
    "although the system conserves it: h is too large for the fastest part of the motion. Reduce h, or use an SVI with "
    "adaptive steps (t_end=)"
)


def tolerable_change(plan: Any) -> float:
    """Return the largest relative change of the energy of a run, or error of its fixed steps, without a warning."""
    return min(LOST, max(TOLERABLE_ERROR, SUMMED * (getattr(plan, "tolerance", None) or 0.0)))


def warn_of_inaccuracy(trajectory: SavedStates, run: Memory, *, before: float = 0.0) -> None:
    """Issue the warnings of large steps, of energy errors and of unresolved fields for the states of a run."""
    error = trajectory.step_error
    if error > TOLERABLE_ERROR:
        warn_of_large_steps(trajectory, before=before)
    if error != error or not isinstance(trajectory.plan, FixedSteps):
        warn_of_energy_error(trajectory, run)
    if trajectory.stepper.interface.layout.mesh is not None:
        warn_of_unresolved_fields(trajectory)


def warn_of_large_steps(trajectory: SavedStates, *, before: float = 0.0, remedy: str = ADAPTIVE_REMEDY) -> None:
    """Issue an :class:`AccuracyWarning` for the worst fixed step, unless an error ``before`` already caused one."""
    error = trajectory.step_error
    if not error > TOLERABLE_ERROR:
        return
    if isinstance(trajectory.plan, Adaptive) or before > TOLERABLE_ERROR or not warnings_wanted():
        return
    size = "unknown: parts of it have no solution" if math.isinf(error) else f"about {error:.1e} (estimated)"
    warn(
        f"the step size h = {trajectory.h:g} is too large: the relative error of the step from "
        f"t = {trajectory.worst_step_time:g} is {size}. Reduce h{remedy}",
        AccuracyWarning,
    )


def warn_of_energy_error(trajectory: SavedStates, run: Memory) -> None:
    """Issue an :class:`AccuracyWarning` if an adaptive run does not conserve an energy that the system conserves.

    Runs over arrays of run-time sizes with fixed steps and no error estimate are checked for gross errors.
    """
    plan, stepper = trajectory.plan, trajectory.stepper
    is_adaptive = isinstance(plan, Adaptive)
    if not is_adaptive:
        has_estimate = trajectory.step_error == trajectory.step_error
        if not isinstance(plan, FixedSteps) or has_estimate or not stepper.interface.layout.coordinates:
            return
    if not stepper.interface.conserves_energy or not warnings_wanted():
        return
    ends, tolerable = run._end_energies(trajectory.t, trajectory.q, trajectory.p), tolerable_change(plan)
    if ends is None or not abs(ends[1] - ends[0]) > 0.5 * tolerable * max(abs(ends[0]), abs(ends[1])):
        return
    if getattr(trajectory, "modes", None) is not None or stepper.in_tau:
        ends = None  # of the modes of the last state, or divided by rates
    if not energy_reason(stepper) and (energies := _changed_energies(trajectory, ends, tolerable)):
        if is_adaptive:
            warn_of_energies(*energies, tolerable=tolerable)
        else:
            warn_of_energies(*energies, tolerable=LOST, why=FIXED_STEP_REMEDY)


def warn_of_energy_errors(ensemble: Any, ends: Array | None = None) -> None:
    """Issue the warning of :func:`warn_of_energy_error` for the worst of ``MOST_CHECKED`` trajectories.

    ``ends``: (k, 2) energies of the first and the last state where they are known, else NaN.
    """
    plans, stepper = ensemble.plans, ensemble.stepper
    if energy_reason(stepper) or not (plans and stepper.interface.conserves_energy and warnings_wanted()):
        return
    by_trajectory, stride, tolerable = {}, -(-len(plans) // MOST_CHECKED), tolerable_change(plans[0])
    checked = np.arange(0, len(plans), stride)
    if ends is not None:
        first, last = np.abs(ends[checked]).T, np.abs(np.diff(ends[checked])[:, 0])
        checked = checked[~(last <= 0.5 * tolerable * np.maximum(first[0], first[1]))]
    for j in checked.tolist():
        if ensemble._reached(j).any() and (energies := _changed_energies(ensemble[j], None, tolerable)):
            by_trajectory[j] = energies
    worst = max(by_trajectory, key=lambda j: relative_energy_change(*by_trajectory[j]), default=None)
    if worst is not None:
        warn_of_energies(*by_trajectory[worst], tolerable=tolerable, where=f" of trajectory {worst}")


def warn_of_energies(
    first: float,
    last: float,
    size: float,
    *,
    tolerable: float = TOLERABLE_ERROR,
    where: str = "",
    why: str = ERROR_AMPLIFIED,
) -> None:
    """Issue an :class:`AccuracyWarning` if a conserved energy differs between the first and the last state.

    Args:
        first, last: energies of the first and the last state.
        size: scale of the energy terms (largest |p.v|), for energies near zero.
        tolerable: tolerated change relative to the largest of the three.
        where: description of the trajectory, appended to "the energy".
        why: probable cause and remedy.
    """
    if relative_energy_change(first, last, size) > tolerable and warnings_wanted():
        warn(f"the energy{where} changed from {first:.3g} to {last:.3g} {why}", AccuracyWarning)


def relative_energy_change(first: float, last: float, size: float) -> float:
    """Return the relative change of an energy; 0 if it is NaN."""
    part = abs(last - first) / max(abs(first), abs(last), size, sys.float_info.min)
    return part if part == part else 0.0


def _changed_energies(
    states: SavedStates, ends: tuple[float, float] | None, tolerable: float
) -> tuple[float, float, float] | None:
    """Return the first and the last energy and the largest |p.v| if the energy changed; ``None`` otherwise.

    ``None`` is also returned outside the domain of L, and at rest up to rounding, where the energy is that of rounding
    errors. ``ends``: the energies if they are known. Velocities are computed only if these differ.
    """
    stepper, q = states.stepper, np.asarray(states.q)
    sides = [(k, states.parameters_on_sides(states.t[k])) for k in (0, -1)]
    try:
        first, last = ends or (
            float(stepper._energies_of(states.t[[k]], states.q[[k]], states.p[[k]], parameters)[0])
            for k, parameters in sides
        )
        if not relative_energy_change(first, last, 0.0) > tolerable:
            return None
        if (np.ptp(q, axis=0) <= RESOLVED * roundoff(stepper.interface.words) * np.abs(q).max(axis=0)).all():
            return None
        states_at = [(states.t[k], q[k], states.p[k], parameters.copy()) for k, parameters in sides]
        sizes = [abs(np.dot(at[2], stepper._transformed("velocity", *at))) for at in states_at]
    except StateError:
        return None
    return first, last, float(max(sizes))
