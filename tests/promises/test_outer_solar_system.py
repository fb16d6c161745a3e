"""The main job: the outer solar system from its published table, by the command line, against a reference."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from nbody_reference import integrate
from outer_planets import GRAVITY, MASSES, POSITIONS, VELOCITIES

pytestmark = [pytest.mark.usefixtures("as_users_compile"), pytest.mark.rotated]

MODEL = Path(__file__).parents[2] / "examples" / "outer_solar_system.toml"
SPAN = 200_000.0


@pytest.fixture(scope="module")
def reference():
    """Final positions and momenta; 1000 steps are right to 1e-13 AU (2000 and 4000 differ by 8e-15)."""
    q, v = integrate(POSITIONS, VELOCITIES, MASSES, GRAVITY, SPAN, 1000)
    return q.astype(float), (v * np.array(MASSES)[:, None]).astype(float)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    output = tmp_path_factory.mktemp("orbit") / "orbit.npz"
    command = [sys.executable, "-m", "scvi_codegen", "run", str(MODEL), "-o", str(output)]
    subprocess.run(command, check=True, capture_output=True)
    return np.load(output)


def test_final_positions_agree_with_the_reference(run, reference):
    q, p = (run[name][-1].reshape(6, 3) for name in ("q", "p"))
    # measured 4e-13 to 1.2e-12 AU; rounding of 1000 steps, magnified by the motion along the orbits
    np.testing.assert_allclose(q, reference[0], rtol=0, atol=5e-12)
    np.testing.assert_allclose(p, reference[1], rtol=0, atol=1e-18 + 2e-12 * np.abs(reference[1]).max())


def test_momenta_are_conserved_to_round_off(run):
    q, p = (run[name].reshape(-1, 6, 3) for name in ("q", "p"))
    linear, angular = p.sum(axis=1), np.cross(q, p).sum(axis=1)
    assert np.abs(linear - linear[0]).max() < 1e-14 * np.abs(p).max()
    assert np.abs(angular - angular[0]).max() < 1e-14 * np.abs(angular[0]).max()


def test_errors_are_those_of_the_readme(run, reference):
    text = " ".join((MODEL.parents[1] / "README.md").read_text(encoding="utf-8").split())
    stated = r"(\d+) steps of (\d+) days: relative energy error (\S+), final positions within (\S+) AU"
    found = re.search(stated, text)
    assert found
    steps, h, energy, distance = map(float, found.groups())
    assert np.abs(np.diff(run["t"]) - h).max() == 0
    assert len(run["t"]) == steps + 1
    assert energy / 4 < np.abs(energies(run) / energies(run)[0] - 1).max() < 1.5 * energy
    assert distance / 20 < np.abs(run["q"][-1].reshape(6, 3) - reference[0]).max() < distance


def test_energy_is_conserved_to_round_off(run):
    assert np.abs(energies(run) / energies(run)[0] - 1).max() < 1e-14


def energies(run):
    q, p = (run[name].reshape(-1, 6, 3) for name in ("q", "p"))
    energy = (p**2 / np.array(MASSES)[:, None]).sum(axis=(1, 2)) / 2
    for i in range(6):
        for j in range(i):
            energy -= GRAVITY * MASSES[i] * MASSES[j] / np.linalg.norm(q[:, i] - q[:, j], axis=1)
    return energy
