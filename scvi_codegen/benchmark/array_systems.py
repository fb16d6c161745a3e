"""Benchmark of array systems: scaling with size, in fresh processes, and steps with several threads.

With several threads the wall time is measured, in short turns; the minimum of each counts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from typing import Any

from scvi_codegen.benchmark.cases.large import Lattice, atoms, bodies, cloth, ring
from scvi_codegen.benchmark.machine import machine_limits
from scvi_codegen.benchmark.report import OURS, ResultTable
from scvi_codegen.benchmark.settings import Plan, ReportActivity, output_of_process
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.runtime.run.run import Run

GROWTH = (10**3, 10**4, 10**5, 10**6)
SIDE = 512
"""Length of the axes of the field."""
MEASURED = {
    "first_step_s": ".2f",
    "ns_a_coordinate_and_step": ".1f",
    "iterations": ".2f",
    "gflops": ".2f",
    "gigabytes_s": ".1f",
    "memory_mb": ".0f",
}
"""Numbers that a process of :mod:`~scvi_codegen.benchmark.contenders.array_process` prints, with their formats."""


@without_accuracy_warnings()
def run_growth(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the time to the first step, and time and memory per step, by number of coordinates."""
    rows, (memory, arithmetic) = list(_growth(plan, report_activity)), machine_limits()
    return ResultTable(
        name="growth",
        title="scaling with size: h = 0.1 (field: 0.03), one process each with an empty cache",
        columns={
            "problem": "",
            "by": "",
            "coordinates": "d",
            **MEASURED,
        },
        rows=tuple(rows),
        remarks=(
            "first step: from text; gflops: of kernels and table products, in iterations; gigabytes: their array reads",
            "and writes; memory: of the process. One core of this machine, at most: multiply-adds in registers",
            f"{arithmetic:.0f} GFLOP/s, STREAM's triad {memory:.1f} GB/s.",
        ),
    )


def _growth(plan: Plan, report_activity: ReportActivity) -> Iterator[dict[str, Any]]:
    sizes = [("ring", count) for count in GROWTH[: 2 if plan.quick else None]]
    sizes.append(("field", 16 if plan.quick else SIDE))
    for method in ("svi:4", "svi:8", "stoermer-verlet"):
        for name, size in sizes:
            count = size * size if name == "field" else size
            report_activity(f"growth: {name} of {count} coordinates by {method}")
            arguments = ["-m", "scvi_codegen.benchmark.contenders.array_process", method, name, str(size)]
            numbers = map(float, output_of_process(arguments).split())
            named = dict(zip(MEASURED, numbers, strict=True))
            yield {"problem": name, "by": f"{OURS} {method}", "coordinates": count} | named


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
            rows.append(
                {"problem": each.name, "coordinates": each.q.size} | _thread_row(each, method, h, numbers, plan)
            )
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


def _thread_row(each: Lattice, method: str, h: float, numbers: list[int], plan: Plan) -> dict[str, Any]:
    stepper: Any = compile_stepper(each.system, method)
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


def _seconds(run: Run, steps: int) -> float:
    """Return the seconds per step of a call with ``steps`` steps."""
    memory: Any = run._memory
    binding = memory.binding.raw
    report = binding.new("report *")
    began = time.perf_counter()
    binding.function("advance")(memory.run, memory.problem, steps, binding.null, report)
    return (time.perf_counter() - began) / steps
