"""Attitudes at any time, and as named quantities of tables and files."""

from __future__ import annotations

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

TOP = lagrange(
    "top on a spring beside a pendulum",
    "x",
    "x_dot**2/2 - x**2/2 + (omega_1**2 + 2*omega_2**2 + omega_3**2/2)/2 - x*R_33"
    " + (n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - n_3",
    rotations={"R": "omega"},
    directions=["n"],
)
Q = {"x": 0, "n": [1, 0, 0], "R": {"euler": "zxz", "angles": [0.3, 0.8, -0.4]}}
V = {"x": 1, "n": [0, 0.2, 0], "omega": [0.7, -0.4, 2.5]}
VECTORS = ("omega", "p_R", "n", "n_dot")


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(TOP, "svi:3", flags=QUICK_FLAGS)


@pytest.fixture(scope="module")
def run(stepper):
    return stepper.integrate(Q, velocity=V, h=0.1, steps=20)


def test_tables_have_matrices_angular_velocities_and_directions_by_name(run, tmp_path):
    pandas = pytest.importorskip("pandas")
    run.save(tmp_path / "run.csv")
    for table in (run.to_dataframe(), pandas.read_csv(tmp_path / "run.csv")):
        entries = table[[f"R_{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)]].to_numpy()
        np.testing.assert_array_equal(entries.reshape(-1, 3, 3), run.rotation())
        np.testing.assert_array_equal(table[["omega_1", "omega_2", "omega_3"]], run.angular_velocity())
        np.testing.assert_array_equal(table[["p_R_1", "p_R_2", "p_R_3"]], run.body_momentum())
        np.testing.assert_array_equal(table[["n_1", "n_2", "n_3"]], run.direction())
    np.testing.assert_allclose(table.loc[0, ["n_1_dot", "n_2_dot", "n_3_dot"]].tolist(), V["n"], rtol=0, atol=1e-15)


def test_quantities_of_states_have_names(stepper, run):
    together = stepper.integrate_ensemble(Q | {"x": [0.0, 0.0]}, velocity=V, h=0.1, steps=20)
    for name, values in {"R": run.rotation(), "omega": run.angular_velocity(), "n": run.direction()}.items():
        np.testing.assert_array_equal(run[name], values)
        np.testing.assert_allclose(together[name][:, 1], values, rtol=0, atol=1e-13)
    np.testing.assert_array_equal(run["x_dot"], run.velocity[:, 0])
    with pytest.raises(sc.StateError, match="there is no quantity 'S' of the states"):
        run["S"]


def test_datasets_have_vectors_with_named_axes(stepper, run):
    pytest.importorskip("xarray")
    data = run.to_xarray()
    assert data["R"].dims == ("t", "space_axis", "body_axis")
    momentum = (data["R"] * data["p_R"]).sum("body_axis")
    np.testing.assert_allclose(momentum.sel(space_axis=3), run.angular_momentum()[:, 2], rtol=0, atol=1e-15)
    np.testing.assert_allclose((data["n"] * data["n_dot"]).sum("space_axis"), 0, rtol=0, atol=1e-15)
    together = stepper.integrate_ensemble(Q | {"x": [0.0, 0.0]}, velocity=V, h=0.1, steps=20).to_xarray()
    for name in VECTORS:
        np.testing.assert_allclose(together[name].isel(trajectory=1), data[name], rtol=0, atol=1e-13)


def test_spins_and_body_momenta_of_a_hamiltonian_are_named():
    pytest.importorskip("pandas")
    system = hamilton(
        "spin in a top", (), "(Pi_1**2 + 2*Pi_2**2 + 3*Pi_3**2)/2 + s_3*R_33 + s_1", rotations={"R": "Pi"}, spins=["s"]
    )
    stepper = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)
    run = stepper.integrate({"R": [1, 0, 0, 0], "s": [0, 0.6, 0.8]}, {"Pi": [1, 2, 3]}, h=0.1, steps=4)
    table = run.to_dataframe()
    np.testing.assert_array_equal(table[["s_1", "s_2", "s_3"]], run.spin())
    np.testing.assert_allclose(table.iloc[0][["Pi_1", "Pi_2", "Pi_3"]], [1, 2, 3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(table.iloc[0][["omega_R_1", "omega_R_2", "omega_R_3"]], [1, 4, 9], rtol=0, atol=1e-13)


def test_attitudes_between_saved_states_are_dense_output(stepper, run):
    np.testing.assert_allclose(run.scipy_rotation(t=run.t[::3]).as_matrix(), run.rotation()[::3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(run.rotation(t=run.t[::3]), run.rotation()[::3], rtol=0, atol=1e-14)
    np.testing.assert_allclose(run.angular_velocity(t=run.t[5]), run.angular_velocity()[5], rtol=0, atol=1e-14)
    middle = stepper.integrate(Q, velocity=V, h=0.05, steps=1)
    for quantity in ("rotation", "quaternion", "body_momentum", "angular_momentum", "direction"):
        between = getattr(run, quantity)(t=0.05)
        np.testing.assert_allclose(between, getattr(middle, quantity)()[-1], rtol=0, atol=1e-13, err_msg=quantity)
    together = stepper.integrate_ensemble(Q | {"x": [0.0, 0.0]}, velocity=V, h=0.1, steps=2)
    with pytest.raises(sc.StateError, match="no dense output"):
        together.rotation(t=0.05)
