"""Cross-compilation of a source for another platform, by the compiler of the extra ``compiler``."""

from __future__ import annotations

import importlib.util
import sys
import tempfile
from pathlib import Path

from scvi_codegen.errors import BuildError
from scvi_codegen.native.announcements import announced
from scvi_codegen.native.building import run_compiler
from scvi_codegen.rendering.source import Source

TARGETS = {
    "aarch64-darwin": "aarch64-macos",
    "aarch64-linux": "aarch64-linux-gnu.2.17",
    "aarch64-windows": "aarch64-windows-gnu",
    "x86_64-darwin": "x86_64-macos",
    "x86_64-linux": "x86_64-linux-gnu.2.17",
    "x86_64-windows": "x86_64-windows-gnu",
}
"""Compiler's names of the platforms of FMI; for Linux with the oldest C library that both architectures support."""


def library_for(platform: str, source: Source, *, flags: tuple[str, ...]) -> bytes:
    """Return a shared library for a platform of :data:`TARGETS`: equal sources and flags give equal bytes.

    Raises:
        BuildError: without the extra ``compiler``, or if it rejects the source.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise BuildError(
            f"compiling for {platform} requires a cross compiler: pip install 'scvi-codegen[compiler]' (ziglang)"
        )
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-") as name:
        folder, made = Path(name), "library"
        source.write(folder)
        texts = [f"{each.prefix}.c" for each in source.sources]
        command = [sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[platform], "-shared", "-fPIC", "-s"]
        with announced(f"compiling for {platform}, slowest the first time"):
            run_compiler([*command, "-std=c99", "-I.", *flags, *texts, "-lm", "-o", made], folder)
        return (folder / made).read_bytes()
