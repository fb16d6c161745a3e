"""The name of compiled code: digits made from everything that determines it, so that none is taken for another."""

from __future__ import annotations

import hashlib
import json
import os
import platform
from functools import cache
from pathlib import Path

import _cffi_backend

from scvi_codegen.native.compilers import compiler_version, find_compiler
from scvi_codegen.rendering.source import Source

__all__ = ["FLAGS_VARIABLE", "fingerprint"]

FLAGS_VARIABLE = "SCVI_CODEGEN_CFLAGS"
"""Not ``CFLAGS``, which package managers set for other ends: an ``-march`` in it would undo the tuning unseen."""


def fingerprint(source: Source, *, flags: tuple[str, ...]) -> str:
    """Return 24 digits made from all that determines the compiled code: text, compiler, flags, cffi, processor.

    Raises:
        BuildError: without a compiler.
    """
    compiler = find_compiler()
    parts = [
        json.dumps([each.to_record() for each in source.sources]),
        json.dumps(compiler),
        compiler_version(compiler),
        json.dumps(flags),
        os.environ.get(FLAGS_VARIABLE, ""),
        _cffi_backend.__version__,
        _commands(),
        _processor() if _tuned(compiler, flags) else platform.machine(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def _tuned(compiler: tuple[str, ...], flags: tuple[str, ...]) -> bool:
    """Whether any flag, wherever it stands, asks for the instructions of this processor (-march, -mcpu, -mtune)."""
    return "=native" in " ".join((*compiler, *flags, os.environ.get(FLAGS_VARIABLE, "")))


@cache
def _commands() -> str:
    """Return the text of the module that chooses further flags and libraries by what the source includes."""
    return Path(__file__).with_name("building.py").read_text(encoding="utf-8")


@cache
def _processor() -> str:
    """What ``-march=native`` depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(wanted)}))
