"""Tables 6 and 7 of the paper: SVI, a symplectic Runge-Kutta method (Gauss) with fewer stages, and collocation.

Step sizes, spans, initial states and tolerance (1e-14 for the largest change of a position or momentum) are the
paper's; the quadrature, where it is not stated for an SVI of degree s, has s Gauss points. The claim of the paper: SVI
is cheaper and more accurate than the Runge-Kutta method.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases import Case, case
from scvi_codegen.benchmark.references import Reference, reference, rms_error
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods import Gauss, SpectralCollocation
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["run_paper_tables"]

TOLERANCE = SolverOptions(tolerance=1e-14, max_iterations=1000, absolute=True)
SRK, SPECTRAL, COLLOCATION = "SRK", "SVI", "SC"

TABLES = (
    (6, "planar-pendulum", (0.5, 0.0), 0.5, {SRK: (Gauss(2), 13.73), SPECTRAL: (SVI(3), 4.94)}, 3, 1.85),
    (7, "duffing", (0.0, 1.0), 0.6, {SRK: (Gauss(3), 86.98), SPECTRAL: (SVI(5), 39.18)}, 5, 4.35),
)
"""Number, case, (q0, v0), h, methods with the printed seconds, degree of collocation and its seconds."""


@without_accuracy_warnings()
def run_paper_tables(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure both tables."""
    rows: list[dict[str, Any]] = []
    for number, name, (q, v), h, methods, degree, seconds in TABLES:
        report_activity(f"tables: Table {number}, {name}")
        plain = case(name)
        chosen = replace(plain, q=np.array([[q]]), velocity=np.array([[v]]), span=plain.span * plan.share)
        named = methods | {COLLOCATION: (SpectralCollocation(degree), seconds)}
        rows += _table(number, chosen, h, named, 3 * plan.rounds)
    formats = {"table": "", "scheme": "", "method": "", "ms": ".3g", "ratio": ".2f", "in_the_paper": ".2f"}
    return ResultTable(
        name="tables",
        title="Tables 6 (pendulum, h = 0.5) and 7 (Duffing, h = 0.6) of the paper",
        columns=formats | {"energy_error": ".1e", "position_error": ".1e", "ms_a_digit": ".3g"},
        rows=tuple(rows),
        remarks=(
            "ratio: time over that of SRK, here and in the paper. energy error: largest along the run, relative.",
            "position error: at the end, relative. ms a digit: time over the correct digits of that position.",
            *(_verdict(number, [row for row in rows if row["table"] == number]) for number, *_ in TABLES),
        ),
    )


def _table(
    number: int, chosen: Case, h: float, methods: dict[str, tuple[Method, float]], repeats: int
) -> list[dict[str, Any]]:
    steppers = {scheme: compile_stepper(chosen.system, method) for scheme, (method, _) in methods.items()}
    exact, count = reference(chosen), round(chosen.span / h)
    seconds: dict[str, list[float]] = {scheme: [] for scheme in steppers}
    for _ in range(repeats):
        for scheme, stepper in steppers.items():
            seconds[scheme].append(_seconds(stepper, chosen, count))
    middle = {scheme: statistics.median(result) for scheme, result in seconds.items()}
    return [
        {
            "table": number,
            "scheme": scheme,
            "method": method.name,
            "ms": 1e3 * middle[scheme],
            "ratio": middle[scheme] / middle[SRK],
            "in_the_paper": printed / methods[SRK][1],
            **_errors(steppers[scheme], chosen, count, exact, 1e3 * middle[scheme]),
        }
        for scheme, (method, printed) in methods.items()
    ]


def _seconds(stepper: Stepper, chosen: Case, count: int) -> float:
    run = stepper.start(chosen.q[0], chosen.velocity[0], h=chosen.span / count, options=TOLERANCE)
    began = time.process_time()
    run.record(count, save_every=count)
    return time.process_time() - began


def _errors(stepper: Stepper, chosen: Case, count: int, exact: Reference, ms: float) -> dict[str, float]:
    """Return the errors of energy and position; both systems have p = v."""
    run = stepper.integrate(chosen.q[0], chosen.velocity[0], h=chosen.span / count, steps=count, options=TOLERANCE)
    energy = run.energy()
    position = rms_error(run.q[-1:], exact)
    digits = -math.log10(position)
    return {
        "energy_error": float(np.abs(energy / energy[0] - 1.0).max()),
        "position_error": position,
        "ms_a_digit": ms / digits if digits > 0.0 else math.nan,
    }


def _verdict(number: int, rows: Sequence[dict[str, Any]]) -> str:
    svi, srk = (next(row for row in rows if row["scheme"] == scheme) for scheme in (SPECTRAL, SRK))
    cheaper = "cheaper" if svi["ms"] < srk["ms"] else "dearer"
    better = "more" if svi["position_error"] < srk["position_error"] else "less"
    digits = abs(math.log10(srk["position_error"] / svi["position_error"]))
    share = svi["ms_a_digit"] / srk["ms_a_digit"]
    return (
        f"Table {number}: at the same step SVI is {cheaper} than SRK ({svi['ratio']:.2f} of its time), {better} "
        f"accurate by {digits:.1f} digits, and needs {share:.2f} of its time a correct digit."
    )
