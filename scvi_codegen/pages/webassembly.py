"""C of a page, compiled to WebAssembly by the ``ziglang`` wheel; the results are in the cache of the package."""

from __future__ import annotations

import base64
import gzip
import importlib.metadata
import importlib.util
import sys
from pathlib import Path

from scvi_codegen.errors import BuildError
from scvi_codegen.files.cache import cached_source
from scvi_codegen.native.announcements import announced
from scvi_codegen.native.building import run_compiler

FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2", "-msimd128", "-s"),
    *("-ffp-contract=off", "-std=c99", "-Wno-psabi"),
)
"""The bits are those of a build for x86-64 with musl by the same compiler, without ``-msimd128``."""
LICENCES = (
    "The WebAssembly contains parts of musl (© 2005-2020 Rich Felker and others, MIT licence), of wasi-libc (MIT"
    " licence, Apache licence 2.0 with LLVM exception) and of compiler-rt"
    " (Apache licence 2.0 with LLVM exception)."
)


def webassembly(folder: Path, sources: tuple[str, ...]) -> str:
    """Return the compressed WebAssembly of C files in a folder, in base64.

    Raises:
        BuildError: without the extra ``compiler``, or if it rejects a file.
    """
    if importlib.util.find_spec("ziglang") is None:
        raise BuildError("a page requires a compiler to WebAssembly: pip install 'scvi-codegen[compiler]' (ziglang)")

    def compiled() -> str:
        command = [sys.executable, "-m", "ziglang", "cc", *FLAGS, *sources, "-lm", "-o", "page.wasm"]
        with announced("compiling to WebAssembly, the first time with its C library, which takes a minute or two"):
            run_compiler(command, folder)
        return base64.b64encode(gzip.compress((folder / "page.wasm").read_bytes(), mtime=0)).decode()

    texts = [path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.[ch]"))]
    return cached_source(["webassembly", *FLAGS, importlib.metadata.version("ziglang"), *sources, *texts], compiled)
