"""Outcome of each kind of robot's file: it moves as by MuJoCo or Pinocchio, or is refused with a reason.

Rows of MJCF have the joints of two bodies, one on the other, and further sections; those of URDF two joints.
"""

import re
from typing import Any

import numpy as np
import pytest
from random_robots import BOX, FACES, by_pinocchio, errors, errors_of_motion

import scvi_codegen as sc
from scvi_codegen.common.errors import ContactError, SystemDefinitionError, SystemDefinitionWarning

MJCF = """<mujoco><compiler {compiler}/><option gravity="0 1 -9" {option}><flag contact="disable"/></option><asset>
<mesh name="m" vertex="{box}" face="{faces}"/></asset><worldbody><site name="w" pos=".1 .5 .2"/>
<body name="a" pos=".1 .2 .3" euler=".1 .2 .3">{a}<geom name="ga" size=".1" pos=".3 .1 0"/>
<site name="s" pos=".3 .1 .1"/>
<body name="b" pos=".3 0 0">{b}<geom type="box" size=".1 .2 .3" pos=".3 0 .1"/><site name="e" pos=".2 .2 .1"/></body>
</body></worldbody>{rest}</mujoco>"""
A, B = '<joint name="x" axis="1 2 3" {}/>', '<joint name="y" axis="0 1 0" {}/>'
PATH = '<tendon><spatial name="t" stiffness="3"><site site="w"/>{}<site site="e"/></spatial></tendon>'
SUM = """<tendon><fixed springlength=".1 .2" stiffness="3 2 1" damping="1 2 3"><joint joint="x" coef=".5"/>
<joint joint="y" coef="-2"/></fixed></tendon>"""
BALLS = '<joint name="x" type="ball" stiffness="3 2 1" damping="1 2 3"/>', '<joint name="y" type="ball"/>'
RATIOS = '<actuator><position joint="{}" kp="3" dampratio=".7" gear="2" inheritrange=".8"/></actuator>'
CLASSES = """<default><default class="p"><position kp="4" kv="1" inheritrange="1"/></default><default class="g">
<general gainprm="2 3" biasprm="1 -2" gaintype="affine"/><intvelocity kp="3" dampratio=".7"/></default>
<default class="d"><damper kv="2"/></default></default><actuator><velocity joint="x" class="p" gear="2"/>
<general joint="y" class="p" gear="-1"/><motor joint="y" class="p" gear="3"/><position joint="y" class="p" kv=".7"/>
<damper joint="y" class="p" ctrlrange="0 1" kv=".5" forcerange="-.1 .2"/><cylinder joint="y" class="p" bias="1 2 3"/>
<general joint="x" class="g" actrange="-.1 .2" gear="2"/><position joint="x" class="g" kp="5" gear="2"/>
<velocity joint="x" class="d" kv="2" ctrlrange="0 1"/></actuator>"""
ACTIVATED = """<actuator><intvelocity joint="x" kp="3" kv="2" actrange="-.1 .2" gear="2"/>
<position joint="y" kp="3" timeconst=".1" ctrlrange="-.2 .1" gear="2"/><cylinder joint="y" diameter="2" bias="1 2 3"/>
<general joint="x" dyntype="integrator" gainprm="2" actrange="-1 0" gear="3"/><motor joint="y" group="3"/>
<damper joint="x" kv="2" ctrlrange="0 1" gear="2"/></actuator>"""
LIMITED = """<actuator><damper joint="x" kv="2" ctrlrange="0 1" forcerange="-.1 .2" gear="2"/>
<general joint="y" gaintype="affine" gainprm="1 2 3" forcerange="-.3 .3" gear="2"/></actuator>"""
SEVERAL = """<actuator><motor joint="x" gear="2"/><position joint="x" kp="2" kv="1" gear="-3"/>
<velocity jointinparent="y" kv="3" forcerange="-.2 .2" gear="-3"/><motor site="e" gear="0 0 3"/></actuator>"""
ON_SITES = '<actuator>{} gear="-1 2 3 .5 .7 -.3"/></actuator>'
ON_BALLS = """<actuator><position joint="x" kp="2" kv="1" gear="1 2 3"/>
<position jointinparent="x" kp="2" kv="1" gear="-1 2 1"/></actuator>"""
ON_FREE = (
    '<actuator><motor joint="f" gear="1 2 3 -1 .5 .7"/><motor jointinparent="f" gear="1 2 3 -1 .5 .7"/></actuator>'
)
ELLIPSOIDS = (
    '<geom type="{}" size="{}" pos=".1 0 .2" euler=".3 .2 .1" fluidshape="ellipsoid" fluidcoef=".3 .2 1 .7 .6"/>'
)
TENDONS = """<tendon><fixed name="s" range="-.4 .7"><joint joint="x" coef=".5"/><joint joint="y" coef="-2"/></fixed>
<spatial name="t" actuatorfrcrange="-.1 .2"><site site="w"/><site site="e"/></spatial><fixed name="r"
actuatorfrcrange="-.1 .2"><joint joint="y" coef=".5"/></fixed></tendon><actuator>
<position tendon="s" kp="2" gear="3" inheritrange=".8"/><velocity tendon="t" kv="3" gear="2"/>
<motor tendon="r" gear="2"/><position tendon="r" kp="3" gear="-3"/></actuator>"""
FLUID = {"option": 'density="9" viscosity="1"'}
BALL, FREE = '<joint name="x" type="ball"/>', '<freejoint name="f"/>'
READ = {
    "names with other characters": {"a": A.replace('"x"', '"1-hip/π"'), "b": B.replace('"y"', '"exp"')},
    "free base": {"a": '<freejoint name="f" align="false"/>'},
    "slack tendon": {"a": A.format('springref=".2"'), "b": B.format('ref=".1"'), "rest": SUM},
    "tendon of balls": {
        "a": BALLS[0],
        "b": BALLS[1],
        "rest": PATH.replace('"3"', '"3" springlength=".2" armature=".4" damping=".2"'),
    },
    "springs of free bodies": {"a": BALLS[0].replace("ball", "free")},
    "free in a medium": FLUID | {"a": FREE + '<geom size=".2"/>', "b": BALLS[1]},
    "bounds of inertias": {"compiler": 'boundmass="30" boundinertia=".2"'},
    "balanced inertias": {
        "compiler": 'balanceinertia="true"',
        "b": B + '<inertial pos=".1 0 0" mass="1" diaginertia=".1 .2 .9"/>',
    },
    "meshes": {"b": B + '<geom type="mesh" mesh="m"/>'},
    "replicate": {"b": B + '<replicate count="3" euler="0 0 1"><geom size=".1" pos="1 0 0"/></replicate>'},
    "attach": {"rest": '<worldbody><attach body="a" prefix="p"/></worldbody>'},
    "medium, equal moments": FLUID | {"a": A + '<geom size=".05" euler="1 0 0" mass="0"/>'},
    "servos by damping ratios and ranges of joints": {
        "a": A.format('range="-1 .5" ref=".3" armature=".2"'),
        "b": B.format('type="slide" range="-.4 .1" ref="-.1"'),
        "rest": RATIOS.format("x") + RATIOS.format("y"),
    },
    "thrusts and torques of sites": {"a": FREE, "rest": ON_SITES.format('<motor site="s"')},
    "servos between sites": {"rest": ON_SITES.format('<position site="e" refsite="s" kp="2" kv="1"')},
    "ranges of tendons": {"rest": TENDONS},
    "servos of a site of a free body, whose range has a long formula": {
        "a": FREE,
        "rest": ON_SITES.format('<position site="e" kp="2" kv="1" forcerange="-3 2"'),
    },
    "servos of a site in the world": {
        "a": BALL,
        "rest": ON_SITES.format('<position site="e" refsite="w" kp="2" kv="1" forcerange="-3 2"').replace(
            "-1 2 3 ", ""
        ),
    },
    "ball joints with servos": {"a": BALL, "rest": ON_BALLS},
    "free joints with motors": {"a": FREE, "rest": ON_FREE},
    "activations as inputs": {"rest": ACTIVATED, "option": 'actuatorgroupdisable="1 3"'},
    "actuators over classes of others": {
        "rest": CLASSES,
        "a": A.format('range="-1 .5"'),
        "b": B.format('range="-1 .7"'),
    },
    "forces of gains of velocities in ranges": {"rest": LIMITED},
    "ranges of the forces of several actuators on joints": {
        "a": A.format('actuatorfrcrange="-.2 .1"'),
        "b": B.format('type="slide" actuatorfrcrange="-.1 .3"'),
        "rest": SEVERAL,
    },
    "ellipsoids in a medium": FLUID
    | {"b": B + ELLIPSOIDS.format("sphere", ".1") + ELLIPSOIDS.format("ellipsoid", ".3 .1 .2")},
    "other ellipsoids in a medium": FLUID
    | {
        "a": FREE + ELLIPSOIDS.format("cylinder", ".1 .3"),
        "b": B.replace("/>", ' type="ball"/>') + ELLIPSOIDS.format("capsule", ".1 .2"),
    },
    "springdamper": {
        "compiler": 'settotalmass="3"',
        "a": '<joint name="x" type="free" springdamper="1 .5"/>',
        "b": B.format('springdamper=".5 .7" armature=".3" ref=".2" stiffness="1 2" damping="1 2"'),
        "rest": '<actuator><motor joint="y" gear="2" armature=".1" damping=".2"/></actuator>',
    },
}
UNREAD = {
    "ellipsoid of a mesh": (
        FLUID | {"b": B + '<geom type="mesh" mesh="m" fluidshape="ellipsoid"/>'},
        "is a mesh with fluidshape='ellipsoid', which is read of sphere, ellipsoid, box, cylinder, capsule",
    ),
    "wrapping": ({"rest": PATH.format('<geom geom="ga"/>')}, "which is read through sites only, without wrapping"),
    "springdamper and rotor of a tendon": (
        {"a": A.format('springdamper="1 1"'), "rest": PATH.format("").replace("stiffness", "armature")},
        "has armature, which is not read with the springdamper of 'x'",
    ),
    "shell": ({"b": B + '<geom size=".1" shellinertia="true"/>'}, "whose inertia is not computed: give its body an"),
    "massless leaf": ({"b": '<body><joint name="z"/></body>' + B}, "joint 'z' moves no mass"),
    "equality of an unknown tendon": (
        {"rest": PATH.format("") + '<equality><tendon tendon1="t" tendon2="u"/></equality>'},
        "names the tendon 'u', which does not exist",
    ),
    "equality of flexible bodies": (
        {"rest": '<equality><flex flex="f"/></equality>'},
        "is not read: remove it or write a constraint",
    ),
}
LINKS = """<link name="{}"><inertial><origin xyz=".1 0 .2" rpy=".1 .2 .3"/><mass value="1"/>
<inertia ixx=".2" iyy=".3" izz=".25" ixy="0" ixz="0" iyz="0"/></inertial><visual><geometry>
<mesh filename="package://robot/a.stl"/></geometry></visual></link>"""
JOINT = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="0 .1 .2"/>{}</joint>'
AXIS = '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>'
ORIENTED = f'{AXIS}<dynamics damping=".2"/>'
URDF = {
    "revolute, meshes of packages": ("revolute", ORIENTED, ""),
    "prismatic": ("prismatic", AXIS, ""),
    "other namespaces and frames": ("revolute", f"{AXIS}<drake:own/>", '<frame name="f" link="c"/>'),
    "mimic": ("revolute", f'{AXIS}<mimic joint="x" multiplier="2"/>', ""),
}


def moved(system: Any) -> None:
    """Integrate from the reference configuration."""
    start = system.keyframes["qpos0"]
    velocity = {name: np.full(np.shape(rate), 0.1) for name, rate in start["velocity"].items()}
    run = sc.compile_stepper(system, "svi:2").integrate(**start | {"velocity": velocity}, h=0.001, steps=3)
    assert np.isfinite(run.q).all()
    assert run.q[-1].tolist() != run.q[0].tolist()


def written(file: Any, **parts: str) -> Any:
    """Write a file of MJCF with parts in place of the default ones."""
    defaults = {"compiler": 'angle="radian"', "option": "", "a": A, "b": B, "rest": "", "box": BOX, "faces": FACES}
    file.write_text(MJCF.format(**{key: value.replace("{}", "") for key, value in (defaults | parts).items()}))
    return file


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("kind", READ)
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.SystemDefinitionWarning")
@pytest.mark.filterwarnings("ignore:the stepper of .* does not locate .*, of 20715 terms")
def test_outcome_of_mjcf_that_is_read(kind, tmp_path):
    file = written(tmp_path / "robot.xml", **READ[kind])
    system = sc.LagrangianSystem.from_mjcf(file, actuators=True)
    moved(system)
    pytest.importorskip("mujoco", reason="pip install mujoco")
    assert max(errors_of_motion(system, file)) < 1e-8


@pytest.mark.parametrize("kind", UNREAD)
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.SystemDefinitionWarning")
def test_outcome_of_mjcf_that_is_refused(kind, tmp_path):
    file = written(tmp_path / "robot.xml", **UNREAD[kind][0])
    with pytest.raises(SystemDefinitionError, match=re.escape(UNREAD[kind][1])):
        sc.LagrangianSystem.from_mjcf(file, actuators=True)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("kind", URDF)
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.SystemDefinitionWarning")
def test_outcome_of_urdf(kind, tmp_path):
    (joint, inner, rest), file = URDF[kind], tmp_path / "robot.urdf"
    joints = JOINT.format("x", "continuous", "a", "b", ORIENTED) + JOINT.format("y", joint, "b", "c", inner)
    file.write_text(f'<robot name="r">{"".join(map(LINKS.format, "abc"))}{joints}{rest}</robot>')
    system = sc.LagrangianSystem.from_urdf(file)
    moved(system)
    pytest.importorskip("pinocchio", reason="pip install pin")
    follower = {"y": ("x", 2.0, 0.0)} if kind == "mimic" else {}
    assert max(errors(system, by_pinocchio(file, False, follower))) < 1e-8


def test_the_link_world_needs_no_declaration(tmp_path):
    joints = JOINT.format("w", "fixed", "world", "a", "") + JOINT.format("x", "revolute", "a", "b", AXIS)
    file, systems = tmp_path / "robot.urdf", []
    for world in ("", '<link name="world"/>'):
        file.write_text(f'<robot name="r">{world}{"".join(map(LINKS.format, "ab"))}{joints}</robot>')
        systems.append(sc.LagrangianSystem.from_urdf(file))
    assert systems[0] == systems[1]


HINGE = {"a": A.format('range="10 60"')}
ROPE = {"rest": '<tendon><fixed name="t" range="-1 1"><joint joint="x" coef="2"/></fixed></tendon>'}
OUTSIDE = {
    "reference": (HINGE, "2 0", "qpos0", "lower limit of joint 'x'", -np.pi / 18),
    "hinge": (HINGE, "2 0", "far", "upper limit of joint 'x'", np.pi / 3 - 2),
    "ball": (
        {"a": '<joint name="x" type="ball" range="0 60"/>', "b": ""},
        "0 1 0 0",
        "far",
        "limit of joint 'x'",
        -np.sqrt(3),
    ),
    "tendon": (ROPE, "2 0", "far", "upper limit of tendon 't'", -3.0),
}
"""Parts, place, state, limit, and the gap there; of a ball (cos a - cos 60)/sin 60, here for a half turn."""


@pytest.mark.second
@pytest.mark.parametrize("kind", OUTSIDE)
def test_outcome_of_states_outside_limits(kind, tmp_path):
    file, (parts, place, state, limit, gap) = tmp_path / "robot.xml", OUTSIDE[kind]
    key = f'<keyframe><key name="far" qpos="{place}"/></keyframe>'
    written(file, **parts | {"compiler": "", "rest": parts.get("rest", "") + key})
    with pytest.warns(SystemDefinitionWarning, match=f"'{state}' with the {limit} of the range .* at {gap:.6g}"):
        system = sc.LagrangianSystem.from_mjcf(file, limits="contact")
    with pytest.raises(ContactError, match=f"{limit} of the range .* at {gap:.6g}"):
        sc.compile_stepper(system, "svi:2").integrate(**system.keyframes[state], h=0.01, steps=2)


def test_outcome_of_a_quaternion_of_length_0(tmp_path):
    """It is no rotation, as for MuJoCo."""
    file, (parts, *_) = tmp_path / "robot.xml", OUTSIDE["ball"]
    key = '<keyframe><key name="k" qpos="0 0 0 0"/></keyframe>'
    written(file, **parts | {"compiler": "", "rest": parts.get("rest", "") + key})
    (turn,) = sc.LagrangianSystem.from_mjcf(file, limits="contact").keyframes["k"]["q"].values()
    assert turn == [1, 0, 0, 0]
