"""Figures, axes and files of plots, in one style, and the trajectories that can be plotted."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.checks import Kind
from scvi_codegen.api.text import write_atomically
from scvi_codegen.common.errors import PlotError, StateError, StepFailedError
from scvi_codegen.runs.recording import RecordedRun
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from scvi_codegen.api.program import Interface

PICTURES = (".png", ".svg", ".pdf")
COLORS = ("#1f5fa8", "#d1495b", "#2e8b57", "#b8860b", "#7a4fa3", "#2b8c9e", "#8c564b", "#555555")
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


def check_plot_path(path: str | os.PathLike[str], suffixes: tuple[str, ...] = PICTURES) -> None:
    """Check before a long run that a picture can be written; StateError for its suffix, PlotError without library."""
    if Path(path).suffix.lower() not in suffixes:
        formats = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
        raise StateError(f"a picture is saved as {formats}, not as {str(path)!r}")
    _check_matplotlib()


def _check_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise PlotError("pictures need matplotlib, which is not installed: pip install 'scvi-codegen[plot]'")
    try:
        importlib.import_module("matplotlib")
    except ValueError as error:  # of a backend that does not exist
        backend = os.environ.get("MPLBACKEND", "")
        raise PlotError(
            f"matplotlib cannot be imported ({error}): unset the environment variable MPLBACKEND={backend!r}, or set "
            "it to 'agg'"
        ) from error


def style() -> Any:
    """Return the context in which pictures are drawn and written."""
    _check_matplotlib()
    import matplotlib as mpl

    return mpl.rc_context(STYLE)


def new_figure(path: str | os.PathLike[str] | None, size: tuple[float, float]) -> Figure:
    """Return a figure of ``size`` inches; without a path pyplot manages it and notebooks display it."""
    if path is None:
        from matplotlib import pyplot

        figure: Figure = pyplot.figure(figsize=size, layout="constrained")
        return figure
    from matplotlib.figure import Figure

    return Figure(figsize=size, layout="constrained")


@contextmanager
def panel(
    path: str | os.PathLike[str] | None,
    ax: Axes | None,
    size: tuple[float, float] = (5.6, 4.4),
    projection: str | None = None,
) -> Iterator[Axes]:
    """Yield the axes to draw on, ``ax`` or new ones; write the picture to ``path`` if there is one."""
    if path is not None:
        check_plot_path(path)
    with style():
        axes = new_figure(path, size).add_subplot(projection=projection) if ax is None else ax
        yield axes
        if path is not None:
            save(axes.get_figure(root=True), path)


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure to a file atomically."""
    kind = Path(path).suffix.lower().removeprefix(".")
    write_atomically(path, lambda file: write_figure(figure, file, kind))


def write_figure(figure: Any, file: IO[bytes], kind: str) -> None:
    """Write a figure in a format, ``"svg"``, ``"pdf"`` or ``"png"``; equal figures give equal bytes."""
    undated = {"svg": "Date", "pdf": "CreationDate", "png": "Software"}
    figure.savefig(file, format=kind, dpi=150, metadata={undated[kind]: None})


def color(number: int) -> str:
    """Return the colour of curve ``number``."""
    return COLORS[number % len(COLORS)]


def plain(text: str) -> str:
    """Return text with characters escaped that matplotlib would read as a formula."""
    return text.replace("$", r"\$")


Array: TypeAlias = NDArray[np.float64]
Motions: TypeAlias = Trajectory | RecordedRun | Sequence[Trajectory | RecordedRun]
"""One trajectory, or several of the same system."""


def _is_motion(value: Any) -> bool:
    return isinstance(value, Trajectory | RecordedRun)


MOTIONS = Kind(
    "a trajectory or a list of them",
    lambda value: _is_motion(value) or (isinstance(value, Sequence) and all(map(_is_motion, value))),
)


def several(motions: Motions) -> list[Trajectory]:
    """Return trajectories as a list, recorded ones with all their states in memory; StateError if there is none."""
    members = motions if isinstance(motions, Sequence) else [motions]
    if not members:
        raise StateError("there is no trajectory to draw")
    return [motion[:] if isinstance(motion, RecordedRun) else motion for motion in members]


SMOOTH = 2000
"""Number of points of a curve up to which states between adaptive steps are added."""
MOST_NUMBERS = 4_000_000
"""Largest number of coordinates of all points of such a curve."""


def smooth(motion: Trajectory) -> Trajectory:
    """Return a trajectory of adaptive steps with states between its saved ones, by dense output; others as they are."""
    n, equidistant = len(motion.t), motion.has_fixed_steps and motion.tau is None
    if equidistant or motion.observed is not None or n < 2:
        return motion
    parts = min(64, SMOOTH // (n - 1), MOST_NUMBERS // motion.q.size)
    if parts < 2:
        return motion
    return at_times(motion, np.interp(np.arange(n * parts - parts + 1) / parts, range(n), motion.t))


def at_times(motion: Trajectory, times: Array) -> Trajectory:
    """Return a trajectory with the states at times, by dense output, else the saved states before them."""
    inside = np.clip(times, *sorted((motion.t[0], motion.t[-1])))
    try:
        q, p = motion.at(inside)
    except (StateError, StepFailedError):  # a recording, or states within steps
        ahead = np.sign(motion.t[-1] - motion.t[0])
        rows = np.searchsorted(ahead * motion.t, ahead * inside, side="right") - 1
        q, p = (motion.stepper.named(np.asarray(states)[rows]) for states in (motion.q, motion.p))
    return motion._between_states(times, q, p)


def column(interface: Interface, states: Any, name: str) -> Array:
    """Return (n,) values of a coordinate or momentum of states with q and p (n, m); StateError for another name."""
    columns = dict(zip(interface.momenta, states.p.T, strict=True))
    columns |= dict(zip(interface.coordinates, states.q.T, strict=True))
    if name not in columns:
        raise StateError(f"{name!r} is neither a coordinate nor a momentum; known are {', '.join(sorted(columns))}")
    values: Array = columns[name]
    return values
