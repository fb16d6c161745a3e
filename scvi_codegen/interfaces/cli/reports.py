"""Texts of reports: numbers, durations, tables and conserved quantities (energy, momentum maps)."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from scvi_codegen.common.errors import MethodWarning, StateError, warn
from scvi_codegen.runs.results.energy import EnergyAccount, energy_account
from scvi_codegen.runs.states.validation import Array

if TYPE_CHECKING:
    from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
    from scvi_codegen.runs.trajectory import Trajectory


def duration(seconds: float) -> str:
    """Return a duration with a suitable unit."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def in_known_digits(x: float, error: float, size: float = 0.0) -> str:
    """Return a number rounded to the digits that an error leaves right; 17 digits if the error is 0 or not finite.

    A number of which no digit is right is not printed, only its error; it is 0 if that is less than rounding of
    ``size``, that of the motion of this coordinate.
    """
    if error == 0.0 or not math.isfinite(error):
        return f"{x: .17g}"
    decimals = math.floor(-math.log10(2.0 * error))
    digits = math.floor(math.log10(abs(x))) + 1 + decimals if x else 0
    if digits > 0:
        return f"{x: .{min(digits, 17)}g}"
    if error < sys.float_info.epsilon * size:
        return " 0"
    return f" no digit (error {error:.1g})" if x else f" 0 within {error:.1g}"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as lines with aligned columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


MAX_LISTED = 12
"""Largest number of momentum maps that are listed one by one."""
LARGE_ERROR, NOT_CONSERVED = 1e-3, 0.1
"""Relative errors from which a quantity is reported as hardly conserved, and as not conserved."""


def known_account(trajectory: Trajectory) -> EnergyAccount | None:
    """Return the account of the energy of a run; ``None`` outside the domain of L."""
    try:
        return energy_account(trajectory, limited=True)
    except StateError:
        return None


def energy_report(trajectory: Trajectory, account: EnergyAccount | None = None) -> str:
    """Return one line: largest relative energy error and its linear drift, or the energy balance of forces."""
    account = account or energy_account(trajectory, limited=True)
    largest = float(np.abs(account.values).max()) / account.scale
    if account.reason:
        changed = f"energy: {account.reason}, it changed by {np.abs(account.change).max():.3g} at most"
        if account.work is None:
            return changed
        return f"{changed}; energy balance |E - E0 - W| {np.abs(account.values).max():.1e} at most"
    drift = f"drift {_drift(trajectory.t, account.values / account.scale):+.1e} over the run"
    return f"{account.title}: {largest:.2e} at most, {drift}{'' if account.initial is None else _verdict(largest)}"


def _verdict(error: float) -> str:
    """Return a remark on an error that is not small, and issue a warning."""
    if error < LARGE_ERROR:
        return ""
    warn(
        f"a conserved quantity has a relative error of {error:.2g}: use a smaller step size or more stages",
        MethodWarning,
    )
    return ": NOT conserved" if error >= NOT_CONSERVED else ": hardly conserved"


def _drift(t: Array, error: Array) -> float:
    """Return the change over the run of the least-squares line through the error."""
    if len(t) < 3:
        return float(error[-1])
    centred = (t - t.mean()) / (t[-1] - t[0])
    return float(centred @ error / (centred @ centred))


def momentum_report(result: Trajectory | EnsembleTrajectory) -> Iterator[str]:
    """Yield a line for each momentum map: its largest change, relative to the largest size of its terms."""
    described = result.stepper.interface
    if result.stepper.changes_states:
        return
    try:
        changes = np.abs(result.momentum_errors())
    except StateError as failure:
        yield str(failure)
        return
    largest = np.fmax.reduce(changes, axis=tuple(range(changes.ndim - 1)))
    kept = described.map_exact or (True,) * len(largest)  # of arrays of run-time sizes: translations and rotations
    for name, exact, error in list(zip(described.map_names, kept, largest, strict=True))[:MAX_LISTED]:
        note = "" if exact else " (not guaranteed by this method)"
        yield f"relative error of {name}: {error:.2e} at most{note}{_verdict(error)}"
    if len(largest) > MAX_LISTED:
        yield f"and {len(largest) - MAX_LISTED} more conserved quantities, {largest[MAX_LISTED:].max():.2e} at most"
