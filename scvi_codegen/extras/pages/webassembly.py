"""C of a page, compiled to WebAssembly by the ``ziglang`` wheel; the results are in the cache of the package."""

from __future__ import annotations

import base64
import gzip
import importlib.metadata
import importlib.util
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from scvi_codegen.api.text import announced, cached_source
from scvi_codegen.common.errors import BuildError

FLAGS = (
    *("-target", "wasm32-wasi", "-mexec-model=reactor", "-O2", "-msimd128", "-s"),
    *("-ffp-contract=off", "-std=c99", "-Wno-psabi"),
)
"""The bits are those of a build for x86-64 with musl by the same compiler, without ``-msimd128``."""
LICENCES = (
    "Formulas are set in a subset of STIX Two Math (Copyright 2001-2021 The STIX Fonts Project Authors), under the SIL"
    " Open Font License, Version 1.1.",
    "What scvi-codegen generated in this page may be used without any condition. Its WebAssembly also contains parts"
    " of musl (Copyright © 2005-2020 Rich Felker, et al.; pow, exp2 and log Copyright © 2017-2018 Arm Limited), of"
    " zig and its compiler_rt (Copyright (c) Zig contributors) and of wasi-libc (its contributors), all under the"
    " MIT licence:",
    "Permission is hereby granted, free of charge, to any person obtaining a copy of this software and associated"
    ' documentation files (the "Software"), to deal in the Software without restriction, including without'
    " limitation the rights to use, copy, modify, merge, publish, distribute, sublicense, and/or sell copies of"
    " the Software, and to permit persons to whom the Software is furnished to do so, subject to the following"
    " conditions:",
    "The above copyright notice and this permission notice shall be included in all copies or substantial"
    " portions of the Software.",
    'THE SOFTWARE IS PROVIDED "AS IS", WITHOUT WARRANTY OF ANY KIND, EXPRESS OR IMPLIED, INCLUDING BUT NOT'
    " LIMITED TO THE WARRANTIES OF MERCHANTABILITY, FITNESS FOR A PARTICULAR PURPOSE AND NONINFRINGEMENT. IN NO"
    " EVENT SHALL THE AUTHORS OR COPYRIGHT HOLDERS BE LIABLE FOR ANY CLAIM, DAMAGES OR OTHER LIABILITY, WHETHER IN"
    " AN ACTION OF CONTRACT, TORT OR OTHERWISE, ARISING FROM, OUT OF OR IN CONNECTION WITH THE SOFTWARE OR THE USE"
    " OR OTHER DEALINGS IN THE SOFTWARE.",
    "Mathematical functions of musl and zig originate in FreeBSD's msun: Copyright (C) 1993, 2004 by Sun"
    " Microsystems, Inc. All rights reserved. Developed at SunPro and SunSoft, Sun Microsystems, Inc. businesses."
    " Permission to use, copy, modify, and distribute this software is freely granted, provided that this notice"
    " is preserved. Parts are Copyright © 2003-2011 David Schultz, © 2003-2009 Steven G. Kargl, © 2003-2009 Bruce"
    " D. Evans, © 2008 Stephen L. Moshier.",
)
"""Paragraphs of the notice of what is embedded in a page."""


def check_compiler() -> None:
    """Raise ``BuildError`` without the extra ``compiler``."""
    if importlib.util.find_spec("ziglang") is None:
        raise BuildError("a page requires a compiler to WebAssembly: pip install 'scvi-codegen[compiler]' (ziglang)")


def run_compiler(command: Sequence[str], folder: Path) -> None:
    """Run a compiler in a folder; raise ``BuildError`` with its first messages if it fails."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = "\n".join(done.stderr.splitlines()[:30])
        raise BuildError(f"the compiler to WebAssembly rejected the source\n{' '.join(command)}\n{lines}")


def webassembly(folder: Path, sources: tuple[str, ...]) -> str:
    """Return the compressed WebAssembly of C files in a folder, in base64.

    Raises:
        BuildError: without the extra ``compiler``, or if it rejects a file.
    """
    check_compiler()

    def compiled() -> str:
        command = [sys.executable, "-m", "ziglang", "cc", *FLAGS, *sources, "-lm", "-o", "page.wasm"]
        with announced("compiling to WebAssembly, the first time with its C library, which takes a minute or two"):
            run_compiler(command, folder)
        return base64.b64encode(gzip.compress((folder / "page.wasm").read_bytes(), mtime=0)).decode()

    texts = [path.read_text(encoding="utf-8") for path in sorted(folder.rglob("*.[ch]"))]
    return cached_source(["webassembly", *FLAGS, importlib.metadata.version("ziglang"), *sources, *texts], compiled)
