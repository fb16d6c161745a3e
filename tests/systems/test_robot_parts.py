"""Parts of MJCF that are computed from others: macros."""

import re

import pytest
from random_robots import errors_of_motion

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError

LEG = """<mujoco model="leg"><compiler angle="radian" eulerseq="ZYX"/><default><geom size=".1"/></default><worldbody>
<body name="thigh" pos="0 0 -.3"><joint name="hip" ref=".2"/><geom pos="0 .1 -.2"/><frame name="f" euler=".3 .2 .1">
<body name="shank" pos="0 0 -.4"><joint name="knee" axis="0 1 0"/><geom pos=".1 0 0"/></body></frame></body></worldbody>
<actuator><motor joint="knee" armature=".01"/><motor joint="hip" armature=".1"/></actuator></mujoco>"""
MACROS = """<mujoco><asset><model name="leg" file="leg.xml"/></asset><option><flag contact="disable"/></option><default>
<geom size=".2"/></default><worldbody><body name="own"><joint name="o"/><geom pos=".1 0 0"/>
<replicate count="2" sep="-" offset=".1 .2 0" euler="0 10 50"><replicate count="1" sep="_"><body name="arm" pos="0 1 0">
<joint name="a" axis="0 1 0"/><geom pos=".2 0 0"/></body></replicate></replicate></body>
<attach model="leg" body="thigh" prefix="l/"/><attach model="leg" frame="f" prefix="r/"/>
<attach body="own" prefix="x"/></worldbody><equality><joint joint1="a" joint2="o"/><joint joint1="a"/></equality>
<tendon><fixed name="t" stiffness="3"><joint joint="a" coef="2"/><joint joint="o" coef="1"/></fixed></tendon>
</mujoco>"""


def test_macros_are_written_out(tmp_path):
    file = tmp_path / "macros.xml"
    (tmp_path / "leg.xml").write_text(LEG)
    file.write_text(MACROS)
    system = sc.LagrangianSystem.from_mjcf(file)
    assert " ".join(sorted(system.joint_names)) == "a_0-0 a_0-1 l/hip l/knee o r/knee xa_0-0 xa_0-1 xo"
    assert sorted(map(str, system.constraints)) == ["a_0_0", "a_0_1", "xa_0_0", "xa_0_1"]
    pytest.importorskip("mujoco", reason="pip install mujoco")
    assert max(errors_of_motion(system, file)) < 1e-12


WRONG = {
    "count": ('count="2"', 'count="2.5"', "count='2.5', which must be a whole number"),
    "model": (
        'model="leg" body',
        'model="lge" body',
        "<attach> 'attach' names the model 'lge', which is not in <asset>",
    ),
    "part": ('body="thigh"', 'body="thihg"', "names the body 'thihg', which does not exist; did you mean 'thigh'?"),
    "file": ("leg.xml", "none.xml", "none.xml cannot be read"),
    "outside": ("leg.xml", "../leg.xml", "names '../leg.xml' outside the folder of the main document"),
    "circle": ("leg.xml", "macros.xml", "names 'macros.xml', which contains this document"),
    "whole": ('<attach body="own"', "<attach ", "needs a model, a body or a frame, and not both of these"),
    "inside": ('<joint name="o"/>', '<attach body="own" prefix="y"/>', "is attached before it is written out"),
}


@pytest.mark.parametrize("change", WRONG)
def test_malformed_macros_are_refused_by_name(change, tmp_path):
    old, new, message = WRONG[change]
    (tmp_path / "leg.xml").write_text(LEG)
    (tmp_path / "macros.xml").write_text(MACROS.replace(old, new))
    with pytest.raises(SystemDefinitionError, match=re.escape(message)):
        sc.LagrangianSystem.from_mjcf(tmp_path / "macros.xml")
