"""C for machines that are not this one, by the cross compiler of the extra ``compiler``; one of them is emulated."""

import importlib.util
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from programs import needs

from scvi_codegen import SCVI, SVI, Model, StoermerVerlet, generate_package, problem
from scvi_codegen.methods.method import Method

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(importlib.util.find_spec("ziglang") is None, reason="pip install 'scvi-codegen[compiler]'"),
]

GENERATED = Path(__file__).parents[2] / "generated"
WARNINGS = "-std=c99 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Werror".split()  # noqa: SIM905  (as typed)
PORTABLE = ("-O2", "-ffp-contract=off")
TARGETS = ("x86_64-windows-gnu", "aarch64-macos", "aarch64-linux-gnu")
QEMU = "qemu-aarch64"


def compiled(target: str, *words: str) -> None:
    command = [sys.executable, "-m", "ziglang", "cc", "-target", target, *WARNINGS, *PORTABLE, *words]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=400)
    assert result.returncode == 0, result.stderr[-4000:]
    assert "warning" not in result.stderr


def folder_for(name: str, method: Method, place: Path) -> Path:
    return generate_package(Model.from_problem(problem(name), method=method), place / "integrator")


@pytest.mark.parametrize("target", TARGETS)
def test_generated_files_compile_for_other_machines_without_a_warning(target, tmp_path):
    sources = sorted(GENERATED.glob("*.c"))
    assert sources
    for source in sources:
        compiled(target, f"-I{GENERATED}", "-c", str(source), "-o", str(tmp_path / f"{source.stem}.o"))


@pytest.mark.parametrize("target", TARGETS)
def test_folder_compiles_to_a_program_for_another_machine(target, tmp_path):
    folder = folder_for("kepler", SVI(4), tmp_path)
    program = tmp_path / "program"
    compiled(target, *map(str, sorted(folder.glob("*.c"))), "-lm", "-o", str(program))
    begins = {"x86_64-windows-gnu": b"MZ", "aarch64-macos": b"\xcf\xfa\xed\xfe"}.get(target, b"\x7fELF")
    assert program.read_bytes().startswith(begins)


@pytest.mark.skipif(
    platform.machine() not in ("x86_64", "AMD64") or sys.platform != "linux", reason="compares with x86-64"
)
@pytest.mark.parametrize(
    ("name", "method"),
    [
        ("kepler", SVI(4)),
        ("kepler", StoermerVerlet()),
        ("double-pendulum", SVI(8)),
        ("planar-pendulum", SCVI(3)),
        ("duffing", SVI(6)),
        ("outer-solar-system", SVI(8)),
    ],
    ids=lambda each: each if isinstance(each, str) else type(each).__name__,
)
def test_an_arm_processor_computes_the_same_bits(name, method, tmp_path):
    """One libm, roundings fixed by flags: 17 digits of every state, also with adaptive steps."""
    needs(QEMU)
    sources = [str(source) for source in sorted(folder_for(name, method, tmp_path).glob("*.c"))]
    message = {}
    for target, runner in {"aarch64-linux-musl": [QEMU], "x86_64-linux-musl": []}.items():
        program = tmp_path / target
        compiled(target, "-static", *sources, "-lm", "-o", str(program))
        result = subprocess.run([*runner, str(program)], capture_output=True, text=True, check=True, timeout=300)
        message[target] = result.stdout
    arm, intel = message.values()
    assert arm == intel
    assert len(arm.splitlines()) > 20
