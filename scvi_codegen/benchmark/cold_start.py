"""Benchmark of the time from text to the first step of the Kepler problem, without and with cache, in new processes."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any

from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.native import building

__all__ = ["run_cold_start"]

FIRST_STEP = """
import json, sys, time
began = time.perf_counter()
import scvi_codegen as sc
symbolic = "sympy" in sys.modules
sc.LagrangianSystem, sc.compile_stepper, sc.SVI
imported = time.perf_counter()
kepler = sc.LagrangianSystem.from_text(
    name="Kepler problem",
    coordinates=["q1", "q2"],
    lagrangian="(q1_dot**2 + q2_dot**2)/2 + mu/sqrt(q1**2 + q2**2)",
    parameters={"mu": 1.0},
)
sc.compile_stepper(kepler, sc.SVI(8)).step([0.5, 0.0], [0.0, 3.0**0.5], 0.1)
done = time.perf_counter()
print(json.dumps([imported - began, done - imported, symbolic, "sympy" in sys.modules]))
"""


def run_cold_start(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure medians, without and with cache in turn."""
    result: dict[str, list[dict[str, Any]]] = {"cold": [], "cached": []}
    for number in range(plan.rounds):
        report_activity(f"cold start: round {number + 1}")
        with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder:
            for kind, rows in result.items():
                rows.append(_first_step(folder) | {"cache": kind})
    formats = {"cache": "", "import_ms": ".0f", "first_step_ms": ".0f", "process_ms": ".0f"}
    return ResultTable(
        name="cold-start",
        title="from the text of Kepler's Lagrangian to the first step, in a fresh process",
        columns=formats | {"sympy_by_import": "", "sympy_by_step": ""},
        rows=tuple(_medians(rows) for rows in result.values()),
        remarks=(
            "import: of scvi_codegen and the names used; first step: from the text on; process: the whole.",
            "sympy: whether SymPy was imported by 'import scvi_codegen', and by the step.",
        ),
    )


def _first_step(folder: str) -> dict[str, Any]:
    environment = os.environ | {building.CACHE_VARIABLE: folder}
    began = time.perf_counter()
    run = subprocess.run(
        [sys.executable, "-c", FIRST_STEP], capture_output=True, text=True, env=environment, check=True, timeout=600
    )
    whole = time.perf_counter() - began
    imported, stepped, by_import, by_step = json.loads(run.stdout)
    times = {"import_ms": 1e3 * imported, "first_step_ms": 1e3 * stepped, "process_ms": 1e3 * whole}
    return times | {"sympy_by_import": str(by_import), "sympy_by_step": str(by_step)}


def _medians(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        key: statistics.median(row[key] for row in rows) if isinstance(value, float) else value
        for key, value in rows[0].items()
    }
