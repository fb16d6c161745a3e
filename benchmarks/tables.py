"""Tables without contenders at equal error: energy drift, and time to the first step."""

import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from itertools import islice
from typing import Any

import numpy as np

from benchmarks.cases.large import bodies
from benchmarks.cases.robots import chain
from benchmarks.cases.unforced import Array, Case, case, chain_case, gravitating
from benchmarks.contenders.engines import mujoco_states
from benchmarks.contenders.ours import momenta_of
from benchmarks.contenders.taylor import heyoka_states
from benchmarks.report import OURS, ResultTable
from benchmarks.settings import Plan, ReportActivity, timed
from scvi_codegen.codegen.native import building
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.compiler import compile_stepper

DRIFTS = {"kepler:0.2": (0.5, 0.35, 0.2), "kepler:0.5": (0.2, 0.15, 0.1)}
"""Three step sizes for each case, from the largest without a visible truncation error down."""
STEPS, QUICK_STEPS, ROBOT_SPAN = 10_000_000, 20_000, 400.0
ROBOT_METHODS = {"svi:2": 0.002, "svi:4": 0.005, "MuJoCo RK4": 0.002, "MuJoCo implicitfast": 0.002}
"""Step sizes for a chain of five hinges; 0.002 is MuJoCo's default."""
SAMPLES, BLOCKS, PARTS = 2000, 20, 10
"""Numbers of samples of the energy, of blocks of them, and of parts of a run; the first part is reported by itself."""


@without_accuracy_warnings()
def run_drift(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the energy error of long runs of this package, heyoka at its default tolerance, and MuJoCo."""
    rows = []
    for name, sizes in DRIFTS.items():
        for h in sizes:
            report_activity(f"drift: {name}, h = {h:g}")
            methods, steps = ("svi:8", *_installed("heyoka", plan)), QUICK_STEPS if plan.quick else STEPS
            rows += [drift_row(case(name), by, h, steps) for by in methods]
    if not plan.quick:
        robot = chain(5)
        for by, h in ROBOT_METHODS.items():
            if "MuJoCo" not in by or _installed("mujoco", plan):
                report_activity(f"drift: {robot.name} by {by}")
                rows.append(drift_row(robot, by, h, round(ROBOT_SPAN / h)))
    columns = {"problem": "", "by": "", "h": "g", "steps": "d", "seconds": ".2f"}
    errors = dict.fromkeys(("first_tenth", "largest", "at_the_end", "drift", "uncertainty"), ".1e")
    return ResultTable(
        name="drift",
        title="energy error of long runs, relative to the energy",
        columns=columns | errors,
        rows=tuple(rows),
        remarks=(
            "first tenth, largest: largest error in the first tenth of the run, and in all of it; a random walk grows",
            "by a factor of about 3; -: unstable. drift: change of a fitted line over the run. uncertainty: its",
            f"standard error, from the variance of the gains over {BLOCKS} blocks. h of heyoka: of the run it repeats.",
        ),
    )


def _installed(name: str, plan: Plan) -> tuple[str, ...]:
    return (name,) if name in plan.peers and importlib.util.find_spec(name) is not None else ()


def drift_row(chosen: Case, by: str, h: float, steps: int) -> dict[str, Any]:
    """Return the energy errors of a run from the first state of a case by one method."""
    stepper = compile_stepper(chosen.system, by if by.startswith("svi") else "svi:8")
    every, q, p = max(1, steps // SAMPLES), chosen.q[0], momenta_of(stepper, chosen)[0]
    if by.startswith("svi"):
        seconds, run = timed(lambda: stepper.integrate(q, p, h=h, steps=steps, save_every=every, check_growth=False))
        energy = run.energy()
    else:
        times, half = np.linspace(0.0, h * steps, steps // every + 1), chosen.dimension
        if by == "heyoka":
            seconds, states = timed(lambda: heyoka_states(chosen, times))
        else:
            seconds, states = mujoco_states(chosen, by.split()[1], h, every, len(times))
        reached = np.isfinite(states).all(axis=1)
        q, v = states[reached, :half], states[reached, half:]
        energy = np.full(len(states), np.nan)
        energy[reached] = stepper.energy(q, stepper.momentum(q, v))
    error = (energy - energy[0]) / abs(energy[0])
    drift, uncertainty = fitted_rate(error)
    return {
        "problem": chosen.name,
        "by": f"{OURS} {by}" if by.startswith("svi") else by,
        "h": h,
        "steps": steps,
        "seconds": seconds,
        "first_tenth": float(np.abs(error[: len(error) // PARTS + 1]).max()),
        "largest": float(np.abs(error).max()),
        "at_the_end": float(error[-1]),
        "drift": drift,
        "uncertainty": uncertainty,
    }


def fitted_rate(error: Array) -> tuple[float, float]:
    """Return the change over the run of a line fitted to equidistant samples, and its standard error.

    Round-off makes the energy a random walk, so the residuals of the fit are correlated and the usual error is too
    small. The increments of the walk are independent: the error is estimated from the variance of its gains over twenty
    blocks, with the variance 6/5 of the fitted change of a walk of unit variance.
    """
    t = np.linspace(-0.5, 0.5, len(error))
    derivative = float(t @ error / (t @ t))
    gains = np.diff(error[np.linspace(0, len(error) - 1, BLOCKS + 1).astype(int)])
    return derivative, float(np.sqrt(1.2 * BLOCKS * np.var(gains, ddof=1)))


def named_bodies(count: int) -> Case:
    """Return the first bodies of a cluster as named coordinates; all attract each other."""
    cluster = bodies(count, 1.0)
    state = [1.0 / count] * count, cluster.q[0], cluster.velocity[0]
    return gravitating(*state, name=f"bodies:{count}", gravity=1.0, span=1.0, fine=0.1)


FIRST_STEPS: dict[str, Callable[[], Case]] = {
    **{name: partial(case, name) for name in ("kepler:0.2", "double-pendulum", "outer-solar-system", "fput-chain:64")},
    **{f"fput-chain:{n}": partial(chain_case, n, step=2.0, fine=2.0) for n in (256, 1000)},
    **{f"bodies:{n}": partial(named_bodies, n) for n in (12, 40)},
}
"""Cases whose time from text to the first step is measured."""
LONGEST = 1800
FIRST_STEP = """
import json, os, sys, time
import scvi_codegen as sc
sc.LagrangianSystem, sc.compile_stepper, sc.SVI
given, start = json.load(sys.stdin)
began = time.perf_counter()
stepper = sc.compile_stepper(sc.LagrangianSystem.from_text(**given), sc.SVI(8))
stepper.step(start, [0.0] * len(start), 1e-3)
seconds, used = time.perf_counter() - began, os.times()
cpu = [used.user + used.system, used.children_user + used.children_system]
print(json.dumps([stepper.source.code.count("\\n"), seconds, *cpu]))
"""
MEASURED = {"lines_of_C": "d", "first_step_s": ".3f", "python_cpu_s": ".2f", "compiler_cpu_s": ".2f"}
"""Numbers that this prints, with their formats."""


def run_first_steps(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure fresh processes, with an empty cache and again with the cache filled, in turn; medians of the rounds."""
    rows = []
    for name, make in islice(FIRST_STEPS.items(), 1 if plan.quick else None):
        rounds: dict[str, list[dict[str, Any]]] = {"empty": [], "filled": []}
        chosen = make()
        for number in range(plan.rounds):
            report_activity(f"first step: {name}, round {number + 1}")
            with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder:
                for kind, measured in rounds.items():
                    measured.append({"system": name, "cache": kind} | _first_step(chosen, folder))
        rows += [_medians(measured) for measured in rounds.values()]
    return ResultTable(
        name="first-step",
        title="from the text of a Lagrangian to the first step of SVI(8), in a fresh process",
        columns={"system": "", "cache": "", "coordinates": "d", **MEASURED},
        rows=tuple(rows),
        remarks=(
            "first step: wall time from the text on; cpu: processor seconds of Python and of the C compiler, which are",
            "less sensitive to other processes.",
        ),
    )


def _first_step(chosen: Case, cache: str) -> dict[str, Any]:
    """Return what a fresh process measures that reads the system as text."""
    system: Any = chosen.system
    names = [str(symbol) for symbol in system.coordinates]
    given = {"name": system.name, "coordinates": names, "lagrangian": str(system.lagrangian)}
    text = json.dumps([given | {"parameters": chosen.parameters}, chosen.q[0].tolist()])
    environment = os.environ | {building.CACHE_VARIABLE: cache}
    how: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "timeout": LONGEST}
    output = subprocess.run([sys.executable, "-c", FIRST_STEP], input=text, env=environment, **how).stdout
    return {"coordinates": chosen.dimension} | dict(zip(MEASURED, json.loads(output), strict=True))


def _medians(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        key: statistics.median(row[key] for row in rows) if isinstance(value, float) else value
        for key, value in rows[0].items()
    }
