"""What a run should have conserved, and how well it did: energy, and the momentum maps of the symmetries."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodWarning, ScviCodegenError, StateError, warn
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.runtime.driven_trajectory import DrivenTrajectory
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["Balance", "energy_balance", "energy_report", "momentum_report"]

Array = NDArray[np.float64]

MOST_SHOWN = 12
LARGE_ERROR, LOST = 1e-3, 0.1
"""Relative errors from which a quantity is said to be hardly conserved, and not at all."""
BALANCED_STEPS, BALANCED_COORDINATES = 10_000, 12
"""The most for which a balance is drawn: Newton's iteration takes each step again, for some tens of microseconds."""


class Balance(NamedTuple):
    """The work W of forces and damping over a run, and by how much E - E0 - W was off 0 at most."""

    work: float
    error: float


def energy_balance(system: MechanicalSystem, trajectory: Trajectory | DrivenTrajectory, steps: int) -> Balance | None:
    """What the steps of a run account for; ``None`` where they keep no account, or it takes long.

    Args:
        system: of the run.
        trajectory: its states, of which each is the start of the steps to the next.
        steps: their number.
    """
    short = 0 < steps <= BALANCED_STEPS and system.dimension <= BALANCED_COORDINATES
    if not (short and system.balances_energy):
        return None
    try:
        energy, work = trajectory.energy(), trajectory.work()
    except ScviCodegenError:
        return None  # of a method, or of states that are not kept, which tell no work; of a machine without a compiler
    return Balance(float(work[-1]), float(np.abs(energy - energy[0] - work).max()))


def energy_report(
    system: MechanicalSystem, trajectory: Trajectory | DrivenTrajectory, balance: Balance | None = None
) -> str:
    """One line: the largest relative energy error and its drift, the part that grows linearly; or the balance."""
    energy = trajectory.energy()
    scale = abs(float(energy[0]))
    error = (energy - energy[0]) / (scale or 1.0)
    what = "relative energy error" if scale else "energy error"
    if why := system.changes_energy:
        changed = f"energy: {why}, it changed by {np.abs(energy - energy[0]).max():.3g} at most"
        return changed if balance is None else f"{changed}; all but {balance.error:.1e} of that is work (E - E0 - W)"
    largest = np.abs(error).max()
    drift = f"drift {_drift(trajectory.t, error):+.1e} over the run"
    return f"{what}: {largest:.2e} at most, {drift}{_verdict(largest) if scale else ''}"


def _verdict(error: float) -> str:
    """What is said of an error that is no small one, with a warning."""
    if error < LARGE_ERROR:
        return ""
    warn(
        f"what the motion conserves is off by {error:.2g} of its size: take a smaller step, or more stages",
        MethodWarning,
    )
    return ": NOT conserved" if error >= LOST else ": hardly conserved"


def _drift(t: Array, error: Array) -> float:
    """Change over the run of the straight line fitted to the error."""
    if len(t) < 3:
        return float(error[-1])
    centred = (t - t.mean()) / (t[-1] - t[0])
    return float(centred @ error / (centred @ centred))


def momentum_report(result: Trajectory | DrivenTrajectory | EnsembleTrajectory) -> Iterator[str]:
    """A line a momentum map: its largest change, relative to the largest size of its terms."""
    described = result.stepper.interface
    try:
        changes = np.abs(result.momentum_errors())
    except StateError as failure:
        yield str(failure)
        return
    largest = np.fmax.reduce(changes, axis=tuple(range(changes.ndim - 1)))
    for name, exact, error in list(zip(described.map_names, described.map_exact, largest, strict=True))[:MOST_SHOWN]:
        note = "" if exact else " (not guaranteed by this method)"
        yield f"relative error of {name}: {error:.2e} at most{note}{_verdict(error)}"
    if len(largest) > MOST_SHOWN:
        yield f"and {len(largest) - MOST_SHOWN} conserved quantities more, {largest[MOST_SHOWN:].max():.2e} at most"
