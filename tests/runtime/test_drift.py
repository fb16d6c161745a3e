"""The energy of two million steps walks at random, and does not drift: every term of a step counts, however small."""

from __future__ import annotations

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS

pytestmark = pytest.mark.usefixtures("as_users_compile")

STEPS = 2_000_000


def start(eccentricity: float) -> tuple[np.ndarray, np.ndarray]:
    """At the pericentre, with semi-major axis 1."""
    speed = np.sqrt((1 + eccentricity) / (1 - eccentricity))
    return np.array([1 - eccentricity, 0.0]), np.array([0.0, speed])


@pytest.mark.parametrize("flags", [TUNED_FLAGS, PORTABLE_FLAGS], ids=["tuned", "portable"])
@pytest.mark.parametrize(("eccentricity", "h"), [(0.2, 0.35), (0.5, 0.1)])
def test_the_energy_does_not_drift(eccentricity, h, flags):
    """Tables of 53 bits, or small terms rounded away, give 5e-13 to 7e-12 here."""
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8), flags=flags)
    energy = stepper.integrate(*start(eccentricity), h=h, steps=STEPS, every=STEPS // 200).energy()
    assert abs(energy / energy[0] - 1).max() < 3e-13


def test_ensembles_do_not_drift():
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))
    q, p = start(0.2)
    runs = stepper.integrate_ensemble(
        np.tile(q, (8, 1)) + [[1e-3 * k, 0.0] for k in range(8)], np.tile(p, (8, 1)), h=0.35, steps=STEPS, every=STEPS
    )
    energy = runs.energy()
    assert abs(np.mean(energy[-1] / energy[0] - 1)) < 2e-13


@pytest.mark.parametrize("angle", [0.7, 4.0])
def test_steps_that_choose_their_length_do_not_drift(angle):
    """h^2 within an ulp of a power of 2 rounds a product by its leading digits alone: 1.5e-12 and 2.1e-12 here."""
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    q, p = start(0.9)
    run = stepper.start(turn @ q, turn @ p, t_end=30_000 * 2 * np.pi, tolerance=1e-20)
    energy = run.record(every=STEPS // 200).energy()
    assert abs(energy / energy[0] - 1).max() < 6e-13
