"""Adaptive steps start at rest and at zero, and are as accurate for light bodies as for heavy ones."""

import numpy as np
import pytest
from notation import lagrange
from scipy.spatial.transform import Rotation

import scvi_codegen as sc


def compiled(lagrangian, coordinates, method="svi:8", **parameters):
    system = sc.LagrangianSystem.from_text("moved", coordinates, lagrangian, parameters=parameters or None)
    return sc.compile_stepper(system, method)


CHAIN = "(a_dot**2 + b_dot**2 + d_dot**2)/2 - 10*((a - t**3)**2 + (b - a)**2 + (d - b)**2)"


@pytest.mark.rotated
@pytest.mark.parametrize("method", ["svi:2", "svi:4", "svi:8"])
def test_chain_at_rest_follows_a_force_that_grows_as_a_power_of_time(method):
    """Each displacement is a power of t beyond the degree, with a large error relative to itself at any step size."""
    run = compiled(CHAIN, ["a", "b", "d"], method).integrate([0.0] * 3, [0.0] * 3, t_end=2.0, tolerance=1e-8)
    fine = compiled(CHAIN, ["a", "b", "d"], "svi:12").integrate([0.0] * 3, [0.0] * 3, h=0.02, steps=100)
    assert run.steps < 4000
    assert np.abs(run.q[-1] - fine.q[-1]).max() < 1e-5 * np.abs(fine.q[-1]).max()


@pytest.mark.rotated
def test_light_planet_is_as_accurate_as_a_heavy_one():
    """Both move about a fixed centre; the mass of the second is 1e-9."""
    stepper = compiled(
        "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2) + m*(u_dot**2 + v_dot**2)/2 + m/sqrt(u**2 + v**2)",
        ["x", "y", "u", "v"],
        m=1e-9,
    )
    run = stepper.integrate([1.0, 0, 0.01, 0], velocity=[0, 1.0, 0, 10.0], t_end=0.2, tolerance=1e-9)
    angles = 1000 * run.t
    assert np.abs(run.q[:, 2] - 0.01 * np.cos(angles)).max() < 1e-6 * 0.01


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_turning_points_are_reached_by_short_steps(solver: str) -> None:
    """Velocities are forgotten with time: steps of a low order near a turning point do not shrink with the velocity."""
    system = sc.LagrangianSystem.from_text("pendulum", ["x"], "x_dot**2/2 + cos(x)")
    run = sc.compile_stepper(system, "svi:3", solver=solver).integrate([1.2], velocity=[0.1], t_end=5.0)
    assert len(run.t) < 3000


@pytest.mark.second
def test_steps_of_a_body_do_not_depend_on_the_reference_attitude():
    """A body that falls from rest, in two frames of space: at the reference attitude, components of its quaternion turn
    by far less than the body, which is to be accurate as a whole."""
    kinetic = "(I1*omega_1**2 + I2*omega_2**2 + I3*omega_3**2)/2"
    text = f"{kinetic} - g1*R_13 - g2*R_23 - g3*R_33"
    body = lagrange(
        "body in a field", (), text, rotations={"R": "omega"}, I1=1.0, I2=2.0, I3=3.0, g1=0.1, g2=0.0, g3=1.0
    )
    stepper = sc.compile_stepper(body, "svi:4")
    start, turned = np.eye(3), Rotation.from_euler("xyz", [0.7, 0.8, 0.9]).as_matrix()
    runs = [
        stepper.integrate(
            {"R": frame @ start},
            velocity={"omega": [0.0, 0.0, 0.0]},
            t_end=2.0,
            tolerance=1e-8,
            parameters=dict(zip(("g1", "g2", "g3"), frame @ [0.1, 0.0, 1.0], strict=True)),
        )
        for frame in (start, turned)
    ]
    first, second = (run.rotation("R")[-1] for run in runs)
    assert abs(turned @ first - second).max() < 1e-10
    assert len(runs[0]) < 1.6 * len(runs[1])
