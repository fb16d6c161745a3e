"""Benchmark of steps of array systems with several threads: wall time, in short turns, the minimum of each."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.large_cases import Lattice, atoms, bodies, cloth, ring
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

__all__ = ["run_threads"]

METHODS = ("svi:8", "stoermer-verlet")
TURN = 0.003
"""Duration of a turn in seconds: short, so that other programs seldom interrupt it."""
PROBLEM_SECONDS = 0.5
"""Seconds for a problem, a method and a number of threads."""


@without_accuracy_warnings()
def run_threads(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the time of a step, and the speed-up by several threads."""
    numbers = _numbers()
    rows = []
    for each, h in _problems(plan):
        for method in METHODS:
            report_activity(f"threads: {each.name} of {each.q.size} coordinates by {method}")
            rows.append({"problem": each.name, "coordinates": each.q.size} | _row(each, method, h, numbers, plan))
    return ResultTable(
        name="threads",
        title="time of a step with one thread, and speed-up with several",
        columns={"problem": "", "coordinates": "d", "by": "", "one_us": ".4g"}
        | {f"threads_{number}": ".2f" for number in numbers},
        rows=tuple(rows),
        remarks=(
            "time of the clock, the best of many turns of 3 ms, threads begun in each, numbers of threads in turn. On",
            "a machine with other work threads that wait for each other may be slower than one.",
        ),
    )


def _numbers() -> list[int]:
    """Return 2, 4, 8, .. up to the number of cores."""
    cores = os.cpu_count() or 1
    return [number for number in (2, 4, 8, 16, 32) if number <= max(cores, 2)]


def _problems(plan: Plan) -> Iterator[tuple[Lattice, float]]:
    """Yield each problem with a step size."""
    if plan.quick:
        yield from ((ring(5000, 1.0), 0.1), (atoms(2, 1.0), 0.002))
        return
    for count in (10**4, 10**5, 10**6):
        yield ring(count, 1.0), 0.1
    for cells in (2, 3, 4, 6):
        yield atoms(cells, 1.0), 0.002
    for number in (256, 1000):
        yield bodies(number, 1.0), 0.02
    yield cloth(200, 1.0), 0.02


def _row(each: Lattice, method: str, h: float, numbers: list[int], plan: Plan) -> dict[str, Any]:
    stepper = compile_stepper(each.system, method)
    arguments: dict[str, Any] = {"h": h, "parameters": each.parameters, "tables": each.tables}
    runs = {threads: stepper.start(each.q, velocity=each.v, threads=threads, **arguments) for threads in (1, *numbers)}
    for run in runs.values():
        run.advance(3)
    steps = max(1, int(TURN / _seconds(runs[1], 1)))
    best, until = dict.fromkeys(runs, float("inf")), time.perf_counter() + plan.share * PROBLEM_SECONDS * len(runs)
    while time.perf_counter() < until:
        for threads, run in runs.items():
            best[threads] = min(best[threads], _seconds(run, steps))
    gained = {f"threads_{threads}": best[1] / best[threads] for threads in numbers}
    return {"by": f"{OURS} {method}", "one_us": 1e6 * best[1]} | gained


def _seconds(run: ArrayRun, steps: int) -> float:
    """Return the seconds per step of a call with ``steps`` steps."""
    report = run.problem.binding.new("report *")
    began = time.perf_counter()
    run.call("advance", run.problem.struct, steps, run.problem.binding.null, report)
    return (time.perf_counter() - began) / steps
