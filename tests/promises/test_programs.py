"""Tests call the programs that the README requires, and others only where they declare them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from programs import UndeclaredProgramError, needs

TESTS = Path(__file__).parents[1]
PROGRAM = "optional-program"


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A program on the PATH that ends with status 3."""
    path = tmp_path / PROGRAM
    path.write_text("#!/bin/sh\nexit 3\n")
    path.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    return path


@pytest.mark.usefixtures("installed")
def test_undeclared_program_is_rejected() -> None:
    with pytest.raises(UndeclaredProgramError, match=f"{PROGRAM} is not required by the README"):
        subprocess.run([PROGRAM], check=False)


def test_declared_program_is_called(installed: Path) -> None:
    assert needs(PROGRAM) == str(installed)
    assert subprocess.run([PROGRAM], check=False).returncode == 3


def test_required_and_declared_programs_are_called(tmp_path: Path) -> None:
    assert subprocess.run(["uname"], capture_output=True, check=False).returncode == 0
    assert subprocess.run([sys.executable, "-c", ""], check=False).returncode == 0
    own = tmp_path / "own"
    own.write_text("#!/bin/sh\nexit 3\n")
    own.chmod(0o755)
    assert subprocess.run([str(own)], check=False).returncode == 3


def test_missing_program_skips_the_test_by_name() -> None:
    with pytest.raises(pytest.skip.Exception, match="needs the program no-such-program"):
        needs("no-such-program")


def test_programs_are_looked_up_in_one_module() -> None:
    """A test that asks ``shutil.which`` by itself would be skipped without the name of the program."""
    exempt = {"tools/programs.py", "tools/browsing.py", "faults/mutate.py", "promises/test_programs.py"}
    files = [path for path in TESTS.rglob("*.py") if path.relative_to(TESTS).as_posix() not in exempt]
    found = [path.name for path in files if re.search(r"which\((?!.*path=)", path.read_text(encoding="utf-8"))]
    assert found == []
