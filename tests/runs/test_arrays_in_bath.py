"""Arrays of run-time sizes in a heat bath: equal to named coordinates, temperatures, bits."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import scvi_codegen as sc

CHAIN = {
    "name": "warm_chain",
    "coordinates": ["q[N]"],
    "parameters": {"m[N]": 1.0, "c[N]": 1.0, "kT": 0.7, "gamma": 0.3},
    "lagrangian": "sum(i in N, m[i]*q_dot[i]**2/2 - q[i]**2/4) - sum(i in N-1, (q[i+1] - q[i])**2/2)",
    "dissipation": "sum(i in N, c[i]*q_dot[i]**2/2)",
    "damping": "gamma",
    "temperature": "kT",
}
VALUES = {"m": np.array([1.0, 2.0, 0.5, 1.0]), "c": np.array([0.0, 1.0, 0.2, 3.0])}
VALUES_AND_KT = {"m[N]": 1.0, "c[N]": 1.0, "kT": 0.7}
START = np.array([0.1, -0.2, 0.3, 0.4])


@pytest.mark.second
@pytest.mark.parametrize("method", ["stoermer-verlet", "svi:2"])
def test_motion_is_that_of_named_coordinates(method):
    """The same normal numbers: positions, momenta and heat differ by rounding errors and tolerances."""
    chain = sc.LagrangianSystem.from_text(**CHAIN)
    settings = {"h": 0.2, "steps": 200, "seed": 11}
    run = sc.compile_stepper(chain, method).integrate(START, np.zeros(4), **settings, parameters=VALUES)
    entries = {f"{name}_{i}": x for name, values in VALUES.items() for i, x in enumerate(values)}
    named = sc.unroll_sums(chain, {"N": 4})
    exact = sc.compile_stepper(named, method).integrate(START, np.zeros(4), **settings, parameters=entries)
    assert_allclose(run.p["q"], np.asarray(exact.p), atol=1e-9)
    assert run.heat() == pytest.approx(exact.heat(), abs=1e-9)
    assert not run.momentum_maps().size


RODS = {"constraints": ["sum(a in 2, (r[i+1, a] - r[i, a])**2) = 1 for i in N-1"], "temperature": "kT"}


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("further", "parts"), [(RODS, (5 / 8, 5 / 8)), ({"temperature": "kT*(1 + t/10)"}, (1.45, 1.95))]
)
def test_arrays_with_rods_and_with_a_temperature_of_time(further, parts):
    """Five of eight momenta are free; kT(t) is that of the time at slow heating. Within four standard errors."""
    potential = "sum(i in N, sum(a in 2, r_dot[i, a]**2))/2 - sum(i in N, sum(a in 2, r[i, a]**2))/2"
    arguments = {"coordinates": ["r[N, 2]"], "lagrangian": potential, "parameters": {"kT": 1.0}, "damping": 1.0}
    system, q = sc.LagrangianSystem.from_text(name="beads", **arguments, **further), np.zeros((400, 4, 2))
    q[:, :, 0] = np.arange(4)
    runs = sc.compile_stepper(system, "svi:1").integrate_ensemble(q, 0 * q, h=0.1, steps=100, save_every=50, seed=1)
    squares = (runs.p.reshape(3, 400, 8) ** 2).mean(axis=2)[1:]
    assert (np.abs(squares.mean(axis=1) - parts) < 4 * squares.std(axis=1) / 20).all()


@pytest.mark.second
def test_other_baths_are_compiled_for_the_sizes_of_a_call():
    """Dashpots between neighbours, and a temperature that varies in time: friction does not act on p_1 + .. + p_N."""
    dissipation = "sum(i in N-1, c[i]*(q_dot[i+1] - q_dot[i])**2/2)"
    free = "sum(i in N, m[i]*q_dot[i]**2/2) - sum(i in N-1, (q[i+1] - q[i])**2/2)"
    changed = {"dissipation": dissipation, "temperature": "kT*(1 + t)", "damping": 0, "lagrangian": free}
    chain = sc.LagrangianSystem.from_text(**{**CHAIN, **changed, "name": "dashpots", "parameters": VALUES_AND_KT})
    run = sc.compile_stepper(chain, "svi:1").integrate(START, np.ones(4), h=0.1, steps=200)
    assert_allclose(run.p["q"].sum(axis=1), 4.0, atol=1e-10)
    assert np.ptp(run.p["q"][-1]) > 0.1
