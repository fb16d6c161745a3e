"""Description of the machine on which the benchmark runs.

Limits of one core of this machine: memory bandwidth by STREAM's triad, arithmetic by multiply-adds in registers.

Benchmark of one C source with several compilers, and for several processors, in turn.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from scvi_codegen.benchmark.report import ResultTable
from scvi_codegen.benchmark.settings import Plan, ReportActivity, seconds_in_turn, set_variable
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods import SVI
from scvi_codegen.models.problems import problem
from scvi_codegen.native import building
from scvi_codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS
from scvi_codegen.native.compilers import find_compiler
from scvi_codegen.rendering.source import Source
from scvi_codegen.version import __version__

PACKAGES = ("numpy", "scipy", "sympy", "heyoka", "rebound", "CyRK", "numba", "jitcode", "symengine", "pydy")


def machine() -> dict[str, str | dict[str, str]]:
    """Return processor, system, compiler and versions as plain data."""
    compiler = find_compiler()
    shown = subprocess.run([*compiler, "--version"], capture_output=True, text=True, timeout=60, check=False).stdout
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "load": ", ".join(f"{value:.2f}" for value in os.getloadavg()) if hasattr(os, "getloadavg") else "unknown",
        "system": platform.platform(),
        "python": platform.python_version(),
        "compiler": shown.splitlines()[0] if shown else " ".join(compiler),
        "flags": " ".join(TUNED_FLAGS),
        "versions": {"scvi-codegen": __version__, **dict(_versions(PACKAGES))},
    }


def _processor() -> str:
    """Return model name and widest vector unit, if the system reports them."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    entries = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    model = " ".join(entries.get(key, "") for key in ("model name", "cpu family", "model")).strip()
    width = next((flag for flag in ("avx512f", "avx2", "sse2") if flag in entries.get("flags", "").split()), "")
    return f"{model or platform.machine()} {width}".strip()


def _versions(names: Iterable[str]) -> Iterable[tuple[str, str]]:
    for name in names:
        try:
            yield name, importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            yield name, "not installed"


DECLARATIONS = (
    "void triad(double *a, const double *b, const double *c, double s, long n);\ndouble multiply_adds(long count);\n"
)
ARRAY_LENGTH, CHAINS, ROUNDS = 10**7, 96, 2 * 10**6
"""Length of an array, several times that of a cache (J. D. McCalpin's rule for STREAM); chains and rounds as in the C
source."""
TIMES = 5


def machine_limits() -> tuple[float, float]:
    """Return GB/s of a = b + s c, each number counted once as in STREAM, and GFLOP/s; of one core, best of several."""
    code = files("scvi_codegen.benchmark").joinpath("machine_limits.c").read_text(encoding="utf-8")
    source = Source(prefix="machine_limits", header=DECLARATIONS, code=code, declarations=DECLARATIONS)
    library = building.load(source, flags=building.TUNED_FLAGS)
    arrays = [library.ffi.from_buffer("double[]", np.ones(ARRAY_LENGTH)) for _ in range(3)]
    works = {
        "memory": lambda: library.lib.triad(*arrays, 3.0, ARRAY_LENGTH),
        "arithmetic": lambda: library.lib.multiply_adds(ROUNDS),
    }
    best = {name: min(seconds) for name, seconds in seconds_in_turn(works, TIMES).items()}
    return 24e-9 * ARRAY_LENGTH / best["memory"], 2e-9 * ROUNDS * CHAINS / best["arithmetic"]


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
            for build, seconds in seconds_in_turn(runs, plan.rounds).items():
                rows[build][column] = 1e6 * min(seconds) / steps
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
    with set_variable("CC", command):
        stepper = compile_stepper(chosen.system, SVI(degree), flags=flags)
    stepper.prepare()
    start: dict[str, Any] = {"q": chosen.q, "velocity": chosen.velocity, "p": chosen.p}
    return lambda: stepper.integrate(**start, h=chosen.step, steps=steps, save_every=steps)
