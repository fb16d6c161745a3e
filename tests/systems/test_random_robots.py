"""Random robots in MJCF and URDF move as by MuJoCo and Pinocchio, recorded and computed."""

import json
import re
from typing import Any

import pytest
from random_robots import RECORDED, SEEDS, Mjcf, Urdf, by_mujoco, by_pinocchio, errors

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.extras.robots.trees.schema import MJCF


def read(robot: Mjcf | Urdf, path: Any) -> Any:
    if isinstance(robot, Mjcf):
        return sc.LagrangianSystem.from_mjcf(path, actuators=True)
    return sc.LagrangianSystem.from_urdf(path, floating=robot.floating)


def bound(robot: Mjcf | Urdf) -> float:
    """Axes of meshes have 8 digits in MuJoCo, forces of media with density as many: without it errors are 1e-15."""
    return 1e-6 if isinstance(robot, Mjcf) and 'mesh="m' in robot.included else 1e-7


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("seed", [5, *range(5), *range(6, SEEDS)])
@pytest.mark.parametrize("kind", [Mjcf, Urdf])
def test_random_robots_have_the_recorded_motions(kind, seed, tmp_path):
    robot = kind(seed)
    motion = json.loads(RECORDED.read_text())[kind.__name__.lower()][seed]
    assert max(errors(read(robot, robot.write(tmp_path)), motion)) < bound(robot)


def singular(file: Any) -> bool:
    """Whether MuJoCo finds no inverse of the mass matrix: two hinges of a body may be drawn with one axis."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(file))
    mujoco.mj_forward(model, data := mujoco.MjData(model))
    return bool(data.warning[int(mujoco.mjtWarning.mjWARN_INERTIA)].number > 0)


@pytest.mark.rotated
@pytest.mark.parametrize("seed", range(SEEDS, 120))
def test_random_models_move_as_by_mujoco(seed, tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    file = (robot := Mjcf(seed)).write(tmp_path)
    try:
        system = read(robot, file)
    except SystemDefinitionError:
        assert singular(file)
        return
    assert max(errors(system, by_mujoco(system, file))) < bound(robot)


@pytest.mark.rotated
@pytest.mark.parametrize("seed", range(SEEDS, 80))
def test_random_robots_move_as_by_pinocchio(seed, tmp_path):
    pytest.importorskip("pinocchio", reason="pip install pin")
    file = (robot := Urdf(seed)).write(tmp_path)
    assert max(errors(read(robot, file), by_pinocchio(file, robot.floating, robot.mimics))) < bound(robot)


def test_attributes_of_mujoco_are_known():
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    path: list[str] = []
    unknown = []
    words: list[str] = []
    rows = []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        if head := re.match(r"( *)\(?(\w+)\)?(?:body)? \((.)\) *(.*)", line):
            rows.append((len(head[1]) // 3, head[2], words := head[4].split()))
        else:
            words += line.split()
    for depth, tag, attributes in rows:
        path = [*path[:depth], tag.replace("world", "body")]
        kind: Any = MJCF["mujoco"]
        for inner in path[1:]:
            name = kind.children.get(inner) if inner != "body" or path[1] != "body" else "body"
            if name in (None, "unchecked", "refused"):
                kind = None
                unknown += [f"<{tag}>"] * (name is None)
                break
            kind = MJCF[name]
        unknown += [f"<{tag} {key}>" for key in attributes if kind and key not in kind.attributes]
    assert len(rows) > 100
    assert unknown == []
