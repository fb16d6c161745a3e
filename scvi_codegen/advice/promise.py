"""What an advised step promised, checked on the whole run that was made with it."""

from __future__ import annotations

import math

import numpy as np

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
INSTEAD = "let steps choose their length (t_end, --tolerance)"


def broken_promise(system: MechanicalSystem, trajectory: Trajectory | DrivenTrajectory, tolerance: float) -> str:
    """Why the error of a run at its end is not below ``tolerance``, whatever was expected; ``""`` if nothing tells so.

    The worst step must be right to the tolerance; and where the energy is conserved, it must be.
    """
    if trajectory.step_error > STEP_MARGIN * tolerance:
        return (
            f"the tolerance {tolerance:g} is not kept: the step from t = {trajectory.step_error_t:g} alone has a "
            f"relative error of about {trajectory.step_error:.1e}; {INSTEAD}"
        )
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
    return (
        f"the tolerance {tolerance:g} is not kept: the energy, which the motion conserves, is off by {change:.1e}; "
        f"{INSTEAD}"
    )
