"""Actuators of MJCF as inputs of systems: gains by class, clamped controls, and motions; forces: test_robots.py."""

import re
from itertools import pairwise

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError, SystemDefinitionWarning
from scvi_codegen.runs.driver.segments import input_of

LIFT = """<mujoco><option gravity="0 0 0"/><default><default class="m"><muscle/></default></default>
<worldbody><body><joint name="x" type="slide"/>
<geom type="sphere" size=".1" mass="2"/><site name="t"/></body></worldbody><actuator>{actuators}</actuator></mujoco>"""
ARM = """<mujoco><option><flag contact="disable"/></option><default><geom type="capsule" size=".04"/>
<joint axis="0 1 0" damping=".1"/></default><worldbody><body><joint name="shoulder"/><geom fromto="0 0 0 0 0 -.5"/>
<body pos="0 0 -.5"><joint name="elbow"/><geom fromto="0 0 0 0 0 -.4"/></body></body></worldbody><actuator>
<position name="servo" joint="elbow" kp="20" kv="1" ctrlrange="-.5 .5"/>
<motor name="shoulder" joint="shoulder" ctrlrange="-4 4"/></actuator></mujoco>"""


def written(folder, text, **parts):
    file = folder / "model.xml"
    file.write_text(text.format(**parts) if parts else text)
    return file


@pytest.mark.second
def test_controls_are_clamped_inputs(tmp_path):
    motor = '<motor name="x" joint="x" gear="2" ctrlrange="-1 .5"/>'
    system = sc.LagrangianSystem.from_mjcf(written(tmp_path, LIFT, actuators=motor), actuators=True)
    assert (system.actuators, *system.input_ranges) == ({"x": "ctrl_x"}, ("ctrl_x", -1.0, 0.5))
    stepper = sc.compile_stepper(system, "svi:2")
    ramp = {"ctrl_x": ([0, 1, 2], [0, 1, 1])}  # force 2 t until t = 1/2, then 1, on the mass 2
    run = stepper.integrate([0.0], velocity=[0.0], inputs=ramp, h=0.1, t_end=1.5)
    assert [piece.t[0] for piece in run.pieces] == [0, 0.5, 1]
    assert run.q[-1, 0] == pytest.approx(1 / 48 + 1 / 8 + 1 / 4, rel=1e-14)  # t^3/6; then x + v s + s^2/4
    both = stepper.integrate_ensemble([[0.0], [0.0]], [[0.0], [0.0]], inputs={"ctrl_x": [3, -9]}, h=0.1, t_end=1)
    assert both.q[-1].ravel() == pytest.approx([0.25, -0.5], rel=1e-14)
    (held := stepper.start([0.0], velocity=[0.0], h=0.1)).set_inputs(ctrl_x=7)
    held.advance(10)
    assert held.q[0] == pytest.approx(0.25, rel=1e-14)


@pytest.mark.second
def test_clamped_functions_are_those_of_numpy():
    t = np.linspace(0, 3, 7)
    values = np.array([0, 2, -3, 1, 0.2, 0.1, 4])
    for kind in ("constant", "linear", "cubic"):
        raw = input_of("u", (t, np.array([values, -values]), kind), 2)
        clamped, times = raw.clamped(-0.7, 1.1), np.linspace(0.001, 2.999, 400)
        for time in times:
            found, plain = (
                [np.polyval(row[3::-1], time - row[4]) for row in data.parameters(time)] for data in (clamped, raw)
            )
            assert found == pytest.approx(np.clip(plain, -0.7, 1.1), abs=1e-13)


def test_actuators_of_one_joint_have_different_names(tmp_path):
    three = "".join(f'<motor joint="x" {name}/>' for name in ('gear="2"', "", 'name="x" gear="3"'))
    system = sc.LagrangianSystem.from_mjcf(written(tmp_path, LIFT, actuators=three), actuators=True)
    assert system.actuators == {"x_2": "x_2", "x_3": "x_3", "x": "ctrl_x"}
    assert system.inputs == ("x_2", "x_3", "ctrl_x")


def test_activations_are_inputs(tmp_path):
    key = '</actuator><keyframe><key name="k" qpos="0" ctrl="3 4" act=".5 .25"/></keyframe><actuator>'
    acting = '<position name="p" joint="x" timeconst=".1" ctrlrange="-1 1"/><intvelocity name="v" joint="x" {}/>'
    file = written(tmp_path, LIFT, actuators=acting.format('actrange="-2 2"') + key)
    laws = r"activations \(dyntype 'filterexact'\), which are the inputs, of p; .* 'integrator'\), .* of v$"
    with pytest.warns(SystemDefinitionWarning, match=laws):
        system = sc.LagrangianSystem.from_mjcf(file, actuators=True)
    assert system.input_ranges == (("p", -1.0, 1.0), ("v", -2.0, 2.0))
    assert system.keyframes["k"]["inputs"] == {"p": 0.5, "v": 0.25}


INVALID = {
    '<motor site="s"/>': "<motor> 'motor' names the site 's', which does not exist",
    '<motor joint="y"/>': ":3: <motor> 'motor' names the joint 'y', which does not exist",
    '<motor tendon="y"/>': "<motor> 'motor' names the tendon 'y', which does not exist",
    '<motor joint="x" refsite="t"/>': "acts on joint and refsite: give one",
    '<motor joint="x" name="m"/><motor joint="x" name="m"/>': "<motor> 'm' is the second actuator of this name",
    '<motor joint="x" ctrllimited="true"/>': "is limited to ctrlrange='0 0': the second number must be larger",
    '<motor joint="x" actdim="1"/>': "<motor> 'motor' has the unknown attribute 'actdim'",
    '<general joint="x" actdim="1"/>': "actdim='1', but 0 activations by its dyntype",
    '<general joint="x" actrange="0 1"/>': "has actrange, the range of an activation, which its dyntype does not have",
    '<position joint="x" timeconst="-1"/>': "the timeconst -1, which must not be < 0",
    '<position joint="x" dampratio="1" kv="1"/>': "has kv and dampratio: one is needed",
    '<position joint="x" inheritrange="1"/>': "an inheritrange, which is read of parts with a range",
    '<velocity joint="x" dampratio="1"/>': "<velocity> 'velocity' has the unknown attribute 'dampratio'",
    '<damper joint="x" kv="-2" ctrlrange="0 1"/>': "the kv -2, which must not be < 0",
    '<damper joint="x" kv="2"/>': "<damper> 'damper' is limited to ctrlrange='0 0': the second number must be larger",
    '<damper joint="x" kv="2" ctrlrange="0 1" ctrllimited="true"/>': "has the unknown attribute 'ctrllimited'",
    '</actuator><compiler autolimits="false"/><actuator><motor joint="x" ctrlrange="0 1"/>': "without ctrllimited",
    '<damper joint="x" kv="2" ctrlrange="-1 1"/>': "has ctrlrange='-1 1', which must not be < 0",
}
"""What MuJoCo refuses, too."""
UNREAD = {
    '<motor joint="x" site="t"/>': "acts on joint and site: give one, or a site and its refsite",
    '<position site="t" refsite="t" dampratio="1"/>': "a dampratio, which hinges and slides with gear and kp >= 0",
    '<position joint="x" gear="0" dampratio="1"/>': "a dampratio, which hinges and slides with gear and kp >= 0",
    '<muscle joint="x"/>': "is not read as an actuator: general, motor, position, velocity, intvelocity, damper",
    '<general joint="x" dyntype="muscle"/>': "dyntype='muscle', which changes the motion and is not read",
    '<general joint="x" class="m"/>': "has gaintype='muscle', which must be fixed or affine",
    '<general joint="x" delay="1" nsample="1"/>': "delay='1', which changes the motion",
    '</actuator><tendon><fixed name="f" actuatorfrcrange="1 2"><joint joint="x" coef="1"/></fixed></tendon>'
    '<actuator><motor tendon="f" name="m"/><motor tendon="f"/>': ":3: <motor> 'm' is one of several on a tendon",
    '<motor cranksite="t" slidersite="t" cranklength="1"/>': "<motor> 'motor' acts on no joint, tendon or site",
}


@pytest.mark.parametrize("actuator", [*INVALID, *UNREAD])
def test_other_actuators_are_refused_by_name(actuator, tmp_path):
    file = written(tmp_path, LIFT, actuators=actuator)
    with pytest.raises(SystemDefinitionError, match=re.escape((INVALID | UNREAD)[actuator])):
        sc.LagrangianSystem.from_mjcf(file, actuators=True)


def test_what_is_no_actuator_is_refused_by_mujoco():
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    for actuator in INVALID:
        with pytest.raises(ValueError, match="Error"):
            mujoco.MjModel.from_xml_string(LIFT.format(actuators=actuator))


@pytest.mark.rotated
def test_servo_of_an_arm_moves_as_by_mujoco(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    from scipy.integrate import solve_ivp

    file, t, angles = written(tmp_path, ARM), np.linspace(0, 1, 3), [-1.0, 1.0, 0.0]
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(file, actuators=True), "svi:3")
    inputs = {"servo": (t, angles), "ctrl_shoulder": -7.0}
    start = {"shoulder": 0.3, "elbow": 0.1}, {"shoulder": 0.0, "elbow": 0.0}
    run = stepper.integrate(start[0], velocity=start[1], inputs=inputs, h=0.005, t_end=1.0)
    model = mujoco.MjModel.from_xml_path(str(file))
    data, state = mujoco.MjData(model), np.array([0.3, 0.1, 0.0, 0.0])

    def field(time, state):
        data.qpos[:], data.qvel[:], data.ctrl[:] = state[:2], state[2:], (np.interp(time, t, angles), -7.0)
        mujoco.mj_forward(model, data)
        return [*state[2:], *data.qacc]

    for span in pairwise([*(piece.t[0] for piece in run.pieces), 1.0]):
        state = solve_ivp(field, span, state, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    assert run.q[-1] == pytest.approx(state[:2], abs=1e-11)
