"""Benchmark of SVI and explicit compositions: Stoermer-Verlet (order 2), Kahan-Li and Sofroniou-Spaletta (8 and 10).

Every method runs with smaller and smaller steps, over a tenth of the span of each case (in longer spans round-off alone
exceeds the smallest error asked for), until the error is small enough or the run takes too long. Errors that a method
does not reach are extrapolated by its order and marked.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases import Case, case
from scvi_codegen.benchmark.contenders.ours import momenta_of
from scvi_codegen.benchmark.references import Reference, reference, rms_error
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.benchmark.work_precision import Point, time_at
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods import StoermerVerlet
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["run_compositions"]

COMPARED = ("kepler:0.5", "henon-heiles", "outer-solar-system")
ERRORS = (1e-4, 1e-8, 1e-12)
METHODS = (SVI(4), SVI(8), StoermerVerlet(), Composition(8), Composition(10))
SHARE = 0.1
LONGEST, COARSEST = 0.5, 8.0
"""Seconds per trajectory beyond which no smaller step is tried; the first step, in units of the step of the case."""

FINER = math.sqrt(0.5)
MAX_REFINEMENTS = 60
RESOLVED = 1e-2
"""Largest error in the asymptotic regime of the order."""

REPEATS = 3


@without_accuracy_warnings()
def run_compositions(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure milliseconds of a trajectory for each error, and the fastest method."""
    rows = []
    for name in COMPARED:
        plain = case(name)
        chosen = replace(plain, span=plain.span * SHARE * plan.share)
        curves = {}
        for method in METHODS:
            report_activity(f"compositions: {name}, {method.name}")
            curves[method.name] = _curve(chosen, method, LONGEST * plan.share)
        rows += [_row(chosen, error, curves) for error in ERRORS]
    return ResultTable(
        name="compositions",
        title="milliseconds of a trajectory at equal error",
        columns={"case": "", "span": "g", "error": ".0e"} | {method.name: "" for method in METHODS} | {"fastest": ""},
        rows=tuple(rows),
        remarks=(
            "~: not reached here (round-off, or more than half a second); extrapolated by the order of the method",
        ),
    )


def _row(chosen: Case, error: float, curves: dict[str, list[Point]]) -> dict[str, Any]:
    reached = {name: time_at(curve, error) for name, curve in curves.items()}
    orders = {method.name: method.order for method in METHODS}
    shown = {
        name: f"~{1e3 * _beyond(curves[name], error, orders[name]):.3g}" if seconds is None else f"{1e3 * seconds:.3g}"
        for name, seconds in reached.items()
    }
    fair = {name: seconds for name, seconds in reached.items() if seconds is not None}
    fastest = min(fair, key=lambda name: fair[name]) if fair else None
    return {"case": chosen.name, "span": chosen.span, "error": error, **shown, "fastest": fastest}


def _beyond(curve: list[Point], error: float, order: int | None) -> float:
    """Return the time for an error below all measured ones, extrapolated from the smallest by the order."""
    if not curve or not order:
        return math.nan
    best = min(curve, key=lambda point: point.error)
    return best.seconds * math.pow(best.error / error, 1.0 / order)


def _curve(chosen: Case, method: Method, longest: float) -> list[Point]:
    stepper = compile_stepper(chosen.system, method)
    momenta = momenta_of(stepper, chosen)
    exact = reference(chosen, momenta)
    points: list[Point] = []
    for refinement in range(MAX_REFINEMENTS):
        count = max(1, round(chosen.span / (COARSEST * chosen.step * FINER**refinement)))
        try:
            point = _point(stepper, chosen, momenta, count, exact)
        except StepFailedError:
            continue
        if point.error < RESOLVED:
            points.append(point)
        if point.error < 0.5 * min(ERRORS) or point.seconds > longest:
            break
    return points


def _point(stepper: Any, chosen: Case, momenta: Any, count: int, exact: Reference) -> Point:
    final, seconds = [], []
    for q, p in zip(chosen.q, momenta, strict=True):
        best = math.inf
        for _ in range(REPEATS):
            run = stepper.start(q, p, h=chosen.span / count)
            began = time.process_time()
            trajectory = run.record(count, save_every=count)
            best = min(best, time.process_time() - began)
            if best > 0.01:
                break
        final.append(trajectory.q[-1])
        seconds.append(best)
    return Point(seconds=float(np.mean(seconds)), error=rms_error(np.array(final), exact))
