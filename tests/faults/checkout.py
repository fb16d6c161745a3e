"""A copy of the checkout, to put faults into, and commands that are run in it."""

import os
import resource
import shutil
import subprocess
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
TOO_LONG = 300
"""Seconds of work of one process, after which what does not end counts as noticed, on a busy machine, too."""
BOTH_TIERS = ("-m", "not full")
"""Options of pytest: the quick tier and the second."""
OF_TESTS = tuple(f"tests/{name}" for name in ("oracles", "tools", "faults"))


def copied(folder: Path) -> Path:
    """The copy, in a folder that also gets its cache."""
    copy = folder / "checkout"
    shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(".git", ".venv", "__pycache__", ".*_cache"))
    return copy


def run(copy: Path, *command: str, seconds: int = TOO_LONG, **variables: str) -> tuple[int, str]:
    """The exit status and the last line that says something; status 1 of what works longer than so many seconds."""
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(copy), *(str(copy / name) for name in OF_TESTS)]),
        "SCVI_CODEGEN_CACHE": str(copy.parent / "cache"),
        "PYTHONDONTWRITEBYTECODE": "1",
        **variables,
    }
    try:
        found = subprocess.run(
            command,
            cwd=copy,
            env=environment,
            capture_output=True,
            text=True,
            timeout=10 * seconds,
            check=False,
            preexec_fn=partial(_limited, seconds),
        )
    except subprocess.TimeoutExpired:
        return 1, "it does not end"
    lines = (found.stdout.strip() or found.stderr.strip()).splitlines() or [""]
    failed = [line for line in lines if line.startswith(("FAILED", "ERROR", "BROKEN"))] or lines
    return found.returncode, failed[-1]


def _limited(seconds: int) -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
