"""Equalities of MJCF: closed loops against the same mechanisms as trees, and against formulas."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.expressions import evaluate

BOX = '<inertial pos="0.1 0 -0.2" mass="2" diaginertia="0.3 0.2 0.1"/>'
ROD = '<inertial pos="0 0 -0.3" mass="1" diaginertia="0.1 0.12 0.02"/>'
TURNED = Rotation.from_euler("XYZ", [0.3, 0, 0.2]).as_matrix()
"""Attitude of the box."""
OMEGA, RATE = np.array([0.5, -1.0, 2.0]), np.array([-1.0, 0.4, 0.3])


def model(tmp_path, bodies, equalities=""):
    """Return the system of bodies in the world and equalities."""
    file = tmp_path / "model.xml"
    file.write_text(
        f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody><equality>{equalities}</equality></mujoco>'
    )
    return sc.LagrangianSystem.from_mjcf(file)


def run_of(system, q, velocity):
    """Return a run of a second."""
    run = sc.compile_stepper(system, "svi:4").integrate(q, velocity=velocity, h=0.01, steps=100)
    assert np.ptp(run.energy()) < 1e-9
    return run


def rod(inner=""):
    """Return a rod that hangs from a ball joint at (0, 0, 1)."""
    joint = '<joint name="hang" type="ball"/>'
    return f'<body name="rod" pos="0 0 1">{joint}{ROD}<site name="end" pos="0 0 -0.6" euler="0.1 0.2 0"/>{inner}</body>'


def box(joint, position):
    """Return a box at a position, with a joint."""
    return f'<body name="box" pos="{position}" euler="0.3 0 0.2">{joint}{BOX}<site name="top" pos="0 0.2 0.1"/></body>'


def named(values, letters="xyz"):
    return {f"{letter}_box": float(value) for letter, value in zip(letters, values, strict=True)}


@pytest.mark.second
def test_massless_links_follow_the_crank_of_a_parallelogram(tmp_path):
    hinge = '<joint name="{0}" type="hinge" axis="0 1 0"/><inertial pos="{1}" mass="{2}" diaginertia="{2} {2} {2}"/>'
    crank = '<body name="crank">' + hinge.format("crank", "0 0 0.5", 1) + "{}</body>"
    coupler = '<body name="coupler" pos="0 0 1">' + hinge.format("coupler", "0.5 0 0", 0) + "</body>"
    rocker = '<body name="rocker" pos="1 0 0">' + hinge.format("rocker", "0 0 0.5", 0) + "</body>"
    loop = '<connect body1="coupler" body2="rocker" anchor="1 0 0"/>'
    closed = run_of(model(tmp_path, crank.format(coupler) + rocker, loop), [0.3, -0.3, 0.3], np.zeros(3))
    alone = run_of(model(tmp_path, crank.format("")), [0.3], [0.0])
    assert closed.q[-1] == pytest.approx(alone.q[-1, 0] * np.array([1, -1, 1]), abs=1e-13)


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    "equality", ['<connect body1="box" body2="rod" anchor="0 0.2 0.1"/>', '<connect site1="end" site2="top"/>']
)
def test_a_connection_of_points_is_a_ball_joint(equality, tmp_path):
    end = np.array([0, 0, -0.6])
    place = np.add(end, [0, 0, 1]) - TURNED @ [0, 0.2, 0.1]
    text = " ".join(map(repr, map(float, place)))
    closed = model(tmp_path, rod() + box("<freejoint/>", text), equality)
    assert len(closed.constraints) == 3
    spin = TURNED.T @ RATE
    speed = named(np.cross(OMEGA, end) - np.cross(RATE, TURNED @ [0, 0.2, 0.1]))
    start = {"R_hang": np.eye(3), "R_box": TURNED} | named(place)
    run = run_of(closed, start, {"omega_hang": OMEGA, "omega_box": spin} | speed)
    elbow = box('<joint name="elbow" type="ball" pos="0 0.2 0.1"/>', " ".join(map(str, place - [0, 0, 1])))
    tree = model(tmp_path, rod(elbow))
    relative = {"omega_hang": OMEGA, "omega_elbow": TURNED.T @ (RATE - OMEGA)}
    nested = run_of(tree, {"R_hang": np.eye(3), "R_elbow": np.eye(3)}, relative)
    expected = nested.rotation("R_hang")[-1] @ TURNED @ nested.rotation("R_elbow")[-1]
    np.testing.assert_allclose(run.rotation("R_hang")[-1], nested.rotation("R_hang")[-1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(run.rotation("R_box")[-1], expected, rtol=0, atol=1e-10)


FIXED = '<fixed name="t{0}"><joint joint="{0}" coef="{1}"/></fixed>'
SPATIAL = '<spatial name="t{0}"><site site="below"/><site site="s{0}"/></spatial>'
TENDONS = '<tendon tendon1="ta" tendon2="tb" polycoef="{}"/></equality><tendon>{}</tendon><equality>'


@pytest.mark.rotated
@pytest.mark.parametrize(
    "equality",
    [
        '<joint joint1="a" joint2="b" polycoef="0.1 0.3 0.2 0 0"/>',
        TENDONS.format("0.2 -1.2 1.6", FIXED.format("a", 2) + FIXED.format("b", -0.5)),
        TENDONS.format("0.1 0.3 0.2", SPATIAL.format("a") + SPATIAL.format("b")),
    ],
)
def test_a_polynomial_between_lengths_reduces_the_motion_to_one_coordinate(equality, tmp_path):
    slides = '<site name="below" pos="0 0 -9"/>' + "".join(
        f'<body><joint name="{name}" type="slide" axis="0 0 1" ref="{ref}"/><site name="s{name}"/>'
        f'<inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/></body>'
        for name, ref, mass in (("a", 0.5, 2), ("b", 0.25, 3))
    )
    system = model(tmp_path, slides, equality)
    run = run_of(system, {"a": 0.6 + 0.3 * 0.5 + 0.2 * 0.25, "b": 0.75}, {"a": 0.5, "b": 1.0})
    one = sc.LagrangianSystem.from_text(
        "one", ["b"], "(2*(0.3 + 0.4*(b - 0.25))**2 + 3)*b_dot**2/2 - 9.81*(2*(0.3*b + 0.2*(b - 0.25)**2) + 3*b)"
    )
    expected = sc.compile_stepper(one, "svi:4").integrate([0.75], velocity=[1.0], h=0.01, steps=100)
    np.testing.assert_allclose(run.q[-1, 1], expected.q[-1, 0], rtol=0, atol=1e-11)
    fixed = model(tmp_path, slides, '<joint joint1="a" polycoef="0.2"/>')
    at_rest = run_of(fixed, {"a": 0.7, "b": 0}, {"a": 0, "b": 0})
    np.testing.assert_allclose(at_rest.q[-1], [0.7, -9.81 / 2], rtol=0, atol=1e-11)


@pytest.mark.parametrize(("written", "whole"), [("0.3", "0.3 1 0 0 0"), ("0.3 2", "0.3 2 0 0 0"), ("", "0 1 0 0 0")])
def test_coefficients_that_are_not_written_keep_their_defaults(written, whole, tmp_path):
    slides = "".join(
        f'<body><joint name="{name}" type="slide"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>'
        for name in "ab"
    )
    attribute = f'polycoef="{written}"' if written else ""
    short = model(tmp_path, slides, f'<joint joint1="a" joint2="b" {attribute}/>')
    assert (
        short.constraints == model(tmp_path, slides, f'<joint joint1="a" joint2="b" polycoef="{whole}"/>').constraints
    )


BARS = (
    f'<body name="crank"><joint name="a" axis="0 1 0"/>{ROD}<body name="bar" pos="0 0 0.4">'
    f'<joint name="b" axis="0 1 0"/>{ROD}</body></body><body name="rocker" pos="1 0 0"><joint name="c" axis="0 1 0"/>'
    f"{ROD}</body>"
)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("equality", "sites", "count"),
    [
        ('<connect body1="one" body2="two" anchor="0.3 0 0.1"/>', False, 3),
        ('<weld body1="one" body2="two"/>', False, 6),
        ('<connect site1="s_one" site2="s_two"/>', True, 3),
        ('<weld site1="s_one" site2="s_two"/>', True, 6),
    ],
)
def test_closures_in_a_turned_parent(equality, sites, count, tmp_path):
    """Bodies on a turned stand, one on a ball joint, one that is free: the equations beside poses composed by SciPy."""

    def pose(position, angles):
        result = np.eye(4)
        result[:3, 3], result[:3, :3] = position, Rotation.from_euler("XYZ", angles).as_matrix()
        return result

    def text(values):
        return " ".join(map(str, values))

    stand = (0.1, 0.2, 0.3), (0.4, -0.3, 0.7)
    bodies = {"one": ((0, 0.5, 0), (0.2, 0.1, 0.5)), "two": ((0.4, 0, 0.2), (-0.3, 0.5, 0.1))}
    ends = {"one": ((0.3, 0, 0.1), (0.1, 0.2, 0.3)), "two": ((0.2, 0.3, -0.1), (0, -0.4, 0.2))}
    axes = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
    slides = {"one": "", "two": "".join(f'<joint name="{k}" type="slide" axis="{n}"/>' for k, n in axes.items())}
    parts = "".join(
        f'<body name="{name}" pos="{text(p)}" euler="{text(r)}">{slides[name]}<joint name="j_{name}" type="ball"/>{BOX}'
        f'<site name="s_{name}" pos="{text(ends[name][0])}" euler="{text(ends[name][1])}"/></body>'
        for name, (p, r) in bodies.items()
    )
    base = f'<body name="stand" pos="{text(stand[0])}" euler="{text(stand[1])}">{parts}</body>'
    system = model(tmp_path, base, equality)
    assert len(system.constraints) == count
    at_rest = {name: pose(*stand) @ pose(*place) for name, place in bodies.items()}
    turns = {"one": Rotation.from_rotvec([0.3, -0.5, 0.2]), "two": Rotation.from_rotvec([-0.1, 0.4, 0.6])}
    values = {"x": 0.2, "y": -0.3, "z": 0.1}
    moved = at_rest | {"two": at_rest["two"] @ pose((0.2, -0.3, 0.1), (0, 0, 0))}
    for name, turn in turns.items():
        moved[name] = moved[name] @ pose((0, 0, 0), turn.as_euler("XYZ"))
        values |= dict(zip((f"R_j_{name}_{letter}" for letter in "xyzw"), turn.as_quat(), strict=True))
    if sites:
        frames = [moved[name] @ pose(*ends[name]) for name in bodies]
    elif "weld" in equality:
        frames = [moved["one"] @ np.linalg.solve(at_rest["one"], at_rest["two"]), moved["two"]]
    else:
        anchor = np.linalg.solve(at_rest["two"], at_rest["one"] @ pose((0.3, 0, 0.1), (0, 0, 0)))
        frames = [moved["one"] @ pose((0.3, 0, 0.1), (0, 0, 0)), moved["two"] @ anchor]
    relative = frames[0][:3, :3].T @ frames[1][:3, :3]
    spin = (relative - relative.T)[[2, 0, 1], [1, 2, 0]]
    expected = [*pose(*stand)[:3, :3].T @ (frames[0] - frames[1])[:3, 3], *spin][:count]
    symbols = {each: values[each.name] for formula in system.constraints for each in formula.free_symbols}
    found = [float(evaluate(formula, symbols)) for formula in system.constraints]
    np.testing.assert_allclose(np.sort(np.abs(found)), np.sort(np.abs(expected)), rtol=0, atol=1e-12)


def test_equations_across_the_plane_of_a_mechanism_are_omitted(tmp_path):
    loop = '<connect body1="bar" body2="rocker" anchor="1 0 0.1"/>'
    assert len(model(tmp_path, BARS, loop).constraints) == 2
    assert len(model(tmp_path, BARS, '<weld body1="bar" body2="rocker"/>').constraints) == 3
    assert model(tmp_path, BARS, loop.replace("/>", ' active="false"/>')).constraints == ()


@pytest.mark.parametrize(
    ("equality", "message"),
    [
        ('<connect body1="ba" anchor="0 0 0"/>', "names the body 'ba', which does not exist; did you mean 'bar'"),
        ('<weld site1="end" site2="top"/>', "names the site 'end', which does not exist"),
        ('<joint joint1="d"/>', "names the hinge or slide 'd', which does not exist"),
        ('<tendon tendon1="t"/>', "<tendon> 'tendon' names the tendon 't', which does not exist"),
        ('<weld body1="bar" relpose="1 2 3"/>', "must be 7 finite numbers"),
    ],
)
def test_equalities_that_cannot_be_read_are_refused_by_name(equality, message, tmp_path):
    with pytest.raises(SystemDefinitionError, match=message):
        model(tmp_path, BARS, equality)


def parallelograms(count):
    """Return MJCF and URDF of a free body with cranks, whose couplers and rockers close loops or follow the cranks."""
    masses = {"base": (9, 0, 0), "crank": (1, 0, -0.2), "coupler": (0.7, 0.2, 0), "rocker": (1.2, 0, -0.2)}
    inertia = '<inertial pos="{1} 0 {2}" mass="{0}" diaginertia="0.3 0.2 0.1"/>'
    origin = '<inertial><origin xyz="{1} 0 {2}"/><mass value="{0}"/><inertia ixx="0.3" iyy="0.2" izz="0.1" '
    origin += 'ixy="0" ixz="0" iyz="0"/></inertial>'
    body, link = ({name: text.format(*row) for name, row in masses.items()} for text in (inertia, origin))
    bodies, loops, links = "", "", f'<link name="base">{link["base"]}</link>'
    for k in range(count):
        place = np.array([np.cos(k), np.sin(k), 0.1 * k])
        beside = place + np.array([0.5, 0, 0])
        parts = [("crank", "base", place), ("coupler", "crank", [0, 0, -0.4]), ("rocker", "base", beside)]
        opened = [
            f'<body name="{name}{k}" pos="{" ".join(map(str, at))}">{body[name]}<joint name="{name}{k}" axis="0 1 0"/>'
            for name, _, at in parts
        ]
        bodies += f"{opened[0]}{opened[1]}</body></body>{opened[2]}</body>"
        loops += f'<connect body1="coupler{k}" body2="rocker{k}" anchor="0.5 0 0"/>'
        for (name, parent, at), turn in zip(parts, (None, -1, 1), strict=True):
            mimic = f'<mimic joint="crank{k}" multiplier="{turn}"/>' if turn else ""
            links += f'<link name="{name}{k}">{link[name]}</link><joint name="{name}{k}" type="continuous">{mimic}'
            links += f'<parent link="{parent}{k if parent == "crank" else ""}"/><child link="{name}{k}"/>'
            links += f'<axis xyz="0 1 0"/><origin xyz="{" ".join(map(str, at))}"/></joint>'
    return f'<body name="base"><freejoint/>{body["base"]}{bodies}</body>', loops, f'<robot name="r">{links}</robot>'


@pytest.mark.rotated
@pytest.mark.parametrize(("count", "solver"), [(3, "newton"), pytest.param(9, "auto", marks=pytest.mark.rotated)])
def test_many_loops_on_a_free_base_move_as_the_tree_of_their_cranks(count, solver, tmp_path):
    bodies, loops, robot = parallelograms(count)
    (tmp_path / "robot.urdf").write_text(robot)
    tree = sc.LagrangianSystem.from_urdf(tmp_path / "robot.urdf", floating=True)
    closed = model(tmp_path, bodies, loops)
    assert len(closed.constraints) == 2 * count
    rates = {f"crank{k}": 1 + 0.3 * k for k in range(count)}
    free = {f"{x}_base": 0.1 * n for n, x in enumerate("xyz")} | {"omega_base": OMEGA}
    start = {f"{x}_base": 0.0 for x in "xyz"} | {"R_base": TURNED}
    turns = {f"{name}{k}": turn for k in range(count) for name, turn in (("crank", 1), ("coupler", -1), ("rocker", 1))}
    states = []
    for system in (closed, tree):
        angles = {name: 0.2 * turn for name, turn in turns.items() if name in map(str, system.coordinates)}
        velocity = free | {name: np.sign(a) * rates["crank" + name[-1]] for name, a in angles.items()}
        stepper = sc.compile_stepper(system, "svi:3", solver=solver if system is closed else "auto")
        states.append(stepper.integrate(start | angles, velocity=velocity, h=0.01, steps=20))
    assert np.ptp(states[0].energy()) < 1e-8
    for name in (*rates, "x_base", "z_base", "R_base_w", "R_base_y"):
        assert states[0][name][-1] == pytest.approx(states[1][name][-1], abs=1e-11)
