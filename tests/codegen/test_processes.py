"""A compiler that takes long is spoken of, and ends with what waits for it, however that ends."""

import io
import logging
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from programs import script

from scvi_codegen.codegen.native import announcements, building
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.codegen.native.compilers import running
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import BuildError

SLOW_COMPILER = """#!/bin/sh
sleep 3600 &
echo $! > {folder}/child
wait
"""
"""As gcc, whose work another process does."""

COMPILING = """
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import (Source)
building.load(Source(prefix="tiny", header="", code="", declarations=""))
"""


@pytest.fixture
def slow_compiler(tmp_path, monkeypatch) -> Path:
    """Two words, so that it is asked for no version."""
    compiler = tmp_path / "slow-cc"
    monkeypatch.setenv("CC", script(compiler, SLOW_COMPILER.format(folder=tmp_path)))
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "cache"))
    return compiler


def child_of(script: Path) -> int:
    """The process that the compiler started, once it has."""
    file, until = script.parent / "child", time.monotonic() + 300
    while not (file.exists() and file.read_text().strip()):
        assert time.monotonic() < until, "the compiler was not started"
        time.sleep(0.02)
    return int(file.read_text())


def has_ended(pid: int) -> bool:
    """Return whether a process ends within moments; unreaped processes have ended."""
    until = time.monotonic() + 300
    while time.monotonic() < until:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z":
                return True
        except FileNotFoundError:
            return True
        time.sleep(0.02)
    return False


needs_proc = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc")


@needs_proc
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL], ids=lambda number: number.name)
def test_ending_python_ends_the_compiler_and_its_children(slow_compiler, number):
    process = subprocess.Popen([sys.executable, "-c", COMPILING], stderr=subprocess.PIPE)
    child = child_of(slow_compiler)
    os.kill(process.pid, number)
    process.communicate(timeout=300)
    assert process.returncode == -number
    assert has_ended(child)


@needs_proc
def test_compiler_is_ended_after_a_timeout(slow_compiler, monkeypatch):
    monkeypatch.setattr(building, "COMPILE_SECONDS", 1)
    with pytest.raises(BuildError, match="stopped after 1 s"):
        building.load(Source(prefix="tiny", header="", code="", declarations=""))
    assert has_ended(child_of(slow_compiler))


def test_output_status_and_temporary_files_are_handled(tmp_path):
    with running(["sh", "-c", 'echo "$TMPDIR"; echo no >&2; exit 3', "name"], tmp_path) as process:
        assert process.communicate(timeout=300) == (f"{tmp_path}\n", "no\n")
    assert process.returncode == 3


MEETING_COMPILER = """#!/bin/sh
case "$*" in *" -c "*) ;; *) exec cc "$@" ;; esac
touch "{folder}/$$"
for _ in $(seq 200); do
  [ $(ls {folder} | wc -l) -ge 2 ] && exec cc "$@"
  sleep 0.05
done
exit 1
"""
"""Compiles nothing before another compiles, too."""


def test_files_are_compiled_concurrently(tmp_path, monkeypatch):
    (folder := tmp_path / "met").mkdir()
    monkeypatch.setenv("CC", script(tmp_path / "meeting-cc", MEETING_COMPILER.format(folder=folder)))
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "cache"))
    library = building.load(replace(part("first"), beside=part("second")), flags=PORTABLE_FLAGS).lib
    assert library.first() == library.second() == 2


def part(name: str) -> Source:
    declarations = f"int {name}(void);"
    code = f"int {name}(void)\n{{\n  return 2;\n}}\n"
    return Source(prefix=name, header=f"{declarations}\n", code=code, declarations=declarations)


def announced_by(monkeypatch, seconds: float, patience: float) -> list[str]:
    """Return what is announced during work of a given duration."""
    monkeypatch.setattr(announcements, "PATIENCE_SECONDS", patience)
    message: list[str] = []
    with announcements.announce_to(message.append), announcements.announced("deriving"):
        time.sleep(seconds)
    return message


def test_only_slow_work_is_announced(monkeypatch, caplog):
    caplog.set_level(logging.INFO, "scvi_codegen")
    assert announced_by(monkeypatch, 0.3, 0.05) == ["deriving"]
    assert announced_by(monkeypatch, 0.0, 0.5) == []
    assert caplog.messages == ["deriving"]


@pytest.mark.parametrize(("level", "shown"), [(logging.NOTSET, "scvi-codegen: {} ...\n"), (logging.WARNING, "")])
def test_compiling_is_announced_unless_the_logger_has_a_higher_level(slow_compiler, monkeypatch, level, shown):
    stream = io.StringIO()
    monkeypatch.setattr(announcements.LOGGER, "level", level)
    monkeypatch.setattr(building, "COMPILE_SECONDS", 0.5)
    monkeypatch.setattr(announcements, "PATIENCE_SECONDS", 0.05)
    monkeypatch.setattr(sys, "stderr", stream)
    with pytest.raises(BuildError):
        building.load(Source(prefix="tiny", header="", code="\n" * 1234, declarations=""), flags=PORTABLE_FLAGS)
    assert stream.getvalue() == shown.format("compiling 1,234 lines of C with slow-cc -O2")
