"""Benchmark: this package and other integrators, compared at equal error.

    cases/       systems with their initial states and spans: unforced, published, suites, forced, adaptive, rotations,
                 robots, rods, fields, large array systems; accelerations derived by hand, and final states in extended
                 precision, independent of the package's steppers (references)
    contenders/  functions from a case and a step size or tolerance to its final state: steppers of this package; peers:
                 heyoka (taylor), IRKGL16 (irkgl16), REBOUND, CyRK, SciPy (peers), MuJoCo, Pinocchio, Exudyn (engines),
                 Siconos (contact), OpenMM (arrays), PyDy (mechanisms), py-pde and spectral methods by hand (pdes)
    comparison   timing of all contenders of a case in turn, in one process
    sections     which contenders and which reference belong to a case
    report       time at equal error, by interpolation; tables and JSON of results; plots: their pictures
    digits       double-double arithmetic, and heyoka in long double and quadruple precision
    families     families of periodic orbits, orbits a second
    errors       run.error and error= beside the run
    tolerances   default runs from 1e-3 to 1e-11 beside heyoka
    tables       energy drift, time from text to the first step
    steps        time of a step: by size and threads, with derivatives, by compiler and processor
    machine      description of the machine
    settings     settings of a benchmark; processor times of functions

The rules: medians of alternating rounds; stepping time only, compile time apart; every peer with the best options and
the best formulation known to us, which are named; whole work-precision curves, no step or tolerance tuned afterwards.
"""

import csv
import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from benchmarks.bath import run_bath
from benchmarks.cases.unforced import CASES
from benchmarks.comparison import run_race
from benchmarks.contenders.peers import PEERS
from benchmarks.digits import run_digits
from benchmarks.errors import run_errors
from benchmarks.falls import run_falls
from benchmarks.families import run_families
from benchmarks.machine import machine
from benchmarks.report import LEGEND, PRECISION, CaseResult, ResultTable, degree_table, header_lines
from benchmarks.sections import BUILDERS
from benchmarks.settings import Plan, ReportActivity
from benchmarks.steps import (
    run_builds,
    run_by_hand,
    run_derivatives,
    run_newton,
    run_scaling,
    run_threads,
    run_transforms,
)
from benchmarks.tables import run_drift, run_first_steps
from benchmarks.tolerances import run_tolerances
from scvi_codegen.common.atomic import write_text
from scvi_codegen.common.errors import ScviCodegenError, StateError, closest

__all__ = ["CASES", "PEERS", "SCHEMA", "SECTIONS", "Plan", "Report", "benchmark"]

SCHEMA = 2
"""Version of the JSON document."""

SECTIONS: Mapping[str, Callable[[Plan, ReportActivity], CaseResult | ResultTable]] = {
    **{name: partial(run_race, build) for name, build in BUILDERS.items()},
    "contact:falls": run_falls,
    "digits": run_digits,
    "drift": run_drift,
    "families": run_families,
    "errors": run_errors,
    "tolerances": run_tolerances,
    "first-step": run_first_steps,
    "scaling": run_scaling,
    "threads": run_threads,
    "by-hand": run_by_hand,
    "transforms": run_transforms,
    "newton": run_newton,
    "derivatives": run_derivatives,
    "builds": run_builds,
    "bath": run_bath,
}
"""Sections of the benchmark: name on the command line -> function that measures it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Report:
    """Results of a benchmark.

    Attributes:
        machine: description of the machine.
        results: results in the order of measurement.
        interrupted: name of the section that Ctrl-C ended, or ``""``.
    """

    machine: Mapping[str, Any]
    results: tuple[CaseResult | ResultTable, ...]
    interrupted: str = ""

    @property
    def cases(self) -> list[CaseResult]:
        """Results that are work-precision curves."""
        return [result for result in self.results if isinstance(result, CaseResult)]

    def text(self) -> str:
        """Return all tables as text."""
        legend = [LEGEND] if self.cases else []
        return "\n\n".join([header_lines(self.machine), *(result.text() for result in self.results), *legend])

    def work_precision(self) -> str:
        """Return all measurements as CSV, one row per setting, in the terms of SciML's ``WorkPrecisionSet``.

        Errors are relative, of the final positions; times in seconds of one solution, medians.
        """
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["prob", "name", "setting", "error", "time", "numruns", "compile_time"])
        for case in self.cases:
            for each in case.measurements:
                if not each.failure:
                    numbers = (each.error, each.seconds, each.repeats, each.compile_seconds)
                    writer.writerow([case.name, each.method, each.setting, *map(repr, numbers)])
        return file.getvalue()

    def data(self) -> dict[str, Any]:
        """Return all tables and measurements as data for ``json.dump``."""
        return {
            "schema": SCHEMA,
            "machine": dict(self.machine),
            "cases": [result.data() for result in self.cases],
            "tables": [result.data() for result in self.results if isinstance(result, ResultTable)],
            "interrupted": self.interrupted,
        }


def benchmark(
    names: Sequence[str] = (),
    plan: Plan | None = None,
    *,
    output: str | None = None,
    plot_path: str | None = None,
    report_activity: ReportActivity = lambda text: None,
    show: ReportActivity = lambda text: None,
) -> Report:
    """Measure sections in turn; a section that fails is reported, Ctrl-C ends the benchmark with its results so far.

    Args:
        names: names of sections, by default all; ``kepler`` means ``kepler:0.2`` and ``kepler:0.5``.
        plan: settings of the measurement.
        output: file to write, after each section: JSON, or .csv for :meth:`Report.work_precision`.
        plot_path: file of the plot.
        report_activity: called with a description of each activity.
        show: called with the text of the report, section by section.

    Raises:
        StateError: for an unknown section.
    """
    sections = tuple(section for name in names for section in _sections(name))
    if plot_path is not None:
        from scvi_codegen.extras.pictures.canvas import check_plot_path

        check_plot_path(plot_path)
    for report in _reports(tuple(dict.fromkeys(sections or SECTIONS)), plan or Plan(), report_activity, show):
        if output is not None:
            text = json.dumps(report.data(), indent=1, allow_nan=False) + "\n"
            write_text(output, report.work_precision() if output.endswith(".csv") else text)
    if plot_path is not None and report.cases:
        from benchmarks.plots import plot_curves

        plot_curves(report.cases, plot_path)
    return report


def _sections(name: str) -> tuple[str, ...]:
    """Return the section of that name, or all whose names begin with it and a colon."""
    names = (name,) if name in SECTIONS else tuple(each for each in SECTIONS if each.startswith(f"{name}:"))
    if not names:
        raise StateError(f"there is no section '{name}'{closest(name, SECTIONS)} Known: {', '.join(SECTIONS)}")
    return names


def _reports(
    names: Sequence[str], plan: Plan, report_activity: ReportActivity, show: ReportActivity
) -> Iterator[Report]:
    """Yield the report after each section; its text is shown as it grows."""
    report = Report(machine=machine(), results=())
    show(header_lines(report.machine))
    for name in names:
        try:
            result = SECTIONS[name](plan, report_activity)
        except KeyboardInterrupt:
            yield replace(report, interrupted=name)
            break
        except ScviCodegenError as error:
            result = ResultTable(name=name, title=f"failed: {error}", columns={}, rows=())
        report = replace(report, results=(*report.results, result))
        show(f"\n{result.text()}")
        yield report
    else:
        precise = [result for result in report.cases if result.name.startswith(PRECISION)]
        if precise:
            table = degree_table(precise)
            report = replace(report, results=(*report.results, table))
            show(f"\n{table.text()}")
            yield report
    if report.cases:
        show(f"\n{LEGEND}")
