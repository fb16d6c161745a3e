"""Benchmark of the energy of array systems over a hundred thousand steps: growth by round-off.

Benchmark of steps of array systems with several threads: wall time, in short turns, the minimum of each.

Benchmark of a thousand gravitating bodies; REBOUND's leapfrog and IAS15 at equal error.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.large import Lattice, atoms, bodies, breather, cloth, field, ring, waves
from scvi_codegen.benchmark.cases.unforced import Array
from scvi_codegen.benchmark.lattices import advanced, reference_of, rms, states_by_rebound
from scvi_codegen.benchmark.methods import fitted_rate
from scvi_codegen.benchmark.report import OURS, ResultTable
from scvi_codegen.benchmark.settings import Plan, ReportActivity, timed
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.runtime.run.run import Run

STEPS, QUICK_STEPS = 100_000, 2000
SAMPLES = 500
PARTS = 10
"""Number of parts of a run; the first is reported by itself."""


def problems(plan: Plan) -> Iterator[tuple[Lattice, float, float]]:
    """Yield each problem with a step size for SVI(8), with local error below round-off, and one for leapfrog."""
    if plan.quick:
        yield from ((ring(16, 1.0), 0.1, 0.02), (cloth(3, 1.0), 0.01, 0.002))
        return
    yield ring(1000, 1.0), 0.1, 0.02
    yield waves(1000, 1.0), 0.1, 0.02
    yield breather(1000, 1.0), 0.02, 0.004
    yield field(32, 1.0), 0.02, 0.004
    yield atoms(2, 1.0), 0.002, 0.0004
    yield cloth(20, 1.0), 0.01, 0.002
    yield bodies(32, 1.0), 0.01, 0.002


@without_accuracy_warnings()
def run_energies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure all problems with SVI(8) and with leapfrog."""
    steps = QUICK_STEPS if plan.quick else STEPS
    rows = []
    for each, h, short in problems(plan):
        for method, length in (("svi:8", h), ("stoermer-verlet", short)):
            report_activity(f"energies: {each.name} of {each.q.size} coordinates by {method}")
            rows.append(_energy_row(each, method, length, steps))
    columns = {"problem": "", "coordinates": "d", "by": "", "h": "g", "seconds": ".1f"}
    errors = dict.fromkeys(("first_tenth", "largest", "at_the_end", "drift", "uncertainty"), ".1e")
    return ResultTable(
        name="energies",
        title=f"error of the energy over {steps} steps, relative to the largest kinetic energy",
        columns=columns | errors,
        rows=tuple(rows),
        remarks=(
            "first tenth, largest: largest error in the first tenth of the run, and in all of it; drift: slope of",
            "the fitted line times the length of the run, with its standard error. A random walk grows by a",
            "factor of about 3 from the first tenth to the end.",
        ),
    )


def _energy_row(each: Lattice, method: str, h: float, steps: int) -> dict[str, Any]:
    stepper = compile_stepper(each.system, method)
    arguments: dict[str, Any] = {"parameters": each.parameters, "tables": each.tables}
    how: dict[str, Any] = {"h": h, "steps": steps, "save_every": steps // SAMPLES or 1, "observe": lambda run: run.t}
    seconds, run = timed(lambda: stepper.integrate(each.q, velocity=each.v, **how, **arguments))
    error = (run.energy() - run.energy()[0]) / run.energies[:, 0].max()
    drift, uncertainty = fitted_rate(error)
    return {
        "problem": each.name,
        "coordinates": each.q.size,
        "by": f"{OURS} {method}",
        "h": h,
        "seconds": seconds,
        "first_tenth": float(np.abs(error[: len(error) // PARTS + 1]).max()),
        "largest": float(np.abs(error).max()),
        "at_the_end": float(error[-1]),
        "drift": drift,
        "uncertainty": uncertainty,
    }


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


def _seconds(run: Run, steps: int) -> float:
    """Return the seconds per step of a call with ``steps`` steps."""
    memory: Any = run._memory
    binding = memory.binding.raw
    report = binding.new("report *")
    began = time.perf_counter()
    binding.function("advance")(memory.run, memory.problem, steps, binding.null, report)
    return (time.perf_counter() - began) / steps


State = tuple[Array, Array]
"""Final positions and velocities."""

COUNT, QUICK_COUNT, SPAN = 1000, 20, 0.5
LEAPS = (16, 64, 256, 1024)
OURS_BY = {"svi:2": (16, 32), "svi:4": (4, 8, 16), "svi:8": (2, 4, 8, 16), "composition:8": (4, 8, 16)}
"""Numbers of steps of each method."""


@without_accuracy_warnings()
def run_thousand_bodies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure every contender at several numbers of steps, each twice."""
    each = bodies(QUICK_COUNT if plan.quick else COUNT, SPAN)
    reference, doubt = reference_of(each)
    energy = _energies(each)
    before = energy((each.q, each.v))
    rows = []
    for name, steps, settle in _contenders(each, plan):
        report_activity(f"cluster: {name}, {steps or 'adaptive'} steps")
        (seconds, end), (again, _) = timed(settle), timed(settle)
        errors = {"error": rms(end[0], reference), "energy_error": abs(energy(end) / before - 1.0)}
        rows.append({"by": name, "steps": steps, "ms": 1e3 * min(seconds, again), **errors})
    return ResultTable(
        name="thousand-bodies",
        title=f"{len(each.q)} bodies, direct sum, softened, to t = {SPAN:g}",
        columns={"by": "", "steps": "d", "ms": ".0f", "error": ".1e", "energy_error": ".1e"},
        rows=tuple(rows),
        remarks=(
            f"error: root mean square of positions over that of the positions, known to {doubt:.0e}; energy error:",
            "relative. Processor time, the faster of two runs. IAS15 has adaptive step size at its default accuracy.",
        ),
    )


def _energies(each: Lattice) -> Callable[[State], float]:
    stepper = compile_stepper(each.system, "stoermer-verlet")
    return lambda state: stepper.start(state[0], velocity=state[1], h=1.0, parameters=each.parameters).energy


def _contenders(each: Lattice, plan: Plan) -> Iterator[tuple[str, int | None, Callable[[], State]]]:
    for method, counts in OURS_BY.items():
        for steps in counts:
            yield f"{OURS} {method}", steps, _ours(each, method, steps)
    for steps in LEAPS:
        yield f"{OURS} stoermer-verlet", steps, _ours(each, "stoermer-verlet", steps)
    if "rebound" in plan.peers and find_spec("rebound"):
        for steps in LEAPS:
            yield "REBOUND leapfrog", steps, partial(states_by_rebound, each, "leapfrog", steps)
        yield "REBOUND IAS15", None, partial(states_by_rebound, each, "ias15", None)


def _ours(each: Lattice, method: str, steps: int) -> Callable[[], State]:
    stepper = compile_stepper(each.system, method)

    def settle() -> State:
        run = advanced(stepper, each, steps)
        arrays = run.stepper.arrays
        return arrays(run.q)["r"], arrays(run.velocity)["r"]

    return settle
