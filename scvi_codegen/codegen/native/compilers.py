"""C compilers: search, version, advice if none works, permitted flags, processes, fingerprints of compiled code.

A flag can make a compiler run another program (``-wrapper``, ``-fplugin=``) or read and write files, so a folder from
somebody else may contain only the flags listed here. Others can be set in the environment variable
SCVI_CODEGEN_CFLAGS. Compilers, with all the processes that they start, end with their parent.
"""

import hashlib
import importlib.util
import json
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import _cffi_backend

from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import BuildError

ALLOWED = re.compile(
    r"-O([0123sgz]|fast)?|-g[0123]?|-W(no-)?[a-z][a-z-]*|-pthread"
    r"|-m(arch|tune|cpu)=[\w.+-]+|-m(no-)?(avx[\w.-]*|sse[\w.]*|fma4?|f16c|bmi2?|prefer-vector-width=\d+)"
    r"|-ffp-contract=(on|off|fast)|-fsanitize=[a-z,-]+|-D[A-Za-z_]\w*(=\d+)?"
    r"|-f(no-)?(math-errno|trapping-math|fast-math|signed-zeros|associative-math|reciprocal-math|finite-math-only"
    r"|rounding-math|unsafe-math-optimizations|unroll-loops|tree-vectorize|tree-slp-vectorize|inline|wrapv|gcse"
    r"|tree-pre"
    r"|strict-aliasing|omit-frame-pointer|schedule-insns2?|rerun-cse-after-loop|dse|lto)",
    re.ASCII,
)

REORDERING_FLAGS = frozenset(("-ffast-math", "-Ofast", "-fassociative-math", "-funsafe-math-optimizations"))
"""Flags that permit the compiler to reorder sums."""


def check_flags(flags: Sequence[str], error: type[ValueError] = ValueError) -> None:
    """Raise an error for a flag that is not allowed."""
    for flag in flags:
        if not isinstance(flag, str) or not ALLOWED.fullmatch(flag):
            raise error(
                f"the compiler flag {flag!r} is not allowed in a recorded run: allowed are flags of "
                "optimisation (-O2), "
                "floating point (-ffp-contract=off), processor (-march=native), definitions (-DNAME=1). Leave it out, "
                "or set it in the environment variable SCVI_CODEGEN_CFLAGS"
            )


GUARDED = 'exec 3<&0 </dev/null; (read -r end <&3; kill -KILL 0) >/dev/null 2>&1 & exec 3<&-; exec "$@"'
"""Shell command that runs a program and kills its process group when the pipe from Python closes."""


@contextmanager
def running(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Run a program in a folder during the block; kill it with its children at the end.

    Its temporary files are in the folder, too. A program that cannot be run has the status 126 or 127, as in a shell.
    Without POSIX only the program itself is killed, and not if Python is killed.
    """
    with (_guarded if os.name == "posix" else _alone)(command, folder) as process:
        yield process


def _started(command: Sequence[str], folder: Path, stdin: int, *, session: bool) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, **dict.fromkeys(("TMPDIR", "TMP", "TEMP"), str(folder))},
        stdin=stdin,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=session,
    )


@contextmanager
def _guarded(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    read_end, pipe = os.pipe()
    try:
        with _started(["/bin/sh", "-c", GUARDED, "sh", *command], folder, read_end, session=True) as process:
            try:
                yield process
            finally:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
    finally:
        os.close(read_end)
        os.close(pipe)


@contextmanager
def _alone(command: Sequence[str], folder: Path) -> Iterator[subprocess.Popen[str]]:
    try:
        started = _started(command, folder, subprocess.DEVNULL, session=False)
    except OSError as error:
        raise BuildError(f"the program {command[0]!r} does not run: {error}") from error
    with started as process:
        try:
            yield process
        finally:
            process.kill()


WHEEL = "take one from a wheel: pip install 'scvi-codegen[compiler]' (ziglang)"


def find_compiler() -> tuple[str, ...]:
    """Return the command that compiles C: ``$CC``, else cc, gcc or clang, else the ``ziglang`` wheel; or BuildError."""
    setting = os.environ.get("CC")
    if setting:
        command = words_of("CC")
        if not command or shutil.which(command[0]) is None:
            raise BuildError(
                f"the compiler in the environment variable CC ({setting!r}) was not found: correct or unset CC"
            )
        return command
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return (name,)
    if importlib.util.find_spec("ziglang"):
        return (sys.executable, "-m", "ziglang", "cc")
    raise BuildError(
        "no C compiler was found; install one (Debian, Ubuntu: apt install gcc libc6-dev; "
        f"macOS: xcode-select --install), or {WHEEL}"
    )


def words_of(variable: str) -> tuple[str, ...]:
    """Return the words of an environment variable, split as by a shell; BuildError if a quote is not closed."""
    text = os.environ.get(variable, "")
    try:
        return tuple(shlex.split(text))
    except ValueError as error:
        raise BuildError(
            f"the environment variable {variable} is {text!r}, which cannot be split into words ({error}): close "
            "its quotes"
        ) from error


def from_wheel(compiler: tuple[str, ...]) -> bool:
    """Return whether a command is the compiler of the extra ``compiler``."""
    return "ziglang" in compiler


def compiler_title() -> str:
    """Return the first line of the compiler's version."""
    command = find_compiler()
    return (_version_output(command).splitlines() or [" ".join(command)])[0]


@cache
def compiler_version(compiler: tuple[str, ...]) -> str:
    """Return an identification of the compiler: its file, or the version printed by a command of several words."""
    if len(compiler) == 1:
        file = Path(shutil.which(compiler[0]) or compiler[0]).resolve()
        with suppress(OSError):
            status = file.stat()
            return f"{file} {status.st_size} {status.st_mtime_ns}"
    return _version_output(compiler)


@cache
def _version_output(compiler: tuple[str, ...]) -> str:
    settings: dict[str, Any] = {"capture_output": True, "text": True, "errors": "replace", "timeout": 60}
    try:
        return str(subprocess.run([*compiler, "--version"], check=False, **settings).stdout)
    except (OSError, ValueError, subprocess.TimeoutExpired) as error:
        raise BuildError(f"the compiler {' '.join(compiler)!r} does not run: {error}") from error


def another_compiler(command: list[str]) -> str:
    """Return advice for an incomplete compiler, e.g. without headers or linker."""
    if from_wheel(tuple(command)):
        return ""
    return f"\nif this compiler is incomplete, {WHEEL}, and set CC='python -m ziglang cc'"


FLAGS_VARIABLE = "SCVI_CODEGEN_CFLAGS"
"""Variable of further flags; not ``CFLAGS``, where package managers may set an ``-march`` that overrides the tuning."""


def fingerprint(source: Source, *, flags: tuple[str, ...]) -> str:
    """Return 24 digits of a digest of what determines the compiled code: source, compiler, flags and processor."""
    compiler = find_compiler()
    # whether any flag selects the instructions of this processor (-march, -mcpu, -mtune)
    tuned = "=native" in " ".join((*compiler, *flags, os.environ.get(FLAGS_VARIABLE, "")))
    parts = [
        json.dumps([part.to_record() for part in source.sources]),
        json.dumps(compiler),
        compiler_version(compiler),
        json.dumps(flags),
        os.environ.get(FLAGS_VARIABLE, ""),
        _cffi_backend.__version__,
        _commands(),
        _processor() if tuned else platform.machine(),
    ]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


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
    names = ("model name", "flags", "Features", "CPU part")
    return "\n".join(sorted({line for line in lines if line.startswith(names)}))
