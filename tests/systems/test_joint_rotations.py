"""Spherical joints and free bodies of SymPy's ``System`` are rotations: SymPy's equations in angles, and MJCF."""

import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from sympy.physics.mechanics import (
    LinearPathway,
    LinearSpring,
    PinJoint,
    ReferenceFrame,
    RigidBody,
    SphericalJoint,
    System,
    TorqueActuator,
    inertia,
)

import scvi_codegen as sc

ANGLES, SPEEDS = np.array([0.4, -0.3, 0.5]), np.array([0.5, 1.0, -0.8])


def body(name, mass, *moments):
    """Return a rigid body of numbers."""
    made = RigidBody(name, mass=sympy.Rational(str(mass)))
    made.central_inertia = inertia(made.frame, *(sympy.Rational(str(each)) for each in moments))
    return made


def arm_on_a_ball_joint():
    """Return a body on a ball joint with tilted frames and a spring, and an arm with a damped hinge on it."""
    wall, upper, lower = (
        RigidBody("wall"),
        body("upper", 1.5, 0.3, 0.2, 0.1, 0.02),
        body("lower", 0.8, 0.05, 0.04, 0.03),
    )
    tilted = ReferenceFrame("tilted")
    tilted.orient_axis(upper.frame, upper.x, sympy.Rational(1, 3))
    ball = SphericalJoint("ball", wall, upper, child_point=upper.z / 2, child_interframe=tilted)
    pin = PinJoint("pin", upper, lower, parent_point=-upper.z / 2, child_point=lower.z / 3, joint_axis=upper.y)
    model = System.from_newtonian(wall)
    model.add_joints(ball, pin)
    model.apply_uniform_gravity(-sympy.Rational(981, 100) * wall.z)
    hook = wall.masscenter.locatenew("hook", wall.x)
    hook.set_vel(wall.frame, 0)
    model.add_actuators(LinearSpring(3, LinearPathway(hook, lower.masscenter), sympy.Rational(1, 2)))
    model.add_actuators(TorqueActuator(-pin.speeds[0] / 20, pin.parent_interframe.y, lower.frame, upper.frame))
    return model, tilted, ball


def in_angles(model, q, u, span):
    """Return the final coordinates and speeds by SymPy's equations and SciPy."""
    state = [*model.q, *model.u]
    mass, forcing = (sympy.lambdify([state], each, cse=True) for each in (model.mass_matrix_full, model.forcing_full))
    rates = lambda t, y: np.linalg.solve(mass(y), forcing(y)).ravel()  # noqa: E731
    return solve_ivp(rates, (0, span), [*q, *u], method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


@pytest.mark.full
def test_a_spherical_joint_moves_as_in_angles():
    model, tilted, ball = arm_on_a_ball_joint()
    model.form_eoms()
    q, u, span = [*ANGLES, 0.2], [*SPEEDS, 0.3], 0.8
    end = in_angles(model, q, u, span)
    velocity = tilted.ang_vel_in(ball.parent_interframe).to_matrix(tilted)
    omega = sympy.lambdify([[*ball.coordinates, *ball.speeds]], velocity)([*ANGLES, *SPEEDS]).ravel()
    system = sc.LagrangianSystem.from_system(model)
    assert [each.name for each in system.coordinates] == ["q_pin", *(f"R_ball_{letter}" for letter in "wxyz")]
    assert [name for name, _ in system.reduced.forces] == ["q_pin"], "the spring and the weights are a potential"
    start = {"q_pin": 0.2, "R_ball": {"euler": "XYZ", "angles": ANGLES}}
    stepper = sc.compile_stepper(system, "svi:5")
    run = stepper.integrate(start, velocity={"q_pin": 0.3, "omega_ball": omega}, h=0.01, steps=80)
    expected = Rotation.from_euler("XYZ", end[:3]).as_matrix()
    np.testing.assert_allclose(run.rotation("R_ball")[-1], expected, rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.q[-1, 0], end[3], rtol=0, atol=1e-10)


@pytest.mark.rotated
def test_reading_does_not_change_the_system():
    model, _, ball = arm_on_a_ball_joint()
    before = ball.child.masscenter.vel(model.frame), ball.child.frame.dcm(model.frame), model.q, model.kdes
    sc.LagrangianSystem.from_system(model)
    assert (ball.child.masscenter.vel(model.frame), ball.child.frame.dcm(model.frame), model.q, model.kdes) == before


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", ["load", "constraint", "velocity"])
def test_a_spherical_joint_whose_angles_occur_elsewhere_is_not_replaced(kind):
    wall, top = RigidBody("wall"), body("top", 1, 0.3, 0.2, 0.1)
    ball = SphericalJoint("ball", wall, top, child_point=top.z / 2)
    model = System.from_newtonian(wall)
    model.add_joints(ball)
    angle, speed = ball.coordinates[1], ball.speeds[1]
    if kind == "load":
        model.add_loads((ball.child.frame, -angle * model.frame.y))
    elif kind == "constraint":
        model.add_holonomic_constraints(angle - sympy.Rational(1, 10))
    else:
        ball.child.masscenter.set_vel(model.frame, speed * model.frame.x)
    system = sc.LagrangianSystem.from_system(model)
    assert [each.name for each in system.coordinates] == ["q0_ball", "q1_ball", "q2_ball"]
    assert not system.rotations


MJCF = """
<mujoco>
  <option gravity="0 0 -9.81"/>
  <worldbody>
    <body name="base">
      <freejoint/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.5 0.4 0.3"/>
      <body name="leg" pos="0.3 0 -0.1">
        <joint name="q_hip" axis="0 1 0" pos="0 0 0"/>
        <inertial pos="0 0 -0.4" mass="0.7" diaginertia="0.1 0.12 0.02"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
