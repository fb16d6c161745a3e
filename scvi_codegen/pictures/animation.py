"""Animations of trajectories, for a notebook or a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.errors import PlotError, StateError
from scvi_codegen.files.atomic import replaced
from scvi_codegen.pictures.canvas import check_plot_path, color, plain, style
from scvi_codegen.pictures.shapes import MovingPoints, shape_of
from scvi_codegen.pictures.trajectory_interface import MOTION, Array, DrawnMotion
from scvi_codegen.representation import summary
from scvi_codegen.validation import FUNCTION, PATH, REAL, checks_arguments

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes

FILMS = (".gif", ".html", ".mp4")
FRAMES_PER_SECOND = 25
TRAIL = 0.15
"""Duration of a trail relative to the film."""
TRAIL_POINTS = 400
MARGIN = 0.06
SIZE = 4.8
"""Width and height of the figure in inches."""


@checks_arguments(trajectory=MOTION, path=PATH, seconds=REAL, positions=FUNCTION)
def animate(
    trajectory: DrawnMotion,
    path: str | os.PathLike[str] | None = None,
    *,
    seconds: float = 8.0,
    positions: Callable[[Array], Array] | None = None,
) -> Film:
    """Animate a trajectory: bodies, pendulums, chains, or a point in the plane of its coordinates.

    Bodies are recognised by coordinate names (x, y or sun_x, sun_y, ..), pendulums by their potential energy, with rod
    lengths from parameters named l, or l1, l2, .., for example. Other numbered coordinates are a chain.

    Args:
        trajectory: trajectory to animate; its states at equidistant times are the frames.
        path: file .gif, .html or .mp4 (with ffmpeg); ``None`` to write none.
        seconds: duration of the animation.
        positions: function from q (n, m) to (n, k, 2) or (n, k, 3) positions of k points, instead of those recognised.

    Returns:
        The film, which a notebook displays.

    Raises:
        StateError: for another suffix, a duration that is not positive, or positions of a wrong shape.
        PlotError: without matplotlib, or without ffmpeg for .mp4.
    """
    if path is not None:
        check_plot_path(path, FILMS)
    if not 0.0 < seconds < float("inf"):
        raise StateError(f"seconds must be a positive number, not {seconds!r}")
    film = Film(trajectory, shape_of(trajectory, positions), float(seconds))
    if path is not None:
        film.save(path)
    return film


@dataclass(frozen=True, eq=False)
class Film:
    """Animation, drawn when it is displayed or saved.

    Attributes:
        trajectory: animated trajectory.
        shape: how a state is drawn.
        seconds: duration.
    """

    trajectory: DrawnMotion
    shape: MovingPoints
    seconds: float

    __repr__ = summary("seconds", "trajectory")

    @cached_property
    def frames(self) -> Any:
        """Indices (k,) of the states shown."""
        times = np.abs(self.trajectory.t - self.trajectory.t[0])
        count = min(len(times), max(1, round(self.seconds * FRAMES_PER_SECOND)))
        return np.searchsorted(times, np.linspace(0.0, times[-1], count) * (1.0 + 1e-12), side="right") - 1

    @cached_property
    def animation(self) -> FuncAnimation:
        """Animation of matplotlib, for further options."""
        from matplotlib.animation import FuncAnimation
        from matplotlib.figure import Figure

        with style():
            figure = Figure(figsize=(SIZE, SIZE), layout="constrained")
            scene = _Scene(figure, self.trajectory, self.shape)
            scene.show(0)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # the layout is fixed; recomputing it for every frame is slow
            interval = 1000.0 * self.seconds / len(self.frames)
            return FuncAnimation(figure, scene.show, frames=self.frames, interval=interval, blit=False)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file .gif, .html or .mp4 atomically; raises as :func:`animate`."""
        check_plot_path(path, FILMS)
        from matplotlib.animation import writers

        kind = Path(path).suffix.lower()
        if kind == ".mp4" and not writers.is_available("ffmpeg"):
            raise PlotError(".mp4 animations need ffmpeg, which is not installed; use .gif or .html")
        with style(), replaced(path) as made:
            if kind == ".html":
                made.write_text(self.animation.to_jshtml(), encoding="utf-8")
            else:
                self.animation.save(made, writer="pillow" if kind == ".gif" else "ffmpeg")

    def _repr_html_(self) -> str:
        with style():
            html: str = self.animation.to_jshtml()
        return html


class _Scene:
    """Axes with points, a line through them, and trails, which show one state at a time."""

    def __init__(self, figure: Any, motion: DrawnMotion, shape: MovingPoints) -> None:
        self.motion, self.shape = motion, shape
        self.drawn_points = shape.points(motion.q, motion.p)
        dimension = self.drawn_points.shape[2]
        self.axes: Axes = figure.add_subplot(projection="3d" if dimension == 3 else None)
        self._set_limits(dimension)
        nothing: list[list[float]] = [[]] * dimension
        self.trails = [self.axes.plot(*nothing, color=color(k), linewidth=1.0, alpha=0.5)[0] for k in shape.trails]
        alone: list[Any] = [slice(None)] if shape.joined else list(range(self.drawn_points.shape[1]))
        marks = list(shape.solids) or alone
        names = shape.names or ("",) * len(marks)
        line = "-" if shape.solids else "o-" if shape.joined else "o"
        self.marks = [
            (which, self.axes.plot(*nothing, line, color=color(k), markersize=5, linewidth=1.2, label=name)[0])
            for k, (which, name) in enumerate(zip(marks, names, strict=True))
        ]
        if shape.names:
            self.axes.legend(loc="upper right", fontsize=8)

    def _set_limits(self, dimension: int) -> None:
        flat = self.drawn_points.reshape(-1, dimension)
        flat = flat[np.isfinite(flat).all(axis=1)]
        low, high = flat.min(axis=0), flat.max(axis=0)
        half = (high - low) / 2
        if self.shape.equal:
            half[:] = half.max()
        half = np.where(half > 0.0, half, 1.0) * (1.0 + 2 * MARGIN)
        for letter, label, middle, size in zip("xyz", self.shape.labels, (low + high) / 2, half, strict=False):
            self.axes.set(**{f"{letter}lim": (middle - size, middle + size), f"{letter}label": label})
        if self.shape.equal:
            self.axes.set_aspect("equal")

    def show(self, frame: int) -> list[Any]:
        """Show the state of a frame, and its trails."""
        first = max(0, frame - round(TRAIL * len(self.drawn_points)))
        rows = np.arange(first, frame + 1)[:: max(1, (frame - first) // TRAIL_POINTS)]
        for k, trail in zip(self.shape.trails, self.trails, strict=True):
            _set(trail, np.concatenate([self.drawn_points[rows, k], self.drawn_points[frame : frame + 1, k]]))
        for which, mark in self.marks:
            _set(mark, np.atleast_2d(self.drawn_points[frame, which]))
        interface = self.motion.stepper.interface
        self.axes.set_title(plain(f"{interface.system}, t = {self.motion.t[frame]:.6g}"))
        return [*self.trails, *(mark for _, mark in self.marks)]


def _set(line: Any, points: Array) -> None:
    """Set the points (n, 2) or (n, 3) of a line."""
    if points.shape[1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)
