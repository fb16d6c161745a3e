"""Spin of axially symmetric bodies by an exact turn, compared with the same bodies with three symbols for moments."""

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.systems.legendre.of_rotations import hamiltonian_of_rotations
from scvi_codegen.systems.splittings.axial import axial_turns

pytestmark = pytest.mark.rotated

KINETIC = "(A*(omega_1**2 + omega_2**2) + C*omega_3**2)/2"
THREE = "(A*omega_1**2 + B*omega_2**2 + C*omega_3**2)/2"
START = {"R": [0.9, 0.3, -0.2, 0.1]}
OMEGA = {"omega": [0.4, -0.7, 6.0]}


def body(lagrangian, **arguments):
    given = {"parameters": {"A": 1.0, "C": 0.5, "w": 1.0}, "rotations": {"R": "omega"}} | arguments
    return sc.LagrangianSystem.from_text("top", lagrangian=lagrangian, **given)


def three(potential="w*R_33"):
    return body(f"{THREE} - {potential}", parameters={"A": 1.0, "B": 1.0, "C": 0.5, "w": 1.0})


@pytest.mark.tiers(3)
@pytest.mark.parametrize(
    ("lagrangian", "arguments", "axes"),
    [
        (f"{KINETIC} - w*R_33", {}, [2]),
        (f"{KINETIC} - w*(R_13**2 + R_33)*sin(R_23)", {}, [2]),
        (f"{KINETIC} - w*R_31", {}, []),
        (f"{KINETIC} - w*(R_31**2 + R_32**2 + R_33)", {}, [2]),  # R_31^2 + R_32^2 = 1 - R_33^2
        ("(A*omega_1**2 + C*(omega_2**2 + omega_3**2))/2 - w*R_21", {}, [0]),
        ("(omega_1**2 + omega_2**2/4 + omega_3**2)/2 - w*R_32", {"parameters": {"w": 1.0}}, [1]),
        ("A*(omega_1**2 + omega_2**2 + omega_3**2)/2 - w*R_33", {"parameters": {"A": 1.0, "w": 1.0}}, []),
        (f"{KINETIC} - w*R_33", {"torques": {"R": ["-A*omega_1", "0", "0"]}}, []),
        (f"{KINETIC} - w*R_33", {"damping": 0.1}, []),
    ],
)
def test_axes_of_symmetry(lagrangian, arguments, axes):
    system = hamiltonian_of_rotations(body(lagrangian, **arguments))
    core, turns = axial_turns(system)
    assert [turn.axis for turn in turns] == axes
    assert (core is system) == (not axes)


def test_a_predictor_turns_with_the_body():
    """Only bodies without further coordinates have a moving frame."""
    lagrangian = " - w*R_33 + x_dot**2/2 - x**2/2 + x*R_33/5"
    systems = (
        body(kinetic + lagrangian, coordinates=["x"], parameters=p)
        for kinetic, p in ((KINETIC, {"A": 1.0, "C": 0.5, "w": 1.0}), (THREE, {"A": 1.0, "B": 1.0, "C": 0.5, "w": 1.0}))
    )
    ours, other = (sc.compile_stepper(each, "svi:6", flags=QUICK_FLAGS) for each in systems)
    start, velocity = {"x": 0.3, **START}, {"x": 0.1, **OMEGA}
    run, expected = (each.integrate(start, velocity=velocity, h=0.1, steps=40) for each in (ours, other))
    assert "MOVING_FRAME" not in ours.source.code
    np.testing.assert_allclose(run.q, expected.q, rtol=0, atol=3e-10)
    assert run.iterations.sum() < 0.8 * expected.iterations.sum()


@pytest.mark.full
def test_adaptive_steps_turn_with_the_body():
    ours, other = (sc.compile_stepper(each, "svi:8") for each in (body(f"{KINETIC} - w*R_33"), three()))
    run, expected = (each.integrate(START, velocity=OMEGA, t_end=5.0, tolerance=1e-12) for each in (ours, other))
    assert len(run.t) < 0.8 * len(expected.t)
    np.testing.assert_allclose(run.at(3.3)[0], expected.at(3.3)[0], rtol=0, atol=1e-11)


@pytest.fixture(scope="module")
def top():
    """Return the stepper of the heavy top in the moving frame, which has not turned at the middle one of the points."""
    stepper = sc.compile_stepper(body(f"{KINETIC} - w*R_33"), "svi:7", flags=QUICK_FLAGS)
    assert "MOVING_FRAME" in stepper.source.code
    return stepper


def test_a_reversed_run_of_20_000_steps_returns_to_its_start(top):
    there = top.integrate(START, velocity=OMEGA, h=0.2, steps=20_000, save_every=20_000)
    back = top.integrate(there.q[-1], there.p[-1], h=-0.2, steps=20_000, save_every=20_000)
    np.testing.assert_allclose(back.rotation()[-1], there.rotation()[0], rtol=0, atol=1e-8)
    np.testing.assert_allclose(back.body_momentum()[-1], there.body_momentum()[0], rtol=0, atol=1e-8)


def test_a_top_at_rest_begins_to_fall(top):
    start, other = {"R": [0.9, 0.3, -0.2, 0.1]}, sc.compile_stepper(three(), "svi:6", flags=QUICK_FLAGS)
    runs = [each.integrate(start, velocity={"omega": [0, 0, 0]}, h=0.05, steps=20) for each in (top, other)]
    np.testing.assert_allclose(runs[0].rotation(), runs[1].rotation(), rtol=0, atol=1e-11)


@pytest.mark.rotated
@pytest.mark.parametrize("method", ["svi:3", "svi:1", "gauss:2"])
def test_steps_in_the_moving_frame_are_symplectic_and_those_of_newtons_method(method):
    ours, newton = (sc.compile_stepper(body(f"{KINETIC} - w*R_33"), method, solver=s) for s in ("auto", "newton"))
    run = ours.integrate(START, velocity=OMEGA, h=0.2, steps=10)
    np.testing.assert_allclose(newton.integrate(START, velocity=OMEGA, h=0.2, steps=10).q, run.q, rtol=0, atol=1e-13)
    tangent = ours.jacobian(run.q[-1], run.p[-1], 0.2)
    form = np.kron([[0, 1], [-1, 0]], np.eye(4))
    np.testing.assert_allclose(tangent.T @ form @ tangent, form, rtol=0, atol=2e-14)
