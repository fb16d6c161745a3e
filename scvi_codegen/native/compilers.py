"""C compilers: search, version, and advice if none works."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from scvi_codegen.errors import BuildError

WHEEL = "take one from a wheel: pip install 'scvi-codegen[compiler]' (ziglang)"


def find_compiler() -> tuple[str, ...]:
    """Return the command that compiles C: ``$CC``, else cc, gcc or clang, else the ``ziglang`` wheel.

    Raises:
        BuildError: if there is none.
    """
    chosen = os.environ.get("CC")
    if chosen:
        command = words_of("CC")
        if not command or shutil.which(command[0]) is None:
            raise BuildError(
                f"the compiler in the environment variable CC ({chosen!r}) was not found: correct or unset CC"
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
    """Return the words of an environment variable, split as by a shell.

    Raises:
        BuildError: if a quote is not closed.
    """
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
    return _title_of(find_compiler())


@cache
def _title_of(command: tuple[str, ...]) -> str:
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


def _version_output(compiler: tuple[str, ...]) -> str:
    """Return the version that the compiler prints."""
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
