"""C text to a loaded library: the compiler's work, the cache, cffi.

An integrator is compiled once into a shared library, and its declarations once into cffi's description of them (ABI
mode: no compiled binding, so no headers of Python, at the price of .2 microseconds a call). Both are kept in the user's
cache folder under a name made from everything that determines them (:mod:`scvi_codegen.native.fingerprint`). They are
built in a temporary folder inside the cache and renamed into place, so processes may race without locks; what does not
match its recorded checksum is built anew. A cache that cannot be written, or that others can write, falls back to a
temporary folder (:mod:`scvi_codegen.files.cache`).
"""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from scvi_codegen.errors import BuildError
from scvi_codegen.files.cache import (
    CACHE_VARIABLE,
    cache_folder,
    discard,
    exposed,
    make_folder,
    make_room,
    touch,
    trusted_folder,
)
from scvi_codegen.native.compilers import another_compiler, find_compiler, from_wheel, words_of
from scvi_codegen.native.fingerprint import FLAGS_VARIABLE, fingerprint
from scvi_codegen.native.processes import running
from scvi_codegen.native.waiting import waiting_for
from scvi_codegen.rendering.source import Source

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

TUNED_FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
"""For a stepper used where it is compiled; no ``-ffast-math``: NaN, infinities and the order of sums are kept."""

PORTABLE_FLAGS = ("-O2", "-ffp-contract=off")
"""For code that must give the same bits on every IEEE 754 machine with the same libm."""

DECLARATIONS, DIRECTIVE = "declarations.h", re.compile("^#", re.MULTILINE)
"""What Python is told of a library, and what in it depends on the processor."""

CUT_FLAGS = ("-fno-gcse", "-fno-tree-pre", "-fno-rerun-cse-after-loop", "-fno-dse", "-fno-schedule-insns2")
"""With -O3, for text with kernels cut into functions: these passes take gcc a tenth of its time and look for common
parts, which were found before; steps take as long without them."""

ROLLED_FLAGS = ("--param=max-completely-peel-times=4",)
"""With -O3, for one trajectory: loops over more coordinates stay loops, which gcc turns into vectors; written out they
become a heap of scalars (leapfrog of 8 masses: half as long again). The lanes of ensembles must be written out."""

WRITTEN_OUT = frozenset({"support/newton_solver.h", "support/shooting_sweep.h"})
"""Steps of one trajectory whose short loops, over unknowns or functions of points, take a tenth longer as loops."""

SHARED_BY_THREADS, THREADS = "support/indexed_threads.h", ("-DSCVI_THREADS", "-pthread")
"""A part of a text whose steps threads may share, and what it is compiled and linked with for that."""

COMPILE_SECONDS = 600
NOT_RUN = (126, 127)
ATTEMPTS = 3
"""To load what another process may remove at any time."""
_loaded: dict[str, Library] = {}
_locks: dict[str, threading.Lock] = {}
"""One a library, so that threads compile it once; a process that is forked off starts with none held."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_locks.clear)


class Library(NamedTuple):
    """A loaded library: ``lib`` has its functions, ``ffi`` their types, ``path`` is where it was loaded from."""

    lib: Any
    ffi: Any
    path: Path


def load(source: Source, *, flags: tuple[str, ...] = TUNED_FLAGS) -> Library:
    """The library of a source, from memory, from the cache or built now.

    Flags in the environment variable ``SCVI_CODEGEN_CFLAGS`` follow, and so override, those given.

    Raises:
        BuildError: without a compiler, or if it refuses the text.
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
        raise BuildError("neither the cache folder nor the temporary folder can be written") from error


def _load_from(folder: Path, source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], name: str) -> Library:
    """The library in a folder, put there first if need be; OSError if that cannot be done."""
    entry = folder / name
    for _ in range(ATTEMPTS):
        if _is_intact(entry):
            try:
                library = _open(entry)
            except ImportError:
                discard(entry)  # a foreign library: build it anew
            else:
                touch(entry)
                return library
        _publish(source, compiler, flags, entry)
        try:
            return _open(entry)
        except ImportError as error:
            if _is_intact(entry):
                made = f"what the compiler {' '.join(compiler)!r} made cannot be loaded here"
                raise BuildError(f"{made}: {error}") from error
    raise OSError(f"{entry} is removed as soon as it is made")


def _library(entry: Path) -> Path:
    return entry / f"{entry.name}.so"


def _binding(entry: Path) -> Path:
    return entry / "binding.py"


def _checksum(entry: Path) -> str:
    """Of the library and its binding."""
    return hashlib.sha256(_library(entry).read_bytes() + _binding(entry).read_bytes()).hexdigest()


def _is_intact(entry: Path) -> bool:
    """Whether library and binding are there, are those that were recorded, and nobody else can have put them there."""
    try:
        recorded = json.loads((entry / "manifest.json").read_text())
        found = _checksum(entry)
    except (OSError, ValueError):
        return False
    matches = isinstance(recorded, dict) and recorded.get("sha256") == found
    return matches and not any(exposed(path) for path in (entry, _library(entry), _binding(entry)))


def _open(entry: Path) -> Library:
    """The library of an entry; ImportError if there is none that can be loaded."""
    described = ModuleType(entry.name)
    try:
        loader = SourceFileLoader(entry.name, str(_binding(entry)))  # not imported, which would write beside it
        exec(loader.source_to_code(_binding(entry).read_bytes(), str(_binding(entry))), described.__dict__)
        return Library(described.ffi.dlopen(str(_library(entry))), described.ffi, _library(entry))
    except (OSError, ValueError) as error:
        raise ImportError(str(error)) from error


def _publish(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], entry: Path) -> None:
    """Build beside the entry and rename into place; a racing process that was first wins."""
    make_folder(entry.parent)
    with tempfile.TemporaryDirectory(prefix=".building-", dir=entry.parent, ignore_cleanup_errors=True) as folder:
        built = Path(folder) / entry.name
        built.mkdir(mode=0o755)
        with waiting_for(_work(source, compiler, flags)):
            _compile(source, compiler, flags, built)
        (built / "manifest.json").write_text(json.dumps({"sha256": _checksum(built), "prefix": source.prefix}))
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
    level = [flag for flag in flags if flag.startswith("-O")]
    command = " ".join([Path(compiler[0]).name, *compiler[1:], *level])
    first = ", whose first use takes longest" if from_wheel(compiler) else ""
    return f"compiling {source.code.count(chr(10)):,} lines of C with {command}{first}"


def _compile(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], folder: Path) -> None:
    """The parts at the same time, each in a process; then one library of them, and what describes it."""
    source.write(folder)
    is_cut = any("support/parts.h" in each.files for each in source.sources)
    cut = CUT_FLAGS if is_cut and _takes_flags(compiler, CUT_FLAGS) else ()
    threads = THREADS if any(SHARED_BY_THREADS in each.files for each in source.sources) else ()
    wanted = [*threads, *words_of(FLAGS_VARIABLE)]
    parts = {each.prefix: _passes(each, flags, cut) for each in source.sources}
    objects = ["-shared", *wanted, *(f"{name}.o" for name in parts)]
    for define, libraries in _mathematics(flags):
        with ExitStack() as ended:
            for name, passes in parts.items():
                command = [*compiler, "-fPIC", "-std=c99", f"-I{folder}", *flags, *passes, *define, *wanted]
                ended.enter_context(_finished([*command, "-c", f"{name}.c"], folder))
            _write_binding(_declarations(source, [*compiler, *flags, *wanted], folder), folder)
        try:
            run_compiler([*compiler, *objects, *libraries, "-o", _library(folder).name], folder)
            break
        except BuildError:
            if not define:
                raise
    if not _library(folder).is_file():
        raise BuildError(
            f"{' '.join(compiler)!r} made no library, and reported no error: it is no C compiler. Set the environment "
            "variable CC to one, as in CC=gcc"
        )
    for name in parts:
        (folder / f"{name}.o").unlink(missing_ok=True)


def _declarations(source: Source, command: list[str], folder: Path) -> str:
    """What Python is told of a library; where that depends on the processor, as the compiler takes it."""
    text = "".join(each.declarations for each in source.sources)
    if not DIRECTIVE.search(text):
        return text
    given, found = folder / DECLARATIONS, folder / f"{DECLARATIONS}.i"
    given.write_text(text, encoding="utf-8")
    run_compiler([*command, "-E", "-P", given.name, "-o", found.name], folder)
    text = found.read_text(encoding="utf-8")
    given.unlink()
    found.unlink()
    return text


def _write_binding(declarations: str, folder: Path) -> None:
    from cffi import FFI  # only building needs the parser; loading does not
    from cffi.recompiler import make_py_source  # what FFI.emit_python_code calls, without its message on stdout

    binding = FFI()
    binding.cdef(declarations)
    binding.set_source(folder.name, None)
    make_py_source(binding, folder.name, str(_binding(folder)), verbose=False)


@cache
def _takes_flags(compiler: tuple[str, ...], flags: tuple[str, ...]) -> bool:
    """Whether the compiler knows them: clang refuses most passes of gcc."""
    with tempfile.TemporaryDirectory() as folder:
        empty = Path(folder, "empty.c")
        empty.touch()
        try:
            run_compiler([*compiler, *flags, "-E", empty.name, "-o", "empty.i"], empty.parent)
        except BuildError:
            return False
    return True


def _passes(part: Source, flags: tuple[str, ...], cut: tuple[str, ...]) -> tuple[str, ...]:
    """What gcc does otherwise than -O3 says."""
    if "-O3" not in flags:
        return ()
    rolled = ROLLED_FLAGS if "support/run.h" in part.files and WRITTEN_OUT.isdisjoint(part.files) else ()
    return (*cut, *rolled)


def _mathematics(flags: tuple[str, ...]) -> list[tuple[list[str], list[str]]]:
    """Definitions and libraries to try in turn: glibc's vector functions in a tuned build on x86-64, then libm."""
    plain: tuple[list[str], list[str]] = ([], ["-lm"])
    name, version = platform.libc_ver()
    modern = name == "glibc" and tuple(int(part) for part in version.split(".")[:2]) >= (2, 22)
    if modern and platform.machine() == "x86_64" and "-march=native" in flags:
        return [(["-DSCVI_LIBMVEC"], ["-lmvec", "-lm"]), plain]
    return [plain]


def run_compiler(command: list[str], folder: Path) -> None:
    """Run it in a folder; BuildError if it fails."""
    with _finished(command, folder):
        pass


@contextmanager
def _finished(command: list[str], folder: Path) -> Iterator[None]:
    """A command that runs beside what is done in the context, whose end waits for it; BuildError where it fails."""
    with running(command, folder) as process:
        yield
        try:
            _, errors = process.communicate(timeout=COMPILE_SECONDS)
        except subprocess.TimeoutExpired as error:
            raise BuildError(f"the compiler took longer than {COMPILE_SECONDS} s: {' '.join(command)}") from error
    if process.returncode in NOT_RUN:
        raise BuildError(f"the compiler {command[0]!r} does not run: {errors.strip()}{another_compiler(command)}")
    if process.returncode:
        shown = "\n".join(errors.splitlines()[:30])
        raise BuildError(f"the C compiler refused the text\n{' '.join(command)}\n{shown}{another_compiler(command)}")
