"""Ensembles as HDF5, Zarr and xarray: what is read back is what was computed, also where some failed."""

from typing import Any

import numpy as np
import pytest
from samples import compile_quickly

import scvi_codegen as sc

pytestmark = pytest.mark.usefixtures("here")


@pytest.fixture(scope="module", autouse=True)
def xarray() -> Any:
    """Import the libraries in this module's tests alone: that takes longer than collecting them."""
    pytest.importorskip("h5netcdf")
    pytest.importorskip("zarr")
    return pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def ensemble() -> sc.EnsembleTrajectory:
    """Three orbits about three masses, the last into the centre, which fails."""
    stepper = compile_quickly(sc.problem("kepler").system, sc.SVI(2))
    q, p = np.array([[1.0, 0.0], [0.8, 0.1], [0.5, 0.0]]), np.array([[0.0, 1.0], [0.1, 1.2], [0.0, 0.0]])
    return stepper.integrate_ensemble(q, p, h=0.05, steps=60, save_every=3, parameters={"mu": [1.0, 1.1, 1.2]})


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", ["a.h5", "a.nc", "a.zarr"])
def test_files_are_read_by_xarray(xarray, ensemble, tmp_path, name):
    path = tmp_path / name
    for _ in range(2):  # the second replaces the first
        ensemble.save(path, units={"t": "s", "q": "m"})
    opened = xarray.open_zarr(path) if name.endswith("zarr") else xarray.open_dataset(path)
    with opened as dataset:
        xarray.testing.assert_equal(dataset.load(), ensemble.to_xarray())
        assert dataset.velocity.attrs["units"] == "m s-1"
        assert dataset.attrs["method"] == ensemble.stepper.interface.method


@pytest.mark.second
def test_failed_trajectory_is_nan_after_its_failure(ensemble):
    assert not ensemble.ok[2]
    dataset = ensemble.to_xarray()
    lost = np.isnan(dataset.q[:, 2, 0].values)
    assert 0 < lost.sum() < len(lost)
    for name in ("energy", "velocity", "momentum_map"):
        values = dataset[name][:, 2].values.reshape(len(lost), -1)
        np.testing.assert_array_equal(np.isnan(values).all(axis=1), lost)
    assert list(dataset.status.values) == list(ensemble.status)
