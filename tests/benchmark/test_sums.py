"""The benchmark of array systems: all contenders compute the same motion, and measurements are reported."""

import numpy as np
import pytest

from scvi_codegen import benchmark as bench
from scvi_codegen.benchmark import array_systems, energies, lattices
from scvi_codegen.benchmark.cases.large import atoms, bodies, field, ring
from scvi_codegen.benchmark.lattices import PLATFORMS
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.methods import Composition

QUICK = bench.Plan(quick=True, peers=())


def quiet(text):
    """Says nothing."""


@pytest.mark.parametrize("lattice", [ring(8, 1.0), field(6, 0.2)], ids=lambda lattice: lattice.name)
def test_lattices_by_hand_move_as_generated_ones(lattice):
    steps = 10
    by_hand, ours = (
        prepare(0)()
        for prepare in (lattices._by_hand(lattice, 8, steps), lattices._ours(lattice, Composition(8), steps))
    )
    assert np.abs(by_hand - ours).max() < 1e-14
    assert np.abs(ours - lattice.q).max() > 0.01


@pytest.mark.parametrize(
    "each",
    [ring(8, 1.0), field(5, 1.0), atoms(1, 1.0), bodies(4, 1.0)],
    ids=lambda each: each.name,
)
def test_accelerations_by_numpy_are_those_of_the_formula(each):
    """Compare with one step of leapfrog."""
    h, given = 1e-3, {"parameters": each.parameters, "tables": each.tables}
    run = compile_stepper(each.system, "stoermer-verlet").integrate(each.q, velocity=each.v, h=h, steps=1, **given)
    ((_, q),) = run.q.values()
    ((_, velocity),) = run.velocity.values()
    kick = h / 2 * (each.accelerations(each.q) + each.accelerations(q))
    np.testing.assert_allclose(velocity - each.v, kick, rtol=0, atol=1e-12 * np.abs(kick).max() + 1e-15)


@pytest.mark.parametrize("name", sorted(PLATFORMS))
def test_openmm_makes_the_steps_of_leapfrog(name):
    pytest.importorskip("openmm", reason="needs the extra 'bench'")
    crystal, steps = atoms(1, 0.5), 50
    theirs = lattices.openmm_run(name, crystal, steps)(0)()
    ours = lattices._ours(crystal, "stoermer-verlet", steps)(0)()
    rounding = {"OpenMM_CPU": 1e-5, "OpenMM_double": 1e-13}[name]
    assert np.abs(theirs - ours).max() < rounding
    assert np.abs(ours - crystal.q).max() > 0.1


@pytest.mark.full
def test_rebound_converges_to_the_same_state():
    pytest.importorskip("rebound", reason="needs the extra 'bench'")
    each = bodies(10, 0.5)
    ours, theirs = lattices._ours(each, "svi:8", 32)(0)(), lattices._rebound(each, "ias15", None)(0)()
    assert np.abs(ours - theirs).max() < 1e-14


@pytest.mark.full
def test_array_systems_are_measured_at_equal_error(monkeypatch):
    monkeypatch.setattr(lattices, "lattices", lambda plan: (ring(32, 2.0), bodies(4, 0.5)))
    rows = lattices.run_lattices(QUICK, quiet).rows
    assert [row["error"] for row in rows] == [*lattices.ERRORS, *lattices.ERRORS]
    assert all(row["doubt"] < 1e-13 and row["DOP853"] > 0.0 and row["composition_8"] > 0.0 for row in rows)
    assert "leapfrog_by_hand" in rows[0]
    assert "leapfrog_by_hand" not in rows[-1]


@pytest.mark.full
def test_growth_is_measured(monkeypatch):
    monkeypatch.setattr(array_systems, "GROWTH", (100, 100_000))
    rows = array_systems.run_growth(QUICK, quiet).rows
    assert [row["coordinates"] for row in rows] == [100, 100_000, 256] * 3
    assert all(row["memory_mb"] > before["memory_mb"] for before, row in zip(rows[::3], rows[1::3], strict=True))
    assert all(row["gigabytes_s"] > 0.0 for row in rows)


@pytest.mark.full
def test_threads_are_measured():
    rows = array_systems.run_threads(QUICK, quiet).rows
    assert [row["problem"] for row in rows] == ["ring"] * 2 + ["atoms"] * 2
    assert all(row["one_us"] > 0.0 and row["threads_2"] > 0.0 for row in rows)


@pytest.mark.full
def test_energies_stay_at_rounding():
    rows = energies.run_energies(QUICK, quiet).rows
    assert rows
    for row in rows:
        exact = row["by"].endswith("svi:8")
        assert row["largest"] < 1e-13 if exact else 1e-8 < row["largest"] < 1e-2
