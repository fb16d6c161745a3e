"""Motions at rest, of which errors relative to their size are undefined, and runs beyond their tolerance."""

import math

import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.extras.advice.advice import missed_tolerance


@pytest.mark.rotated
@pytest.mark.parametrize("turns", [0, 1])
def test_motion_at_rest_has_no_advice(turns):
    """Neither at the origin nor elsewhere; an ensemble has advice if a trajectory moves."""
    pendulum = lagrange("pendulum", "a", "a_dot**2/2 + cos(a)")
    q, settings = 2.0 * math.pi * turns, {"span": 5.0, "tolerance": 1e-4}
    with pytest.raises(sc.StateError, match="at rest"):
        sc.advise(pendulum, "svi:4", [q], velocity=[0.0], **settings)
    moving, both = ([q + 1.0], [0.0]), ([[q], [q + 1.0]], [[0.0], [0.0]])
    alone, together = (sc.advise(pendulum, "svi:4", x, velocity=v, **settings) for x, v in (moving, both))
    assert together.member == 1
    assert together.h == alone.h
    with pytest.raises(sc.StateError, match="all 2 trajectories are at rest"):
        sc.advise(pendulum, "svi:4", [[q], [q]], velocity=both[1], **settings)


@pytest.mark.parametrize(("h", "q0"), [(0.25, 0.0), (0.25, 1e6), (0.05, 0.0)])
def test_error_at_the_end_is_that_of_the_exact_solution(h, q0):
    """x = q0 + cos 3t, after 2.1 turns, where the error does not pass through zero; any tolerance below is missed."""
    system = lagrange("oscillator", "x", "x_dot**2/2 - 9*(x - a)**2/2", a=q0)
    stepper, end = sc.compile_stepper(system, "svi:2"), 4.4
    run = stepper.integrate([q0 + 1.0], [0.0], h=h, steps=round(end / h))
    error = float(run.error.relative[-1])
    true = abs(run.q[-1, 0] - q0 - math.cos(3.0 * run.t[-1])) / 2.0
    assert 0.9 * true < error < 3.0 * true + 1e-9
    assert missed_tolerance(run, 1.01 * error) == ""
    assert missed_tolerance(run, 0.99 * error).startswith(f"the tolerance {0.99 * error:g} is missed: ")
