"""C text to a loaded module: compilers, the cache, cffi.

An integrator is compiled once with its cffi binding (API mode) into one shared library, kept in the user's cache folder
under a name made from everything that determines it: text, compiler, flags, Python ABI, processor. It is built in a
temporary folder inside the cache and renamed into place, so processes may race without locks; what does not match its
recorded checksum is built anew. A cache that cannot be written, or that others can write, falls back to a temporary
folder (:mod:`scvi_codegen.files.cache`).
"""

from __future__ import annotations

import atexit
import hashlib
import importlib.util
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType

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
from scvi_codegen.native.processes import running
from scvi_codegen.native.waiting import waiting_for
from scvi_codegen.rendering.source import Source

__all__ = [
    "CACHE_VARIABLE",
    "PORTABLE_FLAGS",
    "TUNED_FLAGS",
    "cache_folder",
    "compiler_title",
    "find_compiler",
    "fingerprint",
    "load",
]

TUNED_FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math")
"""For a stepper used where it is compiled; no ``-ffast-math``: NaN, infinities and the order of sums are kept."""

PORTABLE_FLAGS = ("-O2", "-ffp-contract=off")
"""For code that must give the same bits on every IEEE 754 machine with the same libm."""

CUT_FLAGS = ("-fno-gcse", "-fno-tree-pre", "-fno-rerun-cse-after-loop", "-fno-dse", "-fno-schedule-insns2")
"""With -O3, for text with kernels cut into functions: these passes take gcc a tenth of its time and look for common
parts, which were found before; steps take as long without them."""

FLAGS_VARIABLE = "SCVI_CODEGEN_CFLAGS"
"""Not ``CFLAGS``, which package managers set for other ends: an ``-march`` in it would undo the tuning unseen."""
COMPILE_SECONDS = 600
NOT_RUN = (126, 127)
ATTEMPTS = 3
"""To load what another process may remove at any time."""
_loaded: dict[str, ModuleType] = {}
_locks: dict[str, threading.Lock] = {}
"""One a library, so that threads compile it once; a process that is forked off starts with none held."""
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_locks.clear)


def find_compiler() -> tuple[str, ...]:
    """The command that compiles C: ``$CC``, else cc, gcc or clang, else the ``ziglang`` wheel.

    Raises:
        BuildError: if there is none.
    """
    chosen = os.environ.get("CC")
    if chosen:
        command = tuple(shlex.split(chosen))
        if not command or shutil.which(command[0]) is None:
            raise BuildError(f"the compiler named by the environment variable CC ({chosen!r}) was not found")
        return command
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return (name,)
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "cc")
    raise BuildError(
        "no C compiler was found; install one (Debian, Ubuntu: apt install gcc libc6-dev; "
        "macOS: xcode-select --install), or take one from a wheel: pip install 'scvi-codegen[compiler]' (ziglang)"
    )


def load(source: Source, *, flags: tuple[str, ...] = TUNED_FLAGS) -> ModuleType:
    """The compiled module of a source, from memory, from the cache or built now.

    Flags in the environment variable ``SCVI_CODEGEN_CFLAGS`` follow, and so override, those given.

    Returns:
        A cffi module with attributes ``lib`` and ``ffi``.

    Raises:
        BuildError: without a compiler, or if it refuses the text.
    """
    compiler = find_compiler()
    key = _key(source, compiler, flags)
    with _locks.setdefault(key, threading.Lock()):
        if key not in _loaded:
            _loaded[key] = _load_or_build(source, compiler, flags, f"_scvi_{key}")
        return _loaded[key]


def fingerprint(source: Source, *, flags: tuple[str, ...] = TUNED_FLAGS) -> str:
    """24 digits made from all that determines the compiled code: text, compiler, flags, Python, processor."""
    return _key(source, find_compiler(), flags)


@cache
def compiler_title() -> str:
    """The first line that the compiler says of its version."""
    command = find_compiler()
    result = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=60, check=False)
    return (result.stdout.splitlines() or [" ".join(command)])[0]


def _key(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...]) -> str:
    parts = [
        json.dumps([each.to_record() for each in source.sources]),
        " ".join(compiler),
        _compiler_version(compiler),
        " ".join(flags),
        os.environ.get(FLAGS_VARIABLE, ""),
        str(sysconfig.get_config_var("SOABI")),
        _processor() if "-march=native" in flags else platform.machine(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


@cache
def _compiler_version(compiler: tuple[str, ...]) -> str:
    """What tells compilers apart: the file that is run, or what a command of several words says of itself."""
    if len(compiler) == 1:
        file = Path(shutil.which(compiler[0]) or compiler[0]).resolve()
        with suppress(OSError):
            status = file.stat()
            return f"{file} {status.st_size} {status.st_mtime_ns}"
    try:
        result = subprocess.run([*compiler, "--version"], capture_output=True, text=True, timeout=60, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the compiler {' '.join(compiler)!r} does not run: {error}") from error
    return result.stdout


@cache
def _processor() -> str:
    """What ``-march=native`` depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}"
    wanted = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(wanted)}))


def _load_or_build(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], name: str) -> ModuleType:
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


def _load_from(
    folder: Path, source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], name: str
) -> ModuleType:
    """The module in a folder, put there first if need be; OSError if that cannot be done."""
    entry = folder / name
    for _ in range(ATTEMPTS):
        if _is_intact(entry):
            try:
                module = _import(entry, name)
            except ImportError:
                discard(entry)  # a foreign library: build it anew
            else:
                touch(entry)
                return module
        _publish(source, compiler, flags, entry)
        try:
            return _import(entry, name)
        except ImportError as error:
            if _is_intact(entry):
                made = f"what the compiler {' '.join(compiler)!r} made cannot be loaded here"
                raise BuildError(f"{made}: {error}") from error
    raise OSError(f"{entry} is removed as soon as it is made")


def _library(entry: Path) -> Path:
    return entry / f"{entry.name}.so"


def _is_intact(entry: Path) -> bool:
    """Whether the library is there, is the one that was recorded, and nobody else can have put it there."""
    try:
        recorded = json.loads((entry / "manifest.json").read_text())
        found = hashlib.sha256(_library(entry).read_bytes()).hexdigest()
    except (OSError, ValueError):
        return False
    matches = isinstance(recorded, dict) and recorded.get("sha256") == found
    return matches and not exposed(entry) and not exposed(_library(entry))


def _import(entry: Path, name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, _library(entry))
    if spec is None or spec.loader is None:
        raise ImportError(f"{entry} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _publish(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], entry: Path) -> None:
    """Build beside the entry and rename into place; a racing process that was first wins."""
    make_folder(entry.parent)
    with tempfile.TemporaryDirectory(prefix=".building-", dir=entry.parent, ignore_cleanup_errors=True) as folder:
        built = Path(folder) / entry.name
        built.mkdir(mode=0o755)
        with waiting_for(_work(source, compiler, flags)):
            _compile(source, compiler, flags, built)
        checksum = hashlib.sha256(_library(built).read_bytes()).hexdigest()
        (built / "manifest.json").write_text(json.dumps({"sha256": checksum, "prefix": source.prefix}))
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
    return f"compiling {source.code.count(chr(10)):,} lines of C with {command}"


def _compile(source: Source, compiler: tuple[str, ...], flags: tuple[str, ...], folder: Path) -> None:
    """Parts and binding at the same time, each in a process; then one library of them."""
    for name, text in source.files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    include = sysconfig.get_paths()["include"]
    python = [] if sys.platform != "darwin" else ["-undefined", "dynamic_lookup"]
    shared = ["-fPIC", "-std=c99", f"-I{include}", f"-I{folder}"]
    passes = CUT_FLAGS if "-O3" in flags and any("support/parts.h" in each.files for each in source.sources) else ()
    wanted = shlex.split(os.environ.get(FLAGS_VARIABLE, ""))
    parts = [each.prefix for each in source.sources]
    objects = ["-shared", *wanted, *python, *(f"{name}.o" for name in ("binding", *parts))]
    for define, libraries in _mathematics(flags):
        with ExitStack() as ended:
            for name in parts:
                command = [*compiler, *shared, *flags, *passes, *define, *wanted, "-c", f"{name}.c"]
                ended.enter_context(_finished(command, folder))
            if not (folder / "binding.c").exists():
                _write_binding(source, folder)
                ended.enter_context(_finished([*compiler, *shared, "-O0", "-c", "binding.c"], folder))
        try:
            _run([*compiler, *objects, *libraries, "-o", _library(folder).name], folder)
            break
        except BuildError:
            if not define:
                raise
    for name in ("binding.c", "binding.o", *(f"{name}.o" for name in parts)):
        (folder / name).unlink()


def _write_binding(source: Source, folder: Path) -> None:
    from cffi import FFI  # only building needs the parser; loading does not
    from cffi.recompiler import make_c_source  # what FFI.emit_c_code calls, without its message on stdout

    binding = FFI()
    binding.cdef("".join(each.declarations for each in source.sources))
    preamble = "".join(f'#include "{each.prefix}.h"\n' for each in source.sources)
    binding.set_source(folder.name, preamble)
    make_c_source(binding, folder.name, preamble, str(folder / "binding.c"), verbose=False)


def _mathematics(flags: tuple[str, ...]) -> list[tuple[list[str], list[str]]]:
    """Definitions and libraries to try in turn: glibc's vector functions in a tuned build on x86-64, then libm."""
    plain: tuple[list[str], list[str]] = ([], ["-lm"])
    name, version = platform.libc_ver()
    modern = name == "glibc" and tuple(int(part) for part in version.split(".")[:2]) >= (2, 22)
    if modern and platform.machine() == "x86_64" and "-march=native" in flags:
        return [(["-DSCVI_LIBMVEC"], ["-lmvec", "-lm"]), plain]
    return [plain]


def _run(command: list[str], folder: Path) -> None:
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
        raise BuildError(f"the compiler {command[0]!r} does not run: {errors.strip()}")
    if process.returncode:
        hint = _header_hint(errors)
        shown = "\n".join(errors.splitlines()[:30])
        raise BuildError(f"the C compiler refused the text{hint}\n{' '.join(command)}\n{shown}")


def _header_hint(message: str) -> str:
    if "Python.h" not in message and "pyconfig.h" not in message:
        return ""
    return "; the headers of Python are missing (Debian, Ubuntu: apt install python3-dev)"
