"""Programs that tests call: those that the README requires, and optional ones, which a test declares with ``needs``.

A test may call only the programs of ``REQUIRED`` (Python, a C compiler with binutils and make, a POSIX shell and
coreutils) and those that it has declared. ``audit`` enforces this on every machine, so that a missing declaration is
found where the program happens to be installed, too.
"""

import os
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest

REQUIRED = frozenset(Path(__file__).with_name("required_programs.txt").read_text(encoding="utf-8").split())
"""Names of the programs that the test command of the README may call on any machine, in addition to Python."""

TRIED_BY_LIBRARIES = frozenset(["fc-list", "ldconfig"])
"""Programs that libraries call if they are there, and do without: Matplotlib's fonts, ``ctypes.util.find_library``."""

REMEDY = {
    "arm-none-eabi-gcc": "Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "Debian: qemu-system-arm",
    "qemu-aarch64": "Debian: qemu-user",
}

_declared: set[str] = set()


class UndeclaredProgramError(AssertionError):
    """A test called a program that the README does not require and that it has not declared."""


def needs(*names: str) -> str:
    """Skip the running test unless these programs are installed; otherwise allow it to call them.

    Returns the path of the first. The value of an argument ``compiler`` of a test is declared before its fixtures.
    """
    for name in names:
        if shutil.which(name) is None:
            remedy = f" ({REMEDY[name]})" if name in REMEDY else ""
            pytest.skip(f"needs the program {name}, which is not installed{remedy}")
    _declared.update(names)
    return str(shutil.which(names[0]))


def script(path: Path, text: str) -> str:
    """Write a program, and return its path as text."""
    path.write_text(text)
    path.chmod(0o755)
    return str(path)


def forget() -> None:
    """Forget what the previous test declared."""
    _declared.clear()


def _program(executable: Any) -> str | None:
    """Name of a program found on the PATH; None for one that is missing, for files of
    the tests' own and for those of the environment of Python."""
    path = Path(os.fsdecode(executable))
    if path.parent == Path() or (path.is_absolute() and str(path.parent) in os.get_exec_path()):
        if path.parent.resolve() == Path(sys.prefix, "bin").resolve() or Path(sys.prefix, "bin", path.name).exists():
            return None
        return path.name if shutil.which(path.name) else None
    return None


def audit(event: str, arguments: tuple[Any, ...]) -> None:
    """Audit hook (``sys.addaudithook``): raise an error where a test starts a program that it has not declared."""
    if event in ("subprocess.Popen", "os.posix_spawn", "os.exec") and "PYTEST_CURRENT_TEST" in os.environ:
        name = _program(arguments[0])
        if name is not None and name not in REQUIRED | TRIED_BY_LIBRARIES | _declared and not name.startswith("python"):
            raise UndeclaredProgramError(f"{name} is not required by the README; call programs.needs({name!r}) first")
