"""Overview of a trajectory: its path and its energy error."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from scvi_codegen.mechanics.symmetry.sampling import bodies
from scvi_codegen.pictures.canvas import COLORS, check_plot_path, new_figure, plain, save, style
from scvi_codegen.pictures.conserved import draw_energy_error
from scvi_codegen.pictures.paths import draw_paths, path_panels
from scvi_codegen.pictures.trajectory_interface import MOTION, DrawnMotion
from scvi_codegen.validation import PATH, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@checks_arguments(trajectory=MOTION, path=PATH)
def plot_trajectory(trajectory: DrawnMotion, path: str | os.PathLike[str] | None = None) -> tuple[Axes, ...]:
    """Draw the path of a trajectory on the left, its relative energy error over time on the right.

    Args:
        trajectory: trajectory to draw.
        path: file for the picture, .png or .svg, written atomically; equal trajectories give equal bytes.

    Returns:
        The axes, from left to right.

    Raises:
        StateError: for another suffix.
        PlotError: without matplotlib.
    """
    if path is not None:
        check_plot_path(path)
    count = 1 + path_panels(trajectory)
    with style():
        figure = new_figure(path, (4.6 * count, 4.4))
        axes: tuple[Axes, ...] = tuple(figure.subplots(1, count))
        _draw(trajectory, axes)
        if path is not None:
            save(figure, path)
    return axes


def _draw(trajectory: DrawnMotion, axes: tuple[Axes, ...]) -> None:
    interface, figure = trajectory.stepper.interface, axes[0].figure
    draw_paths(axes[:-1], trajectory)
    draw_energy_error(axes[-1], trajectory)
    named = len(bodies(interface.coordinates))
    if 1 < named <= len(COLORS):
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=named)
    for panel in axes:
        panel.locator_params(axis="x", nbins=5)
    figure.suptitle(plain(interface.title), fontsize=11)
