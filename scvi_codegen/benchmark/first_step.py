"""Benchmark of the time from text to the first step, for two to some thousand coordinates, in fresh processes.

Benchmark from SymPy's description of n links on a cart to a trajectory: this package, SymPy's lambdify and PyDy.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.texts import (
    SystemText,
    bodies,
    chain,
    cloth,
    kepler,
    lennard_jones,
    links,
    post_newtonian,
)
from scvi_codegen.benchmark.report import OURS, Point, ResultTable, time_at
from scvi_codegen.benchmark.settings import Plan, ReportActivity, output_of_process

COMPILED: Mapping[str, tuple[Callable[[], SystemText], str]] = {
    "Kepler": (kepler, "SVI(8)"),
    "double pendulum": (partial(links, 2), "SVI(8)"),
    "10 links": (partial(links, 10), "SVI(4)"),
    "12 bodies": (partial(bodies, 12), "SVI(4)"),
    "post-Newtonian 4": (partial(post_newtonian, 4), "SVI(8)"),
    "post-Newtonian 5": (partial(post_newtonian, 5), "SVI(8)"),
    "post-Newtonian 6": (partial(post_newtonian, 6), "SVI(8)"),
    "chain of 256": (partial(chain, 256), "SVI(4)"),
    "chain of 1000": (partial(chain, 1000), "SVI(4)"),
    "Lennard-Jones 20": (partial(lennard_jones, 20), "StoermerVerlet()"),
    "Lennard-Jones 50": (partial(lennard_jones, 50), "StoermerVerlet()"),
    "cloth 20 x 20": (partial(cloth, 20), "StoermerVerlet()"),
}
"""System and method by name."""

QUICK = ("Kepler", "double pendulum")
LONGEST = 1800

FIRST_STEP = """
import json, os, sys, time
began = time.perf_counter()
import scvi_codegen as sc
by_import = "sympy" in sys.modules
sc.LagrangianSystem, sc.compile_stepper, sc.SVI
given, start, method = json.load(sys.stdin)
marks = [time.perf_counter()]
system = sc.LagrangianSystem.from_text(**given)
marks.append(time.perf_counter())
stepper = sc.compile_stepper(system, getattr(sc, method[0])(*method[1]))
stepper.step(start, [0.0] * len(start), 1e-3)
done = time.perf_counter()
used = os.times()
seconds = [marks[0] - began, marks[1] - marks[0], done - marks[0]]
cpu = [used.user + used.system, used.children_user + used.children_system]
by_step = "sympy" in sys.modules
print(json.dumps([stepper.source.code.count("\\n"), *seconds, *cpu, str(by_import), str(by_step)]))
"""
MEASURED = {
    "lines_of_C": "d",
    "import_s": ".3f",
    "read_s": ".3f",
    "first_step_s": ".3f",
    "python_cpu_s": ".2f",
    "compiler_cpu_s": ".2f",
    "sympy_by_import": "",
    "sympy_by_step": "",
}
"""Numbers that this prints, with their formats."""


def run_cold_start(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure the medians for Kepler's problem, without and with cache in turn."""
    result: dict[str, list[dict[str, Any]]] = {"empty": [], "filled": []}
    for number in range(plan.rounds):
        report_activity(f"cold start: round {number + 1}")
        with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder:
            for kind, rows in result.items():
                rows.append({"cache": kind} | _first_step("Kepler", folder))
    return _first_steps("cold-start", [_medians(rows) for rows in result.values()])


def run_compile_times(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one run per system, each with an empty cache."""
    rows = []
    for name in COMPILED:
        if not plan.quick or name in QUICK:
            report_activity(f"compile: {name}")
            rows.append({"cache": "empty"} | _first_step(name))
    return _first_steps("compile", rows)


def _first_steps(section: str, rows: list[dict[str, Any]]) -> ResultTable:
    return ResultTable(
        name=section,
        title="from the text of a Lagrangian to the first step, in a fresh process",
        columns={"system": "", "method": "", "cache": "", "coordinates": "d", **MEASURED},
        rows=tuple(rows),
        remarks=(
            "import: wall time of scvi_codegen and the names used; first step: from the text on, including reading it;",
            "cpu: processor seconds of Python and of the C compiler, less sensitive to other processes; sympy: whether",
            "it was imported by 'import scvi_codegen', and by the step.",
        ),
    )


def _first_step(system: str, cache: str = "") -> dict[str, Any]:
    write, method = COMPILED[system]
    keywords = asdict(write())
    start = keywords.pop("start")
    name, _, arguments = method.rstrip(")").partition("(")
    text = json.dumps([keywords, start, [name, [int(argument) for argument in arguments.split(",") if argument]]])
    numbers = json.loads(output_of_process(["-c", FIRST_STEP], text=text, cache=cache, longest=LONGEST))
    given = {"system": system, "method": method, "coordinates": len(start)}
    return given | dict(zip(MEASURED, numbers, strict=True))


def _medians(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        key: statistics.median(row[key] for row in rows) if isinstance(value, float) else value
        for key, value in rows[0].items()
    }


CONTENDERS = (OURS, "lambdify", "PyDy")
LINKS = (2, 5, 10, 20, 40)
ERROR = 1e-9
"""Largest coordinate error after one second at which times are compared."""


def run_mechanisms(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one process per contender, with an empty cache."""
    rows: list[dict[str, Any]] = []
    for count in LINKS[: 1 if plan.quick else None]:
        result = {}
        for name in CONTENDERS:
            report_activity(f"mechanisms: {count} links by {name}")
            result[name] = _measured(name, count)
        rows += [{"links": count, "by": name} | _row(name, result) for name in CONTENDERS]
    return ResultTable(
        name="mechanisms",
        title="a pendulum of n links on a cart, from SymPy's bodies and loads, in a fresh process with an empty cache",
        columns={
            "links": "d",
            "by": "",
            "first_step_s": ".2f",
            "second_ms": ".2f",
            "least_error": ".0e",
            "why_not": "",
        },
        rows=tuple(rows),
        remarks=(
            "first step: processor seconds from the model to the first step or right-hand side, C compilers included;",
            f"second: processor milliseconds per second of simulated time at an error of {ERROR:g};",
            "errors of this project are against lambdify's most accurate result, all others against this project's.",
        ),
    )


def _measured(name: str, links: int) -> dict[str, Any]:
    """Return the measurements of a contender, or the reason of its failure."""
    arguments = ["-m", "scvi_codegen.benchmark.contenders.multibody", name, str(links)]
    try:
        output = output_of_process(arguments, longest=LONGEST)
    except subprocess.TimeoutExpired:
        return {"why_not": f"more than {LONGEST} s"}
    except subprocess.CalledProcessError as failure:
        return {"why_not": (failure.stderr.strip().splitlines() or [f"status {failure.returncode}"])[-1][:80]}
    measured: dict[str, Any] = json.loads(output.splitlines()[-1])
    return measured


def _row(name: str, result: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the times of a contender, with errors relative to another contender's most accurate run."""
    ours, other = result[name], result["lambdify" if name == OURS else OURS]
    if "why_not" in ours or "why_not" in other:
        return {
            "first_step_s": ours.get("first_step"),
            "why_not": ours.get("why_not") or "no reference to compare with",
        }
    exact = np.array(other["runs"][-1]["q"])
    errors = [float(np.abs(np.array(run["q"]) - exact).max()) for run in ours["runs"]]
    points = [Point(seconds=run["seconds"], error=error) for run, error in zip(ours["runs"], errors, strict=True)]
    seconds = time_at(points, ERROR)
    spent = {} if seconds is None else {"second_ms": 1e3 * seconds}
    return {"first_step_s": ours["first_step"], "least_error": min(errors)} | spent
