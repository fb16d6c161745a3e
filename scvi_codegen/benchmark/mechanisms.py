"""Benchmark from SymPy's description of n links on a cart to a trajectory: this package, SymPy's lambdify and PyDy."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.benchmark.work_precision import Point, time_at
from scvi_codegen.native import building

__all__ = ["CONTENDERS", "LINKS", "run_mechanisms"]

CONTENDERS = (OURS, "lambdify", "PyDy")
LINKS = (2, 5, 10, 20, 40)
ERROR = 1e-9
"""Largest coordinate error after one second at which times are compared."""
LONGEST = 1800


def run_mechanisms(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one process per contender, with an empty cache."""
    rows: list[dict[str, Any]] = []
    for links in LINKS[: 1 if plan.quick else None]:
        result = {}
        for name in CONTENDERS:
            report_activity(f"mechanisms: {links} links by {name}")
            result[name] = _measured(name, links)
        rows += [{"links": links, "by": name} | _row(name, result) for name in CONTENDERS]
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
    command = [sys.executable, "-m", "scvi_codegen.benchmark.contenders.multibody", name, str(links)]
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder:
        environment = os.environ | {building.CACHE_VARIABLE: folder}
        try:
            run = subprocess.run(command, capture_output=True, text=True, env=environment, check=False, timeout=LONGEST)
        except subprocess.TimeoutExpired:
            return {"why_not": f"more than {LONGEST} s"}
    if run.returncode:
        return {"why_not": (run.stderr.strip().splitlines() or [f"status {run.returncode}"])[-1][:80]}
    measured: dict[str, Any] = json.loads(run.stdout.splitlines()[-1])
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
