"""Tables of the time of one step: by number of coordinates and threads, with derivatives, by compiler and processor."""

import functools
import itertools
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.cases.large import atoms, bodies, field, ring
from benchmarks.cases.unforced import Array, Case, case
from benchmarks.contenders.ours import momenta_of
from benchmarks.report import ResultTable
from benchmarks.settings import Plan, ReportActivity
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS

STEP_SECONDS = 0.1
"""Shortest time of a timed interval."""
RINGS, QUICK_RINGS = (1_000, 10_000, 100_000, 1_000_000), (1_000,)
SCALED = {"svi:4": 0.1, "svi:8": 0.1, "stoermer-verlet": 0.02}
"""Step sizes of a ring by method."""
THREADED: dict[str, tuple[Callable[[], Case], float]] = {
    **{f"ring:{n}": (functools.partial(ring, n, 1.0), 0.1) for n in RINGS[1:]},
    **{f"atoms:{4 * k**3}": (functools.partial(atoms, k, 1.0), 0.002) for k in (3, 4, 6)},
    **{f"bodies:{n}": (functools.partial(bodies, n, 1.0), 0.01) for n in (256, 1000)},
    "field:512": (functools.partial(field, 512, 1.0), 0.02),
}
"""Array systems and the step sizes of SVI(8); leapfrog takes a fifth of them."""
DIFFERENTIATED: dict[str, tuple[str, float]] = {
    "Kepler": ("kepler:0.5", 0.25),
    "double pendulum": ("double-pendulum", 0.05),
    "FPUT chain of 64": ("fput-chain:64", 0.5),
    "outer solar system": ("outer-solar-system", 200.0),
}
"""Cases and step sizes of which derivatives are computed."""
DERIVED_STEPS = 2000
BUILDS = ("cc", "clang")
TARGETS = ("native", "x86-64-v4", "x86-64-v3", "x86-64", "portable")
BUILT = ("kepler:0.5", "outer-solar-system")


def shortest(work: Callable[[], object], plan: Plan, clock: Callable[[], float] = time.process_time) -> float:
    """Return the shortest of several times of a call, whose number is at least that of the timed rounds."""
    began, best, rounds = clock(), float("inf"), 0
    while rounds < plan.rounds or (clock() - began < STEP_SECONDS and not plan.quick):
        start = clock()
        work()
        best, rounds = min(best, clock() - start), rounds + 1
    return best


def _step_seconds(chosen: Case, method: str, h: float, plan: Plan, threads: int = 1) -> float:
    """Return the shortest wall time of a step of a case with arrays."""
    shape = chosen.arrays.shape if chosen.arrays is not None else (-1,)
    q, velocity = (part[0].reshape(shape) for part in chosen.states)
    run = compile_stepper(chosen.system, method).start(q, velocity=velocity, h=h, threads=threads)
    run.advance(3)
    count = max(1, round(STEP_SECONDS / max(1e-7, shortest(lambda: run.advance(1), plan, time.perf_counter))))
    return shortest(lambda: run.advance(count), plan, time.perf_counter) / count


def run_scaling(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure steps of rings of 10^3 to 10^6 elements."""
    rows = []
    for count in QUICK_RINGS if plan.quick else RINGS:
        report_activity(f"scaling: ring of {count}")
        chosen = ring(count, 1.0)
        times = {by: 1e9 * _step_seconds(chosen, by, h, plan) / count for by, h in SCALED.items()}
        rows.append({"coordinates": count} | times)
    return ResultTable(
        name="scaling",
        title="nanoseconds per coordinate and step of a ring of springs, one thread",
        columns={"coordinates": "d"} | dict.fromkeys(SCALED, ".3g"),
        rows=tuple(rows),
    )


def run_threads(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure steps of large systems with one and with two threads."""
    rows = []
    for name, (make, h) in itertools.islice(THREADED.items(), 1 if plan.quick else None):
        report_activity(f"threads: {name}")
        chosen, row = make(), dict[str, Any](system=name)
        for by, size in (("svi:8", h), ("stoermer-verlet", h / 5)):
            one, two = (_step_seconds(chosen, by, size, plan, threads) for threads in (1, 2))
            row |= {f"{by}_us": 1e6 * one, f"{by}_speed-up": one / two}
        rows.append(row)
    columns = {"system": "", "svi:8_us": ".3g", "svi:8_speed-up": ".2f"}
    columns |= {"stoermer-verlet_us": ".3g", "stoermer-verlet_speed-up": ".2f"}
    return ResultTable(
        name="threads",
        title="time of a step in one thread, and the speed-up of two threads; wall time",
        columns=columns,
        rows=tuple(rows),
    )


def run_derivatives(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure runs alone, with tangent vectors and with a gradient."""
    rows = []
    for (name, (problem, h)), by in itertools.product(DIFFERENTIATED.items(), ("svi:4", "svi:8")):
        if plan.quick and (name, by) != ("Kepler", "svi:4"):
            continue
        report_activity(f"derivatives: {name}, {by}")
        rows.append({"problem": name, "method": by, "h": h} | _derived(case(problem), by, h, plan))
    return ResultTable(
        name="derivatives",
        title="microseconds a step: alone, with one tangent vector, each further one, the gradient of one function",
        columns={"problem": "", "method": "", "h": "g"}
        | dict.fromkeys(("step", "tangent", "further", "pullback"), ".3g"),
        rows=tuple(rows),
        remarks=(f"runs of {DERIVED_STEPS} saved steps, from Python; tangent contains the run, pullback does not.",),
    )


def _derived(chosen: Case, by: str, h: float, plan: Plan) -> dict[str, float]:
    """Return the times of a step of a run, with its derivatives, in microseconds."""
    stepper = compile_stepper(chosen.system, by)
    q, p = chosen.q[0], momenta_of(stepper, chosen)[0]
    how: dict[str, Any] = {"h": h, "steps": DERIVED_STEPS, "check_growth": False}
    basis = np.eye(2 * chosen.dimension)
    few, many = basis[:, :1], basis[:, :4]

    def tangent(directions: Array) -> float:
        return shortest(lambda: stepper.integrate(q, p, **how).tangent(directions), plan)

    run = stepper.integrate(q, p, **how)
    cotangents = np.zeros((len(run.q), len(basis)))
    cotangents[-1, 0] = 1.0
    for directions in (few, many):  # compiled on first use
        run.tangent(directions)
    run.pullback(cotangents)
    alone = shortest(lambda: stepper.integrate(q, p, **how), plan)
    first, more = tangent(few), tangent(many)
    times = {
        "step": alone,
        "tangent": first,
        "further": (more - first) / (many.shape[1] - 1),
        "pullback": shortest(lambda: run.pullback(cotangents), plan),
    }
    return {name: 1e6 * seconds / DERIVED_STEPS for name, seconds in times.items()}


def run_builds(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one source built by the installed compilers for several processors."""
    rows = []
    for command, target in itertools.product(BUILDS, TARGETS[-1:] if plan.quick else TARGETS):
        if shutil.which(command) is not None:
            report_activity(f"builds: {command}, {target}")
            arguments = [sys.executable, "-m", "benchmarks.steps", target, str(plan.rounds), str(int(plan.quick))]
            environment = os.environ | {"CC": command}
            output = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=True).stdout
            rows.append({"compiler": command, "target": target} | json.loads(output))
    names = [f"{name}_{by}" for name in BUILT for by in ("svi:4", "svi:8")]
    return ResultTable(
        name="builds",
        title="microseconds a step by compiler and -march; portable: the flags of generated packages",
        columns={"compiler": "", "target": ""} | dict.fromkeys(names, ".3g"),
        rows=tuple(rows),
    )


def built_steps(target: str, plan: Plan) -> dict[str, float]:
    """Return the times of a step in microseconds with this process's compiler, by case and method."""
    tuned = tuple(f"-march={target}" if flag.startswith("-march") else flag for flag in TUNED_FLAGS)
    flags, result = PORTABLE_FLAGS if target == "portable" else tuned, {}
    chosen: Iterable[Case] = map(case, BUILT)
    for each, by in itertools.product(chosen, ("svi:4", "svi:8")):
        stepper = compile_stepper(each.system, by, flags=flags)
        run = stepper.start(each.q[0], momenta_of(stepper, each)[0], h=each.step)
        count = 100 if plan.quick else 10_000
        result[f"{each.name}_{by}"] = 1e6 * shortest(functools.partial(run.advance, count), plan) / count
    return result


if __name__ == "__main__":
    build, rounds, quick = sys.argv[1:]
    print(json.dumps(built_steps(build, Plan(repeats=int(rounds), quick=quick == "1"))))
