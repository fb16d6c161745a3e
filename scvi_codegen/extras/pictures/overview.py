"""Overview of a trajectory (path and energy error), Poincare sections, and the attribute ``trajectory.plot``.

The attribute is a callable for the overview with a method for each kind of plot. Points of a Poincare section are those
where a trajectory crosses a surface.

Plots of paths: orbits of bodies, planes of two coordinates, coordinates over time.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.api.program import Interface
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.pictures.animation import drawn_shape, positions_of
from scvi_codegen.extras.pictures.arrays import plot_arrays, plot_spectrum
from scvi_codegen.extras.pictures.attitudes import draw_unit_vectors, plot_attitude
from scvi_codegen.extras.pictures.canvas import (
    COLORS,
    MOTIONS,
    Array,
    Motions,
    check_plot_path,
    color,
    column,
    new_figure,
    panel,
    plain,
    save,
    several,
    smooth,
    style,
)
from scvi_codegen.extras.pictures.conserved import plot_energy, plot_momentum_maps
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

POSES = 6
"""Number of poses in a plot."""


def links_of(motion: Trajectory) -> Any:
    """Return the links of the robot that moves, with parents before children; none if it is not read from a file."""
    return motion.stepper.interface.layout.links


def draw_robot(axes: Any, motion: Trajectory, number: int = 0) -> None:
    """Draw the links at equidistant times, the last pose in full colour, and the paths of the tips."""
    shape = drawn_shape(motion)
    seen = positions_of(shape, motion)[..., slice(None) if axes.name == "3d" else [0, 2]]
    rows = np.unique(np.searchsorted(abs(motion.t - motion.t[0]), np.linspace(0, 1, POSES) * abs(np.ptp(motion.t))))
    for row in rows.clip(max=len(seen) - 1):
        alpha = 1.0 if row == rows[-1] else 0.25
        for mark in shape.marks:
            axes.plot(*seen[row, mark["points"]].T, "-", color=color(number), linewidth=1.8, alpha=alpha)
        joints = seen[row, [mark["points"][0] for mark in shape.marks]]
        axes.plot(*joints.T, "o", color=color(number), markersize=3, alpha=alpha)
    for tip in shape.trails:
        axes.plot(*seen[:, tip].T, color=color(number + 1), linewidth=0.7)
    axes.set(xlabel="x", title="links")
    axes.set(**({"ylabel": "y", "zlabel": "z"} if axes.name == "3d" else {"ylabel": "z"}))
    axes.set_aspect("equal", adjustable="datalim")


@checks_arguments(trajectory=MOTIONS)
def plot_trajectory(
    trajectory: Motions, path: str | os.PathLike[str] | None = None, *, error: bool = False
) -> tuple[Axes, ...]:
    """Draw the path of a trajectory on the left, its relative energy error over time on the right.

    Args:
        trajectory: trajectory to draw, or several of the same system, a colour each.
        path: file for the picture, .png, .svg or .pdf, written atomically; equal trajectories give equal bytes.
        error: draw the coordinates over time instead of the path, with bands of their errors (``run.error``).

    Returns:
        The axes, from left to right.

    Raises:
        StateError: for another suffix.
        PlotError: without matplotlib.
    """
    if path is not None:
        check_plot_path(path)
    motions = several(trajectory)
    interface, count = motions[0].stepper.interface, 2 if error else 1 + path_panels(motions[0])
    with style():
        figure = new_figure(path, (4.6 * count, 4.4))
        kinds = [None if error else _projection(motions[0]), *[None] * (count - 1)]
        axes = tuple(figure.add_subplot(1, count, k + 1, projection=kind) for k, kind in enumerate(kinds))
        for panel_axes in axes:  # before axes are made equal, which a change of their ticks would undo
            panel_axes.locator_params(axis="x", nbins=5)
        if error:
            for number, motion in enumerate(motions):
                _draw_times(axes[0], motion, (), number if len(motions) > 1 else None, error=True)
        else:
            draw_paths(axes[:-1], motions)
        plot_energy(motions, ax=axes[-1])
        named = 0 if error else len(Interface.bodies(interface.coordinates))
        if 1 < named <= len(COLORS) and len(motions) == 1:
            figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=named)
        figure.suptitle(plain(interface.title), fontsize=11)
        if path is not None:
            save(figure, path)
    return axes


FEW_POINTS = 2000
DIRECTION_TEXT = {1: ", rising", 0: "", -1: ", falling"}


@checks_arguments(trajectories=MOTIONS, ax=Kind.CANVAS, axes=Kind.NAMES)
def plot_section(
    trajectories: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: tuple[str, str] | None = None,
    event: int = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw a Poincare section, a colour a trajectory.

    Args:
        trajectories: one or several trajectories of the same system, integrated with ``events``.
        path: file for the picture, .png, .svg or .pdf; ``None`` to write none.
        axes: two names of coordinates or momenta (``p_`` before the coordinate, or as the Hamiltonian names it); by
            default the first coordinate that the event does not contain, and its momentum.
        event: index of the event that defines the surface.
        ax: axes to draw on; ``None`` for new ones.

    Raises:
        StateError: for an unknown name, or without such an event.
        PlotError: without matplotlib.
    """
    result = several(trajectories)
    axes = axes or _axes_of_section(result[0], event)
    points = [[_at_crossings(motion, name, event) for name in axes] for motion in result]
    size = 2.0 if sum(len(x) for x, _ in points) > FEW_POINTS else 4.0
    stepper = result[0].stepper
    cut = stepper.events[event]
    with panel(path, ax, (5.6, 5.2)) as panel_axes:
        for number, (x, y) in enumerate(points):
            panel_axes.plot(x, y, ".", color=color(number), markersize=size, markeredgewidth=0.0)
        panel_axes.set(xlabel=axes[0], ylabel=axes[1])
        panel_axes.set_title(plain(f"{stepper.interface.system}: {cut.function} = 0{DIRECTION_TEXT[cut.direction]}"))
    return panel_axes


def _axes_of_section(motion: Trajectory, event: int) -> tuple[str, str]:
    """Return the first coordinate that an event does not contain, and its momentum."""
    interface, events = motion.stepper.interface, motion.stepper.events
    function = str(events[event].function) if -len(events) <= event < len(events) else ""
    pairs = zip(interface.coordinates, interface.momenta, strict=True)
    free = [pair for pair in pairs if not re.search(rf"\b{re.escape(pair[0])}\b", function)]
    return (free or [(interface.coordinates[0], interface.momenta[0])])[0]


def _at_crossings(motion: Trajectory, name: str, event: int) -> Array:
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

    Each draws on the axes ``ax`` or on new ones, writes to a .png, .svg or .pdf if a path is given, and returns the
    axes. Those of an ensemble draw its trajectories together; ``field`` and ``spectrum`` require a single one.
    """

    trajectory: Any = field(repr=False)

    def __call__(self, path: Path = None, *, error: bool = False) -> tuple[Axes, ...]:
        """Draw path and energy error, as :func:`scvi_codegen.plot_trajectory`."""
        return plot_trajectory(self.trajectory, path, error=error)

    def motion(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the path, as :func:`scvi_codegen.plot_motion`."""
        return plot_motion(self.trajectory, path, ax=ax)

    def phase(self, path: Path = None, *, axes: tuple[str, str] | None = None, ax: Axes | None = None) -> Axes:
        """Draw a phase portrait, as :func:`scvi_codegen.plot_phase`."""
        return plot_phase(self.trajectory, path, axes=axes, ax=ax)

    def time(self, *names: str, path: Path = None, ax: Axes | None = None, error: bool = False) -> Axes:
        """Draw quantities over time: names as of ``run[name]``, a curve each; by default the coordinates.

        With ``error`` coordinates and momenta have bands of their errors (``run.error``), between saved states.

        Raises:
            StateError: for an unknown name, or another suffix of ``path``.
            PlotError: without matplotlib.
        """
        motions = several(self.trajectory)
        with panel(path, ax) as panel_axes:
            for number, motion in enumerate(motions):
                drawn = motion if error else smooth(motion)
                _draw_times(panel_axes, drawn, names, number if len(motions) > 1 else None, error=error)
        return panel_axes

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


MAX_POINTS = 20_000
MAX_CURVES = 6


@checks_arguments(trajectory=MOTIONS, ax=Kind.CANVAS)
def plot_motion(trajectory: Motions, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the path of a trajectory: orbits, a plane of coordinates, or coordinates over time.

    Between adaptive steps curves are dense output. Robots from files are drawn as links in space, at a few times.

    Args:
        trajectory: trajectory to draw, or several of the same system, a colour each.
        path: file for the picture, .png, .svg or .pdf; ``None`` to write none.
        ax: axes to draw on; ``None`` for new ones.

    Returns:
        The axes.

    Raises:
        StateError: for another suffix.
        PlotError: without matplotlib.
    """
    motions = several(trajectory)
    with panel(path, ax, projection=_projection(motions[0])) as panel_axes:
        draw_paths([panel_axes], motions)
    return panel_axes


@checks_arguments(trajectories=MOTIONS, ax=Kind.CANVAS, axes=Kind.NAMES)
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
    curves = [[column(interface, smooth(motion), name) for name in names] for motion in result]
    with panel(path, ax) as panel_axes:
        for number, (x, y) in enumerate(curves):
            _draw_curve(panel_axes, x, y, color(number))
        panel_axes.set(xlabel=names[0], ylabel=names[1], title=plain(f"{interface.system}: phase plane"))
    return panel_axes


def _projection(motion: Trajectory) -> str | None:
    return "3d" if links_of(motion) else None


def path_panels(motion: Trajectory) -> int:
    """Return the number of panels of a path: two for rotations, motion in space and three to six coordinates."""
    coordinates = motion.stepper.interface.coordinates
    if links_of(motion):
        return 1
    if motion.stepper.interface.rotations:
        return 2
    result = Interface.bodies(coordinates)
    spatial = result and len(result[0].columns) == 3
    planes = not result and not _is_drawn_in_time(motion) and 3 <= len(coordinates) <= MAX_CURVES
    return 2 if spatial or planes else 1


def _is_drawn_in_time(motion: Trajectory) -> bool:
    """Return whether the coordinates are drawn over time: one, or those of a driven or damped system without bodies."""
    interface = motion.stepper.interface
    m = len(interface.coordinates)
    return m == 1 or (
        m <= MAX_CURVES and bool(interface.changes_energy) and not Interface.bodies(interface.coordinates)
    )


def draw_paths(panels: Sequence[Axes], motions: Sequence[Trajectory]) -> None:
    """Draw the paths into the panels.

    Bodies are drawn by their orbits, robots by their links, rotations by body axes, one coordinate and those of a
    driven or damped system over time, a few others in their first planes, many as one image over time (of the first
    trajectory).
    """
    for number, motion in enumerate(motions):
        if number == 0 or path_panels(motion) > 1 or len(motion.stepper.interface.coordinates) <= MAX_CURVES:
            _draw_path(panels, smooth(motion), number if len(motions) > 1 else None)


def _draw_path(panels: Sequence[Axes], motion: Trajectory, which: int | None) -> None:
    """Draw one path, in one colour if it is one of several (``which``)."""
    coordinates = motion.stepper.interface.coordinates
    result, m, first = Interface.bodies(coordinates), len(coordinates), which or 0
    if links_of(motion):
        draw_robot(panels[0], motion, first)
    elif motion.stepper.interface.rotations:
        for axes, plane in zip(panels, combinations(range(3), 2), strict=False):
            draw_unit_vectors(axes, motion, plane, which)
    elif _is_drawn_in_time(motion):
        _draw_times(panels[0], motion, (), which)
    elif result:
        for axes, plane in zip(panels, combinations(range(3), 2), strict=False):
            for number, body in enumerate(result):
                x, y = (motion.q[:, body.columns[index]] for index in plane)
                _draw_curve(axes, x, y, color(number if which is None else which), body.name or None)
            axes.set(xlabel="xyz"[plane[0]], ylabel="xyz"[plane[1]], title="orbits" if len(result) > 1 else "orbit")
            axes.set_aspect("equal", adjustable="datalim")
    elif m <= MAX_CURVES:
        for axes, plane in zip(panels, combinations(range(m), 2), strict=False):
            _draw_plane(axes, motion, plane, first)
    else:
        _draw_image(panels[0], motion)


def _draw_times(
    axes: Axes, motion: Trajectory, names: Sequence[str], which: int | None, *, error: bool = False
) -> None:
    """Draw quantities over time, by default the first coordinates, in one colour if the motion is one of several.

    With ``error`` the errors of coordinates and momenta are drawn as bands; they are wider than the curve from some
    per mil of the motion on.
    """
    interface = motion.stepper.interface
    names = names or interface.coordinates[:MAX_CURVES]
    bounds: dict[str, Array] = {}
    if error:
        columns = (*interface.coordinates, *interface.momentum_columns)
        bounds = dict(zip(columns, np.concatenate(motion.error.bounds, axis=1).T, strict=True))
    for number, name in enumerate(names):
        shade = color(number if which is None else which)
        axes.plot(motion.t, motion[name], color=shade, label=plain(name))
        if (bound := bounds.get(name)) is not None:
            axes.fill_between(motion.t, motion[name] - bound, motion[name] + bound, color=shade, alpha=0.3, linewidth=0)
    axes.set(xlabel="t", ylabel=plain(names[0]) if len(names) == 1 else "", title="motion in time")
    if len(names) > 1 and not which:
        axes.legend(loc="best")


def _draw_plane(axes: Axes, motion: Trajectory, plane: tuple[int, int], number: int) -> None:
    x, y = (motion.q[:, index] for index in plane)
    _draw_curve(axes, x, y, color(number))
    names = [motion.stepper.interface.coordinates[index] for index in plane]
    axes.set(xlabel=names[0], ylabel=names[1], title="configuration")
    if 0.4 < _extent(x) / max(_extent(y), np.finfo(float).tiny) < 2.5:
        axes.set_aspect("equal", adjustable="datalim")


def _draw_curve(axes: Axes, x: Array, y: Array, color: str, label: str | None = None) -> None:
    """Draw a curve with a ring at the first and a dot at the last state; points if steps are large."""
    every = max(1, len(x) // MAX_POINTS)
    x_drawn, y_drawn = x[::every], y[::every]
    lengths = np.hypot(np.diff(x_drawn), np.diff(y_drawn))
    if len(x_drawn) >= 200 and np.median(lengths) > 0.1 * max(_extent(x_drawn), _extent(y_drawn)):
        axes.plot(x_drawn, y_drawn, ".", color=color, markersize=2.0, alpha=0.7)
    else:
        axes.plot(x_drawn, y_drawn, color=color, linewidth=0.8, alpha=0.8)
    axes.plot(x[:1], y[:1], "o", color=color, markersize=5, fillstyle="none")
    axes.plot(x[-1:], y[-1:], "o", color=color, markersize=5, label=label)


def _extent(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


def _draw_image(axes: Axes, motion: Trajectory) -> None:
    """Draw many coordinates as an image: one row each, colour for the value."""
    every = max(1, len(motion.t) // 2000)
    t, values = motion.t[::every], motion.q[::every].T
    largest = float(np.abs(values).max()) or 1.0
    last = t[-1:] if len(t) > 1 else t + 1
    edges = np.concatenate([t[:1], (t[1:] + t[:-1]) / 2, last])
    rows = np.arange(len(values) + 1) + 0.5
    image = axes.pcolormesh(edges, rows, values, cmap="RdBu_r", vmin=-largest, vmax=largest, rasterized=True)
    axes.grid(visible=False)
    axes.set(xlabel="t", ylabel="coordinate", title="q over time")
    axes.figure.colorbar(image, ax=axes, shrink=0.9)
