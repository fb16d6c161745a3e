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
SECOND_MARGIN = 2.0
"""A second run tells of the last sixteenth of a run, of whose errors that at the end may be the least."""
INSTEAD = "let steps choose their length (t_end, --tolerance)"


def broken_promise(
    system: MechanicalSystem,
    trajectory: Trajectory | DrivenTrajectory,
    tolerance: float,
    known: Known | None = None,
) -> str:
    """Why the error of a run at its end is not below ``tolerance``, whatever was expected; ``""`` if nothing tells so.

    The worst step must be right to the tolerance; and where the energy is conserved, it must be. What a step is wrong
    by is estimated, often as more than it is: where it is too much, a second run decides, if it can (``known``).
    """
    doubt = _worst_step(trajectory, tolerance) or _lost_energy(system, trajectory, tolerance)
    if not doubt:
        return ""
    known = known or known_digits(system, trajectory, most=SECOND_RUN + 4 * trajectory.steps)
    if known is None or known.chaotic:
        return f"{doubt}; {INSTEAD}"
    error = float(np.linalg.norm(known.q)) / (float(np.linalg.norm(trajectory.q[-1])) or 1.0)
    return "" if error <= SECOND_MARGIN * tolerance else f"{doubt}, and a second run ends {error:.1e} away; {INSTEAD}"


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
