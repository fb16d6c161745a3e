"""Plots of rotations, directions and spins: paths of body axes on the unit sphere."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.pictures.canvas import MOTIONS, Array, Motions, color, panel, plain, several, smooth
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

CIRCLE = np.linspace(0.0, 2 * np.pi, 73)


def unit_vectors(motion: Trajectory, axis: int = 3) -> dict[str, Array]:
    """Return (n, 3) unit vectors in space by label: a body axis of each rotation, each direction and spin."""
    result: dict[str, Array] = {}
    for kind, name, *_ in map(str.split, motion.stepper.interface.rotations):
        if kind == "rotation":
            result[f"axis {axis} of {name}"] = motion.rotation(name)[..., axis - 1]
        else:
            vectors = motion.direction(name) if kind == "direction" else motion.spin(name)
            result[name] = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return result


@checks_arguments(trajectory=MOTIONS, axis=Kind.WHOLE, ax=Kind.CANVAS)
def plot_attitude(
    trajectory: Motions, path: str | os.PathLike[str] | None = None, *, axis: int = 3, ax: Axes | None = None
) -> Axes:
    """Draw the path of a body axis of each rotation, and of directions and spins, on the unit sphere.

    Args:
        trajectory: trajectory to draw, or several of the same system.
        path: file for the picture, .png, .svg or .pdf; ``None`` to write none.
        axis: number of the body axis, 1 to 3.
        ax: three-dimensional axes to draw on; ``None`` for new ones.

    Returns:
        The axes.

    Raises:
        StateError: for another suffix, or if the system has no rotation, direction or spin.
        PlotError: without matplotlib.
    """
    if axis not in (1, 2, 3):
        raise StateError(f"axis must be 1, 2 or 3, not {axis}")
    motions = several(trajectory)
    system = motions[0].stepper.interface.system
    if not motions[0].stepper.interface.rotations:
        raise StateError(f"'{system}' has no rotation, direction or spin to draw")
    curves = [curve for motion in motions for curve in unit_vectors(smooth(motion), axis).items()]
    names = len(curves) // len(motions)
    with panel(path, ax, (4.8, 4.8), "3d") as panel_axes:
        for latitude in np.deg2rad(np.arange(-60, 90, 30)):
            radius, height = np.cos(latitude), np.full(len(CIRCLE), np.sin(latitude))
            panel_axes.plot(radius * np.cos(CIRCLE), radius * np.sin(CIRCLE), height, color="0.85", linewidth=0.5)
        for longitude in np.deg2rad(np.arange(0, 180, 30)):
            across = np.cos(CIRCLE)
            panel_axes.plot(
                across * np.cos(longitude), across * np.sin(longitude), np.sin(CIRCLE), color="0.85", linewidth=0.5
            )
        for number, (label, curve) in enumerate(curves):
            shown = plain(label) if number < names else None
            panel_axes.plot(*curve.T, color=color(number), linewidth=0.9, label=shown)
            panel_axes.plot(*curve[-1:].T, "o", color=color(number), markersize=4)
        panel_axes.set(xlabel="x", ylabel="y", zlabel="z", title=plain(system))
        panel_axes.set_aspect("equal")
        panel_axes.legend(loc="upper right", fontsize=8)
    return panel_axes


def draw_unit_vectors(axes: Axes, motion: Trajectory, plane: tuple[int, int], which: int | None = None) -> None:
    """Draw the projections of body axes, directions and spins to a plane of space, in the unit circle."""
    axes.plot(np.cos(CIRCLE), np.sin(CIRCLE), color="0.7", linewidth=0.6)
    for number, (label, curve) in enumerate(unit_vectors(motion).items()):
        colour, shown = (number, label) if which is None else (which, label)
        legend = None if which else plain(shown)  # of the first trajectory alone
        axes.plot(*curve[:, plane].T, color=color(colour), linewidth=0.8, label=legend)
    axes.set(xlabel="xyz"[plane[0]], ylabel="xyz"[plane[1]], title="body axes")
    axes.legend(fontsize=8)
    axes.set_aspect("equal")
