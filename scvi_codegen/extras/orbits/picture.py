"""Picture of a family of periodic orbits: the orbits, their stability, and their periods with the bifurcations."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import MethodError
from scvi_codegen.extras.orbits.solver import PeriodicOrbit
from scvi_codegen.extras.pictures.canvas import (
    COLORS,
    SMOOTH,
    at_times,
    check_plot_path,
    color,
    new_figure,
    save,
    style,
)
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_CURVES = 40
"""Number of orbits that are drawn at most, evenly spaced in their order."""


def plot_family(family: Any, path: str | os.PathLike[str] | None = None) -> Figure:
    """Draw a :class:`~scvi_codegen.Family`, blue where it is stable; write a .png, .svg or .pdf if a path is passed.

    Stability indices are signed, on an axis that is linear where they are stable, from -1 to 1, and logarithmic beyond.
    The third picture is the period by the energy, or of a family along a parameter the largest first coordinate by it.
    """
    if path is not None:
        check_plot_path(path)
    coordinate, parameter = family[0].stepper.coordinates[0], family.parameter
    with without_accuracy_warnings():
        runs = [orbit.run() for orbit in family]

    def height(orbit: PeriodicOrbit, run: Trajectory) -> float:
        return orbit.period if parameter is None else float(run.q[:, 0].max())

    with style():
        figure = new_figure(path, (12.0, 4.0))
        motion, indices, curve = figure.subplots(1, 3)
        for orbit, run in list(zip(family, runs, strict=True))[:: max(1, len(family) // MOST_CURVES)]:
            curve_of = at_times(run, np.linspace(run.t[0], run.t[-1], SMOOTH))
            across = curve_of.q[:, 1] if run.q.shape[1] > 1 else curve_of.p[:, 0]
            motion.plot(curve_of.q[:, 0], across, color=_color(orbit), linewidth=0.8)
        names = [*family[0].stepper.coordinates, f"p_{coordinate}"]
        motion.set(xlabel=names[0], ylabel=names[1], title="orbits, blue where stable")
        kind, values = indices_of(family.orbits)
        for k, column in enumerate(values.T):
            indices.plot(family.values, column.real, ".-", color=color(k), markersize=3, linewidth=0.8)
        indices.axhspan(-1.0, 1.0, color="black", alpha=0.06, linewidth=0)
        indices.set_yscale("symlog", linthresh=1.0)
        indices.set(xlabel=parameter or "energy", ylabel=f"real part of the {kind}")
        heights = [height(orbit, run) for orbit, run in zip(family, runs, strict=True)]
        curve.plot(family.values, heights, color=COLORS[-1], linewidth=0.8)
        curve.scatter(family.values, heights, s=6, c=[_color(orbit) for orbit in family])
        for bifurcation in family.bifurcations:
            place = (family.value_of(bifurcation.orbit), height(bifurcation.orbit, bifurcation.orbit.run()))
            curve.plot(*place, "o", color=COLORS[1])
            curve.annotate(bifurcation.kind, place, fontsize=8)
        curve.set(xlabel=parameter or "energy", ylabel="period" if parameter is None else f"largest {coordinate}")
        if path is not None:
            save(figure, path)
    return figure


def _color(orbit: PeriodicOrbit) -> str:
    return COLORS[0] if orbit.stable else COLORS[-1]


def indices_of(orbits: Sequence[PeriodicOrbit]) -> tuple[str, Array]:
    """Return the name and the complex values of stability indices, or of multipliers where these do not exist."""
    try:
        return "stability index", np.array([orbit.stability_indices for orbit in orbits])
    except MethodError:
        return "multiplier", np.array([orbit.multipliers for orbit in orbits])
