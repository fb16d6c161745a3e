"""Forces at points of bodies against torques derived by hand, and against potentials."""

import numpy as np
import pytest
import sympy
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

BODY = {
    "rotations": {"R": "w"},
    "coordinates": ["x", "y", "z"],
    "lagrangian": "m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + (w_1**2 + 2*w_2**2 + 3*w_3**2)/2",
    "parameters": {"m": 2.0, "c": 0.3},
}
STATE = {"x": 0.1, "y": -0.2, "z": 0.3, "R": [0.9, 0.3, -0.2, 0.1]}
RATES = {"x": 0.2, "y": 0.1, "z": -0.4, "w": [0.7, -0.4, 1.5]}


def end_of(**given):
    system = sc.LagrangianSystem.from_text("body", **(BODY | given))
    run = sc.compile_stepper(system, "svi:4").integrate(STATE, velocity=RATES, h=0.05, steps=40)
    return np.concatenate([run.rotation()[-1].ravel(), run.angular_velocity()[-1], run.q[-1, :3]])


def cross(a, b):
    return [f"({a[i]})*({b[j]}) - ({a[j]})*({b[i]})" for i, j in ((1, 2), (2, 0), (0, 1))]


POINT = ["0.2", "-0.1", "0.5"]
IN_SPACE = ["sin(t)", "c*x_dot", "-y"]


@pytest.mark.rotated
def test_force_in_space_acts_on_position_and_attitude():
    force = {"body": "R", "origin": ["x", "y", "z"], "point": POINT, "force": IN_SPACE}
    turned = [f"unrotate_{k}(R, {', '.join(IN_SPACE)})" for k in (1, 2, 3)]
    by_hand = end_of(forces=dict(zip("xyz", IN_SPACE, strict=True)), torques={"R": cross(POINT, turned)})
    assert np.abs(end_of(point_forces=[force]) - by_hand).max() < 1e-14
    assert np.abs(end_of() - by_hand).max() > 1e-2


@pytest.mark.second
def test_force_in_the_body_frame_is_turned():
    force = {"body": "R", "origin": ["x", "y", "z"], "point": POINT, "force": IN_SPACE, "frame": "body"}
    turned = [f"rotate_{k}(R, {', '.join(IN_SPACE)})" for k in (1, 2, 3)]
    by_hand = end_of(forces=dict(zip("xyz", turned, strict=True)), torques={"R": cross(POINT, IN_SPACE)})
    assert np.abs(end_of(point_forces=[force]) - by_hand).max() < 1e-14


def test_sympy_expressions_give_the_same_forces():
    x, y, z, c, t = sympy.symbols("x y z c t")
    force = [sympy.sin(t), c * sympy.Symbol("x_dot"), -y]
    entries = {"body": "R", "origin": [x, y, z], "point": [sympy.Rational(1, 5), 0, c], "force": force, "frame": "body"}
    texts = {"point": ["0.2", "0", "c"], "force": IN_SPACE, "origin": ["x", "y", "z"]}
    text = sc.LagrangianSystem.from_text("body", **BODY, point_forces=[entries | texts])
    formula = sympy.sympify(BODY["lagrangian"])
    given = BODY | {"lagrangian": formula, "coordinates": [x, y, z]}
    same = sc.LagrangianSystem.from_sympy(name="body", **given, point_forces=[entries])
    assert all(sympy.expand(one - other) == 0 for one, other in zip(text.forces, same.forces, strict=True))


@pytest.mark.rotated
def test_two_forces_and_others_on_the_same_body_are_added():
    force = {"body": "R", "point": POINT, "force": IN_SPACE}
    both = end_of(point_forces=[force, force], torques={"R": ["0", "c", "0"]}, forces={"x": "-c*x_dot"})
    twice = {**force, "force": [f"2*({each})" for each in IN_SPACE]}
    assert (
        np.abs(both - end_of(point_forces=[twice], torques={"R": ["0", "c", "0"]}, forces={"x": "-c*x_dot"})).max()
        < 1e-14
    )


@pytest.mark.rotated
def test_point_given_in_space_between_two_bodies_and_a_direction_is_a_potential_force():
    arm = [f"{'x + ' * (k == 1)}rotate_{k}(A, 1, 0, 0) - rotate_{k}(B, 0, 1, 0) + n_{k}" for k in (1, 2, 3)]
    common = {"rotations": {"A": "v", "B": "w"}, "directions": ["n"], "coordinates": ["x"], "parameters": {"k": 1.7}}
    spins = "v_1**2 + 2*v_2**2 + 3*v_3**2 + w_1**2 + w_2**2 + 2*w_3**2"
    kinetic = f"(x_dot**2 + {spins} + n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2"
    squares = " + ".join(f"({each})**2" for each in arm)
    pull = {"point": arm, "force": [f"-k*({each})" for each in arm]}
    start = {"x": 0.3, "A": [1, 0.2, 0, 0], "B": [0.9, 0, 0.4, 0.1], "n": [0.6, 0, 0.8]}
    rates = {"x": 0.0, "v": [0.1, 0.5, -0.3], "w": [0.2, 0.0, 1.0], "n": [0.0, 0.4, 0.0]}
    ends = []
    for given in ({"lagrangian": f"{kinetic} - k*({squares})/2"}, {"lagrangian": kinetic, "point_forces": [pull]}):
        stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("pair", **common, **given), "svi:4")
        run = stepper.integrate(start, velocity=rates, h=0.02, steps=50)
        ends.append(
            np.concatenate([run.rotation("A")[-1].ravel(), run.rotation("B")[-1].ravel(), run.direction("n")[-1]])
        )
    assert np.abs(ends[0] - ends[1]).max() < 1e-10


def test_points_of_systems_without_rotations():
    force = {"point": ["l*sin(a)", "0", "-l*cos(a)"], "force": ["c", "0", "-g"]}
    system = lagrange("pendulum", "a", "l**2*a_dot**2/2", l=0.7, g=9.8, c=1.0, point_forces=[force])
    by_hand = sympy.sympify("c*l*cos(a) - g*l*sin(a)")
    assert sympy.simplify(sympy.sympify(str(system.forces[0])) - by_hand) == 0


@pytest.mark.rotated
def test_model_files_contain_forces_at_points():
    text = """
    [system]
    name = "thrusters"
    coordinates = ["x"]
    rotations = { R = "w" }
    lagrangian = "x_dot**2/2 + (w_1**2 + 2*w_2**2 + 3*w_3**2)/2"
    point_forces = [{ body = "R", origin = ["x", "0", "0"], point = [0, 0, "l"], force = ["F", 0, 0], frame = "body" }]
    [parameters]
    l = 0.4
    F = 0.3
    [initial]
    q = { x = 0.1, R = [1, 0, 0, 0] }
    q_dot = { x = 0.0, w = [0.1, 0.0, 2.0] }
    [run]
    step = 0.05
    steps = 20
    """
    model = parse_model(text)
    again = parse_model(dump_model(model))
    assert again.system == model.system
    run, other = model.integrate(), again.integrate()
    assert np.array_equal(run.q, other.q)
    assert np.abs(run.angular_momentum("R")[-1] - run.angular_momentum("R")[0]).max() > 0.01
