"""Description of the machine on which the benchmark runs."""

import importlib.metadata
import os
import platform
from collections.abc import Iterable
from pathlib import Path

from scvi_codegen.codegen.native.building import TUNED_FLAGS
from scvi_codegen.codegen.native.compilers import compiler_title
from scvi_codegen.version import __version__

PACKAGES = ("numpy", "scipy", "sympy", "heyoka", "rebound", "CyRK", "numba", "pydy", "mujoco", "pin", "py-pde")


def machine() -> dict[str, str | dict[str, str]]:
    """Return processor, system, compiler and versions as plain data."""
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "load": ", ".join(f"{value:.2f}" for value in os.getloadavg()) if hasattr(os, "getloadavg") else "unknown",
        "system": platform.platform(),
        "python": platform.python_version(),
        "compiler": compiler_title(),
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
