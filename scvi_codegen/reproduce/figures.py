"""Figures of runs as data: views turn runs into panels, checks into numbers and the conditions of a verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple, TypeAlias

from numpy.typing import ArrayLike

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.reproduce.drawing import Panel, Picture, Series, largest_in_bins, thinned
from scvi_codegen.reproduce.experiment import Comparison, Experiment, Result, Verdict, judged
from scvi_codegen.reproduce.runs import MEASURES, PERIOD, MeasuredRun, RunSetting

Runs: TypeAlias = Mapping[str, MeasuredRun]
View: TypeAlias = Callable[[Runs], Iterable[Panel]]


class RunCheck(NamedTuple):
    """Test of a statement of the paper on runs.

    Attributes:
        measures: attributes of the runs and, after a colon, keys of runs (default: all): ``"energy drift: svi sc"``.
        judge: function of the runs, as attributes by key, that returns the conditions under which the statement holds;
            the statement is only shown if there are none.
        bears_on: keys of claims (:mod:`scvi_codegen.reproduce.claims`), separated by spaces.
        note: sentences after the measurement.
    """

    measures: str
    judge: Callable[[SimpleNamespace], Iterable[object]] = lambda runs: ()
    bears_on: str = ""
    note: str = ""

    def compared(self, claim: str, runs: Runs) -> Comparison:
        """Return the comparison of a claim with the measurement."""
        conditions = [bool(each) for each in self.judge(SimpleNamespace(**runs))]
        attributes, _, keys = self.measures.partition(":")
        chosen = [runs[key] for key in keys.split() or runs]
        parts = [f"{MEASURES[each].heading}: {_values(each, chosen)}" for each in attributes.split()]
        measured = "; ".join(parts)
        return Comparison(
            claim=claim,
            measured=" ".join(filter(None, (f"{measured[:1].upper()}{measured[1:]}." if parts else "", self.note))),
            verdict=judged(*conditions) if conditions else Verdict.SHOWN,
            bears_on=tuple(self.bears_on.split()),
        )


def _values(attribute: str, runs: Iterable[MeasuredRun]) -> str:
    form, values = MEASURES[attribute].form, [(run.label, getattr(run, attribute)) for run in runs]
    return ", ".join(f"{'none' if value is None else format(value, form)} ({label})" for label, value in values)


def figure(
    name: str,
    title: str,
    setting: RunSetting,
    views: Sequence[View],
    checks: Mapping[str, RunCheck],
) -> Experiment:
    """Return the experiment that runs the schemes of a setting, draws views of them and tests statements.

    Args:
        name, title: of the experiment.
        setting: problem and schemes.
        views: functions that return the panels; without them there is no picture.
        checks: tests by the statement of the paper; their measures are the columns of the table.
    """

    def run(_: Mapping[str, Result]) -> Result:
        runs = {key: setting.run(key) for key in setting.schemes}
        panels = tuple(panel for view in views for panel in view(runs))
        size, columns = ((7.0, 4.2), 1) if len(panels) == 1 else ((4.0, 3.8), 2 if len(panels) in (2, 4) else 3)
        picture = Picture(panels=panels, columns=columns, size=size) if panels else None
        measures = dict.fromkeys(each for check in checks.values() for each in check.measures.partition(":")[0].split())
        return Result(
            setting=setting.sentences,
            checks=tuple(check.compared(claim, runs) for claim, check in checks.items()),
            tables=(measured_table(runs, list(measures)), *([picture.curves()] if picture else [])),
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
    *keys: str,
    kind: str = "phase",
    part: slice = slice(None),
    window: tuple[float, float] | None = None,
    more: str = "",
) -> View:
    """Return the view of states over the exact curve, a panel for each run.

    Args:
        keys: runs, by default all.
        kind: ``"phase"`` for (q_i, p_i) of every coordinate, ``"orbit"`` for (q_1, q_2).
        part: states that are drawn.
        window: range of both axes.
        more: text after the label in the title.
    """

    def curves(run: MeasuredRun, states: slice) -> list[tuple[ArrayLike, ArrayLike]]:
        q, p = run.q[states], run.p[states]
        return [(q[:, 0], q[:, 1])] if kind == "orbit" else list(zip(q.T, p.T, strict=True))

    def view(runs: Runs) -> Iterable[Panel]:
        for run in (runs[key] for key in keys or runs):
            dots = [_series(run, *xy, marker=".", line="", label="") for xy in curves(run, part)]
            exact = [_series(run.setting.reference, *xy, label="") for xy in curves(run.setting.reference, slice(None))]
            xlabel, ylabel = ("q", "p") if kind == "phase" else ("$q_1$", "$q_2$")
            curves_and_dots, title = (*exact, *dots), f"{run.label}{more}"
            yield Panel(title=title, series=curves_and_dots, xlabel=xlabel, ylabel=ylabel, equal=True, window=window)

    return view


def over_time(quantity: str, *keys: str, title: str = "", periods: bool = False, error: bool = True) -> View:
    """Return the view of a quantity over time, one panel with all runs.

    Args:
        quantity: attribute of the runs.
        keys: runs, by default all.
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


energy_errors = partial(over_time, "energy_error")
momentum_errors = partial(over_time, "momentum_error")
