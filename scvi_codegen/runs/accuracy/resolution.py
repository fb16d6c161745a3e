"""Resolution of fields by their mesh: the part of the squared amplitude in the highest modes."""

import math
from typing import Any, Final

import numpy as np

from scvi_codegen.common.errors import AccuracyWarning, warn
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array, coordinate_shapes
from scvi_codegen.runs.states.words import by_name
from scvi_codegen.runs.stepping.integrator import Integrator

UNRESOLVED: Final = 1e-5
"""Largest part of the squared amplitude of fields in the highest modes of their mesh without a warning."""

MOST_SPECTRA, MOST_VALUES = 64, 2**20
"""Largest numbers of saved states whose spectrum is checked, and of their values; at least four are checked."""


def unresolved_parts(stepper: Integrator, q: Array) -> Array | None:
    """Return (n,) parts of the squared amplitude of fields in the highest modes of their mesh; ``None`` without one."""
    mesh = stepper.interface.layout.mesh
    if mesh is None:
        return None
    fields = by_name(np.asarray(q), coordinate_shapes(stepper.interface))
    return np.asarray(np.max([mesh.unresolved(fields[name]) for name in mesh.field_system.fields], axis=0))


def warn_of_unresolved_members(ensemble: Any) -> None:
    """Issue the warning of :func:`warn_of_unresolved_fields` for the first of some trajectories that need it."""
    count = len(ensemble.parameters) if ensemble.stepper.interface.layout.mesh is not None else 0
    for j in range(0, count, -(-count // MOST_SPECTRA) or 1):
        t, q, *_ = ensemble._one(j)
        h = math.nan if ensemble.plans else ensemble.h
        if len(t) and _unresolved(ensemble.stepper, t, q, h, f"trajectory {j}, "):
            return


def warn_of_unresolved_fields(trajectory: SavedStates) -> None:
    """Issue an :class:`AccuracyWarning` if the highest modes of a mesh contain too much in one of some saved states."""
    _unresolved(trajectory.stepper, trajectory.t, trajectory.q, trajectory.h)


def _unresolved(stepper: Integrator, t: Array, q: Array, h: float, where: str = "") -> bool:
    """Issue the warning of :func:`warn_of_unresolved_fields` for saved states; true if it is necessary."""
    if stepper.interface.layout.mesh is None:
        return False
    count = max(4, min(MOST_SPECTRA, MOST_VALUES // max(1, q.shape[-1])))
    stride = -(-max(len(t) - 1, 1) // count)
    rows = slice((len(t) - 1) % stride, None, stride)
    parts = unresolved_parts(stepper, q[rows]) if warnings_wanted() else None
    if parts is None:
        return False
    sizes = np.abs(np.asarray(q[rows])).max(axis=1)  # a wave that enters a mesh at rest is small at first
    parts = parts * (sizes / (sizes.max() or 1.0)) ** 2
    if parts.max() <= UNRESOLVED:
        return False
    first = int(np.argmax(~(parts <= UNRESOLVED)))
    phase = abs(h) * stepper.interface.layout.mesh.highest_frequency()
    warn(
        f"the mesh does not resolve the fields: {where}at t = {t[rows][first]:g} the highest modes have "
        f"{parts[first]:.1e} of the squared amplitude ({UNRESOLVED:g} is tolerable). Use more elements or points, or a "
        f"smaller h if the run is unstable (h times the highest frequency is {phase:.2g}); shocks are not supported",
        AccuracyWarning,
    )
    return True
