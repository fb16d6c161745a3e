"""Benchmark of the time from text to the first step, for two to some thousand coordinates, in fresh processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

from scvi_codegen.benchmark.compile_systems import (
    SystemText,
    bodies,
    chain,
    cloth,
    kepler,
    lennard_jones,
    links,
    post_newtonian,
)
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.native import building

__all__ = ["COMPILED", "run_compile_times"]

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
from scvi_codegen.mechanics.symmetry.symmetry import symmetries

given, start, method = json.load(sys.stdin)
marks = [time.perf_counter()]
system = sc.LagrangianSystem.from_text(**given)
marks.append(time.perf_counter())
symmetries(system)
marks.append(time.perf_counter())
stepper = sc.compile_stepper(system, getattr(sc, method[0])(*method[1]))
stepper.step(start, [0.0] * len(start), 1e-3)
done = time.perf_counter()
used = os.times()
python, compiler = used.user + used.system, used.children_user + used.children_system
lines = stepper.source.code.count("\\n")
print(json.dumps([done - began, marks[1] - marks[0], marks[2] - marks[1], python, compiler, lines]))
"""


def run_compile_times(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure one run per system, each with an empty cache."""
    rows = []
    for name, (write, method) in COMPILED.items():
        if plan.quick and name not in QUICK:
            continue
        report_activity(f"compile: {name}")
        rows.append({"system": name, "method": method} | _first_step(write(), method))
    formats = {"system": "", "method": "", "coordinates": "d", "lines_of_C": "d", "first_step_s": ".2f"}
    return ResultTable(
        name="compile",
        title="from the text of a Lagrangian to the first step, in a fresh process with an empty cache",
        columns=formats | {"read_s": ".2f", "symmetries_s": ".2f", "python_cpu_s": ".2f", "compiler_cpu_s": ".2f"},
        rows=tuple(rows),
        remarks=(
            "first step: wall time from the import on, including parsing and checking the text and the search for",
            "symmetries; cpu: processor seconds of Python and of the C compiler, less sensitive to other processes.",
        ),
    )


def _first_step(written: SystemText, method: str) -> dict[str, Any]:
    keywords = asdict(written)
    start = keywords.pop("start")
    name, _, arguments = method.rstrip(")").partition("(")
    text = json.dumps([keywords, start, [name, [int(argument) for argument in arguments.split(",") if argument]]])
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-bench-") as folder:
        environment = os.environ | {building.CACHE_VARIABLE: folder}
        run = subprocess.run(
            [sys.executable, "-c", FIRST_STEP],
            input=text, capture_output=True, text=True, env=environment, check=True, timeout=LONGEST,
        )  # fmt: skip
    whole, read, result, python, compiler, lines = json.loads(run.stdout)
    return {
        "coordinates": len(start),
        "lines_of_C": lines,
        "first_step_s": whole,
        "read_s": read,
        "symmetries_s": result,
        "python_cpu_s": python,
        "compiler_cpu_s": compiler,
    }
