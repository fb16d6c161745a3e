"""Nonconservative forces: their definition and their derived expressions."""

import sympy
from notation import hamilton, lagrange
from sympy.physics.mechanics import LagrangesMethod, Point, ReferenceFrame, dynamicsymbols

import scvi_codegen as sc

PARAMETERS = {"m": 1.2, "c": 0.1, "F": 0.5, "w": 2.0}


def driven(**given):
    return sc.LagrangianSystem.from_text(
        name="driven",
        coordinates=["x", "y"],
        lagrangian="m*(x_dot**2 + y_dot**2)/2 - x**2*y**2",
        parameters=PARAMETERS,
        **given,
    )


def test_forces_and_dissipation_are_added():
    system = driven(forces={"y": "F*cos(w*t) - x_dot*y"}, dissipation="c*(x_dot**2 + y_dot**2)/2")
    assert [str(f) for f in system.forces] == ["-c*x_dot", "F*cos(t*w) - c*y_dot - x_dot*y"]
    assert system.depends_on_time
    assert system.changes_energy == "forces act"
    assert driven(forces={"x": "0"}) == driven()


def test_sympy_input_equals_text_input():
    t, c = sympy.symbols("t c")
    x, y = dynamicsymbols("x y")
    L = sympy.Symbol("m") * (x.diff(t) ** 2 + y.diff(t) ** 2) / 2 - x**2 * y**2
    own = sc.LagrangianSystem.from_sympy(
        name="driven",
        lagrangian=L,
        coordinates=[x, y],
        parameters=PARAMETERS,
        forces={y: -c * y.diff(t) ** 3, "x": -c * x},
    )
    assert own == driven(forces={"x": "-c*x", "y": "-c*y_dot**3"})


def test_legendre_transform_and_its_inverse():
    system = driven(forces={"x": "-c*x_dot", "y": "F*cos(w*t)"})
    other = sc.hamiltonian_of(system)
    assert str(other.forces[0]) == "-c*p_x/m"
    assert sc.lagrangian_of(other).forces == system.forces
    text = hamilton("h", "x", "p_x**2/2", c=1, forces={"x": "-c*p_x"})
    assert [str(f) for f in text.forces] == ["-c*p_x"]


def test_work_is_the_same_in_other_coordinates():
    """A constant force along x, in polar coordinates."""
    plane = lagrange("plane", "x y", "(x_dot**2 + y_dot**2)/2", forces={"x": "1"})
    polar = sc.change_coordinates(plane, {"x": "r*cos(a)", "y": "r*sin(a)"}, coordinates=["r", "a"])
    assert [str(f) for f in polar.forces] == ["cos(a)", "-r*sin(a)"]


def test_forces_of_sympys_mechanics_act_through_velocities():
    """A pendulum of length l in the plane, pulled along x and turned by a torque."""
    theta = dynamicsymbols("theta")
    t, length = dynamicsymbols._t, sympy.Symbol("l")
    ground = ReferenceFrame("N")
    rod = ground.orientnew("A", "Axis", (theta, ground.z))
    pivot, bob = Point("O"), Point("P")
    pivot.set_vel(ground, 0)
    bob.set_pos(pivot, length * rod.x)
    bob.v2pt_theory(pivot, ground, rod)
    acting = [(bob, 3 * ground.x - bob.vel(ground)), (rod, 5 * ground.z)]
    method = LagrangesMethod(length**2 * theta.diff(t) ** 2 / 2, [theta], forcelist=acting, frame=ground)
    method.form_lagranges_equations()
    system = sc.LagrangianSystem.from_lagranges_method(method, name="pulled", parameters={"l": 2})
    expected = lagrange(
        "pulled", "theta", "l**2*theta_dot**2/2", l=2, forces={"theta": "-3*l*sin(theta) - l**2*theta_dot + 5"}
    )
    assert sympy.simplify(system.forces[0] - expected.forces[0]) == 0
