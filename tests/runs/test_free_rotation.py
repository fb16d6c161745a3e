"""Explicit splitting of rigid bodies: free rotation in closed form between kicks by potentials and torques."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS
from scipy.spatial.transform import Rotation

import scvi_codegen as sc
from scvi_codegen.runs.states.reduction import Reduction

ATTITUDE = Rotation.from_euler("ZXZ", [0.3, 0.8, -0.4])
OMEGA = np.array([0.7, -0.4, 4.5])
FREE = "a*omega_1**2/2 + omega_2**2 + omega_3**2/2 + x_dot**2/2"
PARAMETERS = {"a": 3.0}
COUPLED = sc.LagrangianSystem.from_text(
    "body and mass",
    ["x"],
    FREE + " - x**2/2 - x*R_33 - cos(t)*R_12*R_31",
    rotations={"R": "omega"},
    parameters=PARAMETERS,
    torques={"R": ["x", "R_13", "sin(t)/3"]},
)
CANONICAL = sc.HamiltonianSystem.from_text(
    "body and mass, canonical",
    ["x"],
    "Pi_1**2/(2*a) + Pi_2**2/4 + Pi_3**2/2 + p_x**2/2 + x**2/2 + x*R_33 + R_12*R_31",
    rotations={"R": "Pi"},
    parameters=PARAMETERS,
)
AUTONOMOUS = sc.LagrangianSystem.from_text(
    "body and mass, autonomous",
    ["x"],
    FREE + " - x**2/2 - x*R_33 - R_12*R_31",
    rotations={"R": "omega"},
    parameters=PARAMETERS,
)


def compiled(system, method, **how):
    return sc.compile_stepper(system, method, flags=QUICK_FLAGS, **how)


@pytest.mark.second
def test_a_symmetric_body_rotates_exactly_in_a_step_of_any_size():
    system = lagrange("free", (), "(omega_1**2 + 2*omega_2**2 + 2*omega_3**2)/2", rotations={"R": "omega"})
    stepper, momentum = compiled(system, "stoermer-verlet"), OMEGA * (1, 2, 2)
    for h in (0.05, 0.2, 7.0):
        run = stepper.integrate({"R": ATTITUDE}, velocity={"omega": OMEGA}, h=h, steps=1)
        common, own = Rotation.from_rotvec(momentum * h / 2), Rotation.from_rotvec([momentum[0] * h / 2, 0, 0])
        np.testing.assert_allclose(run.rotation()[-1], (ATTITUDE * common * own).as_matrix(), rtol=0, atol=3e-14)
        np.testing.assert_allclose(run.angular_velocity()[-1], own.inv().apply(OMEGA), rtol=0, atol=3e-14)


@pytest.fixture(scope="module")
def moving():
    """Return the stepper of the autonomous system by leapfrog, and a run of 20,000 steps."""
    stepper = compiled(AUTONOMOUS, "stoermer-verlet")
    start = {"x": 0.5, "R": ATTITUDE}
    return stepper, stepper.integrate(start, velocity={"x": 0.2, "omega": [0.7, -0.4, 1.5]}, h=0.05, steps=20_000)


@pytest.mark.rotated
def test_steps_are_symplectic_reversible_and_keep_the_gauge(moving):
    stepper, run = moving
    reduction = Reduction(stepper.interface)
    inward, outward = reduction.inward(run.q, run.p), reduction.outward(run.q, run.p)
    step = outward[8] @ stepper.jacobian(run.q[7], run.p[7], 0.05) @ inward[7]
    n = reduction.size // 2
    form = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    np.testing.assert_allclose(step.T @ form @ step, form, rtol=0, atol=3e-14)
    back = stepper.step(*stepper.step(run.q[7], run.p[7], 0.05), -0.05)
    np.testing.assert_allclose(np.ravel(back), np.ravel([run.q[7], run.p[7]]), rtol=0, atol=1e-14)
    assert np.abs(np.sum(run.q[:, 1:] ** 2, axis=1) - 1).max() < 1e-12
    assert np.abs(np.sum(run.q[:, 1:] * run.p[:, 1:], axis=1)).max() < 1e-12


@pytest.mark.rotated
def test_explicit_steps_with_time_dependent_torques_solve_the_stage_equations():
    state = {"x": 0.5, "R": ATTITUDE}, {"x": 0.2, "omega": [0.7, -0.4, 1.5]}
    ends = []
    for solver in ("explicit", "newton"):
        run = compiled(COUPLED, "composition:2", solver=solver).integrate(
            state[0], velocity=state[1], h=0.1, steps=3, parameters={"a": 2.5}
        )
        ends.append(np.ravel([run.q[-1], run.p[-1]]))
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-14)


@pytest.mark.second
def test_hamiltonians_with_rotations_have_the_same_steps(moving):
    _, run = moving
    q, p = compiled(CANONICAL, "stoermer-verlet").step(run.q[0], run.p[0], 0.05)
    np.testing.assert_allclose(np.ravel([q, p]), np.ravel([run.q[1], run.p[1]]), rtol=0, atol=1e-15)


@pytest.mark.rotated
def test_arrays_of_bodies_move_as_by_an_implicit_method():
    body = "2*omega_1[i]**2 + J[i]*omega_2[i]**2 + 2*omega_3[i]**2 + x_dot[i]**2/2 - x[i]*R_33[i]"
    text = f"sum(i in N, {body}) - sum(i < j in N, R_13[i]*R_13[j] + x[i]*x[j]/2)"
    system = lagrange("bodies", "x[N]", text, parameters={"J[N]": 1}, rotations={"R[N]": "omega"})
    start = {"x": [0.3, -0.2], "R": [[1, 0.2, 0, 0.3], [0.5, 0.5, -0.1, 0]]}
    moving = {"x": [0, 0.1], "omega": [[0.7, -0.4, 1.5], [0.2, 1.0, -0.3]]}
    ends = []
    for method, steps in (("composition:8", 10), ("svi:6", 4)):
        stepper = compiled(system, method)
        run = stepper.integrate(start, velocity=moving, parameters={"J": [1, 3]}, h=0.4 / steps, steps=steps)
        ends.append(run.rotation()[-1])
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-11)
