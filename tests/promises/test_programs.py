"""Tests call the programs that the README requires, and others only where they declare them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from programs import UndeclaredProgramError, needs, script

PROGRAM = "optional-program"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A program on the PATH that ends with status 3."""
    path = script(tmp_path / PROGRAM, "#!/bin/sh\nexit 3\n")
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    return path


@pytest.mark.usefixtures("installed")
def test_undeclared_program_is_rejected() -> None:
    with pytest.raises(UndeclaredProgramError, match=f"{PROGRAM} is not required by the README"):
        subprocess.run([PROGRAM], check=False)


def test_declared_program_is_called(installed: str) -> None:
    assert needs(PROGRAM) == installed
    assert subprocess.run([PROGRAM], check=False).returncode == 3


def test_required_and_declared_programs_are_called(tmp_path: Path) -> None:
    assert subprocess.run(["uname"], capture_output=True, check=False).returncode == 0
    assert subprocess.run([sys.executable, "-c", ""], check=False).returncode == 0
    own = script(tmp_path / "own", "#!/bin/sh\nexit 3\n")
    assert subprocess.run([own], check=False).returncode == 3


def test_missing_program_skips_the_test_by_name() -> None:
    with pytest.raises(pytest.skip.Exception, match="needs the program no-such-program"):
        needs("no-such-program")
