"""Iterations between saved states, and the solve_ivp-like call; dense output: tests/motions."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp as scipy_solve_ivp

import scvi_codegen as sc

FLAGS = ("-O0",)
E = 0.3
START = {"q": [1 - E, 0.0], "p": [0.0, math.sqrt((1 + E) / (1 - E))]}


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(4), flags=FLAGS)


@pytest.mark.second
def test_solve_ivp_agrees_with_scipy():
    """Arguments, attributes and shapes are equal; pendulum from rest at 2, four turning points."""
    asked = np.linspace(0, 10, 33)
    system = sc.problem("planar-pendulum").system
    ours = sc.solve_ivp(
        system,
        (0, 10),
        [2.0, 0.0],
        t_eval=asked,
        dense_output=True,
        events=["q", sc.Event("p_q", 1)],
        args={"g": 1.0, "m": 1.0, "l": 1.0},
    )

    def angle(t, y):
        return y[0]

    def turning(t, y):
        return y[1]

    turning.direction = 1
    theirs = scipy_solve_ivp(
        lambda t, y: [y[1], -math.sin(y[0])],
        (0, 10),
        [2.0, 0.0],
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
        t_eval=asked,
        dense_output=True,
        events=[angle, turning],
    )
    assert (ours.status, ours.success) == (theirs.status, theirs.success) == (0, True)
    assert np.array_equal(ours.t, theirs.t)
    assert ours.y.shape == theirs.y.shape
    assert np.abs(ours.y - theirs.y).max() < 1e-9
    assert ours.sol(3.3).shape == theirs.sol(3.3).shape
    assert np.abs(ours.sol(asked + 0.0) - theirs.sol(asked)).max() < 1e-6
    theirs_turning = theirs.t_events[1][theirs.t_events[1] > 0]  # SciPy counts the root at the start
    assert np.abs(ours.t_events[0] - theirs.t_events[0]).max() < 1e-9
    assert np.abs(ours.t_events[1] - theirs_turning).max() < 1e-9
    assert ours.y_events[0].shape == theirs.y_events[0].shape


def test_solve_ivp_ends_at_a_terminal_event(kepler):
    half = sc.solve_ivp(kepler, (0, 100), [*START["q"], *START["p"]], events=sc.Event("q2", -1, terminal=True))
    assert (half.status, half.success) == (1, True)
    assert "'q2'" in half.message
    assert half.t[-1] == pytest.approx(math.pi, abs=1e-8)
    assert half.t_events[0].tolist() == [half.t[-1]]
    assert np.array_equal(half.y[:, -1], half.y_events[0][0])
    chosen = sc.solve_ivp(
        kepler,
        (0, 100),
        [*START["q"], *START["p"]],
        events=sc.Event("q2", -1, terminal=True),
        t_eval=np.arange(0, 100, 0.5),
        dense_output=True,
    )
    assert np.array_equal(chosen.t, np.arange(0, math.pi, 0.5))
    assert np.array_equal(chosen.sol(half.t[-1]), half.y[:, -1])


@pytest.mark.rotated
def test_solve_ivp_reports_a_failed_step():
    runaway = sc.LagrangianSystem.from_text(name="runaway", coordinates=["q"], lagrangian="q_dot**2/2 + q**3/3")
    failed = sc.solve_ivp(sc.compile_stepper(runaway, sc.SVI(3), flags=FLAGS), (0, 10), [1.0, 1.0])
    assert (failed.status, failed.success) == (-1, False)
    assert "smaller step" in failed.message
    assert failed.y.shape == (2, len(failed.t))


def test_iterations_between_saved_states_are_those_of_the_steps(kepler):
    every = kepler.integrate(**START, h=0.1, steps=60)
    until = every.iterations.cumsum()
    times = np.array([0.0, 0.05, 0.1, 0.3, 0.72, 5.0, 5.99, 6.0])
    last = np.searchsorted(every.t, times, side="right") - 1
    assert np.array_equal(kepler.integrate(**START, h=0.1, steps=60, t_eval=times).iterations.cumsum(), until[last])
    assert np.array_equal(kepler.integrate(**START, h=0.1, steps=60, save_every=7).iterations.cumsum(), until[::7])
