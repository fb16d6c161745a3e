"""Price of known errors: ``run.error`` and ``error=`` beside the run that they judge."""

import math
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.cases.unforced import Case, case
from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.compiler import compile_stepper

PROBLEMS = (
    "planar-pendulum", "duffing", "kepler:0.5", "henon-heiles", "fput-chain:8", "outer-solar-system",
    "double-pendulum", "relativistic-particle",
)  # fmt: skip
TOLERANCES = (None, 1e-6, 1e-9)
STEPS = (100, 2000)
"""Approximate numbers of steps of a short and a long run."""


@without_accuracy_warnings()
def run_errors(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the processor times of adaptive runs, of their errors, and of runs whose errors are bounded."""
    rows = []
    for name in PROBLEMS[: 1 if plan.quick else None]:
        report_activity(f"errors: {name}")
        rows += [row for tolerance in TOLERANCES for row in _rows(case(name), tolerance, plan)]
    means = [math.exp(sum(math.log(row["ratio"]) for row in part) / len(part)) for part in _by_length(rows)]
    return ResultTable(
        name="errors",
        title="run.error and error= beside the run, in one thread (milliseconds of the processor)",
        columns={"problem": "", "tolerance": "", "steps": "d", "run": ".3f", "error": ".3f", "ratio": ".2f"}
        | {"bounded": ".3f", "runs": "d", "bounded_ratio": ".2f"},
        rows=tuple(rows),
        remarks=(f"geometric means of the ratio, short and long runs: {', '.join(f'{mean:.2f}' for mean in means)}",),
    )


def _by_length(rows: list[dict[str, Any]]) -> list[list[dict[str, Any]]]:
    return [rows[k :: len(STEPS)] for k in range(len(STEPS))]


def _rows(problem: Case, tolerance: float | None, plan: Plan) -> list[dict[str, Any]]:
    """Return the times of a short and of a long run."""
    stepper, rows = compile_stepper(problem.system), []

    def integrate(end: float, **steps: Any) -> Any:
        checked = None if "error" in steps else False
        return stepper.integrate(problem.q[0], velocity=problem.velocity[0], t_end=end, check_growth=checked, **steps)

    def judged(run: Any) -> Any:
        run._error = None
        return run.error

    pilot = problem.step * 10.0
    steps_of_pilot = max(1, integrate(pilot, tolerance=tolerance).steps)
    for steps in STEPS:
        end = pilot * steps / steps_of_pilot
        ran, run = _least(partial(integrate, end, tolerance=tolerance), plan)
        judged(run)  # derives and compiles
        error, _ = _least(partial(judged, run), plan)
        row = {"problem": problem.name, "tolerance": str(tolerance), "steps": run.steps, "run": ran}
        row |= {"error": error, "ratio": error / ran}
        if tolerance is not None:
            bounded, run = _least(partial(integrate, end, error=tolerance), plan)
            alone, _ = _least(partial(integrate, end, **run.confirmation.steps), plan)
            row |= {"bounded": bounded, "runs": run.confirmation.runs, "bounded_ratio": bounded / alone}
        rows.append(row)
    return rows


def _least(work: Callable[[], Any], plan: Plan) -> tuple[float, Any]:
    """Return the least processor time in milliseconds, and the result."""
    least, result = math.inf, None
    for _ in range(plan.repeats):
        began = time.process_time()
        result = work()
        least = min(least, 1e3 * (time.process_time() - began))
    return least, result
