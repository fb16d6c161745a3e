"""Pictures of experiments as plain data, panels of curves, and their drawing: one colour per scheme.

A picture is drawn on a Matplotlib figure under :data:`STYLE`; text remains text in SVG. Curves are thinned to what a
page can show, so that a file has tens of kilobytes whatever the run's length.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.pictures.canvas import STYLE as TRAJECTORY_STYLE
from scvi_codegen.pictures.canvas import write_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

STYLE = TRAJECTORY_STYLE | {"font.size": 9, "axes.titlesize": 10, "legend.fontsize": 8}
COLORS = {
    "SVI": "#1f5fa8",
    "SCVI": "#1f5fa8",
    "SC": "#d1495b",
    "SRK": "#2e8b57",
    "printed": "#b8860b",
    "Verlet": "#7a4fa3",
    "Euler": "#2b8c9e",
    "exact": "#888888",
}
"""Colours by scheme, the same in every picture."""
MOST_POINTS = 1500
BINS = 400


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Curve of a panel.

    Attributes:
        x, y: coordinates, equally many; on logarithmic axes NaN and 0 are omitted.
        scheme: key of :data:`COLORS`.
        label: text for the legend, or ``""``.
        end: text at the last point, or ``""``.
        marker, line: styles of Matplotlib.
    """

    x: ArrayLike
    y: ArrayLike
    scheme: str
    label: str = ""
    end: str = ""
    marker: str = ""
    line: str = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Pair of axes with curves.

    Attributes:
        title, xlabel, ylabel: texts.
        series: curves.
        log: logarithmic axes: ``""``, ``"x"``, ``"y"`` or ``"xy"``.
        equal: True for equal scales of both axes.
        window: (lowest, highest) of both axes, or ``None``.
        floor: errors below it are round-off and shaded; 0 for none.
    """

    title: str
    series: tuple[Series, ...]
    xlabel: str = ""
    ylabel: str = ""
    log: str = ""
    equal: bool = False
    window: tuple[float, float] | None = None
    floor: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """Panels row by row, each of ``size`` inches."""

    panels: tuple[Panel, ...]
    columns: int = 1
    size: tuple[float, float] = (4.5, 3.8)

    @property
    def width(self) -> float:
        """Width of the picture in inches."""
        return self.columns * self.size[0]

    def curves(self) -> TableBlock:
        """Return the points of all curves as a table that the page does not show."""
        rows = (
            (panel.title, series.label or series.end or series.scheme, float(x), float(y))
            for panel in self.panels
            for series in panel.series
            for x, y in zip(np.asarray(series.x), np.asarray(series.y), strict=True)
        )
        return TableBlock(name="curves", columns=("panel", "curve", "x", "y"), rows=tuple(rows), shown=False)


def draw(picture: Picture, kind: str) -> bytes:
    """Return the bytes of a picture, ``kind`` being ``"svg"`` or ``"png"``; equal pictures give equal bytes."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    file, rows = io.BytesIO(), -(-len(picture.panels) // picture.columns)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(picture.width, rows * picture.size[1]))
        figure.set_layout_engine("constrained")
        axes = list(np.ravel(figure.subplots(rows, picture.columns, squeeze=False)))
        for each, panel in zip(axes, picture.panels, strict=False):
            _draw_panel(each, panel)
        for unused in axes[len(picture.panels) :]:
            unused.axis("off")
        write_figure(figure, file, kind)
    return file.getvalue()


def thinned(*series: ArrayLike, most: int = MOST_POINTS) -> tuple[Array, ...]:
    """Return every k-th entry of each series, at most ``most``."""
    arrays = [np.asarray(values, dtype=float) for values in series]
    every = max(1, -(-len(arrays[0]) // most))
    return tuple(values[::every] for values in arrays)


def largest_in_bins(t: ArrayLike, error: ArrayLike, *, bins: int = BINS) -> tuple[Array, Array]:
    """Return times and the largest |error| from each to the next."""
    times, values = np.asarray(t, dtype=float), np.abs(np.asarray(error, dtype=float))
    size = max(1, len(times) // bins)
    starts = np.arange(0, max(1, len(times) - size + 1), size)  # the last bin includes the remainder
    largest: Any = np.maximum.reduceat(values, starts)
    return times[starts], largest


def _draw_panel(axes: Axes, panel: Panel) -> None:
    for series in panel.series:
        _draw_series(axes, series, positive="y" in panel.log)
    axes.set(title=panel.title, xlabel=panel.xlabel, ylabel=panel.ylabel)
    if "x" in panel.log:
        axes.set_xscale("log")
    if "y" in panel.log:
        axes.set_yscale("log")
    elif not panel.equal:
        axes.ticklabel_format(useOffset=False)
    if panel.floor:
        bottom, top = axes.get_ylim()
        axes.set_ylim(max(bottom, panel.floor / 100), min(top, 10.0))
        axes.axhspan(panel.floor / 1e9, panel.floor, color=COLORS["exact"], alpha=0.15, linewidth=0)
    if panel.equal:
        axes.set_aspect("equal", adjustable="box" if panel.window else "datalim")
    if panel.window:
        axes.set(xlim=panel.window, ylim=panel.window)
    if any(series.label for series in panel.series):
        axes.legend(fontsize=7)


def _draw_series(axes: Axes, series: Series, *, positive: bool) -> None:
    x, y = np.asarray(series.x, dtype=float), np.asarray(series.y, dtype=float)
    if positive:
        x, y = x[y > 0.0], y[y > 0.0]
    style: dict[str, Any] = {"color": COLORS[series.scheme], "marker": series.marker, "linestyle": series.line}
    style |= {"linewidth": 0.9, "markersize": 1.5 if series.marker == "." else 3.0, "label": series.label or None}
    axes.plot(x, y, **style)
    if series.end and len(x):
        axes.annotate(series.end, (x[-1], y[-1]), fontsize=7, color=COLORS[series.scheme])
