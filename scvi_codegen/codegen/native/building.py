"""Compilation of C source to a loaded library: compiler, cache, cffi.

An integrator is compiled once into a shared library, and its declarations once into cffi's description of them (ABI
mode: no compiled binding, so no headers of Python, at a cost of .2 microseconds per call). Both are stored in the
user's cache folder under a name that is a digest of everything that determines them
(:mod:`scvi_codegen.codegen.native.compilers`). They are built in a temporary folder inside the cache and renamed into
place, so processes may race without locks; an entry that does not match its recorded checksum is built again. If the
cache cannot be written, or others can write it, a temporary folder is used (:mod:`scvi_codegen.common.cache`).
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from scvi_codegen.codegen.native.announcements import announced
from scvi_codegen.codegen.native.compilers import (
    FLAGS_VARIABLE,
    another_compiler,
    find_compiler,
    fingerprint,
    from_wheel,
    running,
    words_of,
)
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.cache import (
    CACHE_VARIABLE,
    cache_folder,
    discard,
    exposed,
    make_folder,
    make_room,
    touch,
    trusted_folder,
)
from scvi_codegen.common.errors import BuildError

__all__ = [
    "CACHE_VARIABLE",
    "FLAGS_VARIABLE",
    "PORTABLE_FLAGS",
    "TUNED_FLAGS",
    "Library",
    "cache_folder",
    "fingerprint",
    "load",
    "run_compiler",
]

NATIVE = "-march=native"
TUNED_FLAGS = ("-O3", NATIVE, "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
"""Flags of a stepper used where it is compiled, without ``-ffast-math``: NaN, infinities and orders of sums are kept.
"""

PORTABLE_FLAGS = ("-O2", "-ffp-contract=off")
"""Flags of code that must give the same bits on every IEEE 754 machine with the same libm."""

DECLARATIONS, DIRECTIVE = "declarations.h", re.compile("^#", re.MULTILINE)
"""File of the declarations for cffi, and a pattern of the directives in it that depend on the processor."""

FUSED, FUSED_IN_EXPRESSIONS = "-ffp-contract=fast", "-ffp-contract=on"
"""Flags of products that are fused with sums: of any statements, and of one expression.

Clang decides about the former for each lane of an ensemble, so that bits would depend on the lane of a trajectory; the
latter are as fast. Those of gcc do not, and it knows the latter in GNU C alone.
"""

DIVIDED_FLAGS = ("-fno-gcse", "-fno-tree-pre", "-fno-rerun-cse-after-loop", "-fno-dse", "-fno-schedule-insns2")
"""Flags in addition to -O3 for kernels divided into functions.

These passes take a tenth of gcc's time and search for common subexpressions, which are already shared; steps take as
long without them.
"""

NO_UNROLL_FLAGS = ("--param=max-completely-peel-times=4",)
"""Flags in addition to -O3 for one trajectory: without unrolling, gcc vectorises loops over coordinates.

Unrolled they become scalar code (leapfrog of 8 masses: 1.5 times the time). The lanes of ensembles must be unrolled.
"""

WHOLE_VECTORS = ("-mmove-max=512", "-mstore-max=512")
"""Flags of gcc for copies by the widest registers of the processor (up to version 12 by 16 bytes on most).

A load of a vector that two stores of halves wrote waits for both: steps of a double pendulum take 10 % longer.
"""

SEPARATE_FLAGS = ("-fno-builtin-sin", "-fno-builtin-cos")
"""Flags of gcc for kernels in loops over points.

Otherwise gcc replaces sine and cosine of an argument by one call, of which there is no vector version.
"""

THREADS = ("-DSCVI_THREADS", "-pthread")
"""Flags for sources whose steps threads may share."""

COMPILE_SECONDS = 600
NOT_RUN = (126, 127)
ATTEMPTS = 3
"""Number of attempts to load an entry that another process may remove at any time."""
_loaded: dict[str, Library] = {}
_locks: dict[str, threading.Lock] = {}
"""One lock per library, so that threads compile it once; a forked process starts with none."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_locks.clear)


class Library(NamedTuple):
    """A loaded library: its functions ``lib``, their types ``ffi``, and the ``path`` it was loaded from."""

    lib: Any
    ffi: Any
    path: Path


def load(source: Source, *, flags: tuple[str, ...] = TUNED_FLAGS) -> Library:
    """Return the library of a source, from memory, from the cache or compiled now.

    Flags in the environment variable ``SCVI_CODEGEN_CFLAGS`` are appended, and so override, those given.
    """
    compiler = find_compiler()
    key = fingerprint(source, flags=flags)
    with _locks.setdefault(key, threading.Lock()):
        if key not in _loaded:
            _loaded[key] = _load_or_build(source, compiler, flags, f"_scvi_{key}")
        return _loaded[key]


def _load_or_build(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], name: str) -> Library:
    folder = trusted_folder()
    if folder is not None:
        with suppress(OSError):  # it cannot be written
            return _load_from(folder, source, compiler, flags, name)
    try:
        temporary = Path(tempfile.mkdtemp(prefix="scvi-codegen-"))
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        return _load_from(temporary, source, compiler, flags, name)
    except OSError as error:
        raise BuildError(
            f"neither the cache folder nor the temporary folder can be written: set {CACHE_VARIABLE} to a "
            "folder that can"
        ) from error


def _load_from(folder: Path, source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], name: str) -> Library:
    """Return the library in a folder, compiled if necessary; raise OSError if that is impossible."""
    entry = folder / name
    for _ in range(ATTEMPTS):
        if _is_intact(entry):
            try:
                library = _open(entry)
            except ImportError:
                discard(entry)  # a library of another platform: build it again
            else:
                touch(entry)
                return library
        _publish(source, compiler, flags, entry)
        try:
            return _open(entry)
        except ImportError as error:
            if _is_intact(entry):
                problem = f"the library made by the compiler {' '.join(compiler)!r} cannot be loaded on this machine"
                raise BuildError(f"{problem}: {error}") from error
    raise OSError(f"{entry} was removed by another process {ATTEMPTS} times while it was loaded")


def _library(entry: Path) -> Path:
    return entry / f"{entry.name}.so"


def _binding(entry: Path) -> Path:
    return entry / "binding.py"


def _checksum(entry: Path) -> str:
    return hashlib.sha256(_library(entry).read_bytes() + _binding(entry).read_bytes()).hexdigest()


def _is_intact(entry: Path) -> bool:
    """Return whether library and binding exist, match the recorded checksum, and are not writable by others."""
    try:
        recorded = json.loads((entry / "manifest.json").read_text())
        checksum = _checksum(entry)
    except (OSError, ValueError):
        return False
    matches = isinstance(recorded, dict) and recorded.get("sha256") == checksum
    return matches and not any(exposed(path) for path in (entry, _library(entry), _binding(entry)))


def _open(entry: Path) -> Library:
    """Return the library of an entry; raise ImportError if none can be loaded."""
    described = ModuleType(entry.name)
    try:
        loader = SourceFileLoader(entry.name, str(_binding(entry)))  # not imported, which would write a cache file
        exec(loader.source_to_code(_binding(entry).read_bytes(), str(_binding(entry))), described.__dict__)
        return Library(described.ffi.dlopen(str(_library(entry))), described.ffi, _library(entry))
    except (OSError, ValueError) as error:
        raise ImportError(str(error)) from error


def _publish(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], entry: Path) -> None:
    """Build in a temporary folder and rename into place; if another process was first, its entry is used."""
    make_folder(entry.parent)
    with tempfile.TemporaryDirectory(prefix=".building-", dir=entry.parent, ignore_cleanup_errors=True) as folder:
        built = Path(folder) / entry.name
        built.mkdir(mode=0o755)
        with announced(_work(source, compiler, flags)):
            manifest = _compile(source, compiler, flags, built)
        (built / "manifest.json").write_text(json.dumps(manifest))
        for file in built.rglob("*"):
            file.chmod(file.stat().st_mode & ~0o022)
        try:
            built.replace(entry)
        except OSError:
            if _is_intact(entry):
                return
            discard(entry)
            built.replace(entry)
    make_room(entry.parent, entry)


def _work(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...]) -> str:
    optimisation = [flag for flag in flags if flag.startswith("-O")]
    command = " ".join([Path(compiler[0]).name, *compiler[1:], *optimisation])
    first = ", whose first use takes longest" if from_wheel(compiler) else ""
    return f"compiling {source.code.count(chr(10)):,} lines of C with {command}{first}"


def _compile(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], folder: Path) -> dict[str, Any]:
    """Compile the parts concurrently, one process each; link them, write the binding and return the manifest."""
    source.write(folder)
    if FUSED in flags and _takes_flags(compiler, ("-Xclang", FUSED_IN_EXPRESSIONS)):
        flags = tuple(FUSED_IN_EXPRESSIONS if flag == FUSED else flag for flag in flags)
    is_divided = any(part.contents.divided for part in source.sources)
    cut = DIVIDED_FLAGS if is_divided and _takes_flags(compiler, DIVIDED_FLAGS) else ()
    threads = THREADS if any(part.contents.threads for part in source.sources) else ()
    whole = WHOLE_VECTORS if NATIVE in flags and _takes_flags(compiler, WHOLE_VECTORS) else ()
    further = [*threads, *whole, *words_of(FLAGS_VARIABLE)]
    parts = {part.prefix: _passes(part, flags, cut) for part in source.sources}
    commands: dict[str, list[str]] = {}
    objects = ["-shared", *further, *(f"{name}.o" for name in parts)]
    for define, libraries in _mathematics(flags):
        with ExitStack() as ended:
            for name, passes in parts.items():
                command = [*compiler, "-fPIC", "-std=c99", *flags, *passes, *define, *further, "-c", f"{name}.c"]
                if name != source.prefix or not source.beside or not _copy_object(source, command, flags, folder):
                    ended.enter_context(_finished([*command, f"-I{folder}"], folder))
                    commands[name] = command
            _write_binding(_declarations(source, [*compiler, *flags, *further], folder), folder)
        try:
            run_compiler([*compiler, *objects, *libraries, "-o", _library(folder).name], folder)
            break
        except BuildError:
            if not define:
                raise
    if not _library(folder).is_file():
        raise BuildError(
            f"{' '.join(compiler)!r} created no library and reported no error: it is not a C compiler. Set the "
            "environment variable CC to one, as in CC=gcc"
        )
    for name in parts:
        if source.beside:
            (folder / f"{name}.o").unlink(missing_ok=True)
    return {"sha256": _checksum(folder), "prefix": source.prefix} | _object_record(source, commands, folder)


def _object_record(source: Source, commands: Mapping[str, list[str]], folder: Path) -> dict[str, Any]:
    """Return how the object file of a source alone was made, which sources with further parts are linked with."""
    if source.beside:
        return {}
    file = folder / f"{source.prefix}.o"
    return {"object": hashlib.sha256(file.read_bytes()).hexdigest(), "command": commands[source.prefix]}


def _copy_object(source: Source, command: list[str], flags: tuple[str, ...], folder: Path) -> bool:
    """Copy the object file of the first part of a source from the library of that part alone, if there is one.

    Events are linked with the stepper that they call, whose compilation takes most of the time.
    """
    entry = folder.parent.parent / f"_scvi_{fingerprint(replace(source, beside=None), flags=flags)}"
    file = entry / f"{source.prefix}.o"
    try:
        if not _is_intact(entry) or exposed(file):
            return False
        recorded, content = json.loads((entry / "manifest.json").read_text()), file.read_bytes()
        if (recorded.get("object"), recorded.get("command")) != (hashlib.sha256(content).hexdigest(), command):
            return False
        (folder / file.name).write_bytes(content)
    except (OSError, ValueError):
        return False
    return True


def _declarations(source: Source, command: list[str], folder: Path) -> str:
    """Return the declarations for cffi; those that depend on the processor are preprocessed by the compiler."""
    text = "".join(part.declarations for part in source.sources)
    if not DIRECTIVE.search(text):
        return text
    declarations_file, preprocessed = folder / DECLARATIONS, folder / f"{DECLARATIONS}.i"
    declarations_file.write_text(text, encoding="utf-8")
    run_compiler([*command, "-E", "-P", declarations_file.name, "-o", preprocessed.name], folder)
    text = preprocessed.read_text(encoding="utf-8")
    declarations_file.unlink()
    preprocessed.unlink()
    return text


def _write_binding(declarations: str, folder: Path) -> None:
    from cffi import FFI  # only building needs the parser; loading does not
    from cffi.recompiler import make_py_source  # called by FFI.emit_python_code, without its message on stdout

    binding = FFI()
    try:
        binding.cdef(declarations)
    except Exception as error:  # of the parser, of many types: the declarations come from a generated folder
        raise BuildError(f"the declarations of the C code cannot be read: {error}") from error
    binding.set_source(folder.name, None)
    make_py_source(binding, folder.name, str(_binding(folder)), verbose=False)


@cache
def _takes_flags(compiler: tuple[str, ...], flags: tuple[str, ...]) -> bool:
    """Return whether the compiler accepts flags: clang rejects most passes of gcc."""
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder, "empty.c")
        empty.touch()
        try:
            run_compiler([*compiler, *flags, "-E", empty.name, "-o", "empty.i"], empty.parent)
        except BuildError:
            return False
    return True


def _passes(part: Source, flags: tuple[str, ...], cut: tuple[str, ...]) -> tuple[str, ...]:
    """Return further flags of gcc for a source, with -O3."""
    if "-O3" not in flags:
        return ()
    rolled = NO_UNROLL_FLAGS if part.contents.rolled else ()
    return (*cut, *rolled, *(SEPARATE_FLAGS if part.contents.points_in_loops else ()))


def _mathematics(flags: tuple[str, ...]) -> list[tuple[list[str], list[str]]]:
    """Return definitions and libraries to try in turn: glibc's vector functions if tuned for x86-64, then libm."""
    plain: tuple[list[str], list[str]] = ([], ["-lm"])
    name, version = platform.libc_ver()
    modern = name == "glibc" and tuple(int(part) for part in version.split(".")[:2]) >= (2, 22)
    if modern and platform.machine() == "x86_64" and NATIVE in flags:
        return [(["-DSCVI_LIBMVEC"], ["-lmvec", "-lm"]), plain]
    return [plain]


def run_compiler(command: list[str], folder: Path) -> None:
    """Run a compiler in a folder; raise BuildError if it fails."""
    with _finished(command, folder):
        pass


@contextmanager
def _finished(command: list[str], folder: Path) -> Iterator[None]:
    """Run a command concurrently with the block and wait for it; raise BuildError if it fails."""
    with running(command, folder) as process:
        yield
        try:
            _, errors = process.communicate(timeout=COMPILE_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise BuildError(f"the compiler was stopped after {COMPILE_SECONDS} s: {' '.join(command)}") from error
    if process.returncode in NOT_RUN:
        raise BuildError(f"the compiler {command[0]!r} does not run: {errors.strip()}{another_compiler(command)}")
    if process.returncode:
        shown = "\n".join(errors.splitlines()[:30])
        raise BuildError(f"the C compiler rejected the source\n{' '.join(command)}\n{shown}{another_compiler(command)}")


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
    """Return a shared library for a platform of :data:`TARGETS`, equal for equal sources and flags; or BuildError."""
    if importlib.util.find_spec("ziglang") is None:
        raise BuildError(
            f"compiling for {platform} requires a cross compiler: pip install 'scvi-codegen[compiler]' (ziglang)"
        )
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-") as name:
        folder, library = Path(name), "library"
        source.write(folder)
        texts = [f"{part.prefix}.c" for part in source.sources]
        command = [sys.executable, "-m", "ziglang", "cc", "-target", TARGETS[platform], "-shared", "-fPIC", "-s"]
        with announced(f"compiling for {platform}, slowest the first time"):
            run_compiler([*command, "-std=c99", "-I.", *flags, *texts, "-lm", "-o", library], folder)
        return (folder / library).read_bytes()
