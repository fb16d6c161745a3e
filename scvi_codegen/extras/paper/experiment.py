"""Experiments, results and pictures as plain data, and their report: setting, claims, measurements, verdicts.

The report is one HTML page with MathML, without script or network, which adapts to dark mode, narrow screens and
paper. Pictures are drawn by Matplotlib under :data:`STYLE`: one colour per scheme, and curves thinned to what a page
shows.
"""

from __future__ import annotations

import base64
import csv
import io
import re
import textwrap
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from markupsafe import Markup
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.text import TableBlock, write_atomically
from scvi_codegen.extras.derivation.writing import SPACE, page_template, style_sheet
from scvi_codegen.extras.pictures.canvas import STYLE as TRAJECTORY_STYLE
from scvi_codegen.extras.pictures.canvas import write_figure
from scvi_codegen.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Verdict(Enum):
    """Verdict on a statement of the paper."""

    HOLDS = "holds"
    PARTLY = "holds in part"
    FAILS = "does not hold"
    SHOWN = "shown"
    """No claim, or none that can be decided."""


def judged(*conditions: bool) -> Verdict:
    """Return ``HOLDS`` if all conditions do, ``FAILS`` if none does, else ``PARTLY``."""
    if all(conditions):
        return Verdict.HOLDS
    return Verdict.PARTLY if any(conditions) else Verdict.FAILS


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Statement of the paper and the measurement that tests it.

    Attributes:
        claim: statement of the paper, in one sentence.
        measured: measurement, in one sentence with its numbers.
        verdict: whether they agree.
        bears_on: keys of the claims (:mod:`scvi_codegen.extras.paper.experiment`) that this decides.
    """

    claim: str
    measured: str
    verdict: Verdict
    bears_on: tuple[str, ...] = ()


def comparison(claim: str, measured: str, *conditions: object, bears_on: str = "") -> Comparison:
    """Return a comparison whose verdict follows from conditions; without any it is only shown."""
    verdict = judged(*map(bool, conditions)) if conditions else Verdict.SHOWN
    return Comparison(claim=claim, measured=measured, verdict=verdict, bears_on=tuple(bears_on.split()))


def common_verdict(checks: Iterable[Comparison]) -> Verdict:
    """Return the verdict of several checks: ``PARTLY`` if they differ, ``SHOWN`` if none decides anything."""
    result = {check.verdict for check in checks} - {Verdict.SHOWN}
    if not result:
        return Verdict.SHOWN
    return result.pop() if len(result) == 1 else Verdict.PARTLY


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """Result of an experiment.

    Attributes:
        name: name, as ``"figure-4"``; set by :meth:`Experiment.result`.
        title: the paper's title, one line; by default that of the experiment.
        setting: what was run, and how details that the caption omits were chosen, a sentence each.
        checks: claims and measurements.
        tables: numbers; the first has no name.
        picture: picture, or ``None``.
    """

    name: str = ""
    title: str = ""
    setting: tuple[str, ...] = ()
    checks: tuple[Comparison, ...] = ()
    tables: tuple[TableBlock, ...] = ()
    picture: Picture | None = None

    @property
    def verdict(self) -> Verdict:
        """Common verdict of all checks; ``PARTLY`` if they differ, ``SHOWN`` if there is none."""
        return common_verdict(self.checks)


Run: TypeAlias = Callable[[Mapping[str, Result]], Result]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Part of the paper that can be reproduced.

    Attributes:
        name: name on the command line.
        title: one line.
        run: function that returns the result, called with the results of ``needs``, by name.
        needs: names of experiments whose results it judges.
    """

    name: str
    title: str
    run: Run
    needs: tuple[str, ...] = ()

    def result(self, needs: Mapping[str, Result]) -> Result:
        """Return the result with the name of the experiment, and its title unless it has one."""
        result = self.run(needs)
        return replace(result, name=self.name, title=result.title or self.title)


def package_table(name: str) -> dict[str, Any]:
    """Return the document in a file of this folder."""
    table: dict[str, Any] = tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))
    return table


CLAIMS: Mapping[str, str] = package_table("paper.toml")["claims"]
"""Claims by the keys that checks name in ``bears_on``."""

EVIDENCE = ("figure-1", *(f"figure-{k}" for k in range(3, 31)), "table-8", "table-9", "correction")
"""Experiments whose checks are collected."""


def claims(results: Mapping[str, Result]) -> Result:
    """Return a row for each claim, with the checks that decide it."""
    checks = [(name, check) for name in EVIDENCE if name in results for check in results[name].checks]
    rows = []
    for key, claim in CLAIMS.items():
        evidence = [(name, check) for name, check in checks if key in check.bears_on]
        names = {verdict: [name for name, check in evidence if check.verdict is verdict] for verdict in Verdict}
        parts = [f"{len(of)} {verdict.value} ({', '.join(dict.fromkeys(of))})" for verdict, of in names.items() if of]
        measured = f"Of {len(evidence)} checks: {'; '.join(parts)}." if parts else "No check bears on it."
        rows.append(Comparison(claim=claim, measured=measured, verdict=common_verdict(check for _, check in evidence)))
    missing = ", ".join(name for name in EVIDENCE if name not in results)
    return Result(
        setting=(
            "Every check of a figure or table names the claims that it bears on; here they are collected.",
            "A claim holds if all its checks hold, does not hold if none does, and holds in part otherwise; a claim "
            "without a check is only shown.",
            f"Collected from {len(results)} of {len(EVIDENCE)} experiments{'; without ' if missing else ''}{missing}.",
        ),
        checks=tuple(rows),
    )


EXPERIMENTS = (
    Experiment(name="claims", title="The claims of the paper, one verdict each", run=claims, needs=EVIDENCE),
)


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
        floor: errors below it are round-off and shaded, if there is such a level.
    """

    title: str
    series: tuple[Series, ...]
    xlabel: str = ""
    ylabel: str = ""
    log: str = ""
    equal: bool = False
    window: tuple[float, float] | None = None
    floor: float | None = None


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
        for panel_axes, panel in zip(axes, picture.panels, strict=False):
            _draw_panel(panel_axes, panel)
        for unused in axes[len(picture.panels) :]:
            unused.axis("off")
        write_figure(figure, file, kind)
    return file.getvalue()


def thinned(*series: ArrayLike) -> tuple[Array, ...]:
    """Return every k-th entry of each series, at most ``MOST_POINTS``."""
    arrays = [np.asarray(values, dtype=float) for values in series]
    every = max(1, -(-len(arrays[0]) // MOST_POINTS))
    return tuple(values[::every] for values in arrays)


def largest_in_bins(t: ArrayLike, error: ArrayLike) -> tuple[Array, Array]:
    """Return times and the largest |error| from each to the next."""
    times, values = np.asarray(t, dtype=float), np.abs(np.asarray(error, dtype=float))
    size = max(1, len(times) // BINS)
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
    if panel.floor is not None:
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


def label(name: str) -> str:
    """Return the name of an experiment as in the paper: ``figure-4`` as Figure 4, ``tables-6-7`` as Tables 6-7."""
    first, *rest = name.split("-", 1)
    return " ".join([first.capitalize(), *rest])


def linked(text: Markup, names: Collection[str]) -> Markup:
    """Return text with links to the sections of the experiments that it names; names without a digit are words."""
    numbered = sorted((re.escape(name) for name in names if re.search(r"\d", name)), key=len, reverse=True)
    if not numbered:
        return text
    pattern = re.compile(rf"(?<![\w-])({'|'.join(numbered)})(?![\w-]|\.\d)")
    return Markup(pattern.sub(lambda match: f'<a href="#{match[0]}">{label(match[0]).replace(" ", SPACE)}</a>', text))


TITLE = "The paper, run again"
PLURALS = {Verdict.HOLDS: "hold", Verdict.PARTLY: "hold in part", Verdict.FAILS: "do not hold", Verdict.SHOWN: "shown"}


def report_html(results: Sequence[Result]) -> str:
    """Return the page: a table of all verdicts, then one section per result; a single result is a page of its own.

    Requires Matplotlib if a result has a picture.
    """
    pictures = {result.name: _picture(result) for result in results}
    alone = len(results) == 1
    page = page_template("report.html.jinja", label=label, caption=_caption, linked=linked)
    return page.render(
        title=results[0].title if alone else TITLE,
        alone=alone,
        body_class="alone" if alone else "",
        results=results,
        names=[] if alone else list(pictures),
        counts=tally([result.verdict for result in results]),
        check_counts=tally([check.verdict for result in results for check in result.checks]),
        pictures=pictures,
        css=style_sheet("page.css", "report.css"),
        version=__version__,
    )


def tally(verdicts: Sequence[Verdict]) -> list[tuple[Verdict, str]]:
    """Return the number of occurrences of each verdict: ``"3 hold"``, ``"1 does not hold"``."""
    counts = Counter(verdicts)
    return [
        (verdict, f"{counts[verdict]} {verdict.value if counts[verdict] == 1 else PLURALS[verdict]}")
        for verdict in Verdict
        if counts[verdict]
    ]


def _picture(result: Result) -> Markup:
    """Return the picture as an element with the SVG document inside; it stays light in dark mode."""
    if result.picture is None:
        return Markup()
    document = base64.b64encode(draw(result.picture, "svg")).decode()
    image = Markup('<img src="data:image/svg+xml;base64,{}" alt="{}" style="--width:{:g}in">')
    return image.format(document, f"{label(result.name)}. {result.title}", result.picture.width)


def _caption(result: Result, table: TableBlock) -> str:
    return f"Data of {label(result.name)}{table.name and ': '}{table.name.replace('-', ' ')}"


# Files of a result: NAME.svg, NAME.png, NAME.csv, and NAME.txt with the statement; each written atomically.

WIDTH = 100


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write the files of a result into an existing folder; return their paths."""
    written = []

    def write(name: str, content: bytes) -> None:
        path = folder / name
        write_atomically(path, lambda file: file.write(content))
        written.append(path)

    if result.picture is not None:
        write(f"{result.name}.svg", draw(result.picture, "svg"))
        write(f"{result.name}.png", draw(result.picture, "png"))
    for table in result.tables:
        write(f"{'-'.join(filter(None, (result.name, table.name)))}.csv", csv_text(table).encode())
    write(f"{result.name}.txt", statement(result).encode())
    return written


def csv_text(table: TableBlock) -> str:
    """Return CSV with a line of headings; floats in full precision."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return file.getvalue()


def statement(result: Result) -> str:
    """Return setting, claims and measurements as text."""
    lines = [f"{result.name}: {result.title}", f"verdict: {result.verdict.value}", ""]
    lines += [line for sentence in result.setting for line in _wrapped(sentence)]
    for check in result.checks:
        lines += ["", *_wrapped(f"paper:    {check.claim}"), *_wrapped(f"measured: {check.measured}")]
        lines += [f"verdict:  {check.verdict.value}"]
    return "\n".join(lines) + "\n"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)
