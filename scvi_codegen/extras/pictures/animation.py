"""Animations of trajectories, for a notebook or a file."""

from __future__ import annotations

import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.api.text import summary, write_atomically
from scvi_codegen.common.errors import PlotError, StateError
from scvi_codegen.extras.pictures.canvas import (
    MOTIONS,
    Array,
    Motions,
    at_times,
    check_plot_path,
    color,
    plain,
    several,
    style,
)
from scvi_codegen.extras.pictures.recognition import shape_of
from scvi_codegen.extras.pictures.shape import DrawnSystem, MovingShape, entry_names, shape_of_picture
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes


def drawn_system_of(motion: Trajectory) -> DrawnSystem:
    """Return what the recognition of a shape reads of a trajectory."""
    stepper: Any = motion.stepper
    q: Any = motion.q
    interface, layout = stepper.interface, stepper.interface.layout
    arrays = stepper.arrays(np.asarray(q)[:1]) if interface.arrays else {a.name: q[a.name] for a in layout.coordinates}
    shapes = {name: np.shape(values)[1:] for name, values in arrays.items()}

    def energy(q: Array, p: Array) -> Array:
        return np.asarray(stepper.energy(q, p, motion.t[0], motion.parameters), dtype=float)

    return DrawnSystem(
        coordinates=interface.coordinates or entry_names(shapes), momenta=interface.momenta,
        parameters=interface.parameters, rotations=interface.rotations, constraints=interface.constraints,
        map_names=interface.map_names, shapes=shapes, energy=None if layout.coordinates else energy,
        mesh=layout.mesh, links=layout.links, lengths=interface.lengths,
        tables=stepper.binding.sizes.places if layout.coordinates else {},
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class _Positions(MovingShape):
    """Points whose positions a function of q returns."""

    function: Callable[[Array], Array]

    def positions(self, t: Any, q: Array, p: Array, parameters: Any) -> Array:
        return np.asarray(self.function(q), dtype=float)


def drawn_shape(
    motion: Trajectory, positions: Callable[[Array], Array] | None = None, picture: Mapping[str, Any] | None = None
) -> MovingShape:
    """Return the shape of a trajectory: that of a function or a picture if one is given, else recognised."""
    if positions is None:
        system = drawn_system_of(motion)
        return shape_of(system) if picture is None else shape_of_picture(system, picture)
    tried = np.shape(positions(motion.q[:1]))
    if len(tried) != 3 or tried[0] != 1 or tried[2] not in (2, 3):
        raise StateError(f"positions(q) must have shape (n, k, 2) or (n, k, 3); for n = 1 it has {tried}")
    numbers = range(tried[1])
    marks = [{"kind": "body", "points": [k]} for k in numbers]
    return _Positions(function=positions, dimension=tried[2], points=[[0]] * tried[1], marks=marks, trails=numbers)


def positions_of(shape: MovingShape, motion: Trajectory) -> Array:
    """Return the points (n, k, d) of a shape in the states of a trajectory."""
    return shape.positions(motion.t, np.asarray(motion.q), np.asarray(motion.p), motion.parameters)


FILMS = (".gif", ".html", ".mp4")
FRAMES_PER_SECOND = 25
TRAIL = 0.15
"""Duration of a trail relative to the film."""
STATES_PER_FRAME = 10
"""Number of states of dense output per frame, for smooth trails."""
QUIET_SECONDS = 1.0
"""Time after which the progress of a film is shown on a terminal."""
TRAIL_POINTS = 400
MARGIN = 0.06
SIZE = 4.8
"""Width and height of the figure in inches."""


@checks_arguments(trajectory=MOTIONS, seconds=Kind.REAL)
def animate(
    trajectory: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    seconds: float = 8.0,
    positions: Callable[[Array], Array] | None = None,
    picture: Mapping[str, Any] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Film:
    """Animate trajectories: bodies, pendulums, robots, chains, fields, or a point in the plane of the coordinates.

    Bodies are recognised by coordinate names (x, y or sun_x, sun_y, ..), pendulums by their potential energy, with rod
    lengths from parameters named l, or l1, l2, .., for example, polar and spherical coordinates by their kinetic
    energy. Other coordinates are a chain.

    Args:
        trajectory: trajectory to animate, or several of the same system, together; states at equidistant times are the
            frames, of adaptive steps by dense output.
        path: file .gif, .html or .mp4 (with ffmpeg); ``None`` to write none.
        seconds: duration of the animation.
        positions: function from q (n, m) to (n, k, 2) or (n, k, 3) positions of k points, instead of those recognised.
        picture: formulas of points, and the rods, springs, walls, bodies and trails between them, instead of what is
            recognised: the section ``[picture]`` of a model file, as :func:`scvi_codegen.page` takes it.
        progress: function called with the number of frames drawn and that of all; by default they are shown on stderr
            if that is a terminal and the animation takes more than a second.

    Returns:
        The film, which a notebook displays.

    Raises:
        StateError: for another suffix, a duration that is not positive, or positions of a wrong shape.
        ModelFileError: for mistakes in ``picture``.
        PlotError: without matplotlib, or without ffmpeg for .mp4.
    """
    if path is not None:
        check_plot_path(path, FILMS)
    if not 0.0 < seconds < float("inf"):
        raise StateError(f"seconds must be a positive number, not {seconds!r}")
    film = Film(trajectory, float(seconds), positions, picture, progress or _shown_on_terminal())
    film.shapes  # noqa: B018  (checks positions and picture)
    if path is not None:
        film.save(path)
    return film


@dataclass(frozen=True, eq=False)
class Film:
    """Animation, drawn when it is displayed or saved.

    Attributes:
        trajectory: animated trajectory, or several.
        seconds: duration.
        positions, picture, progress: as of :func:`animate`.
    """

    trajectory: Motions
    seconds: float
    positions: Callable[[Array], Array] | None = None
    picture: Mapping[str, Any] | None = None
    progress: Callable[[int, int], None] | None = None

    __repr__ = summary("seconds", "trajectory")

    @cached_property
    def shown(self) -> tuple[Trajectory, ...]:
        """Trajectories with the states that are drawn: all, or those of dense output at common times."""
        motions = several(self.trajectory)
        longest = max(motions, key=lambda motion: abs(float(motion.t[-1] - motion.t[0])))
        common = all(len(motion.t) == len(longest.t) and (motion.t == longest.t).all() for motion in motions)
        if common and all(motion.has_fixed_steps for motion in motions):
            return tuple(motions)
        count = max(1, round(self.seconds * FRAMES_PER_SECOND) - 1) * STATES_PER_FRAME + 1
        times = np.linspace(longest.t[0], longest.t[-1], count)
        return tuple(at_times(motion, times) for motion in motions)

    @cached_property
    def shapes(self) -> tuple[MovingShape, ...]:
        """Points and marks that represent the states of each trajectory."""
        return tuple(drawn_shape(motion, self.positions, self.picture) for motion in self.shown)

    @cached_property
    def frames(self) -> Any:
        """Indices (k,) of the states shown."""
        times = np.abs(self.shown[0].t - self.shown[0].t[0])
        count = min(len(times), max(1, round(self.seconds * FRAMES_PER_SECOND)))
        return np.searchsorted(times, np.linspace(0.0, times[-1], count) * (1.0 + 1e-12), side="right") - 1

    @cached_property
    def animation(self) -> FuncAnimation:
        """Animation of matplotlib, for further options."""
        from matplotlib.animation import FuncAnimation
        from matplotlib.figure import Figure

        with style():
            figure = Figure(figsize=(SIZE, SIZE), layout="constrained")
            scene = _Scene(figure, self.shown, self.shapes, partial(self._report, [0]))
            scene.show(0)
            figure.draw_without_rendering()
            figure.set_layout_engine("none")  # the layout is fixed; recomputing it for every frame is slow
            interval = 1000.0 * self.seconds / len(self.frames)
            return FuncAnimation(figure, scene.show, frames=self.frames, interval=interval, blit=False)

    def _report(self, done: list[int]) -> None:
        done[0] += 1
        if self.progress is not None:
            self.progress(min(done[0], len(self.frames)), len(self.frames))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file .gif, .html or .mp4 atomically; raises as :func:`animate`."""
        check_plot_path(path, FILMS)
        from matplotlib.animation import writers

        kind = Path(path).suffix.lower()
        if kind == ".mp4" and not writers.is_available("ffmpeg"):
            raise PlotError(".mp4 animations need ffmpeg, which is not installed; use .gif or .html")
        with style(), tempfile.TemporaryDirectory() as folder:
            new = Path(folder) / f"new{kind}"
            if kind == ".html":
                new.write_text(self.animation.to_jshtml(), encoding="utf-8")
            else:
                self.animation.save(new, writer="pillow" if kind == ".gif" else "ffmpeg")
            write_atomically(path, lambda file: file.write(new.read_bytes()))

    def _repr_html_(self) -> str:
        with style():
            html: str = self.animation.to_jshtml()
        return html


def _shown_on_terminal() -> Callable[[int, int], None]:
    """Return a function that shows the number of frames drawn on stderr, if that is a terminal, after a second."""
    begin = time.monotonic()

    def show(done: int, count: int) -> None:
        if sys.stderr.isatty() and time.monotonic() - begin > QUIET_SECONDS:
            sys.stderr.write(f"\ranimating: frame {done} of {count}" if done < count else "\r\x1b[K")
            sys.stderr.flush()

    return show


WIDTHS = {
    "wall": 2.0,
    "rod": 1.8,
    "bonds": 0.8,
    "link": 1.8,
    "spring": 1.0,
    "arrow": 1.5,
    "curve": 1.2,
    "box": 1.2,
    "top": 1.2,
}
"""Widths of marks that are lines; others are dots."""
SIZES = {"pivot": 3, "particles": 4}
HALF_SIDES = np.array([0.5, 0.3, 0.12])
"""Half sides of the box that represents a rigid body, along its axes."""
EDGES = [0, 1, 3, 2, 0, 4, 5, 1, 5, 7, 3, 7, 6, 2, 6, 4]
"""Path along all edges of a box; bits of a corner are the signs of its three coordinates."""
CORNERS = np.array([[1 if number >> k & 1 else -1 for k in range(3)] for number in EDGES]) * HALF_SIDES
COILS = 10


def _path(kind: str, points: Array) -> Array:
    """Return the line of a mark through its points (k, d): edges of a box, coils of a spring, bonds, or the points."""
    if kind in ("box", "top"):
        centre, axes = points[0], points[1:] - points[0]
        return np.concatenate([centre + CORNERS @ axes, centre[np.newaxis], points[-1:]])
    if kind == "bonds":
        pairs = points.reshape(-1, 2, points.shape[1])
        return np.concatenate([pairs, np.full_like(pairs[:, :1], np.nan)], axis=1).reshape(-1, points.shape[1])
    if kind == "spring":
        along = points[1] - points[0]
        across: Array = np.array([along[1], -along[0]]) if len(along) == 2 else np.cross(along, [0.3, 0.2, 1.0])
        sides = np.array([0.0, 0.0, *[0.06, -0.06] * COILS, 0.0, 0.0])
        shares = np.array([0.0, *np.linspace(0.12, 0.88, 2 * COILS + 2), 1.0])
        points = points[0] + np.multiply.outer(shares, along) + np.multiply.outer(sides, across)
    return points


def _marks_of(shape: MovingShape) -> Sequence[Mapping[str, Any]]:
    """Return the marks of a shape; those of a field are the curves along its last axis."""
    if shape.mesh is None:
        return shape.marks
    sizes = [len(nodes) for nodes in shape.mesh["axes"].values()]
    starts = range(0, math.prod(sizes), sizes[-1])
    return [{"kind": "curve", "points": range(k, k + sizes[-1]), "color": 0, **shape.mesh} for k in starts]


class _Scene:
    """Axes with marks and trails, which show one state of each trajectory at a time."""

    def __init__(
        self, figure: Any, motions: Sequence[Trajectory], shapes: Sequence[MovingShape], report: Callable[[], None]
    ) -> None:
        self.motion, self.report, shape = motions[0], report, shapes[0]
        parts = [positions_of(member, motion) for member, motion in zip(shapes, motions, strict=True)]
        self.points = np.concatenate(parts, axis=1)
        dimension = self.points.shape[2]
        self.axes: Axes = figure.add_subplot(projection="3d" if dimension == 3 else None)
        flat = self.points.reshape(-1, dimension)
        flat = flat[np.isfinite(flat).all(axis=1)]
        low, high = flat.min(axis=0), flat.max(axis=0)
        half = (high - low) / 2
        if shape.equal:
            half[:] = half.max()
        half = np.where(half > 0.0, half, 1.0) * (1.0 + 2 * MARGIN)
        for letter, label, middle, size in zip("xyz", shape.labels or "xyz", (low + high) / 2, half, strict=False):
            self.axes.set(**{f"{letter}lim": (middle - size, middle + size), f"{letter}label": label})
        if shape.equal:
            self.axes.set_aspect("equal")
        if dimension == 3:
            self.axes.locator_params(nbins=5)  # more labels overlap
        self.trails: list[tuple[int, Any]] = []
        self.marks: list[tuple[str, list[int], Any]] = []
        for number in range(len(motions)):
            self._add(shape, number * parts[0].shape[1], number if len(motions) > 1 else None)
        if self.axes.get_legend_handles_labels()[1]:
            self.axes.legend(loc="upper right", fontsize=8)

    def _add(self, shape: MovingShape, first: int, which: int | None) -> None:
        """Add the lines of a shape whose points begin at one, in one colour if it is one of several (``which``)."""
        nothing: list[list[float]] = [[]] * self.points.shape[2]
        bodies = [mark["points"][0] for mark in shape.marks if mark["kind"] in ("body", "bob")]
        for k, point in enumerate(shape.trails):
            own = bodies.index(point) if point in bodies else k
            colour = color(own if which is None else which)
            line = self.axes.plot(*nothing, color=colour, linewidth=1.0, alpha=0.5)[0]
            self.trails.append((first + point, line))
        count = 0
        for mark in _marks_of(shape):
            kind, name, colour = mark["kind"], "", color(which or 0)
            if which is None:
                name, colour = mark.get("name", ""), color(mark.get("color", count))
                colour = "0.35" if kind in ("rod", "wall", "spring", "pivot", "bonds") else colour
            count += kind in ("body", "bob")
            form = "-" if kind in WIDTHS else "o"
            form = "o-" if kind == "link" or mark.get("dots") else form
            size = {"markersize": SIZES.get(kind, 3 if kind in WIDTHS else 5), "linewidth": WIDTHS.get(kind, 0.0)}
            line = self.axes.plot(*nothing, form, color=colour, label=name, **size)[0]
            self.marks.append((kind, [first + k for k in mark["points"]], line))

    def show(self, frame: int) -> list[Any]:
        first = max(0, frame - round(TRAIL * len(self.points)))
        rows = np.arange(first, frame + 1)[:: max(1, (frame - first) // TRAIL_POINTS)]
        for k, trail in self.trails:
            _set(trail, np.concatenate([self.points[rows, k], self.points[frame : frame + 1, k]]))
        for kind, which, line in self.marks:
            _set(line, _path(kind, self.points[frame, which]))
        interface = self.motion.stepper.interface
        self.axes.set_title(plain(f"{interface.system}, t = {self.motion.t[frame]:.6g}"))
        self.report()
        return [line for _, line in self.trails] + [line for *_, line in self.marks]


def _set(line: Any, points: Array) -> None:
    if points.shape[1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)
