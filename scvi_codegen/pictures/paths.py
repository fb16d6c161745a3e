"""Plots of paths: orbits of bodies, planes of two coordinates, phase planes, many coordinates over time."""

from __future__ import annotations

import os
from collections.abc import Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from scvi_codegen.mechanics.symmetry.sampling import AXES, Body, bodies
from scvi_codegen.pictures.attitudes import draw_unit_vectors
from scvi_codegen.pictures.canvas import (
    MOTION,
    MOTIONS,
    Array,
    DrawnMotion,
    Motions,
    color,
    column,
    panel,
    plain,
    several,
)
from scvi_codegen.validation import CANVAS, NAMES, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAX_POINTS = 20_000
MAX_CURVES = 6


@checks_arguments(trajectory=MOTION, ax=CANVAS)
def plot_motion(trajectory: DrawnMotion, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the path of a trajectory: orbits, a plane of coordinates, a phase plane, or all coordinates over time.

    Args:
        trajectory: trajectory to draw.
        path: file for the picture, .png or .svg; ``None`` to write none.
        ax: axes to draw on; ``None`` for new ones.

    Returns:
        The axes.

    Raises:
        StateError: for another suffix.
        PlotError: without matplotlib.
    """
    with panel(path, ax) as drawn:
        draw_paths([drawn], trajectory)
    return drawn


@checks_arguments(trajectories=MOTIONS, ax=CANVAS, axes=NAMES)
def plot_phase(
    trajectories: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: tuple[str, str] | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw a phase portrait, a colour a trajectory.

    Args:
        trajectories: one or several trajectories of the same system.
        path, ax: as of :func:`plot_motion`.
        axes: two names of coordinates or momenta; by default the first coordinate and its momentum.

    Raises:
        StateError, PlotError: as :func:`plot_motion`; StateError also for an unknown name.
    """
    result = several(trajectories)
    interface = result[0].stepper.interface
    names = axes or (interface.coordinates[0], interface.momenta[0])
    curves = [[column(interface, motion, name) for name in names] for motion in result]
    with panel(path, ax) as drawn:
        for number, (x, y) in enumerate(curves):
            _draw_curve(drawn, x, y, color(number))
        drawn.set(xlabel=names[0], ylabel=names[1], title=plain(f"{interface.system}: phase plane"))
    return drawn


def path_panels(motion: DrawnMotion) -> int:
    """Return the number of panels of a path: two for rotations, motion in space and three to six coordinates."""
    coordinates = motion.stepper.interface.coordinates
    if motion.stepper.interface.rotations:
        return 2
    result = bodies(coordinates)
    spatial = result and len(result[0].columns) == 3
    return 2 if spatial or (not result and 3 <= len(coordinates) <= MAX_CURVES) else 1


def draw_paths(panels: Sequence[Axes], motion: DrawnMotion) -> None:
    """Draw the path into the panels.

    One coordinate is drawn in the phase plane, bodies by their orbits, rotations by body axes, a few coordinates in
    their first planes, many coordinates as one image over time.
    """
    coordinates = motion.stepper.interface.coordinates
    result, m = bodies(coordinates), len(coordinates)
    if motion.stepper.interface.rotations:
        for drawn, plane in zip(panels, combinations(range(3), 2), strict=False):
            draw_unit_vectors(drawn, motion, plane)
    elif m == 1:
        _draw_phase_plane(panels[0], motion)
    elif result:
        for drawn, plane in zip(panels, combinations(range(3), 2), strict=False):
            _draw_orbits(drawn, motion, result, plane)
    elif m <= MAX_CURVES:
        for drawn, plane in zip(panels, combinations(range(m), 2), strict=False):
            _draw_plane(drawn, motion, plane)
    else:
        _draw_image(panels[0], motion)


def _draw_phase_plane(axes: Axes, motion: DrawnMotion) -> None:
    interface = motion.stepper.interface
    _draw_curve(axes, motion.q[:, 0], motion.p[:, 0], color(0))
    axes.set(xlabel=interface.coordinates[0], ylabel=interface.momenta[0], title="phase plane")


def _draw_plane(axes: Axes, motion: DrawnMotion, plane: tuple[int, int]) -> None:
    x, y = (motion.q[:, index] for index in plane)
    _draw_curve(axes, x, y, color(0))
    names = [motion.stepper.interface.coordinates[index] for index in plane]
    axes.set(xlabel=names[0], ylabel=names[1], title="configuration")
    if 0.4 < _extent(x) / max(_extent(y), np.finfo(float).tiny) < 2.5:
        axes.set_aspect("equal", adjustable="datalim")


def _draw_orbits(axes: Axes, motion: DrawnMotion, result: Sequence[Body], plane: tuple[int, int]) -> None:
    for number, body in enumerate(result):
        x, y = (motion.q[:, body.columns[index]] for index in plane)
        _draw_curve(axes, x, y, color(number), body.name or None)
    axes.set(xlabel=AXES[plane[0]], ylabel=AXES[plane[1]], title="orbits" if len(result) > 1 else "orbit")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_curve(axes: Axes, x: Array, y: Array, color: str, label: str | None = None) -> None:
    """Draw a curve with a ring at the first and a dot at the last state; points if steps are large."""
    every = max(1, len(x) // MAX_POINTS)
    x_drawn, y_drawn = x[::every], y[::every]
    if _is_coarse(x_drawn, y_drawn):
        axes.plot(x_drawn, y_drawn, ".", color=color, markersize=2.0, alpha=0.7)
    else:
        axes.plot(x_drawn, y_drawn, color=color, linewidth=0.8, alpha=0.8)
    axes.plot(x[:1], y[:1], "o", color=color, markersize=5, fillstyle="none")
    axes.plot(x[-1:], y[-1:], "o", color=color, markersize=5, label=label)


def _is_coarse(x: Array, y: Array) -> bool:
    """Return True if steps are large relative to the extent of the curve."""
    if len(x) < 200:
        return False
    size = max(_extent(x), _extent(y))
    return float(np.median(np.hypot(np.diff(x), np.diff(y)))) > 0.1 * size


def _extent(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


def _draw_image(axes: Axes, motion: DrawnMotion) -> None:
    """Draw many coordinates as an image: one row each, colour for the value."""
    every = max(1, len(motion.t) // 2000)
    values = motion.q[::every].T
    largest = float(np.abs(values).max()) or 1.0
    first, last = sorted((float(motion.t[0]), float(motion.t[-1])))
    span = (first, last if last > first else first + 1.0, 0.5, values.shape[0] + 0.5)
    drawn = values if motion.h > 0 else values[:, ::-1]
    image = axes.imshow(
        drawn,
        aspect="auto",
        origin="lower",
        extent=span,
        cmap="RdBu_r",
        vmin=-largest,
        vmax=largest,
        interpolation="none",
    )
    axes.grid(visible=False)
    axes.set(xlabel="t", ylabel="coordinate", title="q over time")
    axes.figure.colorbar(image, ax=axes, shrink=0.9)
