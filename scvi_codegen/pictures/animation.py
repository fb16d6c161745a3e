"""Animations of trajectories, for a notebook or a file, and recognition of the shapes to animate.

Shapes are recognised from coordinates and energies: bodies, chained pendulums, chains, points.
"""

from __future__ import annotations

import math
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.errors import PlotError, StateError
from scvi_codegen.files.atomic import replaced
from scvi_codegen.mechanics.symmetry.sampling import bodies
from scvi_codegen.pictures.arrays import array_values, mesh_of
from scvi_codegen.pictures.attitudes import solids
from scvi_codegen.pictures.canvas import (
    COLORS,
    MOTIONS,
    Array,
    DrawnMotion,
    Motions,
    at_times,
    check_plot_path,
    color,
    plain,
    several,
    style,
)
from scvi_codegen.pictures.robots import links_of, skeleton
from scvi_codegen.representation import summary
from scvi_codegen.validation import REAL, checks_arguments

if TYPE_CHECKING:
    from matplotlib.animation import FuncAnimation
    from matplotlib.axes import Axes

NUMBERED = re.compile(r"(.*?)_?(\d+)")
LENGTHS = ("l", "L", "length")
"""Names of parameters that are rod lengths, alone or followed by a number."""
MAX_RODS = 6
GENERIC = 0.3, 0.17
"""First angle, and difference between angles, of a state without accidental symmetry."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingPoints:
    """Points, lines and labels that represent a state.

    Attributes:
        points: function from q and p (n, m) to (n, k, d) positions of k points in the plane or in space.
        joined: draw a line through the points of a state.
        solids: slices of points that a line joins each, or none.
        joints: mark the points of solids.
        trails: indices of the points whose paths are drawn.
        labels: labels of the d axes.
        names: names of the points, or none.
        equal: use one scale for all axes.
    """

    points: Callable[[Array, Array], Array]
    labels: tuple[str, ...]
    joined: bool = False
    solids: tuple[slice, ...] = ()
    joints: bool = False
    trails: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    equal: bool = True


def shape_of(motion: DrawnMotion, positions: Callable[[Array], Array] | None = None) -> MovingPoints:
    """Return the shape of a system: bodies by coordinate names, pendulums by energy, else a point or a chain.

    Args:
        motion: trajectory whose coordinates are examined.
        positions: function from q (n, m) to (n, k, 2) or (n, k, 3) positions of k points, instead of those recognised.

    Raises:
        StateError: if ``positions`` returns another shape.
    """
    coordinates, m = motion.stepper.interface.coordinates, motion.q.shape[1]
    if positions is not None:
        tried = np.shape(positions(motion.q[:1]))
        if len(tried) != 3 or tried[0] != 1 or tried[2] not in (2, 3):
            raise StateError(f"positions(q) must have shape (n, k, 2) or (n, k, 3); for n = 1 it has {tried}")
        return MovingPoints(
            points=lambda q, p: np.asarray(positions(q), dtype=float),
            labels=tuple("xyz"[: tried[2]]),
            trails=tuple(range(tried[1])),
        )
    if links_of(motion):
        points, parts, tips = skeleton(motion)
        return MovingPoints(points=lambda q, p: points, labels=tuple("xyz"), solids=parts, trails=tips, joints=True)
    if motion.stepper.interface.rotations:
        return _solids(motion)
    if result := bodies(coordinates):
        columns = np.array([body.columns for body in result])
        names = tuple(body.name for body in result if body.name)
        labels = tuple("xyz"[: columns.shape[1]])
        return MovingPoints(
            points=lambda q, p: q[:, columns], labels=labels, trails=tuple(range(len(result))), names=names
        )
    if (mesh := mesh_of(motion)) is not None and len(mesh.axes) < 3:
        return _graph(motion)
    if (sign := hanging(motion)) is not None:
        return _pendulum(_lengths(motion), sign)
    if m == 1:
        labels = (coordinates[0], motion.stepper.interface.momenta[0])
        return MovingPoints(points=lambda q, p: np.stack([q, p], axis=2), labels=labels, trails=(0,), equal=False)
    if m == 2:
        return MovingPoints(points=lambda q, p: q[:, np.newaxis], labels=tuple(coordinates), trails=(0,))
    positions_of_indices = np.arange(1.0, m + 1)
    return MovingPoints(
        points=lambda q, p: np.stack([np.broadcast_to(positions_of_indices, q.shape), q], axis=2),
        labels=("number of the coordinate", "q"),
        joined=True,
        equal=False,
    )


def _solids(motion: DrawnMotion) -> MovingPoints:
    """Return a box for each rotation, an arrow for each direction and spin, at (x, y, z) if these are coordinates."""
    coordinates = motion.stepper.interface.coordinates
    columns = [coordinates.index(name) for name in "xyz" if name in coordinates]
    centres = motion.q[:, columns] if len(columns) == 3 else np.zeros((len(motion.q), 3))
    points, parts, trails = solids(motion, centres)
    return MovingPoints(points=lambda q, p: points, labels=tuple("xyz"), solids=parts, trails=trails)


def _graph(motion: DrawnMotion) -> MovingPoints:
    """Return the graph of the first field of a mesh, a line over x or the lines of a surface over x and y."""
    mesh, (name, values) = mesh_of(motion), array_values(motion, None)
    points = np.stack([*(np.broadcast_to(grid, values.shape) for grid in mesh.points.values()), values], axis=-1)
    count = values.shape[-1]
    lines = tuple(slice(k, k + count) for k in range(0, values[0].size, count))
    return MovingPoints(
        points=lambda q, p: points.reshape(len(points), -1, points.shape[-1]),
        labels=(*(axis.name for axis in mesh.axes), name),
        solids=lines,
        equal=False,
    )


def _pendulum(lengths: Array, sign: float) -> MovingPoints:
    """Return a chain of rods, each hanging from (sign 1) or standing on (-1) the end of the previous one."""

    def points(q: Array, p: Array) -> Array:
        rods = np.stack([lengths * np.sin(q), -sign * lengths * np.cos(q)], axis=2)
        ends = np.cumsum(rods, axis=1)
        return np.concatenate([np.zeros_like(ends[:, :1]), ends], axis=1)

    return MovingPoints(points=points, labels=("x", "y"), joined=True, trails=(len(lengths),))


def hanging(motion: DrawnMotion) -> float | None:
    """Return 1 if the coordinates are angles of pendulums that hang at 0, -1 if upright there, else ``None``."""
    # V = sum a_i (1 - cos q_i), all a_i of one sign; T of two neighbouring momenta is not the sum of that of each.
    numbers, m = numbers_of(motion.stepper.interface.coordinates), motion.q.shape[1]
    if m > MAX_RODS or (m > 1 and numbers is None):
        return None
    generic = GENERIC[0] + GENERIC[1] * np.arange(m)
    q = np.concatenate([np.zeros((1, m)), math.pi * np.eye(m), [generic]])
    try:
        at_rest = _energies(motion, q, np.zeros_like(q))
        a = (at_rest[1:-1] - at_rest[0]) / 2
        expected = at_rest[0] + a @ (1.0 - np.cos(generic))
        alone, both = np.eye(m), np.eye(m)[:-1] + np.eye(m)[1:]
        kinetic = _energies(motion, np.zeros_like(alone), alone) - at_rest[0]
        coupled = _energies(motion, np.zeros_like(both), both) - at_rest[0] - kinetic[:-1] - kinetic[1:]
    except StateError:
        return None
    close = math.isclose(at_rest[-1], expected, rel_tol=0.0, abs_tol=1e-9 * float(np.abs(a).max()))
    one_sign = bool((a > 0.0).all() or (a < 0.0).all())
    together = bool((np.abs(coupled) > 1e-9 * np.abs(kinetic).max()).all())
    return float(np.sign(a[0])) if close and one_sign and together else None


def _energies(motion: DrawnMotion, q: Array, p: Array) -> Array:
    return np.asarray(motion.stepper.energy(q, p, motion.t[0], motion.parameters), dtype=float)


def numbers_of(names: Sequence[str]) -> tuple[int, ...] | None:
    """Return the numbers of theta_1, theta_2, .. or theta1, theta2, ..; ``None`` for other names."""
    result = [NUMBERED.fullmatch(name) for name in names]
    if not all(result) or len({match[1] for match in result if match}) > 1:
        return None
    return tuple(int(match[2]) for match in result if match)


def _lengths(motion: DrawnMotion) -> Array:
    """Return (m,) rod lengths, from parameters by name; 1 if there is none."""
    interface, m = motion.stepper.interface, motion.q.shape[1]
    values = dict(zip(interface.parameters, motion.parameters, strict=True))
    numbers = numbers_of(interface.coordinates) or (0,) * m
    lengths = []
    for number in numbers:
        names = [f"{name}{end}" for end in (number, f"_{number}", "") for name in LENGTHS]
        lengths.append(next((float(values[name]) for name in names if name in values), 1.0))
    return np.array(lengths)


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


@checks_arguments(trajectory=MOTIONS, seconds=REAL)
def animate(
    trajectory: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    seconds: float = 8.0,
    positions: Callable[[Array], Array] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Film:
    """Animate trajectories: bodies, pendulums, robots, chains, fields, or a point in the plane of the coordinates.

    Bodies are recognised by coordinate names (x, y or sun_x, sun_y, ..), pendulums by their potential energy, with rod
    lengths from parameters named l, or l1, l2, .., for example. Other numbered coordinates are a chain.

    Args:
        trajectory: trajectory to animate, or several of the same system, together; states at equidistant times are the
            frames, of adaptive steps by dense output.
        path: file .gif, .html or .mp4 (with ffmpeg); ``None`` to write none.
        seconds: duration of the animation.
        positions: function from q (n, m) to (n, k, 2) or (n, k, 3) positions of k points, instead of those recognised.
        progress: function called with the number of frames drawn and that of all; by default they are shown on stderr
            if that is a terminal and the animation takes more than a second.

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
    film = Film(trajectory, float(seconds), positions, progress or _shown_on_terminal())
    film.shapes  # noqa: B018  (checks positions)
    if path is not None:
        film.save(path)
    return film


@dataclass(frozen=True, eq=False)
class Film:
    """Animation, drawn when it is displayed or saved.

    Attributes:
        trajectory: animated trajectory, or several.
        seconds: duration.
        positions, progress: as of :func:`animate`.
    """

    trajectory: Motions
    seconds: float
    positions: Callable[[Array], Array] | None = None
    progress: Callable[[int, int], None] | None = None

    __repr__ = summary("seconds", "trajectory")

    @cached_property
    def shown(self) -> tuple[DrawnMotion, ...]:
        """Trajectories with the states that are drawn: all, or those of dense output at common times."""
        motions = several(self.trajectory)
        longest = max(motions, key=lambda each: abs(float(each.t[-1] - each.t[0])))
        common = all(len(each.t) == len(longest.t) and (each.t == longest.t).all() for each in motions)
        if common and all(plan is None or plan.fixed for plan in (getattr(each, "plan", None) for each in motions)):
            return tuple(motions)
        count = max(1, round(self.seconds * FRAMES_PER_SECOND) - 1) * STATES_PER_FRAME + 1
        times = np.linspace(longest.t[0], longest.t[-1], count)
        return tuple(at_times(each, times) for each in motions)

    @cached_property
    def shapes(self) -> tuple[MovingPoints, ...]:
        """Points, lines and labels that represent the states of each trajectory."""
        return tuple(shape_of(each, self.positions) for each in self.shown)

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
        with style(), replaced(path) as new:
            if kind == ".html":
                new.write_text(self.animation.to_jshtml(), encoding="utf-8")
            else:
                self.animation.save(new, writer="pillow" if kind == ".gif" else "ffmpeg")

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


class _Scene:
    """Axes with points, a line through them, and trails, which show one state of each trajectory at a time."""

    def __init__(
        self, figure: Any, motions: Sequence[DrawnMotion], shapes: Sequence[MovingPoints], report: Callable[[], None]
    ) -> None:
        self.motion, self.shape, self.report = motions[0], shapes[0], report
        parts = [each.points(motion.q, motion.p) for each, motion in zip(shapes, motions, strict=True)]
        self.drawn_points = np.concatenate(parts, axis=1)
        shape, count, alone = shapes[0], parts[0].shape[1], len(motions) == 1
        dimension = self.drawn_points.shape[2]
        self.axes: Axes = figure.add_subplot(projection="3d" if dimension == 3 else None)
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
        if dimension == 3:
            self.axes.locator_params(nbins=5)  # more labels overlap
        nothing: list[list[float]] = [[]] * dimension
        single = [slice(0, count)] if shape.joined else [slice(k, k + 1) for k in range(count)]
        marks = list(shape.solids) or single
        names = shape.names if shape.names and alone else ("",) * len(marks)
        few = len(marks) <= len(COLORS)  # a surface has one colour
        line = "o-" if shape.joined or shape.joints else "-" if shape.solids else "o"
        form = {"markersize": 3 if shape.joints else 5, "linewidth": 1.2}
        self.trails, self.marks = [], []
        for number in range(len(motions)):
            for k in shape.trails:
                drawn = color(k if alone and not shape.joints else number)
                trail = self.axes.plot(*nothing, color=drawn, linewidth=1.0, alpha=0.5)[0]
                self.trails.append((number * count + k, trail))
            for k, (which, name) in enumerate(zip(marks, names, strict=True)):
                drawn = color(k * few if alone else number)
                mark = self.axes.plot(*nothing, line, color=drawn, label=name, **form)[0]
                self.marks.append((slice(number * count + which.start, number * count + which.stop), mark))
        if any(names):
            self.axes.legend(loc="upper right", fontsize=8)

    def show(self, frame: int) -> list[Any]:
        first = max(0, frame - round(TRAIL * len(self.drawn_points)))
        rows = np.arange(first, frame + 1)[:: max(1, (frame - first) // TRAIL_POINTS)]
        for k, trail in self.trails:
            _set(trail, np.concatenate([self.drawn_points[rows, k], self.drawn_points[frame : frame + 1, k]]))
        for which, mark in self.marks:
            _set(mark, self.drawn_points[frame, which])
        interface = self.motion.stepper.interface
        self.axes.set_title(plain(f"{interface.system}, t = {self.motion.t[frame]:.6g}"))
        self.report()
        return [line for _, line in (*self.trails, *self.marks)]


def _set(line: Any, points: Array) -> None:
    if points.shape[1] == 3:
        line.set_data_3d(*points.T)
    else:
        line.set_data(*points.T)
