"""Pictures of a trajectory: where it goes, and how well it keeps its energy. The only room that knows matplotlib."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import PlotError, StateError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.mechanics.symmetry.bodies import AXES, Body, bodies
from scvi_codegen.runtime.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["check_plot_path", "draw_section", "draw_trajectory", "plot_section", "plot_trajectory"]

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg")
COLORS = ("#1f5fa8", "#d1495b", "#2e8b57", "#b8860b", "#7a4fa3", "#2b8c9e", "#8c564b", "#555555")
MOST_POINTS = 20_000
MOST_CURVES = 6
FEW_POINTS = 2000
WAY = {1: ", rising", 0: "", -1: ", falling"}
BINS = 600
STYLE = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "lines.linewidth": 1.0,
    "legend.frameon": False,
    "svg.hashsalt": "scvi-codegen",
    "svg.fonttype": "none",
    "figure.dpi": 100,
}


def check_plot_path(path: str | os.PathLike[str]) -> None:
    """Raise now what :func:`plot_trajectory` would raise after a long run.

    Raises:
        StateError: for a suffix other than .png and .svg.
        PlotError: without matplotlib.
    """
    if Path(path).suffix.lower() not in SUFFIXES:
        raise StateError(f"a picture is saved as .png or .svg, not as {str(path)!r}")
    if importlib.util.find_spec("matplotlib") is None:
        raise PlotError("pictures need matplotlib, which is not installed: pip install 'scvi-codegen[plot]'")


def plot_trajectory(trajectory: Trajectory, path: str | os.PathLike[str]) -> None:
    """Draw a trajectory and write the picture, whole or not at all; equal trajectories give equal bytes.

    Args:
        trajectory: what to draw.
        path: the file, .png or .svg.

    Raises:
        StateError, PlotError: as :func:`check_plot_path`.
    """
    _write(lambda: draw_trajectory(trajectory), path)


def plot_section(
    trajectories: Trajectory | Sequence[Trajectory],
    path: str | os.PathLike[str],
    *,
    axes: tuple[str, str],
    event: int = 0,
) -> None:
    """Draw a Poincare section, a colour a trajectory, and write the picture as :func:`plot_trajectory` does.

    Args:
        trajectories: one or several of the same system, integrated with ``events``.
        path: the file, .png or .svg.
        axes: two names of coordinates or momenta (``p_`` before the coordinate, or as the Hamiltonian calls it).
        event: which of the events cuts, by its number.

    Raises:
        StateError: for an unknown name, or without such an event.
        PlotError: as :func:`check_plot_path`.
    """
    several = [trajectories] if isinstance(trajectories, Trajectory) else list(trajectories)
    _write(lambda: draw_section(several, axes, event), path)


def draw_section(trajectories: Sequence[Trajectory], axes: tuple[str, str], event: int = 0) -> Figure:
    """The figure of :func:`plot_section`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.6, 5.2), layout="constrained")
    panel = figure.subplots()
    points = [[_at_crossings(trajectory, name, event) for name in axes] for trajectory in trajectories]
    size = 2.0 if sum(len(x) for x, _ in points) > FEW_POINTS else 4.0
    for number, (x, y) in enumerate(points):
        panel.plot(x, y, ".", color=COLORS[number % len(COLORS)], markersize=size, markeredgewidth=0.0)
    stepper = trajectories[0].stepper
    cut = stepper.events[event]
    panel.set(xlabel=axes[0], ylabel=axes[1])
    panel.set_title(f"{stepper.interface.system}: {cut.function} = 0{WAY[cut.direction]}".replace("$", r"\$"))
    return figure


def _at_crossings(trajectory: Trajectory, name: str, event: int) -> Array:
    """(k,) values of a coordinate or momentum at the crossings of an event."""
    interface = trajectory.stepper.interface
    if not -len(trajectory.events) <= event < len(trajectory.events):
        raise StateError(
            f"there is no event {event} in a trajectory with {len(trajectory.events)}: integrate(..., events=...)"
        )
    found = trajectory.events[event]
    columns = {
        **{name: found.p[:, k] for k, name in enumerate(interface.momenta)},
        **{name: found.q[:, k] for k, name in enumerate(interface.coordinates)},
    }
    if name not in columns:
        raise StateError(f"{name!r} is neither a coordinate nor a momentum; there are {', '.join(sorted(columns))}")
    return columns[name]


def _write(draw: Callable[[], Figure], path: str | os.PathLike[str]) -> None:
    """A figure into a file, whole or not at all, with equal bytes for equal figures."""
    check_plot_path(path)
    import matplotlib as mpl

    kind = Path(path).suffix.lower().removeprefix(".")
    metadata = {"Date": None} if kind == "svg" else {"Software": None}

    def write(file: IO[bytes]) -> None:
        draw().savefig(file, format=kind, dpi=150, metadata=metadata)

    with mpl.rc_context(STYLE):
        write_atomically(path, write)


def draw_trajectory(trajectory: Trajectory) -> Figure:
    """The figure: the motion on the left, the relative energy error over time on the right.

    One coordinate is drawn in the phase plane, bodies by their orbits, a few coordinates in their first planes, many
    coordinates as one image over time.
    """
    from matplotlib.figure import Figure

    coordinates = trajectory.stepper.coordinates
    found, m = bodies(coordinates), len(coordinates)
    spatial = found and len(found[0].columns) == 3
    panels = 3 if spatial or (not found and 3 <= m <= MOST_CURVES) else 2
    figure = Figure(figsize=(4.6 * panels, 4.4), layout="constrained")
    axes = figure.subplots(1, panels)
    if m == 1:
        _draw_phase_plane(axes[0], trajectory)
    elif found:
        for panel, plane in zip(axes[:-1], combinations(range(3), 2), strict=False):
            _draw_orbits(panel, trajectory, found, plane)
        if 1 < len(found) <= len(COLORS):
            figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(found))
    elif m <= MOST_CURVES:
        for panel, plane in zip(axes[:-1], combinations(range(m), 2), strict=False):
            _draw_plane(panel, trajectory, plane)
    else:
        _draw_image(axes[0], trajectory)
    _draw_energy_error(axes[-1], trajectory)
    for panel in axes:
        panel.locator_params(axis="x", nbins=5)
    figure.suptitle(trajectory.stepper.title.replace("$", r"\$"), fontsize=11)
    return figure


def _draw_phase_plane(axes: Axes, trajectory: Trajectory) -> None:
    name = trajectory.stepper.coordinates[0]
    _draw_curve(axes, trajectory.q[:, 0], trajectory.p[:, 0], COLORS[0])
    axes.set(xlabel=name, ylabel=f"p_{name}", title="phase plane")


def _draw_plane(axes: Axes, trajectory: Trajectory, plane: tuple[int, int]) -> None:
    x, y = (trajectory.q[:, index] for index in plane)
    _draw_curve(axes, x, y, COLORS[0])
    names = [trajectory.stepper.coordinates[index] for index in plane]
    axes.set(xlabel=names[0], ylabel=names[1], title="configuration")
    if 0.4 < _extent(x) / max(_extent(y), np.finfo(float).tiny) < 2.5:
        axes.set_aspect("equal", adjustable="datalim")


def _draw_orbits(axes: Axes, trajectory: Trajectory, found: Sequence[Body], plane: tuple[int, int]) -> None:
    for number, body in enumerate(found):
        x, y = (trajectory.q[:, body.columns[index]] for index in plane)
        _draw_curve(axes, x, y, COLORS[number % len(COLORS)], body.name or None)
    axes.set(xlabel=AXES[plane[0]], ylabel=AXES[plane[1]], title="orbits" if len(found) > 1 else "orbit")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_curve(axes: Axes, x: Array, y: Array, color: str, label: str | None = None) -> None:
    """A curve through the states, a ring at the first, a dot at the last; points instead where a curve would tangle."""
    every = max(1, len(x) // MOST_POINTS)
    x_drawn, y_drawn = x[::every], y[::every]
    if _is_coarse(x_drawn, y_drawn):
        axes.plot(x_drawn, y_drawn, ".", color=color, markersize=2.0, alpha=0.7)
    else:
        axes.plot(x_drawn, y_drawn, color=color, linewidth=0.8, alpha=0.8)
    axes.plot(x[:1], y[:1], "o", color=color, markersize=5, fillstyle="none")
    axes.plot(x[-1:], y[-1:], "o", color=color, markersize=5, label=label)


def _is_coarse(x: Array, y: Array) -> bool:
    """Whether a step is long compared with the extent of the curve."""
    if len(x) < 200:
        return False
    size = max(_extent(x), _extent(y))
    return float(np.median(np.hypot(np.diff(x), np.diff(y)))) > 0.1 * size


def _extent(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


def _draw_image(axes: Axes, trajectory: Trajectory) -> None:
    """Many coordinates: one row each, colour for the value."""
    every = max(1, len(trajectory) // 2000)
    values = trajectory.q[::every].T
    bound = float(np.abs(values).max()) or 1.0
    first, last = sorted((float(trajectory.t[0]), float(trajectory.t[-1])))
    span = (first, last if last > first else first + 1.0, 0.5, values.shape[0] + 0.5)
    drawn = values if trajectory.h > 0 else values[:, ::-1]
    image = axes.imshow(
        drawn, aspect="auto", origin="lower", extent=span, cmap="RdBu_r", vmin=-bound, vmax=bound, interpolation="none"
    )
    axes.grid(visible=False)
    axes.set(xlabel="t", ylabel="coordinate", title="q over time")
    axes.figure.colorbar(image, ax=axes, shrink=0.9)


def _draw_energy_error(axes: Axes, trajectory: Trajectory) -> None:
    energy = trajectory.energy()
    scale = abs(energy[0])
    error = np.abs(energy - energy[0]) / (scale or 1.0)
    t, largest = _largest_in_bins(trajectory.t, error)
    axes.plot(t, largest, color=COLORS[0], linewidth=0.9)
    axes.set_yscale("log")
    positive = largest[np.isfinite(largest)]
    if not positive.size:
        positive = np.array([1e-16])
    low = 10.0 ** np.floor(np.log10(positive.min()) - 0.3)
    axes.set_ylim(low, max(10.0 ** np.ceil(np.log10(positive.max()) + 0.3), 10.0 * low))
    title = "relative energy error" if scale else "energy error"
    axes.set(xlabel="t", title=title)


def _largest_in_bins(t: Array, error: Array) -> tuple[Array, Array]:
    """(k,) times and the largest error from each to the next; zeros, which a log axis cannot show, become NaN."""
    size = max(1, len(t) // BINS)
    starts = np.arange(0, len(t), size)
    largest: Any = np.maximum.reduceat(error, starts)
    return t[starts], np.where(largest > 0.0, largest, np.nan)
