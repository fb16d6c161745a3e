"""Trajectories of SymPy's mechanics agree with SymPy's own equations; missing parts are named."""

from typing import Any

import numpy as np
import pytest
import sympy
from mechanisms import MECHANISMS, Mechanism, bicycle
from sympy.physics.mechanics import (
    KanesMethod,
    LagrangesMethod,
    Particle,
    Point,
    ReferenceFrame,
    System,
    dynamicsymbols,
)

from scvi_codegen import SVI, LagrangianSystem, SystemDefinitionError, compile_stepper
from scvi_codegen.extras.robots.kinetics import potential_of
from scvi_codegen.systems.constraints import kind_of
from scvi_codegen.systems.constraints.kind import HOLONOMIC

T = dynamicsymbols._t
Q1, Q2, U1, U2 = dynamicsymbols("q1 q2 u1 u2")
M, K, C = sympy.symbols("m k c")
NAMED = {"m": 2.0, "k": 3.0, "c": 0.5}


def assert_moves_alike(mechanism: Mechanism, steps: int = 200) -> None:
    """Compare trajectories with steps of high order."""
    system = mechanism.system()
    stepper = compile_stepper(system, SVI(4, "gauss-lobatto:5") if system.constraints else SVI(5))
    rates = mechanism.speeds_to_rates(np.array(mechanism.q), np.array(mechanism.u))
    run = stepper.integrate(mechanism.q, velocity=rates, h=mechanism.span / steps, steps=steps)
    q, v = mechanism.motion()
    np.testing.assert_allclose(run.q[-1], q, rtol=0, atol=2e-11)
    np.testing.assert_allclose(run.velocity[-1], v, rtol=0, atol=1e-9)


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", MECHANISMS)
def test_trajectories_agree_with_sympys_equations(name: str) -> None:
    assert_moves_alike(MECHANISMS[name]())


def kanes_method(*positions: Any, loads: Any = (), q: Any = (Q1,), u: Any = (U1,), kd: Any = None, **more: Any) -> Any:
    """Particles of mass m along x, and forces on them; speeds are rates unless kinematic equations are given."""
    frame, origin = ReferenceFrame("N"), Point("O")
    origin.set_vel(frame, 0)
    bodies = []
    for number, x in enumerate(positions):
        point = origin.locatenew(f"P{number}", x * frame.x)
        point.set_vel(frame, (x.diff(T) + more.get("slip", 0)) * frame.x)
        bodies.append(Particle(f"p{number}", point, M))
    more.pop("slip", None)
    return KanesMethod(
        frame,
        q_ind=list(q),
        u_ind=list(u),
        kd_eqs=[a.diff(T) - b for a, b in zip(q, u, strict=True)] if kd is None else kd,
        bodies=bodies,
        forcelist=[(body.masscenter, force * frame.x) for body, force in zip(bodies, loads, strict=False)] or None,
        **more,
    )


def taken(method: KanesMethod, **more: Any) -> LagrangianSystem:
    return LagrangianSystem.from_kanes_method(method, name="taken", parameters=NAMED, **more)


def text(coordinates: str, lagrangian: str, **more: Any) -> LagrangianSystem:
    return LagrangianSystem.from_text(
        name="taken", coordinates=coordinates.split(), lagrangian=lagrangian, parameters=NAMED, **more
    )


def test_speeds_may_be_combinations_of_derivatives() -> None:
    """u1 = q1' + q2', u2 = q1' - q2'; loads in speeds."""
    kinematics = [Q1.diff(T) + Q2.diff(T) - U1, Q1.diff(T) - Q2.diff(T) - U2]
    method = kanes_method(Q1, Q2, loads=(-C * U1, -K * Q2 + C * U2), q=(Q1, Q2), u=(U1, U2), kd=kinematics)
    expected = text(
        "q1 q2",
        "m*q1_dot**2/2 + m*q2_dot**2/2 - k*q2**2/2",
        forces={"q1": "-c*(q1_dot + q2_dot)", "q2": "c*(q1_dot - q2_dot)"},
    )
    found = taken(method)
    assert found.lagrangian == expected.lagrangian
    assert [sympy.expand(a - b) for a, b in zip(found.forces, expected.forces, strict=True)] == [0, 0]


def test_speeds_are_defined_where_a_coefficient_vanishes() -> None:
    """Elimination would divide by sin(q1); the determinant of the kinematic equations is -1."""
    sine, cosine = sympy.sin(Q1), sympy.cos(Q1)
    kinematics = [Q1.diff(T) - sine * U1 - cosine * U2, Q2.diff(T) - cosine * U1 + sine * U2]
    found = taken(kanes_method(Q1, Q2, loads=(-C * U1, -C * U2), q=(Q1, Q2), u=(U1, U2), kd=kinematics))
    values = dict(zip((*found.coordinates, *found.velocities, *found.parameters), (0, 2, 3, 5), strict=False))
    forces = [force.xreplace(values) for force in found.forces]
    assert sorted(float(force.xreplace(dict.fromkeys(force.free_symbols, sympy.S.One))) for force in forces) == [
        -5.0,
        -3.0,
    ]


def test_a_speed_without_a_coordinate_gets_its_integral() -> None:
    method = kanes_method(Q1, u=(U1, U2), q=(Q1,), kd=[Q1.diff(T) - U1], slip=U2)
    with pytest.raises(SystemDefinitionError, match="singular"):
        taken(method)


def test_auxiliary_speeds_are_zero_and_their_forces_do_no_work() -> None:
    method = kanes_method(Q1, slip=U2, loads=(-K * Q1,), u_auxiliary=[U2])
    assert taken(method) == text("q1", "m*q1_dot**2/2 - k*q1**2/2")


def test_time_dependent_forces_are_inputs_or_set_to_zero_order_hold() -> None:
    force = dynamicsymbols("F")
    method = kanes_method(Q1, loads=(force - K * Q1,))
    driven = taken(method, inputs=[force])
    assert driven == text("q1", "m*q1_dot**2/2 - k*q1**2/2", forces={"q1": "F"}, inputs=["F"])
    held = LagrangianSystem.from_kanes_method(method, name="taken", parameters={**NAMED, force: 0.25})
    assert held.forces == (sympy.Symbol("F", real=True),)
    assert held.constants[held.forces[0]] == 0.25
    with pytest.raises(SystemDefinitionError, match=r"'F\(t\)' in the forces is neither a coordinate"):
        taken(method)


@pytest.mark.rotated
def test_weights_and_springs_become_a_potential_and_dampers_remain_forces() -> None:
    mechanism = MECHANISMS["particles on a spring"]()
    system = mechanism.system().with_parameters(c=0.0, g=0.0)
    assert all(force.has(sympy.Symbol("c", real=True)) for force in system.forces)
    run = compile_stepper(system, SVI(6)).integrate(mechanism.q, velocity=mechanism.u, h=0.01, steps=500)
    assert np.ptp(run.energy()) < 1e-12


def test_rolling_constraint_forces_do_no_work() -> None:
    mechanism = MECHANISMS["rolling disc"]()
    system = mechanism.system()
    power = sympy.Add(*(f * v for f, v in zip(system.forces, system.velocities, strict=True)))
    assert any(system.forces)
    assert sympy.simplify(power) == 0


def test_potential_energies_count_as_in_the_equations() -> None:
    """Potential energies enter the equations of Lagrange, not those of Kane."""
    frame, origin = ReferenceFrame("N"), Point("O")
    system = System(frame, origin)
    point = origin.locatenew("P", Q1 * frame.x)
    particle = Particle("p", point, M)
    particle.potential_energy = K * Q1**2 / 2
    system.add_bodies(particle)
    system.add_coordinates(Q1)
    system.add_speeds(U1)
    system.add_kdes(Q1.diff(T) - U1)
    with_energy, without = text("q1", "m*q1_dot**2/2 - k*q1**2/2"), text("q1", "m*q1_dot**2/2")
    assert LagrangianSystem.from_system(system, name="taken", parameters=NAMED) == with_energy
    system.form_eoms()
    assert LagrangianSystem.from_system(system, name="taken", parameters=NAMED) == without
    system.form_eoms(LagrangesMethod)
    assert LagrangianSystem.from_system(system, name="taken", parameters=NAMED) == with_energy


def test_velocity_constraints_implied_by_configuration_constraints_are_dropped() -> None:
    options = {"q": (Q1,), "u": (U1,), "kd": [Q1.diff(T) - U1, Q2.diff(T) - U2], "u_dependent": [U2]}
    rate = [U1 - 2 * Q1 * U2]
    configuration = {"q_dependent": [Q2], "configuration_constraints": [Q2 - Q1**2]}
    method = kanes_method(Q1, Q2, **options, **configuration, velocity_constraints=[U2 - 2 * Q1 * U1])
    assert taken(method) == text("q1 q2", "m*q1_dot**2/2 + m*q2_dot**2/2", constraints=["q2 - q1**2"])
    rolling = text("q1 q2", "m*q1_dot**2/2 + m*q2_dot**2/2", constraints=["q1_dot - 2*q1*q2_dot"])
    assert taken(kanes_method(Q1, Q2, **{**options, "q": (Q1, Q2)}, velocity_constraints=rate)) == rolling


@pytest.mark.rotated
def test_bicycle_has_the_constraints_of_its_wheels() -> None:
    """Contact of the front wheel, its rolling (two), and the rear wheel whose rolling is in the velocities."""
    lengths = dict.fromkeys(("htangle", "WRrad", "WFrad", "framelength", "forkoffset", "forklength", "g"), 0.5)
    moments = [f"I{body}{axis}" for body in ("frame", "fork", "rear", "front") for axis in ("11", "22")]
    masses = [f"m{body}" for body in ("frame", "fork", "rear", "front")]
    parameters = lengths | dict.fromkeys((*moments, *masses), 1.0)
    found = LagrangianSystem.from_kanes_method(bicycle(), name="bicycle", parameters=parameters)
    assert [q.name for q in found.coordinates] == ["q1", "q2", "q5", "q4", "integral_u3", "integral_u6"]
    assert [kind_of(found, g) is HOLONOMIC for g in found.constraints] == [True, False, False]


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (lambda: kanes_method(), "no bodies"),
        (lambda: kanes_method(Q1, kd=[]), "no kinematic equations"),
        (
            lambda: kanes_method(Q1, u=(U1, U2), q=(Q1, Q2), kd=[U1 - Q1.diff(T), U1 - Q2.diff(T) - Q1]),
            "1 .*for them|cannot",
        ),
        (lambda: kanes_method(Q1, slip=dynamicsymbols("w")), r"velocity of 'p0' depends on 'w\(t\)'"),
        (lambda: "KanesMethod", "method must be a KanesMethod of sympy.physics.mechanics"),
    ],
)
def test_missing_parts_are_named(method: Any, message: str) -> None:
    with pytest.raises(SystemDefinitionError, match=message):
        taken(method())


X, Y, Z, A = sympy.symbols("x y z a", real=True)
DISTANCE = (sympy.sin(X) + A * sympy.sin(Y)) ** 2 + (2 - sympy.cos(X) - A * sympy.cos(Y)) ** 2


@pytest.mark.parametrize(
    "potential",
    [
        X * Y**2 + Z**4 * sympy.cos(X),
        sympy.exp(-A * X) * Y + sympy.log(X + Y),
        -A / sympy.sqrt(X**2 + Y**2 + Z**2),
        (sympy.sqrt(DISTANCE) - A) ** 2 + A * Z,
        sympy.cos(X + Y) * Z - sympy.sin(X) * sympy.cos(Y),
        sympy.Integer(0),
    ],
    ids=str,
)
def test_potentials_are_recovered_from_their_gradients(potential: sympy.Expr) -> None:
    variables = (X, Y, Z)
    found = potential_of([-potential.diff(q) for q in variables], variables)
    assert found is not None
    point = {X: 0.3, Y: 0.7, Z: 1.1, A: 0.6}
    for q in variables:
        assert float((found - potential).diff(q).subs(point)) == pytest.approx(0.0, abs=1e-13)
