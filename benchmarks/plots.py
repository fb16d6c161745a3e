"""Work-precision plots: time against error, one panel per problem, one line per method through its settings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from benchmarks.report import OURS, CaseResult
from scvi_codegen.extras.pictures.canvas import COLORS, check_plot_path, save, style

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLUMNS = 3
PANEL, LINE = (4.6, 3.8), 0.25
"""Sizes in inches: of a panel; height of a line of the legend."""
LINES = ("-", "--", ":", "-.")
MOST_ABREAST = 4
"""Largest number of methods in a line of the legend; two for a single panel."""


def plot_curves(results: Sequence[CaseResult], path: str | os.PathLike[str]) -> None:
    """Draw all cases into one file, .png or .svg.

    Raises:
        StateError: for another suffix.
        PlotError: without matplotlib.
    """
    check_plot_path(path)
    with style():
        save(draw_curves(results), path)


def draw_curves(results: Sequence[CaseResult]) -> Figure:
    """Return the figure: logarithmic axes, better is down and to the left; a method has one colour in all panels."""
    from matplotlib.figure import Figure

    columns = min(COLUMNS, len(results))
    lines = -(-len(results) // columns)
    methods = list(dict.fromkeys(method for result in results for method in result.methods()))
    abreast = min(2 * columns, MOST_ABREAST)
    width, height = (PANEL[0] * columns, PANEL[1] * lines + LINE * -(-len(methods) // abreast))
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    looks = {method: look_of(number) for number, method in enumerate(methods)}
    handles: dict[str, Artist] = {}
    for panel, result in zip(panels, results, strict=False):
        for method in result.methods():
            handles[method] = _draw_method(panel, result, method, looks[method])
        panel.set(xscale="log", yscale="log", xlabel="time of a trajectory, ms", ylabel="error", title=result.name)
        label_times(panel)
    for panel in panels[len(results) :]:
        panel.set_visible(False)
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=abreast)
    return figure


def label_times(axes: Axes) -> None:
    """Label times as 0.1, 0.2, 0.5, 1, .. ms, as many as fit."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def look_of(number: int) -> dict[str, str]:
    """Return colour and line style of a method; styles change when all colours are used."""
    return {"color": COLORS[number % len(COLORS)], "linestyle": LINES[number // len(COLORS) % len(LINES)]}


def _draw_method(axes: Axes, result: CaseResult, method: str, look: Mapping[str, str]) -> Artist:
    points = [each for each in result.measurements if each.method == method and not each.failure]
    x, y = [1e3 * point.seconds for point in points], [max(point.error, 1e-18) for point in points]
    width, marker = (2.0, "o") if method.startswith(OURS) else (1.0, "s")
    line: Artist = axes.plot(x, y, **look, linewidth=width, marker=marker, markersize=4)[0]
    return line
