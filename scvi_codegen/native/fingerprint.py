"""Fingerprint of compiled code: a digest of everything that determines it."""

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

FLAGS_VARIABLE = "SCVI_CODEGEN_CFLAGS"
"""Variable of further flags; not ``CFLAGS``, where package managers may set an ``-march`` that overrides the tuning."""


def fingerprint(source: Source, *, flags: tuple[str, ...]) -> str:
    """Return 24 digits of a digest of everything that determines the compiled code: source, compiler, flags, processor.

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
    """Return whether any flag selects the instructions of this processor (-march, -mcpu, -mtune)."""
    return "=native" in " ".join((*compiler, *flags, os.environ.get(FLAGS_VARIABLE, "")))


@cache
def _commands() -> str:
    """Return the source of the module that chooses further flags and libraries."""
    return Path(__file__).with_name("building.py").read_text(encoding="utf-8")


@cache
def _processor() -> str:
    """Return what ``-march=native`` depends on: model and features of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(wanted)}))
