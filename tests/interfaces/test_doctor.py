"""``scvi-codegen doctor`` on machines that lack something, made for the occasion."""

import importlib.metadata
import importlib.util
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest
from commands import invoke, json_of

from scvi_codegen.interfaces.cli.commands import doctor as diagnostics

PROJECT = Path(__file__).parents[2] / "pyproject.toml"


def doctor(*words: str) -> tuple[int, str]:
    result = invoke("doctor", *words, status=None)
    return result.exit_code, result.output


def findings(status: int = 0) -> dict[str, dict[str, Any]]:
    report = json_of("doctor", status=status)
    assert report["ok"] == (status == 0)
    return {found["name"]: found for found in report["findings"]}


@pytest.fixture
def without_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """Skip the trial compilation, where it does not matter."""
    monkeypatch.setattr(
        diagnostics, "_trial", lambda folder: diagnostics.CheckResult(name="trial", status="lacks", result="")
    )


def no_compiler(monkeypatch: pytest.MonkeyPatch, empty: Path) -> None:
    """Return an environment without a compiler on the PATH or from a wheel."""
    find = importlib.util.find_spec
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(empty))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: name != "ziglang" and find(name, *more))


@pytest.mark.rotated
def test_trial_stepper_is_compiled_in_a_temporary_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "cache"))
    status, report = doctor()
    assert status == 0
    error = re.search(r"^ok +trial +a pendulum, .*relative energy error (\S+)$", report, re.MULTILINE)
    assert error is not None
    assert float(error[1]) < 1e-10
    assert re.search(r"^ok +compiler ", report, re.MULTILINE)
    assert re.search(r"^ok +cache .*0 compiled integrators", report, re.MULTILINE)
    assert not (tmp_path / "cache").exists()


@pytest.mark.rotated
def test_missing_compiler_names_what_to_install(tmp_path, monkeypatch):
    no_compiler(monkeypatch, tmp_path)
    status, report = doctor()
    assert status == 1
    assert re.search(r"^fails compiler +none$", report, re.MULTILINE)
    assert "apt install gcc" in report
    assert "trial" not in report
    assert "integrators cannot be compiled and run on this machine: compiler" in report
    assert findings(1)["compiler"]["status"] == "fails"


@pytest.mark.rotated
def test_illegal_instructions_end_only_the_trial_process(tmp_path, monkeypatch):
    header = tmp_path / "trap.h"
    header.write_text("__attribute__((constructor)) static void trap(void) { __builtin_trap(); }\n")
    monkeypatch.setenv("SCVI_CODEGEN_CFLAGS", f"-O0 -include {header}")
    assert re.search("the compiled program was ended by SIG(ILL|TRAP)", findings(1)["trial"]["remedy"])


@pytest.mark.rotated
def test_faulty_arithmetic_is_detected(tmp_path, monkeypatch):
    header = tmp_path / "coarse.h"
    header.write_text("#include <math.h>\n#define sin(x) (0.9 * sin(x))\n")
    monkeypatch.setenv("SCVI_CODEGEN_CFLAGS", f"-O0 -USCVI_LIBMVEC -include {header}")
    assert "violate IEEE 754 arithmetic" in findings(1)["trial"]["remedy"]


@pytest.mark.usefixtures("without_trial")
def test_unused_cache_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(tmp_path / "file" / "cache"))
    assert "is not writable" in findings()["cache"]["remedy"]
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o777)
    monkeypatch.setenv("SCVI_CODEGEN_CACHE", str(shared))
    assert f"chmod go-w '{shared}'" in findings()["cache"]["remedy"]
    monkeypatch.setenv("SCVI_CODEGEN_CACHE_SIZE", "much")
    assert "it must be a size" in findings()["cache"]["remedy"]


@pytest.mark.usefixtures("without_trial")
@pytest.mark.rotated
def test_extras_are_listed_with_missing_packages(monkeypatch):
    extras = tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]
    before = findings()
    listed = [name.removeprefix("extra ") for name in before if name.startswith("extra ")]
    assert set(listed) == set(extras)
    assert listed[:3] + listed[-4:] == ["compiler", "data", "plot", "bench", "docs", "release", "test"]
    assert f"numpy {importlib.metadata.version('numpy')}" in before["libraries"]["result"]

    versions = {"matplotlib": "3.1", "distributed": None}

    def version(name: str) -> str:
        found = versions.get(name, "9999.0")
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(diagnostics, "version", version)
    found = findings()
    assert found["extra plot"]["status"] == "lacks"
    assert found["extra plot"]["remedy"] == "missing matplotlib >= 3.8: pip install 'scvi-codegen[plot]'"
    assert found["extra distributed"]["remedy"] == "missing distributed: pip install 'scvi-codegen[distributed]'"
    assert found["extra data"]["status"] == "ok"
    versions["sympy"] = None
    assert "missing sympy: pip install 'scvi-codegen'" in findings(1)["libraries"]["remedy"]
