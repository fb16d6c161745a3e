"""Default runs at loose and tight tolerances beside heyoka's default options, at equal errors of their ends."""

import importlib.util
import math
from collections.abc import Callable, Iterator
from contextvars import Context
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.cases.adaptive import adaptive_case
from benchmarks.cases.forced import driven_pendulum
from benchmarks.cases.references import reference
from benchmarks.cases.unforced import Array, Case, case
from benchmarks.comparison import measure
from benchmarks.contenders.ours import END_ALONE
from benchmarks.contenders.taylor import heyoka_at
from benchmarks.report import OURS, Contender, ResultTable, time_at
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.runs.compiler import compile_stepper

SMOOTH = (
    "planar-pendulum", "duffing", "kepler:0.2", "kepler:0.5", "henon-heiles", "outer-solar-system", "double-pendulum",
    "relativistic-particle", "fput-chain:8", "fput-chain:64",
)  # fmt: skip
ENCOUNTERS = ("kepler:0.9", "kepler:0.99", "double-pendulum", "figure-eight", "swinging-atwood", "hill")
PROBLEMS: dict[str, Callable[[], Case]] = {
    **{name: partial(case, name) for name in SMOOTH},
    **{f"adaptive:{name}": partial(adaptive_case, name) for name in ENCOUNTERS},
    "forced:double-pendulum": driven_pendulum,
}
TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-8, 1e-11)
HEYOKAS = tuple(10.0**-k for k in range(16))
"""Tolerances of heyoka, between whose errors and times are interpolated."""
LEAST_SPAN, PART_OF_SPAN = 20.0, 1 / 50
"""Runs of some revolutions: calls count beside them."""


def run_tolerances(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure calls of ``integrate`` with a tolerance alone, and heyoka's ``propagate_until``."""
    rows = []
    for name, make in list(PROBLEMS.items())[: 1 if plan.quick else None]:
        report_activity(f"tolerances: {name}")
        rows.append({"problem": name} | _ratios(make(), plan))
    means = [_mean([row[str(tolerance)] for row in rows if str(tolerance) in row]) for tolerance in TOLERANCES]
    return ResultTable(
        name="tolerances",
        title="time of heyoka over that of integrate, default options of both, at the error that each tolerance gives",
        columns={"problem": ""}
        | {str(t): ".2f" for t in TOLERANCES}
        | {f"us {t}": ".1f" for t in TOLERANCES[::2]}
        | {f"iterations {t}": "d" for t in TOLERANCES},
        rows=tuple(rows),
        remarks=(f"geometric means: {', '.join(f'{mean:.2f}' for mean in means)}",),
    )


def _ratios(problem: Case, plan: Plan) -> dict[str, Any]:
    """Return times of heyoka over ours, our times in microseconds and our iterations, by tolerance."""
    short = replace(problem, span=min(problem.span, max(LEAST_SPAN, PART_OF_SPAN * problem.span)))
    exact = reference(short)
    has_heyoka = "heyoka" in plan.peers and importlib.util.find_spec("heyoka") is not None
    contenders = [*_ours(short), *(heyoka_at(short, HEYOKAS[:: 5 if plan.quick else 1]) if has_heyoka else ())]
    points = measure(contenders, lambda _: exact, repeats=plan.rounds)
    theirs = [each for each in points if not each.method.startswith(OURS) and not each.failure]
    row: dict[str, Any] = {}
    for tolerance, point in zip(TOLERANCES, points, strict=False):
        seconds = time_at([replace(each, seconds=each.fastest) for each in theirs], point.error)
        if seconds:  # heyoka reaches the error
            row[str(tolerance)] = seconds / point.fastest
        row |= {f"us {tolerance}": 1e6 * point.fastest, f"error {tolerance}": point.error}
        run = compile_stepper(short.system).integrate(
            short.q[0], velocity=short.velocity[0], t_end=short.span, tolerance=tolerance, check_growth=False
        )
        row |= {f"iterations {tolerance}": int(run.iterations.sum()), f"steps {tolerance}": run.steps}
        row |= {f"rejected {tolerance}": run.rejected_steps, f"method {tolerance}": run.method}
    return row


def _ours(problem: Case) -> Iterator[Contender]:
    stepper = compile_stepper(problem.system)

    def prepare(tolerance: float, index: int) -> Callable[[], Array]:
        start = problem.q[index], problem.velocity[index]
        how: dict[str, Any] = {"t_end": problem.span, "tolerance": tolerance, "save_every": END_ALONE}
        run = partial(stepper.integrate, start[0], velocity=start[1], **how)
        return lambda: Context().run(run).q[-1]  # outside without_accuracy_warnings, which disables the check

    for tolerance in TOLERANCES:
        yield Contender(OURS, f"tol={tolerance:.0e}", "default", 0.0, partial(prepare, tolerance))


def _mean(ratios: list[float]) -> float:
    """Return the geometric mean, NaN without heyoka."""
    return math.exp(sum(map(math.log, ratios)) / len(ratios)) if ratios else math.nan
