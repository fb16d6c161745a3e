"""What an advised step promised, checked on the whole run that was made with it."""

from __future__ import annotations

import math

import numpy as np

from scvi_codegen.advice.known_digits import SECOND_RUN, Known, known_digits
from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.runtime.driven_trajectory import DrivenTrajectory
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["broken_promise"]

STEP_MARGIN = 10.0
"""What the estimate of the error of a step may be off by, where steps are so long that few digits are right."""
ENERGY_MARGIN = 100.0
"""Energies may be off by so many times more, as part of their size, than positions: near a collision they are."""
ROUNDING = 1e-11
SECOND_MARGIN, KNOWN_TO = 2.0, 1e-12
"""A second run tells of the last sixteenth, of whose errors that at the end may be the least; it has errors, too."""
INSTEAD = "let steps choose their length (t_end, --tolerance)"


def broken_promise(
    system: MechanicalSystem,
    trajectory: Trajectory | DrivenTrajectory,
    tolerance: float,
    known: Known | None = None,
) -> str:
    """Why the error of a run at its end is not below ``tolerance``, whatever was expected; ``""`` if nothing tells so.

    A second run decides, if there is one. Without, the worst step must be right to the tolerance; and where the energy
    is conserved, it must be. The error of a step is often estimated as more than it is: who fails so is run again.

    Args:
        system: what moves.
        trajectory: the run, each of its states at a whole step.
        tolerance: |q - q_exact| / |q| that was promised for its end.
        known: what a second run told of the end.
    """
    doubt = _worst_step(trajectory, tolerance) or _lost_energy(system, trajectory, tolerance)
    if known is None and doubt:
        known = known_digits(system, trajectory, most=SECOND_RUN + 4 * trajectory.steps)
    if known is None or known.chaotic:
        return f"{doubt}; {INSTEAD}" if doubt else ""
    error = float(np.linalg.norm(known.q)) / (_late_size(trajectory) or 1.0)
    if error <= SECOND_MARGIN * tolerance + KNOWN_TO:
        return ""
    said = doubt or f"the tolerance {tolerance:g} is not kept"
    return f"{said}: a second run, of other steps, ends {error:.1e} away; {INSTEAD}"


def _late_size(trajectory: Trajectory | DrivenTrajectory) -> float:
    """Of the states whose errors a second run tells."""
    late = trajectory.q[-max(1, len(trajectory.q) // 16) :]
    return float(np.linalg.norm(np.maximum(np.abs(late[-1]), np.sqrt(np.mean(late**2, axis=0)))))


def _worst_step(trajectory: Trajectory | DrivenTrajectory, tolerance: float) -> str:
    if not trajectory.step_error > STEP_MARGIN * tolerance:
        return ""
    return (
        f"the tolerance {tolerance:g} is not kept: the step from t = {trajectory.step_error_t:g} alone has a "
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
    return f"the tolerance {tolerance:g} is not kept: the energy, which the motion conserves, is off by {change:.1e}"
