"""Largest step of tau for a requested accuracy, and reports of runs that miss it."""

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.runs.driver.largest_step import REFINEMENTS, accuracy_message, largest_step

KEPLER = sc.problem("kepler").system
START: Any = [1.9, 0.0], [0.0, (0.1 / 1.9) ** 0.5]
"""Apocentre of an ellipse of eccentricity 0.9, period 2 pi."""


@cache
def stepper() -> sc.Stepper:
    return sc.compile_stepper(sc.reparametrise(KEPLER, "frequency"), sc.SVI(8))


@pytest.mark.parametrize("tolerance", [0.0, 1e-12, 1e-8])
def test_largest_step_satisfies_the_tolerance_and_a_larger_one_does_not(tolerance: float) -> None:
    h = largest_step(stepper(), *START, 20.0, tolerance)
    assert stepper().integrate(*START, h=h, t_end=20.0).step_error <= (tolerance or 2.0**-53)
    try:
        longer = stepper().integrate(*START, h=h * 2 ** (1 / REFINEMENTS), t_end=20.0).step_error
    except sc.StepFailedError:  # the equations of a longer step are not solved
        longer = np.inf
    assert longer > (tolerance or 2.0**-53)
    assert largest_step(stepper(), *START, -20.0, tolerance) == pytest.approx(-h)


def test_largest_step_is_accurate_to_round_off_after_many_orbits() -> None:
    """Beside Kepler's ellipse, which closes."""
    h = largest_step(stepper(), *START, 100.0)
    run = stepper().integrate(*START, h=h, t_end=40 * np.pi)
    assert len(run) < 20 * 35
    assert np.abs(run.q[-1] - START[0]).max() < 2e-11
    assert np.ptp(run.energy()) < 1e-13


@pytest.mark.second
def test_steps_from_rest_are_as_long_as_those_of_a_motion() -> None:
    """The first short step from rest is its own curvature, relative to which svi:2 has an error at any step."""
    system = sc.LagrangianSystem.from_text("vibration", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")
    vibration = sc.compile_stepper(system, "svi:2", time_transformation="1/(1 + q**2)")
    lengths = [largest_step(vibration, [0.3], [p], 0.3, 1e-10) for p in (0.0, 0.2)]
    assert 0.25 < lengths[0] / lengths[1] < 1
    run = vibration.integrate([0.3], [0.0], t_end=0.3, error=1e-6)
    assert len(run) < 300
    assert abs(run.q[-1, 0] - 0.3 * math.cos(0.3)) < 1e-12


def test_invalid_tolerances_are_reported() -> None:
    assert accuracy_message(9e-16, 1.0, 0.0) is None
    assert accuracy_message(float("nan"), 1.0, 0.0) is not None
    message = accuracy_message(1e-3, 1.5, 1e-9)
    assert message is not None
    assert "t = 1.5" in message
    assert "1.0e-03, but 1.0e-09 was requested" in message


@pytest.mark.rotated
def test_systems_without_a_largest_step_are_rejected() -> None:
    for span, tolerance in ((0.0, 1e-9), (1.0, 1.0), (1.0, -1.0)):
        with pytest.raises(sc.StateError, match=r"span = \S+ must not be 0, and tolerance"):
            largest_step(stepper(), *START, span, tolerance)
    verlet = sc.compile_stepper(sc.reparametrise(KEPLER, "frequency"), sc.StoermerVerlet())
    if np.isnan(verlet.integrate(*START, h=0.1, steps=3).step_error):
        with pytest.raises(sc.MethodError, match="no error estimate: give h"):
            largest_step(verlet, *START, 1.0, 1e-3)
