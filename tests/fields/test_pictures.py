"""Pictures and files of fields on meshes."""

import numpy as np
import pytest
from numpy import cos, pi, sin
from samples import QUICK_FLAGS

import scvi_codegen as sc

pytestmark = pytest.mark.second


def run_of(axes, boundary, method, start, *, velocity=None, steps=20, **options):
    density = "u_t**2/2" + "".join(f" - u_{axis}**2/2" for axis in axes)
    field = sc.FieldSystem.from_text("waves", ["u"], dict.fromkeys(axes, (0, 1)), density, boundary=boundary)
    mesh = field.discretise(method, **options)
    u = start(*mesh.points.values())
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
    return mesh, stepper.integrate({"u": u}, h=0.01, steps=steps)


def on_a_line(**others):
    elements = {"degree": 5, "elements": [0, 0.3, 0.5, 1]}
    periodic = {"x": "periodic"}
    return run_of("x", periodic, "spectral-elements", lambda x: cos(2 * pi * x), **elements, **others)


def in_the_plane(**others):
    boundary = {"x": (0, 0), "y": "periodic"}
    size = {"degree": 4, "elements": {"x": 2, "y": 3}}
    wave = lambda x, y: sin(pi * x) * sin(2 * pi * y)  # noqa: E731
    return run_of("xy", boundary, "spectral-elements", wave, **size, **others)


@pytest.mark.rotated
def test_space_time_diagram_and_image_have_the_values_of_the_field(tmp_path):
    _, run = on_a_line()
    ax = run.plot.field(tmp_path / "u.png")
    [image] = [each for each in ax.collections if each.get_array() is not None]
    assert np.asarray(image.get_array()) == pytest.approx(run["u"])
    assert (run["u"] == run.q["u"]).all()
    assert (run["u_dot"] == run.velocity["u"]).all()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x", "t")
    assert (tmp_path / "u.png").stat().st_size > 3000
    mesh, run = in_the_plane()
    ax = run.plot.field(tmp_path / "u.svg", state=0)
    [image] = [each for each in ax.collections if each.get_array() is not None]
    assert np.asarray(image.get_array()) == pytest.approx(run.q["u"][0].T)
    assert ax.get_title() == "t = 0"
    assert mesh.points["y"][0, 0] == 0


@pytest.mark.rotated
def test_dataset_has_the_coordinates_of_the_mesh(tmp_path):
    mesh, run = in_the_plane()
    data = run.to_xarray()
    assert data.u.dims == ("t", "x", "y")
    assert data.u.values == pytest.approx(run.q["u"])
    assert data.x.values == pytest.approx(mesh.points["x"][:, 0])
    assert data.u_t.values == pytest.approx(run.p["u"] / mesh.weights)
    run.save(tmp_path / "run.nc")
    xarray = pytest.importorskip("xarray")
    with xarray.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as again:
        assert again.u.sel(y=0, method="nearest").shape == (21, mesh.weights.shape[0])
    run.save(tmp_path / "run.csv")
    assert len((tmp_path / "run.csv").read_text().split("\n")[0].split(",")) == 3 + 3 * mesh.weights.size


def test_dataset_of_a_hamiltonian_density_has_the_density_of_momenta():
    field = sc.FieldSystem.from_text(
        "q", ["q"], {"x": (0, 1)}, hamiltonian="q_x**2/2 + p**2/2", momenta=["p"], boundary={"x": "periodic"}
    )
    mesh = field.discretise("fourier", points=8)
    x = mesh.points["x"]
    stepper = sc.compile_stepper(mesh.system, "svi:1", flags=QUICK_FLAGS)
    data = stepper.integrate({"q": sin(2 * pi * x)}, p={"q": mesh.weights * x}, h=0.01, steps=1).to_xarray()
    assert data.p_.values[0] == pytest.approx(x)
    assert data.q_.values[0] == pytest.approx(sin(2 * pi * x))
