"""Verification, on the whole run, of the error for which a step size was recommended."""

from __future__ import annotations

import math

import numpy as np

from scvi_codegen.advice.significant_digits import SECOND_RUN, Known, known_digits
from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.runtime.inputs.trajectory_with_inputs import DrivenTrajectory
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

__all__ = ["missed_tolerance"]

STEP_MARGIN = 10.0
"""Safety factor for the estimate of the local error, which is inaccurate for large steps."""
ENERGY_MARGIN = 100.0
"""Ratio of the relative energy error allowed to the tolerance; energies are sensitive near collisions."""
ROUNDING = 1e-11
"""Relative energy error that round-off may cause."""
SECOND_MARGIN, SECOND_RUN_ERROR = 2.0, 1e-12
"""Safety factor and absolute slack for the error measured with a second run, which has errors, too."""
REMEDY = "use adaptive step size (t_end, --tolerance)"
"""Remedy that the messages name."""


def missed_tolerance(
    system: MechanicalSystem,
    trajectory: Trajectory | DrivenTrajectory,
    tolerance: float,
    known: Known | None = None,
) -> str:
    """Return why the error at the end of a run exceeds ``tolerance``; ``""`` if there is no evidence for it.

    The comparison with a second run decides, if there is one. Otherwise the largest local error and the energy error,
    if energy is conserved, are compared with the tolerance. These estimates are often too large; a run that fails them
    is compared with a second run.

    Args:
        system: mechanical system.
        trajectory: run whose states are all at the ends of steps.
        tolerance: error |q - q_exact| / |q| for which the step size was recommended.
        known: error estimate from a second run.
    """
    doubt = _worst_step(trajectory, tolerance) or _lost_energy(system, trajectory, tolerance)
    if known is None and doubt:
        known = known_digits(system, trajectory, most=SECOND_RUN + 4 * trajectory.steps)
    if known is None or known.chaotic:
        return f"{doubt}; {REMEDY}" if doubt else ""
    error = float(np.linalg.norm(known.q)) / (_late_size(trajectory) or 1.0)
    if error <= SECOND_MARGIN * tolerance + SECOND_RUN_ERROR:
        return ""
    message = doubt or f"the tolerance {tolerance:g} is missed"
    return f"{message}: a second run with other steps differs by {error:.1e} at the end; {REMEDY}"


def _late_size(trajectory: Trajectory | DrivenTrajectory) -> float:
    """Return the size of the last states, whose errors a second run measures."""
    late = trajectory.q[-max(1, len(trajectory.q) // 16) :]
    return float(np.linalg.norm(np.maximum(np.abs(late[-1]), np.sqrt(np.mean(late**2, axis=0)))))


def _worst_step(trajectory: Trajectory | DrivenTrajectory, tolerance: float) -> str:
    if not trajectory.step_error > STEP_MARGIN * tolerance:
        return ""
    return (
        f"the tolerance {tolerance:g} is missed: the step from t = {trajectory.worst_step_time:g} alone has a "
        f"relative error of about {trajectory.step_error:.1e}"
    )


def _lost_energy(system: MechanicalSystem, trajectory: Trajectory | DrivenTrajectory, tolerance: float) -> str:
    if system.changes_energy:
        return ""
    try:
        energy = trajectory.energy()
    except StateError:
        return ""
    size = float(np.abs(energy).max() + np.abs(trajectory.p * trajectory.velocity).sum(axis=1).max())
    change = float(np.abs(energy - energy[0]).max()) / (size or 1.0)
    if math.isfinite(change) and change <= ENERGY_MARGIN * tolerance + ROUNDING:
        return ""
    return f"the tolerance {tolerance:g} is missed: the conserved energy has a relative error of {change:.1e}"
