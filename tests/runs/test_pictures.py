"""Plots and animations of rotations, directions and spins."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.extras.pictures.animation import positions_of

pytest.importorskip("matplotlib")

pytestmark = pytest.mark.rotated


@pytest.fixture(scope="module")
def run():
    text = (
        "(x_dot**2 + y_dot**2 + z_dot**2)/2 + (omega_1**2 + omega_2**2 + omega_3**2/2)/2 - R_33"
        " + (n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - n_3"
    )
    system = lagrange("top beside a pendulum", "x y z", text, rotations={"R": "omega"}, directions=["n"])
    return sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS).integrate(
        {"x": 1, "y": 0, "z": 0, "R": {"axis": [1, 0, 0], "angle": 0.6}, "n": [1, 0, 0]},
        velocity={"x": 0.1, "y": 0, "z": 0.2, "omega": [0, 0, 6], "n": [0, 0.3, 0]},
        h=0.05,
        steps=20,
    )


def test_paths_of_a_body_axis_and_a_direction_are_drawn_on_the_sphere(run, tmp_path):
    axes = run.plot.attitude(tmp_path / "attitude.svg", axis=1)
    curves = {line.get_label(): np.array(line.get_data_3d()).T for line in axes.lines}
    np.testing.assert_array_equal(curves["axis 1 of R"], run.rotation()[:, :, 0])
    np.testing.assert_allclose(curves["n"], run.direction(), rtol=0, atol=1e-15)
    assert (tmp_path / "attitude.svg").stat().st_size > 1000
    with pytest.raises(sc.StateError, match="axis must be 1, 2 or 3, not 4"):
        run.plot.attitude(axis=4)
    pendulum = sc.compile_stepper(sc.problem("planar-pendulum").system, "svi:1", flags=QUICK_FLAGS)
    with pytest.raises(sc.StateError, match="has no rotation, direction or spin"):
        sc.plot_attitude(pendulum.integrate([0.0], [1.0], h=0.1, steps=2), tmp_path / "none.png")


def test_an_animation_moves_and_turns_with_the_body(run):
    film = run.animate(seconds=0.2)
    centre, *axes, base, tip = np.moveaxis(positions_of(film.shapes[0], film.shown[0]), 1, 0)
    np.testing.assert_array_equal(centre, run.q[:, :3])
    np.testing.assert_array_equal(base, centre)
    turned = np.stack(axes, axis=2) - centre[:, :, np.newaxis]
    np.testing.assert_allclose(turned, run.rotation(), rtol=0, atol=1e-15)
    np.testing.assert_allclose(tip, centre + run.direction(), rtol=0, atol=1e-15)
