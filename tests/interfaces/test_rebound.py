"""Bodies to REBOUND and from it: with an object in place of a simulation, and, where it is installed, its IAS15."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.errors import StateError, SystemDefinitionError

UNITS = {"length": "au", "mass": "msun", "time": "yr"}


class Simulation(SimpleNamespace):
    """The attributes of ``rebound.Simulation`` that conversions read and set."""

    def __init__(self) -> None:
        super().__init__(G=1.0, t=0.0, particles=[], softening=0.0, gravity="basic", boundary="none", collision="none")
        self.N_var, self.N_active, self.testparticle_type, self._additional_forces = 0, -1, 0, None
        self._units = dict.fromkeys(UNITS)

    @property
    def N(self) -> int:
        return len(self.particles)

    @property
    def units(self):
        return self._units

    @units.setter
    def units(self, names) -> None:
        self.G, self._units = 4 * np.pi**2, dict(zip(("length", "time", "mass"), names, strict=True))

    def add(self, **state: float) -> None:
        at_rest = dict.fromkeys(("x", "y", "z", "vx", "vy", "vz"), 0.0)
        self.particles.append(SimpleNamespace(**at_rest | state))


@pytest.fixture
def fake(monkeypatch):
    module = ModuleType("rebound")
    module.Simulation = Simulation
    monkeypatch.setitem(sys.modules, "rebound", module)
    made = Simulation()
    made.add(m=1.0)
    made.add(m=1e-3, x=1.0, vy=6.28)
    made.add(m=1e-4, x=2.0, vy=4.4)
    return made


@pytest.mark.parametrize(
    ("name", "value"),
    [("N_active", 1), ("N_active", 0), ("_post_timestep_modifications", print), ("_pre_timestep_modifications", print)],
)
@pytest.mark.parametrize("kind", [0, 1])
def test_features_without_counterpart_are_refused_by_name(fake, name, value, kind):
    setattr(fake, name, value)
    fake.testparticle_type = kind
    with pytest.raises(SystemDefinitionError, match=f"this simulation has {name.lstrip('_')}"):
        sc.from_rebound(fake)


@pytest.mark.parametrize("active", [-1, 3])
def test_simulations_whose_bodies_all_attract_are_accepted(fake, active):
    fake.N_active, fake.testparticle_type = active, 1
    assert sc.from_rebound(fake).system.dimension == 9


def test_conversion_there_and_back_preserves_state_time_and_units(fake):
    fake.units, fake.t = ("au", "yr", "msun"), 2.5
    bodies = sc.from_rebound(fake)
    back = sc.from_rebound(sc.to_rebound(bodies))
    assert back.units == bodies.units == UNITS
    assert back.t == 2.5
    assert np.array_equal(back.q, bodies.q)
    assert np.array_equal(back.velocity, bodies.velocity)
    assert list(back.system.defaults) == pytest.approx(list(bodies.system.defaults), rel=1e-13)
    with pytest.raises(StateError, match="omit q, velocity, t and units"):
        sc.to_rebound(bodies, t=1.0)
    with pytest.raises(StateError, match="give q and velocity"):
        sc.to_rebound(bodies.system)
    with pytest.raises(StateError, match="units must name length, time, mass"):
        sc.to_rebound(bodies.system, bodies.q, velocity=bodies.velocity, units={"length": "au"})


@pytest.mark.parametrize("name", ["kepler", "double-pendulum", "fput-chain", "henon-heiles", "driven-duffing"])
def test_systems_other_than_n_body_are_rejected(sample, name, fake):
    system = sample(name).system
    with pytest.raises(SystemDefinitionError, match="is not a system of bodies"):
        sc.to_rebound(system, [0.0] * system.dimension, velocity=[0.0] * system.dimension)


@pytest.fixture
def rebound():
    return pytest.importorskip("rebound", reason="pip install 'scvi-codegen[rebound]'")


@pytest.fixture
def simulation(rebound):
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
