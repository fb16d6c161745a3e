"""Adaptive steps depend neither on the origin nor on the unit of coordinates, and start at rest and at zero."""

import math

import numpy as np
import pytest

import scvi_codegen as sc


def compiled(lagrangian, coordinates, method="svi:8", **parameters):
    system = sc.LagrangianSystem.from_text("moved", coordinates, lagrangian, parameters=parameters or None)
    return sc.compile_stepper(system, method)


PENDULUM = "a_dot**2/2 + cos(a)"
KEPLER = "(x_dot**2 + y_dot**2)/2 + g/sqrt((x - c)**2 + y**2)"
CHAIN = "(a_dot**2 + b_dot**2 + d_dot**2)/2 - 10*((a - t**3)**2 + (b - a)**2 + (d - b)**2)"


@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_windings_of_an_angle_change_neither_steps_nor_errors(method):
    stepper = compiled(PENDULUM, ["a"], method)
    runs = [stepper.integrate([1 + 2 * math.pi * k], [0.0], t_end=50.0, tolerance=1e-8) for k in (0, 10, 1000, 100_000)]
    ends = [run.q[-1, 0] - 2 * math.pi * k for run, k in zip(runs, (0, 10, 1000, 100_000), strict=True)]
    assert max(run.steps for run in runs) <= 1.1 * min(run.steps for run in runs)
    assert np.ptp(ends) < 1e-6


@pytest.mark.parametrize("method", ["svi:2", "svi:4", "svi:8"])
def test_chain_at_rest_follows_a_force_that_grows_as_a_power_of_time(method):
    """Each displacement is a power of t beyond the degree, with a large error relative to itself at any step size."""
    run = compiled(CHAIN, ["a", "b", "d"], method).integrate([0.0] * 3, [0.0] * 3, t_end=2.0, tolerance=1e-8)
    fine = compiled(CHAIN, ["a", "b", "d"], "svi:12").integrate([0.0] * 3, [0.0] * 3, h=0.02, steps=100)
    assert run.steps < 4000
    assert np.abs(run.q[-1] - fine.q[-1]).max() < 1e-5 * np.abs(fine.q[-1]).max()


def test_ellipse_of_small_pericentre_far_from_the_origin():
    """What is known beyond the rounding of the shift: e = .9999, shifted by 100."""
    stepper, e, errors = compiled(KEPLER, ["x", "y"], "svi:8", c=0.0, g=1.0), 0.9999, []
    for shift in (0.0, 100.0):
        run = stepper.integrate(
            [1 - e + shift, 0.0],
            [0.0, math.sqrt((1 + e) / (1 - e))],
            t_end=3.0,
            tolerance=1e-12,
            parameters={"c": shift},
            check_growth=False,
        )
        errors.append(abs(run.energy()[-1] / run.energy()[0] - 1))
        assert run.steps < 400
    assert errors[0] < 1e-8
    assert errors[1] < 1e-4  # rounding of the shift relative to the pericentre, 1e-14 / 1e-4, times the growth


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


def test_absolute_tolerance_of_a_coordinate_takes_fewer_steps():
    stepper = compiled("(x_dot**2 + z_dot**2)/2 - x**2/2 - 300*z**2/2", ["x", "z"])
    own, other = (
        stepper.integrate([1.0, 1e-9], [0.0, 0.0], t_end=10.0, tolerance=1e-9, **options)
        for options in ({}, {"absolute_tolerance": {"z": 1e-3}})
    )
    assert other.steps < 0.7 * own.steps
    assert other.q[-1, 0] == pytest.approx(math.cos(10.0), abs=1e-7)


@pytest.mark.parametrize("method", ["svi:4", "svi:6", "svi:8"])
def test_tiny_vibrations_far_from_the_origin(method: str) -> None:
    """The rounding of x = 1000 in the force, 1e-6 of it, is no error of the step."""
    system = sc.LagrangianSystem.from_text("far", ["x"], "x_dot**2/2 - (x - 1000)**2/2")
    stepper = sc.compile_stepper(system, method)
    steps = [len(stepper.integrate([1000 + a], velocity=[0.0], t_end=6.0).t) for a in (1e-7, 1e-5, 1.0)]
    assert max(steps) <= steps[-1] + 4


@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_turning_points_are_reached_by_short_steps(solver: str) -> None:
    """Velocities are forgotten with time: steps of a low order near a turning point do not shrink with the velocity."""
    system = sc.LagrangianSystem.from_text("pendulum", ["x"], "x_dot**2/2 + cos(x)")
    run = sc.compile_stepper(system, "svi:3", solver=solver).integrate([1.2], velocity=[0.1], t_end=5.0)
    assert len(run.t) < 3000
