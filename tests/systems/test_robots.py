"""Robots from URDF and MJCF: what is read, and errors of malformed files; energies: test_random_robots.py."""

import re
import shutil
import subprocess
import sys
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from random_robots import errors_of_motion

import scvi_codegen as sc
from scvi_codegen.common.errors import ContactError, SystemDefinitionError, SystemDefinitionWarning
from scvi_codegen.extras.robots.trees.shapes import SHAPES
from scvi_codegen.systems.formulas.expressions import evaluate

ROBOTS = Path(__file__).parent / "robots"


def value(system: Any, rate: float) -> float:
    """Lagrangian at entries of rotations and coordinates whose velocities are in proportion to the rate."""
    formula = system.reduced.lagrangian
    places = {x: 0.3 + 0.1 * k for k, x in enumerate(sorted(formula.free_symbols, key=str))}
    moving = {x: v * rate if "omega" in x.name or "_dot" in x.name else v for x, v in places.items()}
    return float(evaluate(formula, moving))


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("shape", SHAPES)
def test_inertias_of_shapes_are_integrals(shape):
    size = np.array([0.5, 0.7, 0.9][: SHAPES[shape][0]])
    centers = (np.arange(160) + 0.5) / 160 * 2.8 - 1.4
    x, y, z = np.meshgrid(centers, centers, centers, indexing="ij")
    inside = {
        "sphere": lambda: x**2 + y**2 + z**2 < size[0] ** 2,
        "ellipsoid": lambda: (x / size[0]) ** 2 + (y / size[1]) ** 2 + (z / size[-1]) ** 2 < 1,
        "box": lambda: (abs(x) < size[0]) & (abs(y) < size[1]) & (abs(z) < size[-1]),
        "cylinder": lambda: (x**2 + y**2 < size[0] ** 2) & (abs(z) < size[1]),
        "capsule": lambda: x**2 + y**2 + np.maximum(abs(z) - size[-1], 0) ** 2 < size[0] ** 2,
    }[shape]()
    squares = np.array([(each[inside] ** 2).mean() for each in (x, y, z)])
    volume, moments = SHAPES[shape][1](size)
    assert volume == pytest.approx(inside.sum() * (2.8 / 160) ** 3, rel=0.02)
    assert moments == pytest.approx(squares.sum() - squares, rel=0.03)


def test_damping_and_actuators_act_on_joints():
    system = sc.LagrangianSystem.from_urdf(ROBOTS / "arm.urdf", actuated=["rail-1"], gravity=(0, 0, -1.62))
    assert system.inputs == ("tau_rail_1",)
    assert system.forces[0] == -system.velocities[0] / 4
    assert sympy.Symbol("tau_rail_1_0") in {sympy.Symbol(each.name) for each in system.forces[1].free_symbols}


@pytest.mark.tiers(0, 1)
def test_runs_of_a_ball_joint_and_a_hinge_keep_energy_and_vertical_momentum():
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(ROBOTS / "ball.xml"), "svi:3")
    start, rates = {"R_ball": [1, 0.2, 0.1, 0], "swing": 0.4}, {"omega_ball": [0.3, 0.2, 1.0], "swing": 0.5}
    errors = []
    for h in (0.02, 0.01):
        energy = stepper.integrate(start, velocity=rates, h=h, t_end=5.0).energy()
        errors.append(np.abs(energy - energy[0]).max())
    assert errors[1] < errors[0] / 40 < 1e-7  # order 6
    momentum = stepper.integrate(start, velocity=rates, h=0.02, steps=250).angular_momentum("R_ball")
    assert np.abs(momentum[:, 2] - momentum[0, 2]).max() < 1e-12


URDF = {
    "not XML": ("</robot>", "", "is not XML"),
    "entities": ('<robot name="arm"', '<!DOCTYPE a [<!ENTITY b "c">]><robot name="arm"', "entities"),
    "another element": ("robot", "sdf", "begins with <sdf>, not with <robot>"),
    "missing link": ('<child link="tool"/>', '<child link="tol"/>', "'tol', which does not"),
    "two parents": ('<child link="finger"/>', '<child link="tool"/>', "moves as well"),
    "circle": ('<parent link="base"/>', '<parent link="finger"/>', "form a circle"),
    "kind": ('"prismatic"', '"helical"', "is of type 'helical', which is not read; possible: fixed, revolute"),
    "massless": ("inertial>", "visual>", "'shoulder' moves no mass"),
    "substitution": ("1 2 -2", "$(optenv X)", "write the file that xacro makes of it"),
    "older": ("<dynamics damp", "<joint_properties damp", "is not read: write <dynamics>"),
    "axis": ("1 2 -2", "0 0 0", "must not be zero"),
    "numbers": ("1 2 -2", "1 2", "3 finite numbers"),
    "text": ("1 2 -2", "1 2 x", "must be numbers"),
    "infinite": ("1 2 -2", "1 2 inf", "must be numbers"),
    "negative": ('mass value="1.2"', 'mass value="-1.2"', "has the value -1.2, which must not be < 0"),
    "negative moment": ('ixx="0.05"', 'ixx="-0.05"', "'upper', with the links fixed to it,"),
    "twice": ('link name="tool"', 'link name="base"', "is defined twice"),
    "no value": ('<mass value="1.2"/>', "<mass/>", "has no attribute 'value'"),
    "unknown attribute": ("damping", "dampnig", "'dampnig'; did you mean 'damping'?"),
    "unknown element": ("dynamics", "dynamcs", "<dynamcs>; did you mean 'dynamics'?"),
    "number of Python": ('damping="0.25"', 'damping="1_0"', "must be numbers"),
    "no number": ('damping="0.25"', 'damping="nan"', "must be numbers"),
    "large": ('damping="0.25"', 'damping="1e99"', "magnitude must be less than 1e+40"),
    "negative damping": ('damping="0.25"', 'damping="-1"', "damping -1, which must not be"),
    "impossible inertia": ('izz="0.003"', 'izz="0.3"', "which no body has"),
    "two axes": ("<limit", '<axis xyz="1 0 0"/><limit', "is the second <axis>"),
    "no mass": ('<mass value="1.2"/>', "", "needs <mass> and <inertia>"),
    "macro": ("</robot>", '<xacro:if xmlns:xacro="x"/></robot>', "write the file that xacro makes"),
    "itself": ('mimic joint="shoulder"', 'mimic joint="grip"', "itself: grip, grip"),
    "circle of joints": (
        'effort="10" velocity="5"/>\n    <dyn',
        'effort="10" velocity="5"/>\n    <mimic joint="grip"/>\n    <dyn',
        "'shoulder' follows itself: shoulder, grip, shoulder",
    ),
    "free inside": ('"prismatic"', '"floating"', "is free, but its parent moves: remove the joint"),
    "follows": ('mimic joint="shoulder"', 'mimic joint="sholder"', "'sholder', which is no"),
}
MJCF = {
    "equality": ("</mujoco>", "<equality><weld/></equality></mujoco>", "<weld> 'weld' has no attribute 'body1'"),
    "tendon": (
        "</mujoco>",
        '<tendon><spatial name="t" stiffness="1"><pulley divisor="2"/></spatial></tendon></mujoco>',
        "<pulley> 'pulley' in <spatial> 't' is on the tendon 't', which is read through sites only",
    ),
    "mesh": ('type="box"', 'type="box" mesh="m"', "give its body an <inertial>"),
    "class": ('childclass="limb"', 'childclass="lim"', "of the class 'lim'"),
    "orientations": ('quat="1 0.1 0.2 0.3"', 'quat="1 0 0 0" euler="0 0 0"', "quat and euler"),
    "free inside": ('type="ball"', 'type="free"', "inside another body"),
    "composite": ("</worldbody>", "<composite/></worldbody>", "write out what it makes"),
    "axes": ('eulerseq="zyx"', 'eulerseq="zy"', "is not three of the letters"),
    "name": ('name="slip"', 'name="flex"', "<joint> 'flex' is defined twice: rename one"),
    "include": ("<option", '<include file="none.xml"/><option', "none.xml cannot be read"),
    "include of a device": ("<option", '<include file="/dev/zero"/><option', "names '/dev/zero' outside the folder"),
    "include of a folder": ("<option", '<include file="."/><option', "it is no regular file"),
    "include of itself": ("<option", '<include file="figure.xml"/><option', "is included already"),
    "keyword": ('angle="degree"', 'angle="degrees"', "which must be degree or radian; did you mean 'degree'?"),
    "impossible inertia": ('fullinertia="0.1 0.2 0.15', 'fullinertia="0.1 0.2 1.5', "which no body has"),
    "medium": ("<option", '<option wind="1 0 0"', "wind='1 0 0', which changes the motion"),
    "tendon of a class": (
        "</mujoco>",
        '<default><tendon damping="1"/></default><tendon><fixed><joint joint="no" coef="1"/></fixed></tendon></mujoco>',
        "names the hinge or slide 'no', which does not exist",
    ),
    "actuator of a tendon": (
        "</mujoco>",
        '<actuator><motor tendon="t" armature="1"/></actuator></mujoco>',
        "which is read of actuators of hinges and slides only",
    ),
    "spring and damper": ('axis="0 1 0" ref="15"', 'axis="0 1 0" springyield="1"', "springyield='1', which changes"),
    "class twice": ("</default>", '</default><default class="limb"/>', "second of the class 'limb'"),
    "places": ('fromto="', 'pos="0 0 1" fromto="', "has pos and fromto"),
    "place": ('size="0.1 0.2 0.3"', "", "figure.xml:16: <geom> 'geom' in <body> 'torso' has no attribute 'size'"),
    "parallel": ('xyaxes="0 1 0 -1 0 0.2"', 'xyaxes="0 1 0 0 2 0"', "must be two different directions"),
    "size": ('size="0.1 0.2 0.3"', 'size="0.1 0.2"', "3 numbers > 0 are needed"),
    "sites": (
        "</mujoco>",
        '<equality><weld site1="a" body1="b"/></equality></mujoco>',
        "has site1 and body1: sites or bodies are needed",
    ),
}
WHOLE = {"another element", "entities", "impossible inertia", "massless", "include", "include of a folder"}
WHOLE |= {"negative moment", "not XML"}
"""Errors without a line."""


@pytest.mark.parametrize(("robot", "change"), [*product(["arm.urdf"], URDF), *product(["figure.xml"], MJCF)])
def test_malformed_files_are_refused_by_name(robot, change, tmp_path):
    (old, new, message), text = (URDF if robot == "arm.urdf" else MJCF)[change], (ROBOTS / robot).read_text()
    (file := tmp_path / robot).write_text(text.replace(old, new) if robot == "arm.urdf" else text.replace(old, new, 1))
    assert file.read_text() != text
    with pytest.raises(SystemDefinitionError, match=re.escape(message)) as refused:
        (sc.LagrangianSystem.from_urdf if robot == "arm.urdf" else sc.LagrangianSystem.from_mjcf)(file)
    assert change in WHOLE or re.search(r"(arm\.urdf|\.xml):\d+: <", str(refused.value))


def test_moments_of_inertia_are_checked_with_fixed_links(tmp_path):
    text, file = (ROBOTS / "arm.urdf").read_text(), tmp_path / "arm.urdf"
    negative = text.replace('ixx="0.001"', 'ixx="-0.001"')  # of the sensor: its sum with that of the arm is positive
    rounded = negative.replace('"0.0001"', '"-5.4e-20"').replace('"0.0002"', '"0"')
    file.write_text(text.replace('izz="0.003"', 'izz="0.3"'))
    with pytest.warns(SystemDefinitionWarning, match="which no body has"):
        sc.LagrangianSystem.from_urdf(file, check_inertias=False)
    file.write_text(text.replace('"revolute"', '"floating"'))
    with pytest.raises(SystemDefinitionError, match=r"urdf:\d+: <joint> 'shoulder' is free, but its parent moves"):
        sc.LagrangianSystem.from_urdf(file, floating=True)
    file.write_text(rounded)
    assert rounded != negative != text
    assert len(sc.LagrangianSystem.from_urdf(file).coordinates) == 2


def test_included_files_are_read_and_total_masses_scaled(tmp_path):
    text = (ROBOTS / "ball.xml").read_text()
    body = re.search("<worldbody>.*</worldbody>", text, re.DOTALL).group()
    (tmp_path / "body.xml").write_text(f"<mujocoinclude>{body}</mujocoinclude>")
    (tmp_path / "all.xml").write_text(text.replace(body, '<include file="body.xml"/>'))
    (tmp_path / "heavy.xml").write_text(text.replace("<worldbody>", '<compiler settotalmass="7"/><worldbody>'))
    one = sc.LagrangianSystem.from_mjcf(ROBOTS / "ball.xml")
    assert sc.LagrangianSystem.from_mjcf(tmp_path / "all.xml").lagrangian == one.lagrangian
    heavy = sc.LagrangianSystem.from_mjcf(tmp_path / "heavy.xml")
    masses = 3.0 + 0.5
    assert value(heavy, 0.7) == pytest.approx(value(one, 0.7) * 7 / masses)
    (tmp_path / "body.xml").write_text('<mujocoinclude><include file="body.xml"/></mujocoinclude>')
    with pytest.raises(SystemDefinitionError, match="included already"):
        sc.LagrangianSystem.from_mjcf(tmp_path / "all.xml")


def test_nested_includes_flags_and_groups_of_geoms_are_read(tmp_path):
    text, file = (ROBOTS / "ball.xml").read_text(), tmp_path / "all.xml"
    inside = re.search("<worldbody>(.*)</worldbody>", text, re.DOTALL).group(1)
    (tmp_path / "body.xml").write_text(f"<mujocoinclude>{inside}</mujocoinclude>")
    one = sc.LagrangianSystem.from_mjcf(ROBOTS / "ball.xml")
    file.write_text(text.replace(inside, '<frame><include file="body.xml"/></frame>'))
    assert sc.LagrangianSystem.from_mjcf(file).lagrangian == one.lagrangian
    still = '<option><flag gravity="disable" spring="disable" damper="disable"/></option><worldbody>'
    file.write_text(text.replace("<worldbody>", still))
    free = sc.LagrangianSystem.from_mjcf(file)
    assert value(free, 0.0) == 0.0 != value(one, 0.0)
    pin = '<mujoco><compiler {}/><worldbody><body><joint/><geom size="0.1" pos="1 0 0"/>{}</body></worldbody></mujoco>'
    seen = []
    for setting, geom in (("", ""), ('inertiagrouprange="0 2"', '<geom size="0.2" group="3"/>')):
        file.write_text(pin.format(setting, geom))
        seen.append(sc.LagrangianSystem.from_mjcf(file).lagrangian)
    assert seen[0] == seen[1]
    base = '<body name="base"><geom type="mesh" mesh="m"/>'  # fixed to the world
    file.write_text(text.replace(inside, f"{base}{inside}</body>"))
    assert sc.LagrangianSystem.from_mjcf(file).lagrangian == one.lagrangian
    file.write_text(text.replace("<worldbody>", '<compiler coordinate="global"/><worldbody>'))
    with pytest.raises(SystemDefinitionError, match="which changes the motion"):
        sc.LagrangianSystem.from_mjcf(file)


LIFT = {
    "mjcf": """<mujoco><worldbody>
<body><joint name="lift" type="slide" axis="0 0 1" range="-.5 1"/><geom size=".1" mass="1"/></body>
<body pos="2 0 0"><joint name="wheel" axis="0 0 1" frictionloss=".1" range="-90 90" limited="false"/>
<inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .1"/></body></worldbody></mujoco>""",
    "urdf": """<robot name="lift"><link name="base"/><link name="cage"><inertial>
<mass value="1"/>INERTIA</inertial></link>
<link name="disc"><inertial><mass value="1"/>INERTIA</inertial></link>
<joint name="lift" type="prismatic"><parent link="base"/><child link="cage"/><axis xyz="0 0 1"/>
<limit lower="-.5" upper="1" effort="1" velocity="1"/></joint><joint name="wheel" type="continuous">
<parent link="base"/><child link="disc"/><axis xyz="0 0 1"/><dynamics friction=".1"/></joint></robot>""".replace(
        "INERTIA", '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    ),
}


@pytest.mark.parametrize("kind", LIFT)
def test_limits_and_dry_friction_of_joints_are_contacts(kind, tmp_path):
    file = tmp_path / f"lift.{kind}"
    file.write_text(LIFT[kind])
    with pytest.warns(SystemDefinitionWarning, match="limits of joints lift; dry friction of joints wheel$"):
        assert not getattr(sc.LagrangianSystem, f"from_{kind}")(file).has_contacts
    system = getattr(sc.LagrangianSystem, f"from_{kind}")(file, limits="contact", friction="contact")
    stepper = sc.compile_stepper(system, "svi:2")
    run = stepper.integrate({"lift": 0.0, "wheel": 0.0}, velocity={"lift": 0.0, "wheel": 1.0}, h=0.05, t_end=1.5)
    (_, falls), (lands, rests), (stops, sticks) = run.contact_modes
    assert (falls, rests, sticks) == (("open", "open", "slip"), ("slip", "open", "slip"), ("slip", "open", "stick"))
    assert (lands, stops) == pytest.approx((np.sqrt(1 / 9.81), 1.0), rel=1e-13)
    assert run.q[-1] == pytest.approx([-0.5, 0.5], rel=1e-13)
    assert run.contact_forces()[-1, 0, 0] == pytest.approx(9.81, rel=1e-12)
    with pytest.raises(ContactError, match=r"contact 1 \(lower limit of joint 'lift' of the range -0.5 to 1\) at -0.2"):
        stepper.integrate({"lift": -0.7, "wheel": 0.0}, velocity={"lift": 0.0, "wheel": 1.0}, h=0.05, t_end=1.5)


@pytest.mark.tiers(0, 1)
def test_parts_of_models_that_are_not_read_are_named_in_one_warning(tmp_path):
    text, file = (ROBOTS / "figure.xml").read_text(), tmp_path / "figure.xml"
    text = text.replace('name="flex"', 'name="flex" range="-90 90" frictionloss="0.1"')
    text = text.replace("</mujoco>", '<actuator><position name="servo" joint="flex" kp="3"/></actuator></mujoco>')
    file.write_text(text)
    unread = "limits of joints flex; dry friction of joints flex; actuators servo; contacts$"
    with pytest.warns(SystemDefinitionWarning, match=unread) as caught:
        sc.LagrangianSystem.from_mjcf(file)
    assert [Path(warning.filename).name for warning in caught] == ["test_robots.py"]
    disabled = '<flag contact="disable" limit="disable" frictionloss="disable"/></option>'
    file.write_text(text.replace('<option gravity="0 1 -9"/>', f"<option>{disabled}"))
    with pytest.warns(SystemDefinitionWarning, match="without actuators servo$"):
        sc.LagrangianSystem.from_mjcf(file)


DEFAULTS = {
    "equality": (
        '<default><equality active="false"/></default>{hinge}<geom size="1"/>{end}'
        '<equality><joint joint1="q"/></equality>',
        '{hinge}<geom size="1"/>{end}',
    ),
    "actuators": (
        '<default><motor armature="2"/></default>{hinge}<geom size="1"/>{end}'
        '<actuator><motor joint="q" damping="3" gear="2"/></actuator>',
        '<default><joint armature="8" damping="12"/></default>{hinge}<geom size="1"/>{end}',
    ),
    "disabled forces": (
        '<option><flag spring="disable" damper="disable"/></option>{hinge}<geom size="1" pos="1 0 0"/>{end}',
        '{free}<geom size="1" pos="1 0 0"/>{end}',
    ),
    "disabled constraints": (
        '<option><flag constraint="disable"/></option>{hinge}<geom size="1"/>{end}'
        '<equality><joint joint1="q"/></equality>',
        '{hinge}<geom size="1"/>{end}',
    ),
}


@pytest.mark.parametrize("case", DEFAULTS)
def test_defaults_are_those_of_mujoco(case, tmp_path):
    parts = {
        "hinge": '<worldbody><body gravcomp="0.5"><joint name="q" axis="1 0 0" stiffness="1"/>',
        "free": '<worldbody><body><joint name="q" axis="1 0 0"/>',
        "end": "</body></worldbody>",
    }
    found = []
    for text in DEFAULTS[case]:
        file = tmp_path / "model.xml"
        file.write_text(f"<mujoco>{text.format(**parts)}</mujoco>")
        system = sc.LagrangianSystem.from_mjcf(file, name="model")
        found.append((system.lagrangian, system.forces, system.constraints))
    assert found[0] == found[1]


def test_included_files_are_sought_in_the_folder_of_the_main_document_first(tmp_path):
    (tmp_path / "parts").mkdir()
    body = '<mujocoinclude><body name="{}"><joint/><geom size="0.1" pos="1 0 0"/></body></mujocoinclude>'
    (tmp_path / "parts" / "all.xml").write_text('<mujocoinclude><include file="arm.xml"/></mujocoinclude>')
    (tmp_path / "parts" / "arm.xml").write_text(body.format("inner"))
    (tmp_path / "main.xml").write_text('<mujoco><worldbody><include file="parts/all.xml"/></worldbody></mujoco>')
    assert str(sc.LagrangianSystem.from_mjcf(tmp_path / "main.xml").coordinates[0]) == "inner"
    (tmp_path / "arm.xml").write_text(body.format("outer"))
    assert str(sc.LagrangianSystem.from_mjcf(tmp_path / "main.xml").coordinates[0]) == "outer"
    (tmp_path / "arm.xml").write_text(body.format("outer").replace("geom ", "goem "))
    with pytest.raises(SystemDefinitionError, match=r"arm\.xml:1: <body> 'outer' contains .*; did you mean 'geom'"):
        sc.LagrangianSystem.from_mjcf(tmp_path / "main.xml")


def test_deep_documents_are_read(tmp_path):
    depth, file = 1500, tmp_path / "deep.xml"
    inside = '<joint/><geom size="0.1" pos="1 0 0"/>'
    frames = f"{'<frame>' * depth}{inside}{'</frame>' * depth}"
    bodies = '<body pos="0 0 0.1">' * depth
    file.write_text(f"<mujoco><worldbody>{bodies}{frames}{'</body>' * depth}</worldbody></mujoco>")
    assert len(sc.LagrangianSystem.from_mjcf(file).coordinates) == 1


NAMES = """left-hip left_hip, left.hip left_hip_2, left/hip left_hip_3, 1_knee joint_1_knee, _x joint_x, θ1 theta1, É E,
t t_, pi pi_, int int_, exp exp_, q q, q_dot q_dot_2, 膝 joint_"""


def test_names_become_identifiers(tmp_path):
    file, expected = tmp_path / "names.xml", dict(pair.split() for pair in NAMES.split(","))
    bodies = "".join(f'<body pos="0 0 {k}"><joint name="{name}"/>{{0}}</body>' for k, name in enumerate(expected))
    ties = '<equality><joint joint1="left.hip" joint2="1_knee"/></equality>'
    part, head = '<geom size="0.1" pos="0.1 0 0"/>', '<mujoco model=""><option><flag contact="disable"/></option>'
    file.write_text(f"{head}<worldbody>{bodies.format(part)}</worldbody>{ties}</mujoco>")
    system = sc.LagrangianSystem.from_mjcf(file, actuated=["left/hip"])
    assert system.joint_names == expected
    assert [str(q) for q in system.coordinates] == [*expected.values()]
    assert (system.name, system.inputs) == ("names", ("tau_left_hip_3",))
    assert str(system.constraints[0]) == "(-joint_1_knee + left_hip_2)"


LEG = """<body pos="0 0 -.2"><joint name="hip{0}"/><geom pos="0 0 -.225" size=".05 .225"/><body pos="0 0 -.7">
<joint name="knee{0}" pos="0 0 .25"/><geom size=".04 .25"/><body pos=".2 0 -.35"><joint name="ankle{0}" pos="-.2 0 .1"/>
<geom pos="-.1 0 .1" size=".06 .1" zaxis="1 0 0"/></body></body></body>"""
DROPPED = f"""<mujoco><option><flag contact="disable"/></option><default><geom type="capsule"/><joint axis="0 -1 0"
armature=".01" damping=".1"/></default><worldbody><body pos="0 0 1.25"><joint name="x" type="slide" axis="1 0 0"
armature="0" damping="0"/><joint name="z" type="slide" axis="0 0 1" armature="0" damping="0" ref="1.25"/>
<joint name="pitch" axis="0 1 0" armature="0" damping="0"/><geom size=".05 .2"/>{LEG.format(1)}{LEG.format(2)}</body>
</worldbody></mujoco>"""


@pytest.mark.tiers(0, 1)
def test_joints_of_a_robot_that_is_dropped_stay_at_rest(tmp_path):
    (tmp_path / "robot.xml").write_text(DROPPED)
    robot = sc.LagrangianSystem.from_mjcf(tmp_path / "robot.xml")
    run = sc.compile_stepper(robot, "svi:3").integrate(**robot.keyframes["qpos0"], h=0.001, t_end=0.5)
    assert run.velocity[-1] == pytest.approx([0, -9.81 / 2, *[0] * 7], abs=1e-11)


@pytest.mark.rotated
@pytest.mark.parametrize("unit", [1.0, 1e3])
@pytest.mark.parametrize("method", ["svi:2", "svi:4", "svi:6"])
def test_dropped_robot_takes_no_more_adaptive_steps_than_one_whose_joints_turn(method, unit, tmp_path):
    """Joints at rest move by rounding alone, also where lengths and masses are numbers 1e3 times as large."""
    powers = {"pos": unit, "size": unit, "ref": unit, "armature": unit**3, "damping": unit**3}
    text = DROPPED.replace("<option", f'<option gravity="0 0 {-9.81 * unit}"').replace(
        '"capsule"', f'"capsule" density="{1000 / unit**2}"'
    )
    text = re.sub(
        r' (pos|size|ref|armature|damping)="(.*?)"',
        lambda m: f' {m[1]}="{" ".join(str(powers[m[1]] * float(x)) for x in m[2].split())}"',
        text,
    )
    (tmp_path / "robot.xml").write_text(text)
    robot = sc.LagrangianSystem.from_mjcf(tmp_path / "robot.xml")
    stepper, start = sc.compile_stepper(robot, method), robot.keyframes["qpos0"]["q"]
    for tolerance in (1e-6, 1e-10):
        rest, turning = (
            stepper.integrate(start, velocity=[0, 0, 0, *[v] * 6], t_end=0.1, tolerance=tolerance) for v in (0, 1e-3)
        )
        assert rest.steps <= 2 * turning.steps
        assert rest.q[-1] == pytest.approx([0, unit * (1.25 - 9.81 / 200), *[0] * 7], abs=1e-12 * unit)


PLANAR = """<joint name="slab" type="planar"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
<dynamics damping=".3"/></joint><drake:joint name="socket" type="ball"><parent link="b"/><child link="c"/></drake:joint>
<joint name="knee" type="revolute"><parent link="c"/><child link="d"/><axis xyz="0 1 0"/>
<dynamics damping=".2" spring_stiffness="3" spring_reference=".4"/></joint><frame name="f" link="d"/>
<transmission name="m"><joint name="knee"/><actuator name="m"><drake:rotor_inertia value=".01"/>
<drake:gear_ratio value="-20"/></actuator></transmission></robot>"""
SAME = """<mujoco model="r"><compiler angle="radian"/><default><joint damping=".3"/></default><worldbody><body>{0}
<joint name="x_slab" type="slide" axis="1 0 0"/><joint name="y_slab" type="slide" axis="0 1 0"/>
<joint name="angle_slab"/><body>{0}<joint name="socket" type="ball" damping="0"/><body>{0}<joint name="knee"
axis="0 1 0" damping=".2" stiffness="3" springref=".4" armature="4"/></body></body></body></worldbody></mujoco>"""


def test_joints_of_drake_are_those_of_mujoco(tmp_path):
    file, other = tmp_path / "robot.urdf", tmp_path / "robot.xml"
    inertia = '<origin xyz=".1 0 .2"/><mass value="1"/><inertia ixx=".2" iyy=".3" izz=".25" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="{each}"><inertial>{inertia}</inertial></link>' for each in "abcd")
    file.write_text(f'<robot name="r">{links}{PLANAR}')
    with pytest.warns(SystemDefinitionWarning, match="without elements <frame>; actuators m$"):
        system = sc.LagrangianSystem.from_urdf(file)
    other.write_text(SAME.format('<inertial pos=".1 0 .2" mass="1" diaginertia=".2 .3 .25"/>'))
    same = sc.LagrangianSystem.from_mjcf(other)
    assert (system.lagrangian, system.forces) == (same.lagrangian, same.forces)


FOUR_BAR = """<mujoco><option><flag contact="disable"/></option><default><geom type="capsule" size=".03"/></default>
<worldbody><body name="base">{base}<geom fromto="0 0 0 1 0 0"/>
 <body name="crank"><joint name="crank" axis="0 1 0"/><geom fromto="0 0 0 0 0 .4"/>
  <body name="coupler" pos="0 0 .4"><joint name="coupler" axis="0 1 0"/><geom fromto="0 0 0 1 0 .2"/></body></body>
 <body name="rocker" pos="1 0 0"><joint name="rocker" axis="{axis}"/><geom fromto="0 0 0 0 0 .6"/></body></body>
</worldbody><equality><connect body1="coupler" body2="rocker" anchor="1 0 .2"/></equality></mujoco>"""
TURNED, SPINNING = {"R_my_base": [1, 0.2, 0.1, 0.3]}, {"omega_my_base": [0.5, 0.3, 1.0]}
PLACE, SPEED = (
    {f"{x}_my_base": value for x, value in zip("xyz", v, strict=True)} for v in [(0.1, 0.2, 0), (0.1, 0, 1)]
)
BASES = {
    "fixed": ("", {}, {}),
    "yaw": ('<joint name="base" axis="0 0 1"/>', {"base": 0.3}, {"base": 1.0}),
    "roll": ('<joint name="base" axis="1 0 0"/>', {"base": 0.3}, {"base": 1.0}),
    "ball": ('<joint name="my-base" type="ball"/>', TURNED, SPINNING),
    "free": ('<freejoint name="my-base"/>', PLACE | TURNED, SPEED | SPINNING),
}


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("base", BASES)
def test_closed_loops_move_on_any_base(base, tmp_path):
    file, (joint, place, rates) = tmp_path / "loop.xml", BASES[base]
    file.write_text(FOUR_BAR.format(base=joint, axis="0 1 0"))
    system = sc.LagrangianSystem.from_mjcf(file)
    q, v = dict.fromkeys(["crank", "coupler", "rocker"], 0.0), {"crank": 2.0, "coupler": -2.0, "rocker": 4 / 3}
    run = sc.compile_stepper(system, "svi:3").integrate(q | place, velocity=v | rates, h=0.005, steps=50)
    ends = dict(zip(map(str, system.coordinates), run.q[-1], strict=True))
    crank, turned, rocker = ends["crank"], ends["crank"] + ends["coupler"], ends["rocker"]
    tip = 0.4 * np.exp(1j * crank) + (0.2 + 1j) * np.exp(1j * turned)  # z + i x
    assert abs(tip - 1j - 0.6 * np.exp(1j * rocker)) < 1e-12
    assert np.ptp(run.energy()) < 1e-9
    pytest.importorskip("mujoco", reason="pip install mujoco")
    assert max(errors_of_motion(system, file)) < 1e-12


def test_axes_of_loops_that_are_rounded_are_parallel(tmp_path):
    file = tmp_path / "loop.xml"
    file.write_text(FOUR_BAR.format(base="", axis="1e-6 1 0"))
    with pytest.warns(SystemDefinitionWarning, match="an equation of a closed loop is omitted"):
        assert len(sc.LagrangianSystem.from_mjcf(file).constraints) == 2
    file.write_text(FOUR_BAR.format(base="", axis=".1 1 0"))
    assert len(sc.LagrangianSystem.from_mjcf(file).constraints) == 3


def test_robot_in_which_nothing_moves_is_refused(tmp_path):
    file = tmp_path / "still.urdf"
    file.write_text('<robot name="still"><link name="base"/></robot>')
    with pytest.raises(SystemDefinitionError, match=r"from_urdf: floating=True, MJCF: <freejoint>"):
        sc.LagrangianSystem.from_urdf(file)
    with pytest.raises(SystemDefinitionError, match="no hinge or slide 'elbow'"):
        sc.LagrangianSystem.from_urdf(ROBOTS / "arm.urdf", actuated=["elbow"])
    with pytest.raises(SystemDefinitionError, match="cannot be read"):
        sc.LagrangianSystem.from_urdf(tmp_path / "none.urdf")


@pytest.mark.tiers(0, 1)
def test_robots_of_a_folder_are_listed_with_their_outcome(tmp_path):
    """By the script of the benchmarks; with MuJoCo, those of MJCF are equal."""
    script = Path(__file__).parents[2] / "benchmarks" / "robot_files.py"
    shutil.copytree(ROBOTS, tmp_path / "robots")
    (tmp_path / "robots" / "wrong.xml").write_text("<mujoco><worldbody><body><jiont/></body></worldbody></mujoco>")
    words = [sys.executable, str(script), str(tmp_path / "robots")]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(listed) == 5
    assert sum("loaded" in line for line in listed[:-1]) == 3
    assert sum("wrong.xml: refused" in line and "jiont" in line for line in listed) == 1
    assert "error of" not in "".join(listed)


@pytest.mark.rotated
def test_trials_and_last_steps_continue_curves_at_sizes_off_the_grid(tmp_path):
    """The last steps take 5 iterations from straight lines, and a search by larger factors than two up to 64."""
    rod = '<joint name="q{0}" axis="{1}"/><inertial pos="0 0 -.5" mass="1" diaginertia=".0833 .0833 .01"/>'
    axes = ("1 0 0", "0 1 0") * 6
    bodies = "".join(f'<body pos="0 0 {-min(k, 1)}">{rod.format(k, axis)}' for k, axis in enumerate(axes))
    (tmp_path / "chain.xml").write_text(f"<mujoco><worldbody>{bodies}{'</body>' * 12}</worldbody></mujoco>")
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(tmp_path / "chain.xml"), "svi:4")
    start = {"q": np.linspace(0.4, 0.6, 12), "t_end": 1.0}
    bounds = (
        (0.0, 1e-2, 10, 5),
        (0.0, 1e-5, 13, 5),
        (-0.3, 1e-2, 6, 3),
        (-0.3, 1e-5, 7, 5),
        (1, 1e-2, 14, 5),
        (1, 1e-5, 20, 8),
    )
    for speed, tolerance, first, last in bounds:
        velocity = np.linspace(speed, speed / 2, 12)
        exact = stepper.integrate(**start, velocity=velocity, tolerance=1e-11)
        run = stepper.integrate(**start, velocity=velocity, tolerance=tolerance)
        assert run.iterations[1] <= first
        assert run.iterations[-1] <= last
        assert abs(run.q[-1] - exact.q[-1]).max() < tolerance


@pytest.mark.second
def test_splittings_of_bodies_with_inclined_axes_of_inertia_have_two_words(tmp_path):
    """These axes are numbers of 60 digits."""
    ball = '<joint name="b" type="ball"/><geom type="capsule" size=".04" fromto="0 0 0 .1 0 -.5"/>'
    (tmp_path / "ball.xml").write_text(f"<mujoco><worldbody><body>{ball}</body></worldbody></mujoco>")
    system = sc.LagrangianSystem.from_mjcf(tmp_path / "ball.xml")
    start = {"q": {"R_b": [1, 0, 0, 0]}, "velocity": {"omega_b": [0.3, 0.4, 0.5]}, "h": 0.002, "steps": 50}
    one, two = (
        sc.compile_stepper(system, "stoermer-verlet", precision=precision).integrate(**start)
        for precision in ("double", "double-double")
    )
    assert two.q == pytest.approx(one.q, abs=1e-14)
