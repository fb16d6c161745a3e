"""The oldest and the newest releases of what the project needs: tests of several rooms in fresh environments."""

import os
import re
import subprocess
import tomllib
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NEEDED = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
FLOOR = re.compile(r"[\w-]+>=[\d.]+")
RUN = (
    "tests/methods/test_quadrature.py",
    "tests/systems/test_expression_text.py",
    "tests/systems/test_derivatives.py",
    "tests/systems/test_system.py",
    "tests/systems/test_symmetries.py",
    "tests/systems/test_hamiltonian.py",
    "tests/interfaces/test_model_file.py",
    "tests/runs/test_stepper.py",
)
"""What SymPy, NumPy, SciPy and cffi have a part in."""


def test_every_dependency_has_a_lower_bound():
    assert [need for need in NEEDED if not FLOOR.fullmatch(need)] == []


@pytest.mark.full
@pytest.mark.parametrize("age", ["oldest", "newest"])
def test_tests_pass_with_the_lower_bounds(age, tmp_path):
    venv.create(tmp_path / "home", with_pip=True)
    [python] = (tmp_path / "home").glob("*/python")
    wanted = [need.replace(">=", "==") for need in NEEDED] if age == "oldest" else ["--upgrade", *NEEDED]
    install = [
        str(python),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--only-binary=:all:",
        *wanted,
        "pytest>=8",
        "hypothesis>=6.100",
    ]
    made = subprocess.run(install, capture_output=True, text=True, check=False, timeout=1800)
    if "Could not find a version" in made.stderr and "(from versions: none)" in made.stderr:
        pytest.skip("there is no index of packages to install from")
    assert made.returncode == 0, made.stderr[-3000:]
    result = subprocess.run(
        [str(python), "-m", "pytest", "-q", "-p", "no:cacheprovider", *RUN],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=3000,
    )
    assert result.returncode == 0, result.stdout[-5000:] + result.stderr[-2000:]
