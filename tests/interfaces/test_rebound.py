"""Bodies to REBOUND and from it: the same motion by its IAS15 and by steps from the Lagrangian."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.errors import StateError, SystemDefinitionError

rebound = pytest.importorskip("rebound", reason="pip install 'scvi-codegen[rebound]'")


@pytest.fixture
def simulation():
    made = rebound.Simulation()
    made.G = 0.5
    for mass, x, vy, vz in [(2.0, 0.0, 0.0, 0.0), (1e-2, 1.0, 1.0, 0.05), (3e-3, -2.2, -0.7, 0.01)]:
        made.add(m=mass, x=x, vy=vy, vz=vz)
    made.t = 3.0
    return made


def positions(simulation) -> np.ndarray:
    return np.array([[particle.x, particle.y, particle.z] for particle in simulation.particles]).ravel()


@pytest.mark.full
@pytest.mark.usefixtures("as_users_compile")
def test_imported_simulation_has_the_trajectory_of_rebound(simulation):
    system, q, velocity, t, units = sc.from_rebound(simulation)
    assert (t, units) == (3.0, {})
    run = sc.compile_stepper(system, "svi:8").integrate(q, velocity=velocity, h=0.05, steps=1000, t=t)
    simulation.integrate(53.0)
    assert np.abs(run.q[-1] - positions(simulation)).max() < 1e-11
    assert np.abs(run.q[-1] - q).max() > 0.1


@pytest.mark.full
@pytest.mark.usefixtures("as_users_compile")
def test_exported_outer_solar_system_has_the_trajectory_in_rebound():
    outer = sc.problem("outer-solar-system")
    run = sc.compile_stepper(outer.system, "svi:8").integrate(outer.q, velocity=outer.velocity, h=100.0, steps=200)
    simulation = sc.to_rebound(outer.system, outer.q, velocity=outer.velocity)
    simulation.integrate(20_000.0)
    assert np.abs(run.q[-1] - positions(simulation)).max() < 1e-12 * np.abs(run.q).max()


def test_export_and_import_are_bitwise_inverse(simulation):
    bodies = sc.from_rebound(simulation)
    back = sc.from_rebound(sc.to_rebound(bodies.system, bodies.q, velocity=bodies.velocity, t=bodies.t))
    assert back.q.tobytes() == bodies.q.tobytes()
    assert back.velocity.tobytes() == bodies.velocity.tobytes()
    assert back.t == bodies.t
    assert list(back.system.defaults) == pytest.approx(list(bodies.system.defaults), rel=1e-13)


def test_units_are_those_of_the_simulation(simulation):
    named = rebound.Simulation()
    named.units = ("AU", "yr", "Msun")
    named.add(m=1.0)
    named.add(m=1e-3, x=1.0, vy=6.28)
    bodies = sc.from_rebound(named)
    assert bodies.units == {"length": "au", "time": "yr", "mass": "msun"}
    assert bodies.system.defaults[0] == pytest.approx(4 * np.pi**2, rel=1e-4)


def test_energies_agree_in_two_axes_and_by_other_names():
    pair = sc.LagrangianSystem.from_text(
        name="pair",
        coordinates=["a", "b", "c", "d"],
        lagrangian="M*(a_dot**2 + b_dot**2)/2 + (c_dot**2 + d_dot**2)/4 + k*M/sqrt((a - c)**2 + (b - d)**2)",
        parameters={"M": 2.0, "k": 0.75},
    )
    simulation = sc.to_rebound(pair, [0.0, 0.5, 1.0, 0.0], velocity=[0.0, 0.0, 0.2, 1.0])
    assert [particle.m for particle in simulation.particles] == pytest.approx([2.0, 0.5], rel=1e-13)
    assert pytest.approx(1.5, rel=1e-12) == simulation.G
    assert simulation.energy() == pytest.approx(0.25 * (0.04 + 1.0) - 1.5 / 1.25**0.5, rel=1e-12)


ODDITIES = {
    "softening": lambda made: setattr(made, "softening", 0.1),
    "collision": lambda made: setattr(made, "collision", "direct"),
    "boundary": lambda made: (setattr(made, "root_size", 10.0), setattr(made, "boundary", "periodic")),
    "without mass": lambda made: made.add(x=5.0),
    "variational": lambda made: made.add_variation(),
    "additional forces": lambda made: setattr(made, "additional_forces", lambda pointer: None),
}


@pytest.mark.parametrize("oddity", ODDITIES)
def test_non_gravitational_forces_are_rejected_by_name(simulation, oddity):
    ODDITIES[oddity](simulation)
    with pytest.raises(SystemDefinitionError, match=f"this simulation has .*{oddity}"):
        sc.from_rebound(simulation)


@pytest.mark.parametrize("name", ["kepler", "double-pendulum", "fput-chain", "henon-heiles", "driven-duffing"])
def test_systems_other_than_n_body_are_rejected(sample, name):
    system = sample(name).system
    with pytest.raises(SystemDefinitionError, match="is not a system of bodies"):
        sc.to_rebound(system, [0.0] * system.dimension, velocity=[0.0] * system.dimension)


def test_incompatible_states_are_rejected(simulation):
    bodies = sc.from_rebound(simulation)
    with pytest.raises(StateError, match="q must have 9 entries, 3 a body"):
        sc.to_rebound(bodies.system, bodies.q[:6], velocity=bodies.velocity)
