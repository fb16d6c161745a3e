"""Drawing functions shared by the pictures: one colour per scheme, thinned curves, panels of errors.

A picture is drawn on a Matplotlib figure under :data:`STYLE`; text remains text in SVG. Curves are thinned to what a
page can show, so that a file has tens of kilobytes whatever the run's length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.pictures.canvas import STYLE as TRAJECTORY_STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes = Figure = Any  # Matplotlib is imported when a picture is drawn

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


def panels(figure: Figure, rows: int, columns: int) -> list[Axes]:
    """Return axes row by row, laid out without overlap."""
    figure.set_layout_engine("constrained")
    return list(np.ravel(figure.subplots(rows, columns, squeeze=False)))


def thinned(*series: ArrayLike, most: int = MOST_POINTS) -> tuple[Array, ...]:
    """Return every k-th entry of each series, at most ``most``."""
    arrays = [np.asarray(values, dtype=float) for values in series]
    every = max(1, -(-len(arrays[0]) // most))
    return tuple(values[::every] for values in arrays)


def largest_in_bins(t: ArrayLike, error: ArrayLike, *, bins: int = BINS) -> tuple[Array, Array]:
    """Return times and the largest |error| from each to the next; zeros become NaN for a log axis."""
    times, values = np.asarray(t, dtype=float), np.abs(np.asarray(error, dtype=float))
    size = max(1, len(times) // bins)
    starts = np.arange(0, max(1, len(times) - size + 1), size)  # the last bin includes the remainder
    largest: Any = np.maximum.reduceat(values, starts)
    return times[starts], np.where(largest > 0.0, largest, np.nan)


def draw_error(axes: Axes, t: ArrayLike, error: ArrayLike, scheme: str, label: str | None = None, **style: Any) -> None:
    """Draw |error| over time on a log axis: the largest in each of some hundred bins."""
    axes.plot(*largest_in_bins(t, error), **{"color": COLORS.get(scheme), "label": label or scheme} | style)
    axes.set_yscale("log")


def draw_orbit(axes: Axes, x: ArrayLike, y: ArrayLike, scheme: str, label: str | None = None, **style: Any) -> None:
    """Draw a curve in a plane."""
    axes.plot(*thinned(x, y), **{"color": COLORS.get(scheme), "label": label or scheme, "linewidth": 0.8} | style)


def draw_powers(axes: Axes, h: ArrayLike, powers: Sequence[tuple[float, float]]) -> None:
    """Draw lines c h^p for (c, p) in ``powers``, each labelled at its end, on log-log axes."""
    steps = np.asarray(h, dtype=float)
    for constant, power in powers:
        axes.plot(steps, constant * steps**power, color=COLORS["exact"], linestyle=":", linewidth=0.8)
        end = (steps[-1], constant * steps[-1] ** power)
        axes.annotate(f"$h^{{{power:g}}}$", end, fontsize=7, color=COLORS["exact"])
    axes.set(xscale="log", yscale="log")


@dataclass(frozen=True, slots=True, kw_only=True)
class Series:
    """Curve of a panel.

    Attributes:
        x, y: coordinates, equally many; NaN and 0 are omitted.
        scheme: key of ``COLORS``.
        label: text for the legend, or ``""``.
        end: text at the last point, outwards, or ``""``.
        marker, line: styles of Matplotlib.
    """

    x: ArrayLike
    y: ArrayLike
    scheme: str
    label: str = ""
    end: str = ""
    marker: str = "o"
    line: str = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Pair of axes; with ``steps`` x is a step size, on a logarithmic axis."""

    title: str
    series: tuple[Series, ...]
    steps: bool = False
    xlabel: str = "degree s"


def draw_panels(figure: Figure, *, rows: int, columns: int, content: tuple[Panel, ...], floor: float) -> None:
    """Draw all panels row by row; errors below ``floor`` are round-off and shaded."""
    for index, (axes, panel) in enumerate(zip(panels(figure, rows, columns), content, strict=True)):
        for series in panel.series:
            _draw(axes, series)
        axes.set(yscale="log", title=panel.title)
        bottom, top = axes.get_ylim()
        axes.set_ylim(max(bottom, floor / 100), min(top, 10.0))
        axes.axhspan(floor / 1e9, floor, color=COLORS["exact"], alpha=0.15, linewidth=0)
        if axes.get_ylim()[0] < floor / 10:
            alignment = {"x": 0.98, "ha": "right"} if panel.steps else {"x": 0.02}
            axes.text(y=0.02, s="round-off", transform=axes.transAxes, fontsize=7, color=COLORS["exact"], **alignment)
        if panel.steps:
            axes.set_xscale("log")
            left, right = axes.get_xlim()
            axes.set_xlim(left / 1.3, right * 1.4)
        if index >= (rows - 1) * columns:
            axes.set_xlabel("step h" if panel.steps else panel.xlabel)
        if index % columns == 0:
            axes.set_ylabel("error")
        if any(series.label for series in panel.series):
            axes.legend(fontsize=7, **({"loc": "lower right", "bbox_to_anchor": (1, 0.06)} if panel.steps else {}))


def _draw(axes: Axes, series: Series) -> None:
    x, y = np.asarray(series.x, dtype=float), np.asarray(series.y, dtype=float)
    seen = y > 0.0
    x, y, color = x[seen], y[seen], COLORS[series.scheme]
    axes.plot(
        x,
        y,
        color=color,
        label=series.label or None,
        marker=series.marker,
        linestyle=series.line,
        markersize=3.0,
        linewidth=0.9,
    )
    if series.end and len(x):
        outwards = -1 if x[-1] < x[0] else 1
        axes.annotate(
            series.end,
            (x[-1], y[-1]),
            (4 * outwards, 0),
            textcoords="offset points",
            ha="left" if outwards > 0 else "right",
            va="center",
            fontsize=7,
            color=color,
        )
