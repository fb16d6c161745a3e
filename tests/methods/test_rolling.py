"""Nonholonomic constraints: order 2s, closed forms of sleigh and disk, conserved quantities, combinations."""

import numpy as np
import pytest
import sympy
from notation import lagrange
from numpy.testing import assert_allclose
from samples import sleigh
from scipy.integrate import solve_ivp
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

import scvi_codegen as sc

START = np.array([0.3, -0.4, 0.5]), np.array([1.1 * np.cos(0.5), 1.1 * np.sin(0.5), 0.8])


def lobatto(s):
    return sc.SVI(s, f"gauss-lobatto:{s + 1}")


def by_accelerations(t, state):
    """The sleigh of ``samples``: its equations and the rate of its constraint, solved for accelerations."""
    x, y, a, vx, vy, w = state
    m, j, d, k, sine, cosine = 1.3, 0.7, 0.2, 0.5, np.sin(a), np.cos(a)
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[m, 0, -m * d * sine], [0, m, m * d * cosine], [-m * d * sine, m * d * cosine, j]]
    matrix[:3, 3] = -sine, cosine, 0.0
    matrix[3, :2] = sine, -cosine
    found = np.linalg.solve(
        matrix, [m * d * w * w * cosine - k * x, m * d * w * w * sine - 2 * k * y, 0.0, -w * (vx * cosine + vy * sine)]
    )
    return [vx, vy, w, *found[:3]]


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("s", "steps"), [(1, 20), (2, 10), (3, 10), (4, 5)])
def test_the_order_is_2s_and_the_step_is_symmetric(s, steps):
    end = solve_ivp(by_accelerations, (0.0, 2.0), np.concatenate(START), method="DOP853", rtol=1e-13, atol=1e-14)
    stepper, errors = sc.compile_stepper(sleigh(), lobatto(s)), []
    for n in (steps, 2 * steps):
        run = stepper.integrate(START[0], velocity=START[1], h=2.0 / n, steps=n)
        errors.append(np.abs(np.concatenate([run.q[-1], run.velocity[-1]]) - end.y[:, -1]).max())
        assert np.abs(run.constraint_values()).max() < 2e-15
    assert abs(np.log2(errors[0] / errors[1]) - 2 * s) < 0.3
    back = stepper.step(run.q[-1], run.p[-1], -run.h, 2.0)
    assert_allclose(back, (run.q[-2], run.p[-2]), rtol=0, atol=2e-15)
    if s > 2:
        free = stepper.integrate(START[0], velocity=START[1], t_end=2.0)
        assert_allclose(free.q[-1], end.y[:3, -1], rtol=0, atol=1e-11)


@pytest.mark.rotated
def test_chaplygin_sleigh_agrees_with_its_closed_form():
    """Without springs: speed V tanh(k t), rate of turning W sech(k t), k = m d V / J; from a turn on the spot."""
    m, j, d, turning = 1.3, 0.7, 0.2, 0.9
    speed = np.sqrt(j / m) * turning
    k = m * d * speed / j
    stepper = sc.compile_stepper(sleigh().with_parameters(k=0.0), lobatto(4))
    run = stepper.integrate([0.0, 0.0, 0.0], velocity=[0.0, 0.0, turning], h=0.25, steps=80)
    heading = 2 * turning / k * np.arctan(np.tanh(k * run.t / 2))
    assert_allclose(run.q[:, 2], heading, rtol=0, atol=1e-10)
    assert_allclose(run.velocity[:, 2], turning / np.cosh(k * run.t), rtol=0, atol=1e-10)
    assert_allclose(np.hypot(*run.velocity.T[:2]), speed * np.tanh(k * run.t), rtol=0, atol=1e-10)


def test_rolling_disk_moves_in_circles_and_conserves_free_momenta():
    disk = sc.LagrangianSystem.from_text(
        name="rolling disk",
        coordinates=["x", "y", "a", "b"],
        lagrangian="m*(x_dot**2 + y_dot**2)/2 + J*a_dot**2/2 + K*b_dot**2/2",
        parameters={"m": 1, "J": 0.25, "K": 0.5, "r": 1},
        constraints=["x_dot = r*b_dot*cos(a)", "y_dot = r*b_dot*sin(a)"],
    )
    names = [symmetry.name for symmetry in sc.symmetries(disk)]
    assert "momentum of a" in names
    assert "momentum of b" not in names
    stepper = sc.compile_stepper(disk, lobatto(3))
    run = stepper.integrate(
        [0.0, 0.0, 0.3, 0.0], velocity=[2 * np.cos(0.3), 2 * np.sin(0.3), 0.7, 2.0], h=0.1, steps=200
    )
    assert_allclose(run.q[:, 0], 2 / 0.7 * (np.sin(0.3 + 0.7 * run.t) - np.sin(0.3)), rtol=0, atol=1e-11)
    saved = names.index("momentum of a")
    assert np.abs(run.momentum_errors()[:, saved]).max() < 1e-15
    centripetal = -np.sin(run.q[:, 2]) * 2 * 0.7, np.cos(run.q[:, 2]) * 2 * 0.7
    assert_allclose(run.multipliers().T, centripetal, rtol=0, atol=1e-11)


@pytest.mark.rotated
def test_holonomic_and_moving_nonholonomic_constraints_combine():
    """A slope x = 4 z equals the system with z eliminated; and a moving constraint x_dot = cos(t)."""
    common = {"parameters": {"m": 1.0, "J": 0.3, "g": 9.81}, "name": "sleigh on a slope"}
    skate = "x_dot*sin(a) - y_dot*cos(a)"
    space = sc.LagrangianSystem.from_text(
        coordinates=["x", "y", "z", "a"],
        lagrangian="m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + J*a_dot**2/2 - m*g*z",
        constraints=[skate, "z = x**2/4"],
        **common,
    )
    plane = sc.LagrangianSystem.from_text(
        coordinates=["x", "y", "a"],
        lagrangian="m*(x_dot**2*(1 + x**2/4) + y_dot**2)/2 + J*a_dot**2/2 - m*g*x**2/4",
        constraints=[skate],
        **common,
    )
    x, v = 0.8, 0.5
    one = sc.compile_stepper(space, lobatto(4)).integrate(
        [x, 0.0, x * x / 4, 0.6],
        velocity=[v * np.cos(0.6), v * np.sin(0.6), x / 2 * v * np.cos(0.6), 0.4],
        h=0.02,
        steps=100,
    )
    other = sc.compile_stepper(plane, lobatto(4)).integrate(
        [x, 0.0, 0.6], velocity=[v * np.cos(0.6), v * np.sin(0.6), 0.4], h=0.02, steps=100
    )
    assert_allclose(one.q[:, [0, 1, 3]], other.q, rtol=0, atol=1e-12)
    assert np.abs(one.constraint_values()).max() < 2e-15
    dragged = sc.LagrangianSystem.from_text(
        coordinates=["x", "y", "a"],
        lagrangian="m*(x_dot**2 + y_dot**2)/2 + J*a_dot**2/2 - m*g*y",
        constraints=["x_dot = cos(t)"],
        **common,
    )
    assert dragged.changes_energy == "constraints do work"
    run = sc.compile_stepper(dragged, lobatto(3)).integrate([0, 0, 0], velocity=[1, 0, 0], h=0.1, steps=30)
    assert_allclose(run.q[:, 0], np.sin(run.t), rtol=0, atol=1e-9)
    assert_allclose(run.multipliers()[:, 0], -np.sin(run.t), rtol=0, atol=1e-13)


@pytest.mark.second
def test_a_blade_of_prescribed_direction_does_no_work():
    """Constraint forces do work only if the rates of constraints at rest are not 0, also where they contain time."""
    system = lagrange("blade", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x_dot*sin(t) = y_dot*cos(t)"])
    assert not system.changes_energy
    run = sc.compile_stepper(system, lobatto(4)).integrate([0.0, 0.0], velocity=[1.0, 0.0], h=0.05, steps=60)
    assert np.abs(run.energy() - 0.5).max() < 1e-12 < 0.1 < np.ptp(run.velocity[:, 0])


@pytest.mark.rotated
def test_nonholonomic_constraints_from_sympy_mechanics():
    x, y, a = dynamicsymbols("x y a")
    m, j, d, k = sympy.symbols("m J d k")
    vx, vy, w = (q.diff() for q in (x, y, a))
    lagrangian = (m * (vx**2 + vy**2) + j * w**2) / 2 + m * d * w * (vy * sympy.cos(a) - vx * sympy.sin(a))
    method = LagrangesMethod(
        lagrangian - k * (x**2 / 2 + y**2), [x, y, a], nonhol_coneqs=[vx * sympy.sin(a) - vy * sympy.cos(a)]
    )
    values = {m: 1.3, j: 0.7, d: 0.2, k: 0.5}
    found = sc.LagrangianSystem.from_lagranges_method(method, name="sleigh", parameters=values)
    one, other = (sc.compile_stepper(system, lobatto(2)) for system in (found, sleigh()))
    p = other.momentum(*START)
    assert_allclose(one.step(START[0], p, 0.1), other.step(START[0], p, 0.1), rtol=1e-14)


def test_velocities_against_the_constraints_are_rejected_or_projected():
    stepper = sc.compile_stepper(sleigh(), lobatto(2))
    with pytest.raises(sc.StateError, match=r"x_dot\*sin\(a\) - y_dot\*cos\(a\) is [-\d.]+, not 0"):
        stepper.integrate([0.0, 0.0, 0.5], velocity=[1.0, 1.0, 0.0], h=0.1, steps=1)
    q, p = stepper.project([0.0, 0.0, 0.5], velocity=[1.0, 1.0, 0.0])
    assert np.abs(stepper.constraint_values(q, p)[1]).max() < 1e-15
    assert_allclose(q, [0.0, 0.0, 0.5], rtol=0, atol=0.0)
