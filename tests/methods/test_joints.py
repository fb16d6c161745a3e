"""The mechanisms of ``examples/joints.py`` against closed forms, reduced coordinates and the statics of trusses."""

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose

from scvi_codegen import SVI, compile_stepper

JOINTS: Any = SimpleNamespace(**runpy.run_path(str(Path(__file__).parents[2] / "examples" / "joints.py")))
G = JOINTS.GRAVITY
SPAN = 2.0


def ran(mechanism: Any, steps: int = 200) -> Any:
    run = mechanism.run(SPAN, steps)
    assert np.abs(run.constraint_values()[0]).max() < 2e-15 * max(1.0, np.abs(run.q).max())
    return run


def reduced(lagrangian: str, start: list[float], velocity: list[float], t: np.ndarray, **parameters: float) -> Any:
    """(n, m) positions of the same motion in coordinates that need no constraint, by adaptive steps."""
    names = [f"u{k}" for k in range(len(start))]
    system = lagrange("reduced", names, lagrangian, parameters={"g": G, **parameters})
    run = compile_stepper(system, SVI(8)).integrate(start, velocity=velocity, t_end=float(t[-1]))
    return run.at(t)[0]


def test_free_dumbbell_has_uniform_translation_and_rotation():
    run = ran(JOINTS.dumbbell())
    (one, other), t, turning = run.q.reshape(-1, 2, 2).transpose(1, 0, 2), run.t, 2.0 / 0.8
    centre = np.column_stack([0.6 + 2.0 * t, 4.5 * t - G * t**2 / 2])
    assert_allclose(0.25 * one + 0.75 * other, centre, rtol=0, atol=1e-12)
    assert_allclose(other - one, 0.8 * np.column_stack([np.cos(turning * t), np.sin(turning * t)]), rtol=0, atol=1e-9)
    assert_allclose(-2 * 0.8 * run.multipliers()[:, 0], 0.75 * turning**2 * 0.8, rtol=0, atol=1e-9)


@pytest.mark.rotated
def test_a_point_slides_on_its_line():
    run = ran(JOINTS.pendulum_on_a_slide())
    s, f = reduced(
        "2*u0_dot**2/2 + ((u0_dot*cos(w) + l*u1_dot*cos(u1))**2 + (u0_dot*sin(w) + l*u1_dot*sin(u1))**2)/2"
        " - 3*g*u0*sin(w) + g*l*cos(u1)",
        [0.0, np.pi / 2],
        [0.0, 0.0],
        run.t,
        l=0.5,
        w=-0.4,
    ).T
    line = s[:, np.newaxis] * [np.cos(-0.4), np.sin(-0.4)]
    assert_allclose(run.q[:, :2], line, rtol=0, atol=1e-8)
    assert_allclose(run.q[:, 2:], line + 0.5 * np.column_stack([np.sin(f), -np.cos(f)]), rtol=0, atol=1e-8)


@pytest.mark.rotated
def test_welded_bodies_tumble_as_one():
    run = ran(JOINTS.welded_plates())
    (x1, y1, a1, x2, y2, a2), t = run.q.T, run.t
    assert_allclose(a1, 3.0 * t, rtol=0, atol=1e-10)
    assert_allclose(a2, 0.5 + 3.0 * t, rtol=0, atol=1e-10)
    assert_allclose((x1 + 2 * x2) / 3, 1.4 / 3 + t, rtol=0, atol=1e-11)
    assert_allclose((y1 + 2 * y2) / 3, (4.0 + 2 * 6.1) / 3 * t - G * t**2 / 2, rtol=0, atol=1e-11)
    centripetal = 2.0 / 3.0 * 0.7 * 3.0**2
    assert_allclose(np.hypot(*run.multipliers()[:, :2].T), centripetal, rtol=0, atol=1e-8)
    assert_allclose(run.multipliers()[:, 2], 0.0, rtol=0, atol=1e-8)


def by_joints() -> np.ndarray:
    """(17,) pulls from the balance of both components of force at all nine joints: the method of joints at once."""
    places, members, last = JOINTS.PLACES, JOINTS.MEMBERS, JOINTS.BOTTOM[-1]
    balance = np.zeros((len(places), 2, len(members) + 2))
    for column, (a, b) in enumerate(members):
        along = (places[b] - places[a]) / np.hypot(*(places[b] - places[a]))
        balance[a, :, column], balance[b, :, column] = along, -along
    balance[0, 1, -2] = balance[last, 1, -1] = 1.0
    weights = np.array([0.2 + (3.0 if k == 1 else 0.0) for k in JOINTS.LOADS]) * G
    loads = np.column_stack([np.zeros(len(places)), weights])
    pulls, residual, rank, _ = np.linalg.lstsq(balance.reshape(-1, balance.shape[2]), loads.ravel(), rcond=None)
    assert rank == len(pulls)
    assert residual[0] < 1e-20
    return pulls


@pytest.mark.second
def test_member_forces_of_a_bridge_equal_the_method_of_joints():
    run = JOINTS.bridge().run(0.1, 1, "svi:1")
    pulls = JOINTS.pulls(run)
    assert np.abs(run.q - run.q[0]).max() < 1e-13
    assert_allclose(pulls, [by_joints()] * 2, rtol=0, atol=1e-10)
    left = (9 * 0.2 / 2 + 3.0 * 0.75) * G
    assert_allclose(pulls[0, -2:], [left, (9 * 0.2 + 3.0) * G - left], rtol=0, atol=1e-10)
    moment = left - 0.2 * G - 0.2 * G * 0.5
    top = JOINTS.MEMBERS.index((5, 6))
    assert_allclose(pulls[0, top], -moment / JOINTS.HEIGHT, rtol=0, atol=1e-10)
