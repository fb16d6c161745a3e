"""Other builds of the same text: plain x86-64, AVX2, and one under the address and undefined-behaviour sanitizers."""

import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest
from programs import needs

from scvi_codegen.codegen.native import building

pytestmark = pytest.mark.usefixtures("as_users_compile")

ROOT = Path(__file__).parents[2]
SANITIZERS = "-O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer"


def run_stepper_tests(tmp_path: Path, flags: str, *arguments: str, **environment: str) -> None:
    """The tests of steppers, in a process of their own whose integrators are compiled with other flags."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist", *arguments]
    result = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {building.CACHE_VARIABLE: str(tmp_path), building.FLAGS_VARIABLE: flags} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-5000:] + result.stderr[-5000:]


def sanitizer_library(name: str) -> str:
    """Path of a run-time library of gcc's, which must be there before the interpreter."""
    result = subprocess.run([needs("gcc"), f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    path = result.stdout.strip()
    if not Path(path).is_absolute():
        pytest.skip(f"{name} is not installed")
    return path


def files_named(*names: str) -> list[str]:
    """The test files of these names, wherever they stand."""
    found = [sorted((ROOT / "tests").glob(f"*/test_{name}.py")) for name in names]
    assert all(found)
    return [str(path.relative_to(ROOT)) for paths in found for path in paths]


@pytest.mark.full
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="flags of x86-64")
@pytest.mark.parametrize("level", ["x86-64", "x86-64-v3"])
def test_steppers_work_on_older_processors(tmp_path, level):
    if level == "x86-64-v3" and "avx2" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no AVX2")
    files = files_named("stepper", "ensemble", "against_oracle", "structure", "constraints")
    run_stepper_tests(tmp_path, f"-march={level}", *files)


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="the sanitizers are preloaded")
def test_sanitizers_report_no_error(tmp_path):
    libraries = " ".join(map(sanitizer_library, ("libasan.so", "libubsan.so")))
    options = "detect_leaks=0:allocator_may_return_null=1"  # the interpreter keeps what it has; too much is refused
    files = files_named("stepper", "fuzz_steppers", "constraints", "arrays_newton", "run_error")
    run_stepper_tests(tmp_path, SANITIZERS, *files, CC="gcc", LD_PRELOAD=libraries, ASAN_OPTIONS=options)


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["kepler", "double-pendulum", "charged-particle"])
def test_portable_flags_are_bitwise_reproducible(tmp_path, monkeypatch, name):
    """Different compilers, one libm: the same numbers; the tuned build differs by roundings."""
    needs("gcc", "clang")
    from scvi_codegen.interfaces.models.problems import problem
    from scvi_codegen.methods import SVI
    from scvi_codegen.runs.compiler import compile_stepper

    monkeypatch.setenv(building.CACHE_VARIABLE, str(tmp_path))
    chosen, ends = problem(name), {}
    for compiler in ("gcc", "clang"):
        monkeypatch.setenv("CC", compiler)
        stepper = compile_stepper(chosen.system, SVI(8), flags=building.PORTABLE_FLAGS)
        p = stepper.momentum(chosen.q, chosen.velocity)
        run = stepper.integrate(chosen.q, p, h=chosen.step, steps=200)
        ends[compiler] = (run.q.tobytes(), run.p.tobytes())
    assert ends["gcc"] == ends["clang"]
