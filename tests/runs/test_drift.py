"""The energy of two million steps walks at random, and does not drift: every term of a step counts, however small."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS, TUNED_FLAGS
from scvi_codegen.interfaces.models.systems import point_vortices

pytestmark = [pytest.mark.usefixtures("as_users_compile"), pytest.mark.rotated]

STEPS = 2_000_000


def start(eccentricity: float) -> tuple[np.ndarray, np.ndarray]:
    """At the pericentre, with semi-major axis 1."""
    speed = np.sqrt((1 + eccentricity) / (1 - eccentricity))
    return np.array([1 - eccentricity, 0.0]), np.array([0.0, speed])


@pytest.mark.covering
@pytest.mark.parametrize("flags", [TUNED_FLAGS, PORTABLE_FLAGS], ids=["tuned", "portable"])
@pytest.mark.parametrize(("eccentricity", "h"), [(0.2, 0.35), (0.5, 0.1)])
def test_energy_does_not_drift(eccentricity, h, flags):
    """Tables of 53 bits, or small terms rounded away, give 5e-13 to 7e-12 here."""
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8), flags=flags)
    energy = stepper.integrate(*start(eccentricity), h=h, steps=STEPS, save_every=STEPS // 200).energy()
    assert abs(energy / energy[0] - 1).max() < 3e-13


@pytest.mark.full
def test_ensembles_do_not_drift():
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))
    q, p = start(0.2)
    runs = stepper.integrate_ensemble(
        np.tile(q, (8, 1)) + [[1e-3 * k, 0.0] for k in range(8)],
        np.tile(p, (8, 1)),
        h=0.35,
        steps=STEPS,
        save_every=STEPS,
    )
    energy = runs.energy()
    assert abs(np.mean(energy[-1] / energy[0] - 1)) < 2e-13


@pytest.mark.parametrize("angle", [0.7, 4.0])
def test_adaptive_steps_do_not_drift(angle):
    """h^2 within an ulp of a power of 2 rounds a product by its leading digits alone: 1.5e-12 and 2.1e-12 here."""
    stepper = sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    q, p = start(0.9)
    run = stepper.start(turn @ q, turn @ p, t_end=30_000 * 2 * np.pi, tolerance=1e-20)
    energy = run.record(save_every=STEPS // 200).energy()
    assert abs(energy / energy[0] - 1).max() < 6e-13


ROD = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])
RODS = sc.LagrangianSystem.from_text(
    name="two rods",
    coordinates=["x1", "y1", "x2", "y2"],
    lagrangian="m*(x1_dot**2 + y1_dot**2)/2 + (x2_dot**2 + y2_dot**2)/2 - g*(m*y1 + y2)",
    parameters={"m": 2.0, "g": 3.0},
    constraints=["x1**2 + y1**2 = 1", "(x2 - x1)**2 + (y2 - y1)**2 = 1"],
)
OWN = {"rod": ROD, "two rods": RODS, "vortices": point_vortices(2)}


MILLION = 1_000_000
LONG = {
    "kepler": ("kepler", "svi:8", "fixed-point", 0.3, ([0.8, 0.0], [0.0, np.sqrt(1.5)])),
    "kepler by Newton": ("kepler", "svi:6", "newton", 0.15, ([0.8, 0.0], [0.0, np.sqrt(1.5)])),
    "henon-heiles": ("henon-heiles", "svi:8", "fixed-point", 0.4, ([0.1, 0.2], [0.2, 0.1])),
    "henon-heiles by composition": (
        "henon-heiles",
        {"method": "composition", "order": 8},
        "auto",
        0.05,
        ([0.1, 0.2], [0.2, 0.1]),
    ),
    "planar-pendulum": ("planar-pendulum", "gauss:8", "fixed-point", 0.1, ([1.0], [0.3])),
    "double-pendulum": ("double-pendulum", "svi:8", "fixed-point", 0.02, ([0.4, -0.2], [0.1, 0.2])),
    "double-pendulum by Newton": ("double-pendulum", "scvi:6", "newton", 0.02, ([0.4, -0.2], [0.1, 0.2])),
    "charged-particle": ("charged-particle", "gauss:8", "fixed-point", 0.1, ([0.6, 0.3, -0.2], [-0.3, 0.4, 0.5])),
    "two vortices": ("vortices", "gauss:6", "fixed-point", 0.05, ([0.5, -0.4], [0.1, 0.3])),
    "rod": ("rod", "svi:6", "auto", 0.02, ([0.6, -0.8], [0.4, 0.3])),
    "two rods": ("two rods", "svi:5", "auto", 0.02, ([0.6, -0.8, 1.4, -1.4], [0.8, 0.6, 0.7, 0.7])),
}


@pytest.mark.full
@pytest.mark.parametrize("name", LONG)
def test_energies_of_a_million_steps_walk_at_random(name):
    """Beside a part of the walk of a sum that rounds the state in every step: half of it for close vortices."""
    part = 0.5 if "vortices" in name else 0.25
    system, method, solver, h, state = LONG[name]
    given = OWN[system] if system in OWN else sc.problem(system).system
    method = sc.methods.method_from_specification(method) if isinstance(method, dict) else method
    stepper = sc.compile_stepper(given, method, solver=solver)
    energy = stepper.integrate(*state, h=h, steps=MILLION, save_every=MILLION // 200).energy()
    assert abs(energy - energy[0]).max() < part * 2.0**-52 * np.sqrt(MILLION) * max(1.0, abs(energy[0]))
