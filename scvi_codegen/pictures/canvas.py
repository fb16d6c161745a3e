"""Figures, axes and files of plots, in one style."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from scvi_codegen.errors import PlotError, StateError
from scvi_codegen.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES = (".png", ".svg")
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
    """Check before a long run that a picture can be written.

    Raises:
        StateError: for a suffix that is none of ``suffixes``.
        PlotError: without matplotlib.
    """
    if Path(path).suffix.lower() not in suffixes:
        known = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
        raise StateError(f"a picture is saved as {known}, not as {str(path)!r}")
    _check_matplotlib()


def _check_matplotlib() -> None:
    if importlib.util.find_spec("matplotlib") is None:
        raise PlotError("pictures need matplotlib, which is not installed: pip install 'scvi-codegen[plot]'")


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
    path: str | os.PathLike[str] | None, ax: Axes | None, size: tuple[float, float] = (5.6, 4.4)
) -> Iterator[Axes]:
    """Yield the axes to draw on, ``ax`` or new ones; write the picture to ``path`` if there is one."""
    if path is not None:
        check_plot_path(path)
    with style():
        drawn = new_figure(path, size).add_subplot() if ax is None else ax
        yield drawn
        if path is not None:
            save(drawn.get_figure(root=True), path)


def save(figure: Any, path: str | os.PathLike[str]) -> None:
    """Write a figure to a file atomically."""
    kind = Path(path).suffix.lower().removeprefix(".")
    write_atomically(path, lambda file: write_figure(figure, file, kind))


def write_figure(figure: Any, file: IO[bytes], kind: str) -> None:
    """Write a figure in a format, ``"svg"`` or ``"png"``; equal figures give equal bytes."""
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    figure.savefig(file, format=kind, dpi=150, metadata=metadata)


def color(number: int) -> str:
    """Return the colour of curve ``number``."""
    return COLORS[number % len(COLORS)]


def plain(text: str) -> str:
    """Return text with characters escaped that matplotlib would read as a formula."""
    return text.replace("$", r"\$")
