"""Benchmark: this package and other integrators, compared at equal error.

    cases/              problems, eight initial states each, accelerations derived by hand (unforced, adaptive, rods
                        with forces or constraints, rotations, large array systems, texts of systems), and their final
                        states in extended precision, independent of the package's steppers (references)
    contenders/         steppers of this package, at the step sizes that advise() recommends; its peers: REBOUND, CyRK,
                        JiTCODE, SciPy, heyoka and MuJoCo (engines) at several tolerances
    comparison          timing of all of them in turn, in one process, for one case, or an ensemble of 64 trajectories
    report              time at equal error, by interpolation; tables and JSON of results; plots: their pictures
    energies            energy drift over ten million steps, and of array systems over a hundred thousand
    hand_written        generated C and hand-written C; cost of a control step, and of the bare C function
    first_step          time from text to the first step, also for larger systems and SymPy's bodies and loads
    constrained_bodies  energies and lengths at equal time; MuJoCo
    lattices            SVI and compositions at equal error; hand-written C (lattices.c), SciPy, REBOUND, OpenMM
    array_systems       scaling with size; several threads
    machine             description and limits of the machine; the same source with several compilers
    settings            settings of a benchmark; processor times of functions and outputs of fresh processes

The rules: medians of alternating rounds; stepping time only, compile time apart; every peer with the best options and
the best formulation known to us, which are named; whole work-precision curves, no step or tolerance tuned afterwards.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from scvi_codegen.benchmark.array_systems import run_growth, run_threads
from scvi_codegen.benchmark.cases.adaptive import ADAPTIVE_CASES
from scvi_codegen.benchmark.cases.rods import CONSTRAINED_CASES, FORCED_CASES
from scvi_codegen.benchmark.cases.rotations import ROTATIONS
from scvi_codegen.benchmark.cases.unforced import CASES
from scvi_codegen.benchmark.comparison import (
    ENSEMBLES,
    run_adaptive,
    run_bodies,
    run_case,
    run_constrained,
    run_ensemble,
    run_forced,
    run_rotations,
)
from scvi_codegen.benchmark.constrained_bodies import run_constrained_bodies
from scvi_codegen.benchmark.contenders.peers import PEERS
from scvi_codegen.benchmark.energies import run_drift, run_energies
from scvi_codegen.benchmark.first_step import run_cold_start, run_compile_times, run_mechanisms
from scvi_codegen.benchmark.hand_written import run_control_loop, run_hand_written
from scvi_codegen.benchmark.lattices import run_compositions, run_lattices
from scvi_codegen.benchmark.machine import machine, run_compilers
from scvi_codegen.benchmark.report import LEGEND, CaseResult, ResultTable, header_lines
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.errors import ScviCodegenError, StateError, closest
from scvi_codegen.files.atomic import write_atomically

__all__ = ["CASES", "PEERS", "SCHEMA", "SECTIONS", "Plan", "Report", "benchmark"]

SCHEMA = 2
"""Version of the JSON document."""

SECTIONS: Mapping[str, Callable[[Plan, ReportActivity], CaseResult | ResultTable]] = {
    **{name: partial(run_case, name) for name in CASES},
    **{f"ensemble:{name}": partial(run_ensemble, name) for name in ENSEMBLES},
    **{f"forced:{name}": partial(run_forced, name) for name in FORCED_CASES},
    **{f"constrained:{name}": partial(run_constrained, name) for name in CONSTRAINED_CASES},
    **{f"adaptive:{name}": partial(run_adaptive, name) for name in ADAPTIVE_CASES},
    **{f"rotations:{name}": partial(run_rotations, name) for name in ROTATIONS},
    "rotations:bodies": run_bodies,
    "drift": run_drift,
    "compositions": run_compositions,
    "hand-written": run_hand_written,
    "cold-start": run_cold_start,
    "compile": run_compile_times,
    "mechanisms": run_mechanisms,
    "constrained-bodies": run_constrained_bodies,
    "control-loop": run_control_loop,
    "lattices": run_lattices,
    "growth": run_growth,
    "threads": run_threads,
    "energies": run_energies,
    "c-compilers": run_compilers,
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
    json_path: str | None = None,
    plot_path: str | None = None,
    resume: bool = False,
    report_activity: ReportActivity = lambda text: None,
    show: ReportActivity = lambda text: None,
) -> Report:
    """Measure sections in turn; a section that fails is reported, Ctrl-C ends the benchmark with its results so far.

    Args:
        names: names of sections, by default all; ``kepler`` means ``kepler:0.2`` and ``kepler:0.5``.
        plan: settings of the measurement.
        json_path: file to write, after each section.
        plot_path: file of the plot.
        resume: keep the sections of ``json_path`` that did not fail, and add others to them.
        report_activity: called with a description of each activity.
        show: called with the text of the report, section by section.

    Raises:
        StateError: for an unknown section; if ``json_path`` is not a report of this version.
    """
    sections = tuple(section for name in names for section in _sections(name))
    if plot_path is not None:
        from scvi_codegen.pictures.canvas import check_plot_path

        check_plot_path(plot_path)
    known = _known(json_path) if resume and json_path is not None else {}
    wanted = dict.fromkeys((*known, *(sections or SECTIONS)))
    for report in _reports(tuple(wanted), known, plan or Plan(), report_activity, show):
        if json_path is not None:
            _write(report, json_path)
    if plot_path is not None and report.cases:
        from scvi_codegen.benchmark.plots import plot_curves

        plot_curves(report.cases, plot_path)
    return report


def _sections(name: str) -> tuple[str, ...]:
    """Return the section of that name, or all whose names begin with it and a colon."""
    names = (name,) if name in SECTIONS else tuple(each for each in SECTIONS if each.startswith(f"{name}:"))
    if not names:
        raise StateError(f"there is no section '{name}'{closest(name, SECTIONS)} Known: {', '.join(SECTIONS)}")
    return names


Result = CaseResult | ResultTable
FAILED = "failed: "


def _known(json_path: str) -> dict[str, Result]:
    """Return the sections of a report on disk by name; none if there is no such file."""
    path = Path(json_path)
    if not path.exists():
        return {}
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        results: list[Result] = [
            *map(CaseResult.from_data, data["cases"]),
            *(ResultTable.from_data(each) for each in data["tables"] if not each["title"].startswith(FAILED)),
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StateError(f"{json_path} is not a report that can be resumed: {type(error).__name__}: {error}") from None
    return {each.name: each for each in results}


def _write(report: Report, json_path: str) -> None:
    text = json.dumps(report.data(), indent=1, allow_nan=False) + "\n"
    write_atomically(json_path, lambda file: file.write(text.encode()))


def _reports(
    names: Sequence[str], known: Mapping[str, Result], plan: Plan, report_activity: ReportActivity, show: ReportActivity
) -> Iterator[Report]:
    """Yield the report after each section; its text is shown as it grows."""
    report = Report(machine=machine(), results=())
    show(header_lines(report.machine))
    for name in names:
        try:
            result = known[name] if name in known else SECTIONS[name](plan, report_activity)
        except KeyboardInterrupt:
            yield replace(report, interrupted=name)
            break
        except ScviCodegenError as error:
            result = ResultTable(name=name, title=f"{FAILED}{error}", columns={}, rows=())
        report = replace(report, results=(*report.results, result))
        show(f"\n{result.text()}")
        yield report
    if report.cases:
        show(f"\n{LEGEND}")
