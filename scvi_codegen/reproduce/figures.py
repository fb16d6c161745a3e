"""Figures of runs (1, 3-5, 9-15, 21-30): views turn runs into panels, checks into numbers and conditions of a verdict.

Their settings, views and checks are those of ``figures.toml``.
"""

import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, TypeAlias

from numpy.typing import ArrayLike

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.errors import MethodWarning
from scvi_codegen.files.toml_text import package_table
from scvi_codegen.methods import as_method, method_from_specification
from scvi_codegen.reproduce.drawing import Panel, Picture, Series, largest_in_bins, thinned
from scvi_codegen.reproduce.experiment import Comparison, Experiment, Result, comparison
from scvi_codegen.reproduce.runs import EXACT, MEASURES, PERIOD, SECTION_3, MeasuredRun, RunSetting, Scheme, system_of

Runs: TypeAlias = Mapping[str, MeasuredRun]
View: TypeAlias = Callable[[Runs], Iterable[Panel]]


def compared(claim: str, check: str, runs: Runs) -> Comparison:
    """Return the comparison of a claim with measurements.

    Args:
        claim: statement of the paper.
        check: ``"ATTRIBUTE: CONDITION, ..; ATTRIBUTE: ..|CLAIMS|NOTE"``. A condition is a chain such as
            ``svi < 1e-6 < sc`` or ``100*svi < sc`` of numbers and absolute values of the attribute for runs by key; a
            key alone is only listed. CLAIMS are keys of :mod:`scvi_codegen.reproduce.claims`; NOTE is appended.
        runs: runs by key.
    """
    conditions, claims, note = (part.strip() for part in f"{check}||".split("|")[:3])
    measured, outcomes = [], []
    for part in conditions.split(";"):
        attribute, _, chains = (text.strip() for text in part.partition(":"))
        terms = [[term.strip() for term in chain.split("<")] for chain in chains.split(",")]
        keys = dict.fromkeys(term.split("*")[-1] for chain in terms for term in chain)
        measure, named = MEASURES[attribute], [runs[key] for key in keys if key in runs]
        texts = ((getattr(run, attribute), run.label) for run in named)
        listed = ", ".join(f"{'none' if x is None else format(x, measure.form)} ({label})" for x, label in texts)
        measured.append(f"{measure.heading}: {listed}")
        for chain in terms:
            values = [_value(term, attribute, runs) for term in chain]
            outcomes += [all(x < y for x, y in pairwise(values))] if len(values) > 1 else []
    sentence = "; ".join(measured)
    text = f"{sentence[:1].upper()}{sentence[1:]}. {note}".strip()
    return comparison(claim, text, *outcomes, bears_on=claims)


def _value(term: str, attribute: str, runs: Runs) -> float:
    """Return a number, or the absolute value of the attribute of a run, times a factor; NaN if it has none."""
    factor, _, key = term.rpartition("*")
    if key not in runs:
        return float(term)
    value = getattr(runs[key], attribute)
    return math.nan if value is None else float(factor or 1.0) * abs(value)


def figure(name: str, title: str, setting: RunSetting, views: Sequence[View], checks: str) -> Experiment:
    """Return the experiment that runs the schemes of a setting, draws views of them and tests statements.

    Args:
        name: name of the experiment, ``"figure-1"``.
        title: title of the experiment.
        setting: problem and schemes.
        views: functions that return the panels.
        checks: statements of the paper, a line each, followed by indented lines as in :func:`compared`.
    """
    tests = re.findall(r"^(\S.*)\n((?:[ ]+.*(?:\n|$))+)", checks, re.MULTILINE)
    measures = dict.fromkeys(re.findall(r"(\w+):", " ".join(test.split("|")[0] for _, test in tests)))

    def run(_: Mapping[str, Result]) -> Result:
        runs = {key: setting.run(key) for key in setting.schemes}
        panels = tuple(panel for view in views for panel in view(runs))
        size, columns = ((7.0, 4.2), 1) if len(panels) == 1 else ((4.0, 3.8), 2 if len(panels) in (2, 4) else 3)
        picture = Picture(panels=panels, columns=columns, size=size)
        return Result(
            setting=setting.sentences,
            checks=tuple(compared(claim, " ".join(test.split()), runs) for claim, test in tests),
            tables=(measured_table(runs, list(measures)), picture.curves()),
            picture=picture,
        )

    return Experiment(name=name, title=title, run=run)


def measured_table(runs: Runs, measures: Sequence[str]) -> TableBlock:
    """Return a row for each run with the values of some attributes."""
    headings = [MEASURES[each].heading for each in measures]
    return TableBlock(
        columns=("method", "h", "steps", *headings),
        rows=tuple((r.label, r.h, r.steps, *(getattr(r, each) for each in measures)) for r in runs.values()),
        formats={"h": ".4g"} | {heading: MEASURES[each].form for heading, each in zip(headings, measures, strict=True)},
    )


def _series(run: MeasuredRun, xs: ArrayLike, ys: ArrayLike, **style: str) -> Series:
    x, y = thinned(xs, ys)
    return Series(x=x, y=y, scheme=run.scheme.color, **{"label": run.label} | style)


def plane(
    *keys: str, kind: str = "phase", part: str = ":", window: tuple[float, float] | None = None, more: str = ""
) -> View:
    """Return the view of states over the exact curve, a panel for each run.

    Args:
        keys: runs, by default all.
        kind: ``"phase"`` for (q_i, p_i) of every coordinate, ``"orbit"`` for (q_1, q_2).
        part: states that are drawn, as in ``"-63:"``.
        window: range of both axes.
        more: text after the label in the title.
    """
    drawn = slice(*(int(bound) if bound else None for bound in part.split(":")))

    def curves(run: MeasuredRun, states: slice) -> list[tuple[ArrayLike, ArrayLike]]:
        q, p = run.q[states], run.p[states]
        return [(q[:, 0], q[:, 1])] if kind == "orbit" else list(zip(q.T, p.T, strict=True))

    def view(runs: Runs) -> Iterable[Panel]:
        for run in (runs[key] for key in keys or runs):
            dots = [_series(run, *xy, marker=".", line="", label="") for xy in curves(run, drawn)]
            exact = [_series(run.setting.reference, *xy, label="") for xy in curves(run.setting.reference, slice(None))]
            xlabel, ylabel = ("q", "p") if kind == "phase" else ("$q_1$", "$q_2$")
            curves_and_dots, title = (*exact, *dots), f"{run.label}{more}"
            yield Panel(title=title, series=curves_and_dots, xlabel=xlabel, ylabel=ylabel, equal=True, window=window)

    return view


def over_time(*keys: str, quantity: str, title: str = "", periods: bool = False, error: bool = True) -> View:
    """Return the view of a quantity over time, one panel with all runs.

    Args:
        keys: runs, by default all.
        quantity: attribute of the runs.
        title: title of the panel.
        periods: True for time in periods of 2 pi.
        error: True for the largest absolute value in each of some hundred intervals, on a logarithmic axis.
    """
    unit, lines = PERIOD if periods else 1.0, ("-", ":", "--")

    def view(runs: Runs) -> Iterable[Panel]:
        series, drawn = [], list[str]()
        for run in (runs[key] for key in keys or runs):
            drawn.append(run.scheme.color)
            points = (run.t / unit, getattr(run, quantity))
            line = lines[(drawn.count(run.scheme.color) - 1) % len(lines)]
            series.append(_series(run, *(largest_in_bins(*points) if error else points), line=line))
        name = MEASURES[quantity].heading
        ylabel = f"|{name}|, largest in each interval" if error else name
        xlabel = "t, in periods" if periods else "t"
        log = "y" if error else ""
        yield Panel(title=title or name, series=tuple(series), xlabel=xlabel, ylabel=ylabel, log=log)

    return view


def _settings(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, RunSetting]:
    settings = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MethodWarning)  # SVI with fewer Gauss points than the degree
        for name, table in tables.items():
            system, q, velocity = table["system"], tuple(table["q"]), tuple(table["velocity"])
            settings[name] = RunSetting(
                system=system_of(system),
                q=q,
                velocity=velocity,
                h=table["h"],
                span=table["span"],
                schemes={key: _scheme(**scheme) for key, scheme in table["schemes"].items()},
                sentences=tuple(table["sentences"]),
                options=replace(SECTION_3, tolerance=table["tolerance"]),
                exact=partial(EXACT[system], q, velocity) if system in EXACT else None,
            )
    return settings


def _scheme(label: str, method: str | dict[str, Any], color: str, h: float | None = None) -> Scheme:
    return Scheme(label, as_method(method) if isinstance(method, str) else method_from_specification(method), color, h)


def _figure(
    name: str, title: str, setting: str, views: Sequence[dict[str, Any]], checks: str, span: float | None = None
) -> Experiment:
    """Return the figure of a table of the file; ``span`` if it differs from that of the setting."""
    chosen = SETTINGS[setting] if span is None else replace(SETTINGS[setting], span=span)
    return figure(name, title, chosen, [_view(**view) for view in views], checks)


def _view(draw: str, runs: Sequence[str] = (), **how: Any) -> View:
    return VIEWS[draw](*runs, **how)


VIEWS: Mapping[str, Callable[..., View]] = {"plane": plane, "over time": over_time}
_TABLES = package_table("reproduce/figures.toml")
SETTINGS = _settings(_TABLES.pop("settings"))
EXPERIMENTS = tuple(_figure(name, **table) for name, table in _TABLES.items())
