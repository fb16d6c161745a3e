"""Keyframes and frames of robots: states, places, velocities and Jacobians, compared with MuJoCo and closed forms."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.errors import StateError, SystemDefinitionWarning

BODIES = """<mujoco><option><flag contact="disable"/></option><worldbody>
<body name="base" pos=".3 .1 1" euler="10 20 30"><freejoint name="base"/><geom size=".1" pos=".3 .1 0"/>
<site name="s" pos=".1 .2 .3" euler="40 50 60"/><frame euler="0 0 9"><body name="a" pos=".1 .2 .3" euler="9 8 7">
<joint name="lift" type="slide" axis="0 1 1" ref=".2" range="-1 1"/><geom size=".1" pos=".3 .1 0"/>
<body name="fixed" pos=".2 0 0" euler="1 2 3"><geom size=".1"/><body name="c">
<joint name="t" axis="1 2 3" pos=".1 .2 0"/><geom size=".1"/><body name="d">
<joint name="ball" type="ball" pos=".1 0 0"/><geom type="box" size=".1 .2 .3"/><site name="tip" pos=".2 .2 .1"/>
</body></body></body></body></frame></body></worldbody><actuator><motor name="m" joint="t"/></actuator>
<keyframe><key name="home" qpos="1 2 3 .5 .5 .5 .5 2 .2 .6 0 .8 0" qvel="1 2 3 4 5 6 7 8 9 10 11" ctrl=".7"/></keyframe>
</mujoco>"""


@pytest.mark.rotated
def test_keyframes_are_states_and_frames_have_jacobians(tmp_path):
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    file = tmp_path / "model.xml"
    file.write_text(BODIES)
    with pytest.warns(SystemDefinitionWarning, match="without limits of joints lift$"):
        system = sc.LagrangianSystem.from_mjcf(file, actuators=True)
    rest, home = (system.keyframes[name] for name in ("qpos0", "home"))
    assert (rest["q"]["lift"], rest["velocity"]["omega_ball"], rest["inputs"]) == (0.2, [0, 0, 0], {"m": 0.0})
    run = sc.compile_stepper(system, "svi:2").integrate(**home, h=0.001, steps=1)
    model = mujoco.MjModel.from_xml_path(str(file))
    data, order = mujoco.MjData(model), [0, 1, 2, 6, 7, 3, 4, 5, 8, 9, 10]
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    places = [(data.site(name), mujoco.mj_jacSite, model.site(name).id, name) for name in ("s", "tip")]
    bodies = ("base", "a", "fixed", "c", "d")
    places += [(data.body(name), mujoco.mj_jacBody, model.body(name).id, name) for name in bodies]
    for place, jacobian, number, name in places:
        moving, turning = np.zeros((2, 3, model.nv))
        jacobian(model, data, moving, turning, number)
        frame = run.frame(name)
        expected = place.xpos, place.xmat.reshape(3, 3), moving @ data.qvel, turning @ data.qvel
        for values, theirs in zip(frame, (*expected, moving[:, order], turning[:, order]), strict=True):
            assert values[0] == pytest.approx(theirs, abs=1e-11)
    with pytest.raises(StateError, match="no frame 'tipp' that moves; did you mean 'tip'"):
        run.frame("tipp")
    with pytest.warns(SystemDefinitionWarning, match="as 'home' with the upper limit of joint 'lift' .* at -1:"):
        limited = sc.LagrangianSystem.from_mjcf(file, actuators=True, limits="contact")
    assert limited.keyframes["home"]["q"]["lift"] == 2.0


@pytest.mark.second
def test_frames_of_urdf_links_follow_and_belong_to_ensembles(tmp_path):
    file, inertia = tmp_path / "arm.urdf", '<inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/>'
    links = "".join(f'<link name="{x}"><inertial><mass value="1"/>{inertia}</inertial></link>' for x in "abcd")
    joint = '<joint name="{}" type="{}"><parent link="{}"/><child link="{}"/><origin xyz="1 0 0"/>'
    joint += '<axis xyz="0 0 1"/>{}</joint>'
    mimic = '<mimic joint="q" multiplier="-2" offset=".5"/>'
    rows = ("q", "continuous", "a", "b", ""), ("r", "continuous", "b", "c", mimic), ("s", "fixed", "c", "d", "")
    file.write_text(f'<robot name="r">{links}{"".join(joint.format(*row) for row in rows)}</robot>')
    system = sc.LagrangianSystem.from_urdf(file, gravity=(0, 0, 0))
    runs = sc.compile_stepper(system, "svi:2").integrate_ensemble([[0.3], [0.4]], [[1.0], [2.0]], h=0.1, steps=3)
    q, v = runs.q[..., 0], runs["q_dot"]
    expected = 1 + np.exp(1j * q) + np.exp(1j * (0.5 - q))
    slope = 1j * np.exp(1j * q) - 1j * np.exp(1j * (0.5 - q))
    frame = runs.frame("d")
    assert frame.position[..., 0] + 1j * frame.position[..., 1] == pytest.approx(expected)
    assert frame.velocity[..., 0] + 1j * frame.velocity[..., 1] == pytest.approx(slope * v)


def test_frames_of_bodies_that_only_slide(tmp_path):
    file = tmp_path / "slider.xml"
    body = (
        '<body name="a" pos="1 0 0" euler="0 0 90"><joint name="q" type="slide" axis="1 0 0"/><geom size=".1"/></body>'
    )
    file.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_mjcf(file), "svi:2")
    frame = stepper.integrate([0.5], velocity=[2.0], h=0.1, steps=2).frame("a")
    assert frame.position[-1] == pytest.approx([1.0, 0.9, 0.0])
    assert frame.velocity[-1] == pytest.approx([0.0, 2.0, 0.0])
    assert frame.rotation[-1] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), abs=1e-15)
