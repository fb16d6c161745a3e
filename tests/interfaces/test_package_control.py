"""Generated folders with adaptive steps: from C, from Python, on a microcontroller."""

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen import MethodError, generate_package

STRICT = "-O2 -std=c99 -Wall -Wextra -Werror -Wno-psabi -ffp-contract=off"
SPAN = 10.0


@pytest.fixture(scope="module")
def model() -> sc.Model:
    found = sc.Model.from_problem(sc.problem("kepler"), sc.SVI(4))
    return replace(found, h=None, tolerance=1e-9, span=SPAN)


def output(folder: Path, flags: str = STRICT) -> list[str]:
    done = subprocess.run(
        ["make", "-s", "-C", str(folder), "run", f"CFLAGS={flags}"], capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


def exact_end(model: sc.Model) -> np.ndarray:
    stepper = sc.compile_stepper(model.system, sc.SVI(8))
    return stepper.integrate(model.q, velocity=model.velocity, t_end=SPAN).q[-1]


@pytest.mark.rotated
@pytest.mark.parametrize(("precision", "error"), [("double", 1e-6), ("single", 1e-2)])
def test_microcontroller_code_has_adaptive_steps_if_requested(model, tmp_path, precision, error):
    folder = generate_package(replace(model, tolerance=1e-5), tmp_path / "board", embedded=precision)
    flags = f"{STRICT} -Wdouble-promotion" if precision == "single" else STRICT
    subprocess.run(["cc", "-c", *flags.split(), "-ffreestanding", "board.c"], cwd=folder, check=True)
    end = np.array([float(word) for word in output(folder)[-2].split()])
    assert np.abs(end[1:3] - exact_end(model)).max() < 100.0 * error
    fixed = generate_package(replace(model, h=0.1, tolerance=None), tmp_path / "fixed", embedded=precision)
    assert "advance_to" not in (fixed / "fixed.c").read_text()


def test_method_without_adaptive_steps_is_reported(model, tmp_path):
    with pytest.raises(MethodError, match="give h and steps"):
        generate_package(replace(model, method=sc.StoermerVerlet()), tmp_path / "verlet")
    assert not (tmp_path / "verlet").exists()
