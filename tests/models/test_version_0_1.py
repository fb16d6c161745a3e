"""A folder that version 0.1 generated, as it was written, does here what it did there."""

import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from scvi_codegen import Stepper, load_package

FOLDER = Path(__file__).parents[1] / "corpus" / "version_0_1" / "pendulum_verlet"

END = (10.5, float.fromhex("-0x1.cec9f55665c78p-2"), float.fromhex("0x1.aac0af08a90a9p-3"))
"""t, q, p after 40 steps of 1/4 from (0.5, 0) at t = 1/2, computed by version 0.1."""


@pytest.fixture(scope="module")
def stepper() -> Stepper:
    return load_package(FOLDER)


def test_states_are_those_of_version_0_1(stepper):
    run = stepper.integrate([0.5], [0.0], h=0.25, steps=40, t=0.5)
    assert (run.t[-1], run.q[-1, 0], run.p[-1, 0]) == pytest.approx(END, rel=1e-13)
    many = stepper.integrate_ensemble([[0.5], [0.4]], [[0.0], [0.1]], h=0.25, steps=40, t=0.5)
    assert np.array_equal(many.t, run.t)
    assert np.array_equal(many.q[:, 0], run.q)


def test_runs_of_version_0_1_are_saved_and_restored(stepper):
    run = stepper.start([0.5], [0.0], h=0.25, t=0.5)
    run.advance(15)
    assert run.t == 0.5 + 15 * 0.25
    for again in (stepper.from_checkpoint(run.checkpoint()), pickle.loads(pickle.dumps(run))):
        again.advance(25)
        assert (again.t, again.q[0], again.p[0]) == pytest.approx(END, rel=1e-13)


def test_dense_output_and_events_of_version_0_1(stepper):
    run = stepper.integrate([0.5], [0.0], h=0.25, steps=40, t=0.5, save_every=4)
    assert run.at(float(END[0]))[0] == pytest.approx(END[1], rel=1e-13)
    crossings = stepper.integrate([0.5], [0.0], h=0.25, steps=40, t=0.5, events="q").events[0]
    assert np.abs(crossings.q).max() < 1e-12
    assert np.allclose(run.at(crossings.t)[0], 0.0, atol=1e-12)


def test_version_0_1_is_imported_as_a_package():
    code = "import pendulum_verlet as p; print(*p.stepper.step([0.5], [0.0], 0.25)[0])"
    shown = subprocess.run([sys.executable, "-c", code], cwd=FOLDER.parent, capture_output=True, text=True, check=True)
    assert float(shown.stdout) == pytest.approx(0.5, abs=0.02)
