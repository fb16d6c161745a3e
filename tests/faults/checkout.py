"""A copy of the checkout, to put faults into, and commands that are run in it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

__all__ = ["ROOT", "TOO_LONG", "copied", "run"]

ROOT = Path(__file__).resolve().parents[2]
TOO_LONG = 600
"""Seconds after which what does not end counts as noticed."""
OF_TESTS = tuple(f"tests/{name}" for name in ("oracles", "tools", "faults"))


def copied(folder: Path) -> Path:
    """The copy, in a folder that also gets its cache."""
    copy = folder / "checkout"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache"))
    return copy


def run(copy: Path, *command: str) -> tuple[int, str]:
    """The exit status and the last line that says something; status 1 of what does not end."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(copy), *(str(copy / name) for name in OF_TESTS)]),
        "SCVI_CODEGEN_CACHE": str(copy.parent / "cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    try:
        found = subprocess.run(
            command, cwd=copy, env=environment, capture_output=True, text=True, timeout=TOO_LONG, check=False
        )
    except subprocess.TimeoutExpired:
        return 1, "it does not end"
    lines = (found.stdout.strip() or found.stderr.strip()).splitlines() or [""]
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR", "BROKEN"))] or lines
    return found.returncode, failed[-1]
