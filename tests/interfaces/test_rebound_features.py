"""Simulations of REBOUND that are refused, and units, with an object in place of a simulation: REBOUND is optional."""

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
def simulation(monkeypatch):
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
def test_features_without_counterpart_are_refused_by_name(simulation, name, value, kind):
    setattr(simulation, name, value)
    simulation.testparticle_type = kind
    with pytest.raises(SystemDefinitionError, match=f"this simulation has {name.lstrip('_')}"):
        sc.from_rebound(simulation)


@pytest.mark.parametrize("active", [-1, 3])
def test_simulations_whose_bodies_all_attract_are_accepted(simulation, active):
    simulation.N_active, simulation.testparticle_type = active, 1
    assert sc.from_rebound(simulation).system.dimension == 9


def test_conversion_there_and_back_preserves_state_time_and_units(simulation):
    simulation.units, simulation.t = ("au", "yr", "msun"), 2.5
    bodies = sc.from_rebound(simulation)
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
