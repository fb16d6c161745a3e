"""Overview of a trajectory (path and energy error), Poincare sections, and the attribute ``trajectory.plot``.

The attribute is a callable for the overview with a method for each kind of plot. Points of a Poincare section are those
where a trajectory crosses a surface.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.symmetry.sampling import bodies
from scvi_codegen.pictures.arrays import plot_arrays, plot_spectrum
from scvi_codegen.pictures.attitudes import plot_attitude
from scvi_codegen.pictures.canvas import (
    COLORS,
    MOTION,
    MOTIONS,
    Array,
    DrawnMotion,
    Motions,
    check_plot_path,
    color,
    column,
    new_figure,
    panel,
    plain,
    save,
    several,
    style,
)
from scvi_codegen.pictures.conserved import draw_energy_error, plot_energy, plot_momentum_maps
from scvi_codegen.pictures.paths import draw_paths, path_panels, plot_motion, plot_phase
from scvi_codegen.validation import CANVAS, NAMES, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@checks_arguments(trajectory=MOTION)
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
    for each in axes:
        each.locator_params(axis="x", nbins=5)
    figure.suptitle(plain(interface.title), fontsize=11)


FEW_POINTS = 2000
DIRECTION_TEXT = {1: ", rising", 0: "", -1: ", falling"}


@checks_arguments(trajectories=MOTIONS, ax=CANVAS, axes=NAMES)
def plot_section(
    trajectories: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: tuple[str, str],
    event: int = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw a Poincare section, a colour a trajectory.

    Args:
        trajectories: one or several trajectories of the same system, integrated with ``events``.
        path: file for the picture, .png or .svg; ``None`` to write none.
        axes: two names of coordinates or momenta (``p_`` before the coordinate, or as the Hamiltonian names it).
        event: index of the event that defines the surface.
        ax: axes to draw on; ``None`` for new ones.

    Raises:
        StateError: for an unknown name, or without such an event.
        PlotError: without matplotlib.
    """
    result = several(trajectories)
    points = [[_at_crossings(motion, name, event) for name in axes] for motion in result]
    size = 2.0 if sum(len(x) for x, _ in points) > FEW_POINTS else 4.0
    stepper = result[0].stepper
    cut = stepper.events[event]
    with panel(path, ax, (5.6, 5.2)) as drawn:
        for number, (x, y) in enumerate(points):
            drawn.plot(x, y, ".", color=color(number), markersize=size, markeredgewidth=0.0)
        drawn.set(xlabel=axes[0], ylabel=axes[1])
        drawn.set_title(plain(f"{stepper.interface.system}: {cut.function} = 0{DIRECTION_TEXT[cut.direction]}"))
    return drawn


def _at_crossings(motion: DrawnMotion, name: str, event: int) -> Array:
    """Return (k,) values of a coordinate or momentum at the crossings of an event."""
    if not -len(motion.events) <= event < len(motion.events):
        raise StateError(
            f"there is no event {event} in a trajectory with {len(motion.events)}: integrate(..., events=...)"
        )
    return column(motion.stepper.interface, motion.events[event], name)


Path = str | os.PathLike[str] | None


@dataclass(frozen=True, slots=True)
class Plots:
    """Pictures of one trajectory: ``run.plot()``, ``run.plot.energy()``, ``run.plot.phase("orbit.png")``.

    Each draws on the axes ``ax`` or on new ones, writes to a .png or .svg if a path is given, and returns the axes.
    """

    trajectory: DrawnMotion = field(repr=False)

    def __call__(self, path: Path = None) -> tuple[Axes, ...]:
        """Draw path and energy error, as :func:`scvi_codegen.plot_trajectory`."""
        return plot_trajectory(self.trajectory, path)

    def motion(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the path, as :func:`scvi_codegen.plot_motion`."""
        return plot_motion(self.trajectory, path, ax=ax)

    def phase(self, path: Path = None, *, axes: tuple[str, str] | None = None, ax: Axes | None = None) -> Axes:
        """Draw a phase portrait, as :func:`scvi_codegen.plot_phase`."""
        return plot_phase(self.trajectory, path, axes=axes, ax=ax)

    def energy(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the energy error over time, as :func:`scvi_codegen.plot_energy`."""
        return plot_energy(self.trajectory, path, ax=ax)

    def attitude(self, path: Path = None, *, axis: int = 3, ax: Axes | None = None) -> Axes:
        """Draw the path of a body axis on the sphere, as :func:`scvi_codegen.plot_attitude`."""
        return plot_attitude(self.trajectory, path, axis=axis, ax=ax)

    def momentum_maps(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the errors of momentum maps, as :func:`scvi_codegen.plot_momentum_maps`."""
        return plot_momentum_maps(self.trajectory, path, ax=ax)

    def field(self, path: Path = None, *, field: str | None = None, state: int = -1, ax: Axes | None = None) -> Axes:
        """Draw a field of a mesh, or an array, as :func:`scvi_codegen.plot_arrays`."""
        return plot_arrays(self.trajectory, path, array=field, state=state, ax=ax)

    def spectrum(self, path: Path = None, *, field: str | None = None, ax: Axes | None = None) -> Axes:
        """Draw the spectrum of a field of a mesh, as :func:`scvi_codegen.plot_spectrum`."""
        return plot_spectrum(self.trajectory, path, field=field, ax=ax)

    def section(self, path: Path = None, *, axes: tuple[str, str], event: int = 0, ax: Axes | None = None) -> Axes:
        """Draw a Poincare section, as :func:`scvi_codegen.plot_section`."""
        return plot_section(self.trajectory, path, axes=axes, event=event, ax=ax)
