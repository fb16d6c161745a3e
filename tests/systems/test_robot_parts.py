"""Parts of MJCF that are computed from others: macros, and inertias of meshes."""

import re

import numpy as np
import pytest
from random_robots import FACES, errors_of_motion

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.robots.trees.mjcf import links_of_mjcf

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


@pytest.mark.second
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
    "many": ('count="2"', 'count="1e9"', "makes more than 10000 elements, with other macros: reduce its count"),
    "keys": (
        "</mujoco>",
        '<keyframe><key name="k"/><key name="k"/></keyframe></mujoco>',
        "second keyframe of this name",
    ),
    "count": ('count="2"', 'count="2.5"', "count='2.5', which must be a whole number"),
    "model": ('model="leg" body', 'model="lge" body', "names the model 'lge', which is not in <asset>"),
    "part": ('body="thigh"', 'body="thihg"', "names the body 'thihg', which does not exist; did you mean 'thigh'?"),
    "file": ("leg.xml", "none.xml", "none.xml cannot be read"),
    "outside": ("leg.xml", "../leg.xml", "names '../leg.xml' outside the folder of the document"),
    "circle": ("leg.xml", "macros.xml", "macros.xml', which contains this document"),
    "whole": ('<attach body="own"', "<attach ", "needs a model, a body or a frame, and not both of these"),
    "inside": ('<joint name="o"/>', '<attach body="own" prefix="y"/>', "is attached before it is written out"),
}
BOX = "-1 -.5 -.25 0 -.5 -.25 -1 .5 -.25 0 .5 -.25 -1 -.5 .25 0 -.5 .25 -1 .5 .25 0 .5 .25"
BOXES = f'vertex="{BOX} {BOX.replace("-1", "2").replace(" 0 ", " 3 ")}"'
BOXES += f' face="{FACES} {" ".join(str(int(k) + 8) for k in FACES.split())}"'
MESH = """<mujoco><option><flag contact="disable"/></option><asset><mesh name="m" {}/></asset><worldbody><body>
<joint name="j" axis="1 2 3"/>{}</body></worldbody></mujoco>"""
RULES = {
    "exact": '<geom type="box" size=".5 .5 .25" pos="-.5 0 0"/><geom type="box" size=".5 .5 .25" pos="2.5 0 0"/>',
    "convex": '<geom type="box" size="2 .5 .25" pos="1 0 0"/>',
    "legacy": "",
    "shell": "",
}


@pytest.mark.second
@pytest.mark.parametrize("rule", RULES)
def test_inertias_of_meshes_are_integrals(rule, tmp_path):
    file, geom, one = tmp_path / "mesh.xml", '<geom type="mesh" mesh="m" mass="2" pos=".1 0 0"/>', []
    for shape in ('<geom type="mesh" mesh="m"/>', RULES[rule]):
        file.write_text(MESH.format(f'{BOXES} inertia="{rule}"', shape))
        one += [links_of_mjcf(file)[1][-1].inertia] if shape else []
    for part in ("mass", "center", "matrix"):
        assert getattr(one[0], part) == pytest.approx(getattr(one[-1], part), rel=1e-14, abs=1e-13)
    pytest.importorskip("mujoco", reason="pip install mujoco")
    turned = f'{BOXES} inertia="{rule}" scale="1 -2 3" refpos=".1 .2 .3" refquat="1 .2 .3 .4"'
    file.write_text(MESH.format(turned, geom))
    assert max(errors_of_motion(sc.LagrangianSystem.from_mjcf(file), file)) < 1e-7  # MuJoCo's axes have 8 digits


def test_meshes_are_read_from_files(tmp_path):
    trimesh = pytest.importorskip("trimesh", reason="pip install trimesh")
    (tmp_path / "parts").mkdir()
    file, box = tmp_path / "mesh.xml", trimesh.creation.box((1, 2, 3))
    settings = '<asset/><compiler assetdir="parts" strippath="true"/>'
    for kind in ("stl", "stl_ascii", "obj"):
        path = tmp_path / "parts" / f"m.{kind[:3]}"
        box.export(path, file_type=kind)
        text = MESH.format(f'file="/away/{path.name}" scale=".1 .1 .1" class="main"', '<geom mesh="m" type="mesh"/>')
        file.write_text(text.replace('name="m" ', "").replace("<asset>", f"{settings}<asset>"))
        assert links_of_mjcf(file)[1][-1].inertia.mass == pytest.approx(6.0)


def test_meshes_are_read_from_files_of_mujoco(tmp_path):
    corners, faces = (np.array([*map(float, text.split())], "<f4") for text in (BOX, FACES))
    counts = np.array([8, 8, 8, 12], "<i4")
    data = b"".join(part.tobytes() for part in (counts, corners, corners, corners[:16], faces.astype("<i4")))
    geom, file, moments = '<geom type="mesh" mesh="m" density="7"/>', tmp_path / "mesh.xml", []
    for mesh in ('file="m.msh"', f'vertex="{BOX}" face="{FACES}"'):
        (tmp_path / "m.msh").write_bytes(data)
        file.write_text(MESH.format(f'{mesh} inertia="exact"', geom))
        moments.append(links_of_mjcf(file)[1][-1].inertia.matrix.tolist())
    assert moments[0] == moments[1]
    file.write_text(MESH.format('file="m.msh" inertia="exact"', geom))
    for wrong in (data[:10], data[:-4], data + b"0", b"\xff" * 16 + data[16:]):
        (tmp_path / "m.msh").write_bytes(wrong)
        with pytest.raises(SystemDefinitionError, match="whose first numbers are not the counts of MSH files"):
            links_of_mjcf(file)
    (tmp_path / "m.msh").write_bytes(data)
    pytest.importorskip("mujoco", reason="pip install mujoco")
    assert max(errors_of_motion(sc.LagrangianSystem.from_mjcf(file), file)) < 1e-7


MESHES = {
    "mesh file": ('file="no.stl"', "no.stl cannot be read"),
    "format": ('file="leg.xml"', "cannot be read as STL, OBJ"),
    "mesh outside": ('file="../m.stl"', "outside the folder of the document"),
    "orientation": (BOXES.replace("0 2 1", "0 1 2") + ' inertia="exact"', "has triangles with opposite orientations"),
    "volume": (
        'vertex="0 0 0 1 0 0 0 1 0 0 0 1" face="0 1 2 0 3 1 0 2 3 1 3 2" inertia="exact"',
        "has the volume -0.166667: turn its triangles",
    ),
    "corner": (BOXES.replace("0 2 1", "0 2 99"), "and faces of 3 of their numbers each"),
    "flat": ('vertex="0 0 0 1 0 0 0 1 0 1 1 0"', "is flat or too narrow for a convex hull: give faces"),
    "flat faces": (
        'vertex="0 0 .3 1 0 .1 0 1 .2 1 1 0" face="0 1 2 1 3 2"',
        "is flat, without a volume: use inertia='shell'",
    ),
    "line": ('vertex="0 0 0 1 1 0 2 2 0 3 3 0" face="0 1 2 1 3 2" inertia="shell"', "has the volume 0"),
    "far": (f'vertex="{BOX.replace("-.25", "1e38")}" face="{FACES}"', "not finite or not smaller than 1e+15"),
    "infinite": (f'vertex="{BOX.replace("-.25", "inf")}" face="{FACES}"', "which must be numbers"),
}


@pytest.mark.parametrize("case", [*WRONG, *MESHES])
def test_malformed_parts_are_refused_by_name(case, tmp_path):
    file, (old, *new, message) = tmp_path / "macros.xml", (WRONG | MESHES)[case]
    if "file=" in old:
        pytest.importorskip("trimesh", reason="pip install trimesh")
    (tmp_path / "leg.xml").write_text(LEG)
    file.write_text(MACROS.replace(old, *new) if new else MESH.format(old, '<geom type="mesh" mesh="m"/>'))
    with pytest.raises(SystemDefinitionError, match=re.escape(message)):
        links_of_mjcf(file)
