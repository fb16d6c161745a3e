"""Benchmark of one C source with several compilers, and for several processors, in turn."""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods import SVI
from scvi_codegen.models.problems import problem
from scvi_codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS

__all__ = ["run_compilers"]

PROBLEMS = ("kepler", "outer-solar-system")
DEGREES = (4, 8)
STEPS = 4000
LEVELS: Mapping[str, tuple[str, str]] = {
    "x86-64": ("plain x86-64", ""),
    "x86-64-v3": ("AVX2", "avx2"),
    "x86-64-v4": ("AVX-512", "avx512f"),
}
"""Levels of x86-64 as gcc and clang name them: title, and the processor flag required."""

Step = Callable[[], object]


def run_compilers(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure microseconds per step: minima of processor time, all builds in turn, round after round."""
    steps = max(1, int(STEPS * plan.share))
    builds = _builds()
    rows: dict[str, dict[str, Any]] = {build: {"build": build} for build in builds}
    for name in PROBLEMS:
        for degree in DEGREES:
            column = f"{name}, SVI({degree})"
            report_activity(f"builds: {column}")
            runs = {build: _runner(name, degree, steps, *how) for build, how in builds.items()}
            for build, seconds in _fastest(runs, plan.rounds).items():
                rows[build][column] = 1e6 * seconds / steps
    columns = [key for key in next(iter(rows.values()), {}) if key != "build"]
    return ResultTable(
        name="c-compilers",
        title="microseconds per step, by compiler and flags",
        columns={"build": ""} | dict.fromkeys(columns, ".2f"),
        rows=tuple(rows.values()),
        remarks=("minima of processor time, builds in turn; compilers and levels that are not available are omitted",),
    )


def _builds() -> dict[str, tuple[str, tuple[str, ...]]]:
    """Return compiler and flags by title, for the compilers that are installed."""
    result = {name: name for name in ("gcc", "clang") if shutil.which(name)}
    if importlib.util.find_spec("ziglang"):
        result["ziglang"] = f"{sys.executable} -m ziglang cc"
    builds: dict[str, tuple[str, tuple[str, ...]]] = {}
    for title, command in result.items():
        builds[f"{title}, this processor"] = (command, TUNED_FLAGS)
        for architecture in _levels():
            flags = tuple(f"-march={architecture}" if flag == "-march=native" else flag for flag in TUNED_FLAGS)
            if title != "ziglang":  # a clang with other names of processors
                builds[f"{title}, {LEVELS[architecture][0]}"] = (command, flags)
        builds[f"{title}, portable"] = (command, PORTABLE_FLAGS)
    return builds


def _levels() -> Iterator[str]:
    """Yield the levels of x86-64 that this processor supports."""
    if platform.machine() not in ("x86_64", "AMD64"):
        return
    description = Path("/proc/cpuinfo")
    has = description.read_text(encoding="utf-8").split() if description.exists() else []
    yield from (architecture for architecture, (_, flag) in LEVELS.items() if not flag or flag in has)


def _runner(name: str, degree: int, steps: int, command: str, flags: tuple[str, ...]) -> Step:
    """Return a function that performs many steps with one build."""
    chosen = problem(name)
    with _compiled_by(command):
        stepper = compile_stepper(chosen.system, SVI(degree), flags=flags)
    stepper.prepare(adaptive=False)
    start: dict[str, Any] = {"q": chosen.q, "velocity": chosen.velocity, "p": chosen.p}
    return lambda: stepper.integrate(**start, h=chosen.step, steps=steps, save_every=steps)


@contextmanager
def _compiled_by(command: str) -> Iterator[None]:
    before = os.environ.get("CC")
    os.environ["CC"] = command
    try:
        yield
    finally:
        del os.environ["CC"]
        if before is not None:
            os.environ["CC"] = before


def _fastest(runs: Mapping[str, Step], rounds: int) -> dict[str, float]:
    """Return the smallest processor time of each, in seconds."""
    result = dict.fromkeys(runs, float("inf"))
    for _ in range(rounds):
        for build, run in runs.items():
            began = time.process_time()
            run()
            result[build] = min(result[build], time.process_time() - began)
    return result
