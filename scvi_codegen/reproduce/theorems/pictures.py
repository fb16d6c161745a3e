"""Panels of errors on logarithmic axes, over the step size or the degree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scvi_codegen.reproduce.laboratory.drawing import COLORS, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["Panel", "Series", "draw_panels"]


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

    x: Sequence[float]
    y: Sequence[float]
    scheme: str
    label: str = ""
    end: str = ""
    marker: str = "o"
    line: str = "-"


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Pair of axes; with ``steps`` x is a step size on a logarithmic axis, otherwise a degree."""

    title: str
    series: tuple[Series, ...]
    steps: bool = False


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
            axes.set_xlabel("step h" if panel.steps else "degree s")
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
