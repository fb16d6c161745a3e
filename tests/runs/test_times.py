"""Compensated time: t + n h to the last bit, in runs, ensembles and the arithmetic of the test."""

import math
from fractions import Fraction

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.runs.states.times import steps_within, times_after

pytestmark = pytest.mark.usefixtures("as_users_compile")

GRIDS = [(0.0, 0.1), (1e6, 0.1), (-3.7, 1e-3), (0.3, -0.7), (1e-3, 2.0**-20), (1e16, 3.0), (5.0, 1e-17)]


@pytest.fixture(scope="module")
def free() -> sc.Stepper:
    system = sc.LagrangianSystem.from_text(name="free fall", coordinates=["q"], lagrangian="q_dot**2/2 - q")
    return sc.compile_stepper(system, sc.SVI(2), flags=PORTABLE_FLAGS)


def in_last_places(time: float, t: float, h: float, n: int) -> float:
    """Return the distance of a time from t + n h, in units of the last place."""
    return float(abs(Fraction(time) - (Fraction(t) + n * Fraction(h))) / Fraction(math.ulp(time)))


@pytest.mark.rotated
def test_time_is_the_rounded_sum_after_a_million_steps(free):
    run = free.start([0.0], [0.0], h=0.1, t=0.7)
    run.advance(1_000_000)
    assert in_last_places(run.t, 0.7, 0.1, 1_000_000) <= 0.5 + 1e-9


@pytest.mark.parametrize(("t", "h"), GRIDS)
def test_times_are_rounded_with_compensation(t, h):
    numbers = np.array([0, 1, 2, 3, 1000, 10**9 + 7, 2**53 - 1])
    for n, high, low in zip(numbers.tolist(), *times_after(t, h, numbers), strict=True):
        assert in_last_places(high, t, h, n) <= 0.5 + 1e-9
        wrong = abs(Fraction(high) + Fraction(low) - Fraction(t) - n * Fraction(h))
        assert wrong <= Fraction(math.ulp(high)) / 2**50


@pytest.mark.rotated
def test_states_store_the_following_step_size(free):
    run = free.integrate([0.1], [0.0], h=0.25, steps=8, save_every=2)
    assert run.step_sizes.tolist() == [0.25] * 5
    between = free.integrate([0.1], [0.0], h=0.25, steps=8, t_eval=[0.0, 0.3, 0.5])
    assert np.array_equal(between.step_sizes, [0.25, np.nan, 0.25], equal_nan=True)
    ended = free.integrate([0.1], [0.0], h=0.25, steps=8, events="q")
    assert ended.step_sizes[-1] == 0.25


def test_spans_are_divided_into_equal_steps_below_the_maximum():
    assert steps_within([0.3, 0.30001, 1e-9, 0.1], 0.1).tolist() == [3, 4, 1, 1]
    assert steps_within([2.1, 5.4], -0.3).tolist() == [7, 18]  # the quotients are more, by rounding alone
    with pytest.raises(sc.StateError, match=r"h = 1e-12 requires 1e\+12 steps"):
        steps_within(1.0, 1e-12)
    with pytest.raises(sc.StateError, match="requires inf steps"):
        steps_within(1e300, 1e-300)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("t", "h", "t_end"), [(0.0, 0.1, 0.35), (1e16, 3.0, 1e16 + 8)])
def test_runs_backward_end_as_those_forward(free, t, h, t_end):
    """The third step of 3 from 1e16 ends beyond 1e16 + 8, which is its end when rounded: it is shortened."""
    forward = free.integrate([0.1], [0.2], t=t, h=h, t_end=t_end)
    backward = free.integrate([0.1], [-0.2], t=-t, h=-h, t_end=-t_end)
    for name, sign in (("t", -1), ("q", 1), ("p", -1), ("step_sizes", -1)):
        np.testing.assert_array_equal(getattr(backward, name), sign * getattr(forward, name))
    assert (backward.steps, backward.t[-1]) == (forward.steps, -t_end)
    assert (forward.step_sizes[:-1] > 0.0).all()
