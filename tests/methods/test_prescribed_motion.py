"""As many constraints as coordinates: kinematics, multipliers by inverse dynamics, dead points."""

from __future__ import annotations

import numpy as np
import pytest
import sympy
from notation import lagrange
from numpy.testing import assert_allclose
from sympy.physics.mechanics import dynamicsymbols

import scvi_codegen as sc

NUMBERS = {"m": 1.0, "M": 0.4, "g": 9.81, "a": 1.0, "b": 2.0, "c": 1.5, "d": 2.0, "w": 2.0}
CONSTRAINTS = ["x1 = a*cos(w*t)", "y1 = a*sin(w*t)", "(x2 - x1)**2 + (y2 - y1)**2 = b**2", "(x2 - d)**2 + y2**2 = c**2"]
LAGRANGIAN = "m*(x1_dot**2 + y1_dot**2)/2 + M*(x2_dot**2 + y2_dot**2)/2 - g*(m*y1 + M*y2)"
NEAR = [1.0, 0.0, 1.94, 1.5]


def linkage(constraints: list[str] = CONSTRAINTS) -> sc.LagrangianSystem:
    return lagrange("driven linkage", "x1 y1 x2 y2", LAGRANGIAN, parameters=NUMBERS, constraints=constraints)


def inverse_dynamics(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions of the linkage as an intersection of circles, and the forces that its accelerations require."""
    t = sympy.Symbol("t")
    m, upper, g, a, b, c, d, w = NUMBERS.values()
    pin = sympy.Matrix([a * sympy.cos(w * t), a * sympy.sin(w * t)])
    apart = sympy.Matrix([d, 0]) - pin
    length = sympy.sqrt(apart.dot(apart))
    along = (length**2 + b**2 - c**2) / (2 * length)
    height = sympy.sqrt(b**2 - along**2)
    q = [*pin, *(pin + (along * apart + height * sympy.Matrix([-apart[1], apart[0]])) / length)]
    known = sympy.lambdify(t, [q, [each.diff(t, 2) for each in q]])
    positions, multipliers = [], []
    for time in times:
        (x1, y1, x2, y2), acceleration = known(time)
        rod, rocker = 2 * np.array([x2 - x1, y2 - y1]), 2 * np.array([x2 - d, y2])
        gradients = [[1, 0, 0, 0], [0, 1, 0, 0], [*-rod, *rod], [0, 0, *rocker]]
        required = np.array([m, m, upper, upper]) * acceleration + g * np.array([0, m, 0, upper])
        positions.append([x1, y1, x2, y2])
        multipliers.append(np.linalg.solve(np.transpose(gradients), required))
    return np.array(positions), np.array(multipliers)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", [sc.SVI(1, "gauss-lobatto:2"), "svi:3"])
@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_multipliers_are_the_forces_of_inverse_dynamics(method, solver):
    stepper = sc.compile_stepper(linkage(), method, solver=solver)
    run = stepper.integrate(*stepper.project(NEAR), h=0.05, steps=80)
    positions, forces = inverse_dynamics(run.t)
    assert_allclose(run.q, positions, rtol=0, atol=1e-13)
    assert_allclose(run.multipliers(), forces, rtol=0, atol=1e-12 * np.abs(forces).max())
    between = np.array([0.13, 0.41, 0.77])
    assert_allclose(run.at(between)[0], inverse_dynamics(between)[0], rtol=0, atol=1e-13)


@pytest.mark.rotated
def test_adaptive_steps_and_ensembles():
    stepper = sc.compile_stepper(linkage(), "svi:4")
    start = stepper.project(NEAR)
    run = stepper.integrate(*start, t_end=3.0)
    positions, forces = inverse_dynamics(run.t)
    assert_allclose(run.q, positions, rtol=0, atol=1e-13)
    assert_allclose(run.multipliers(), forces, rtol=0, atol=1e-12 * np.abs(forces).max())
    many = stepper.integrate_ensemble(*(np.stack([each, each]) for each in start), h=0.1, steps=30)
    assert_allclose(many.q[-1], positions[[-1, -1]], rtol=0, atol=1e-13)


def test_the_same_system_from_sympy_and_from_files(tmp_path):
    x, y = dynamicsymbols("x y")
    t = dynamicsymbols._t
    lagrangian = (x.diff(t) ** 2 + y.diff(t) ** 2) / 2
    symbolic = sc.LagrangianSystem.from_sympy(
        name="crank", lagrangian=lagrangian, coordinates=[x, y], constraints=[x - sympy.cos(t), y - sympy.sin(t)]
    )
    text = lagrange("crank", "x y", "(x_dot**2 + y_dot**2)/2", constraints=["x = cos(t)", "y = sin(t)"])
    assert symbolic == text
    model = sc.Model(system=text, method="svi:2", q=[1.0, 0.0], velocity=[0.0, 1.0], h=0.1, span=1.0)
    sc.save_model(model, tmp_path / "crank.toml")
    run = sc.load_model(tmp_path / "crank.toml").integrate()
    assert_allclose(run.multipliers(), -run.q, rtol=0, atol=1e-13)


@pytest.mark.second
def test_prescribed_velocities():
    lagrangian = "J*a_dot**2/2 + m*x_dot**2/2"
    cart = lagrange("cart", "a x", lagrangian, J=1, m=2, constraints=["x_dot = t", "a = x"])
    run = sc.compile_stepper(cart, "svi:2").integrate([0, 0], velocity=[0, 0], h=0.1, steps=10)
    assert_allclose(run.q[-1], [0.5, 0.5], rtol=0, atol=1e-14)
    assert_allclose(run.multipliers(), [[3.0, 1.0]] * 11, rtol=0, atol=1e-12)


SLIDER = {
    "name": "slider-crank",
    "coordinates": ["angle", "x"],
    "lagrangian": "J*angle_dot**2/2 + m*x_dot**2/2",
    "parameters": {"J": 1, "m": 2, "l": 1.5},
}


@pytest.mark.parametrize("span", [{"h": 0.01, "steps": 400}, {"t_end": 4.0}])
def test_dead_points_are_named_with_the_rank(span):
    """The slider reaches x = 1 + l at t = 2.3 with crank and rod in line."""
    constraints = ["x = 1/5 + t", "x**2 - 2*x*cos(angle) + 1 = l**2"]
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text(**SLIDER, constraints=constraints), "svi:3")
    start = stepper.project([1.8, 0.6], t=0.4)
    with pytest.raises(sc.StepFailedError, match=r"nearly singular there.*rank 1 of 2.*dead point") as failure:
        stepper.integrate(*start, t=0.4, **span)
    assert 2.28 < failure.value.t < 2.3 + 1e-12
    with pytest.raises(sc.StateError, match=r"linearly dependent there \(rank 1 of 2\)"):
        stepper.integrate([0.0, 2.5], velocity=[0.0, 1.0], t=2.3, h=0.01, steps=1)


@pytest.mark.rotated
def test_impacts_are_impossible():
    stepper = sc.compile_stepper(linkage(), "svi:1")
    with pytest.raises(sc.EventError, match=r"changes of the state by 'x1' .* constraints leave no motion away"):
        stepper.integrate(*stepper.project(NEAR), h=0.05, steps=80, events=sc.impact("x1"))
