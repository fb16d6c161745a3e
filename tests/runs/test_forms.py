"""Systems with rotations from SymPy's frames, and after Legendre and time transformations."""

import numpy as np
import pytest
import sympy
from notation import hamilton, lagrange
from samples import QUICK_FLAGS
from sympy.physics.mechanics import Point, ReferenceFrame, RigidBody, dynamicsymbols, inertia

import scvi_codegen as sc

TOP = lagrange(
    "heavy top", (), "(3*omega_1**2/2 + 5*omega_2**2/2 + 3*omega_3**2/2)/2 - w*R_33", rotations={"R": "omega"}, w=1.0
)
START = {"q": {"R": [1, 0.3, 0, 0.1]}, "velocity": {"omega": [0.1, 0.2, 1]}}


def end(system, method="svi:6", t_end=1.0, name="R"):
    stepper = sc.compile_stepper(system, method, flags=QUICK_FLAGS)
    start = {"q": {name: START["q"]["R"]}, "velocity": START["velocity"]}
    return stepper.integrate(**start, t_end=t_end).rotation()[-1]


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("by_speeds", [True, False])
def test_a_frame_of_sympy_oriented_by_a_quaternion_is_a_rotation(by_speeds):
    N, B = ReferenceFrame("N"), ReferenceFrame("B")
    q, u = dynamicsymbols("q0:4"), dynamicsymbols("u1:4")
    B.orient_quaternion(N, q)
    if by_speeds:
        B.set_ang_vel(N, u[0] * B.x + u[1] * B.y + u[2] * B.z)
    fixed = Point("O")
    fixed.set_vel(N, 0)
    centre = fixed.locatenew("C", B.z / 2)
    centre.v2pt_theory(fixed, N, B)
    body = RigidBody("top", centre, B, 2, (inertia(B, 1, 2, sympy.Rational(3, 2)), centre))
    weight = 2 * centre.pos_from(fixed).dot(N.z)
    top = sc.LagrangianSystem.from_sympy(
        name="top", lagrangian=body.kinetic_energy(N) - weight, rotations={B: N}, torques={"B": (0, 0, sympy.S(0))}
    )
    np.testing.assert_allclose(end(top, name="B"), end(TOP), rtol=0, atol=1e-13)


def test_a_frame_oriented_by_angles_is_rejected_with_the_remedy():
    N, B = ReferenceFrame("N"), ReferenceFrame("B")
    B.orient_body_fixed(N, dynamicsymbols("a1:4"), "zxz")
    with pytest.raises(sc.SystemDefinitionError, match=r"write B.orient_quaternion\(N"):
        sc.LagrangianSystem.from_sympy(name="top", lagrangian=sympy.S(1), rotations={B: N})


def test_spins_and_rotations_of_a_hamiltonian_are_read_from_sympy():
    x, p, R_33 = sympy.symbols("x p_x R_33")
    Pi, s = sympy.symbols("Pi_1:4"), sympy.symbols("s_1:4")
    by_sympy = sc.HamiltonianSystem.from_sympy(
        name="all",
        coordinates=[x],
        momenta=[p],
        rotations={"R": "Pi"},
        spins=["s"],
        hamiltonian=p**2 / 2 + Pi[0] ** 2 / 2 + Pi[1] ** 2 + 3 * Pi[2] ** 2 + x * R_33 + s[0] * s[2],
    )
    by_text = hamilton(
        "all", "x", "p_x**2/2 + Pi_1**2/2 + Pi_2**2 + 3*Pi_3**2 + x*R_33 + s_1*s_3", rotations={"R": "Pi"}, spins=["s"]
    )
    assert by_sympy == by_text


@pytest.mark.second
def test_the_hamiltonian_of_a_top_has_its_rotation():
    np.testing.assert_allclose(end(sc.hamiltonian_of(TOP)), end(TOP), rtol=0, atol=1e-14)


@pytest.mark.full
@pytest.mark.parametrize("method", ["svi:5", sc.SVI(4, sc.gauss_legendre(5))])
def test_a_top_in_transformed_time_moves_as_in_time(method):
    transformed = sc.reparametrise(TOP, "1 + R_33**2")
    stepper = sc.compile_stepper(transformed, method, flags=QUICK_FLAGS)
    run = stepper.integrate(**START, h=0.05, steps=20)
    np.testing.assert_allclose(run.rotation()[-1], end(TOP, t_end=float(run.t[-1])), rtol=0, atol=1e-12)
    assert np.ptp(np.diff(run.t)) > 1e-3
