"""Machines without a compiler, and without the headers of Python."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from programs import needs, script

from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import BuildError

needs_wheel = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="pip install 'scvi-codegen[compiler]'"
)

RUN = """
import scvi_codegen as sc
kepler = sc.problem("kepler")
run = sc.compile_stepper(kepler.system, "svi:4").integrate(kepler.q, velocity=kepler.velocity, h=0.05, steps=1000)
print(abs(run.energy() / run.energy()[0] - 1).max())
"""


def bare_machine(tmp_path: Path) -> dict[str, str]:
    """An environment whose PATH leads to a shell alone."""
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "sh").symlink_to("/bin/sh")
    home = os.environ.get("HOME", str(tmp_path))  # where zig keeps the libraries that it made at its first use
    return {"PATH": str(tools), "HOME": home, building.CACHE_VARIABLE: str(tmp_path / "cache")}


def in_python(environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *words]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=400)


@pytest.mark.full
@needs_wheel
def test_machine_without_a_compiler_uses_the_one_from_the_wheel(tmp_path):
    environment = bare_machine(tmp_path)
    assert not any(shutil.which(name, path=environment["PATH"]) for name in ("cc", "gcc", "clang"))
    ran = in_python(environment, "-c", RUN)
    assert ran.returncode == 0, ran.stderr
    assert float(ran.stdout) < 1e-6
    outcome = in_python(environment, "-m", "scvi_codegen", "doctor")
    assert outcome.returncode == 0, outcome.stdout + outcome.stderr
    assert re.search(
        r"^ok +compiler .*-m ziglang cc: .*\(extra compiler: the PATH has no cc, gcc or clang\)$", outcome.stdout, re.M
    )
    assert re.search(r"^ok +trial ", outcome.stdout, re.M)


def broken(code: str) -> str:
    with pytest.raises(BuildError) as error:
        building.load(Source(prefix="tiny", header="", code=code, declarations="int tiny(void);\n"), flags=("-O0",))
    return str(error.value)


def test_compiler_without_headers_is_replaced_by_the_one_from_the_wheel(tmp_path, monkeypatch):
    monkeypatch.setenv(building.CACHE_VARIABLE, str(tmp_path))
    message = broken("#include <no_such_header.h>\n")
    assert "no_such_header.h" in message
    assert "pip install 'scvi-codegen[compiler]' (ziglang), and set CC='python -m ziglang cc'" in message


WATCHED = """#!/bin/sh
echo "$@" >> {folder}/commands
exec {compiler} -MD -MF {folder}/$$.d "$@"
"""


def test_no_header_of_python_is_read(tmp_path, monkeypatch):
    """The compiler opens no header of Python and receives no path to them."""
    compiler = script(tmp_path / "watched-cc", WATCHED.format(folder=tmp_path, compiler=needs("cc")))
    monkeypatch.setenv("CC", compiler)
    monkeypatch.setenv(building.CACHE_VARIABLE, str(tmp_path / "cache"))
    code = "#include <math.h>\nint tiny(void);\nint tiny(void)\n{\n  return (int)floor(7.5);\n}\n"
    source = Source(prefix="tiny", header="", code=code, declarations="int tiny(void);\n")
    assert building.load(source, flags=("-O0",)).lib.tiny() == 7
    read = "".join(path.read_text() for path in tmp_path.glob("*.d"))
    assert "math.h" in read
    assert "Python.h" not in read
    paths = sysconfig.get_paths()
    assert not any(paths[kind] in (tmp_path / "commands").read_text() + read for kind in ("include", "platinclude"))
