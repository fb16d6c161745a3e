"""Random robots in MJCF and URDF: energies, damping and constraints by MuJoCo and Pinocchio, recorded and computed."""

import json
import re
from typing import Any

import numpy as np
import pytest
from random_robots import (
    RECORDED,
    SEEDS,
    Mjcf,
    Urdf,
    Whole,
    by_mujoco,
    by_pinocchio,
    equations_of,
    errors_of_motion,
    motion_by_pinocchio,
    state_of,
)

import scvi_codegen as sc
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.expressions import evaluate
from scvi_codegen.systems.multibody.trees.schema import MJCF

MORE = [*range(SEEDS, 20), *(pytest.param(seed, marks=pytest.mark.full) for seed in range(20, 60))]
"""Seeds of the robots that are compared with the programs themselves."""


def quantities(robot: Any, state: Any, path: Any) -> list[float]:
    """Return what ``by_mujoco`` returns, of the system that is read."""
    if isinstance(robot, Mjcf):
        system = sc.LagrangianSystem.from_mjcf(path)
    else:
        system = sc.LagrangianSystem.from_urdf(path, floating=robot.floating)
    values, resting = {}, {}
    for name, kind in robot.joints.items():
        numbers = state[name]
        names = [f"{axis}_{name}" for axis in "xyz"] if kind == "free" else [] if kind == "ball" else [name]
        place, rates = numbers[: len(numbers) - len(names)], numbers[len(names) :]
        if kind in ("ball", "free"):
            w, x, y, z = turn = numbers[len(names) : len(names) + 4]
            rates = numbers[len(names) + 4 :]
            matrix = np.array([[-x, -y, -z], [w, -z, y], [z, w, -x], [-y, x, w]])
            spun = matrix @ rates[-3:] / 2
            for letter, a, b in zip("wxyz", turn, spun, strict=True):
                values |= {f"R_{name}_{letter}": a, f"R_{name}_{letter}_dot": float(b)}
                resting |= {f"R_{name}_{letter}": float(letter == "w"), f"R_{name}_{letter}_dot": 0.0}
        for each, a, b in zip(names, place, rates, strict=False):
            values |= {each: a, f"{each}_dot": b}
            resting |= {each: 0.0, f"{each}_dot": 0.0}

    def at(formula: Any, point: dict[str, float]) -> float:
        return float(evaluate(formula, {each: point[each.name] for each in formula.free_symbols}))

    energy = at(system.lagrangian, values) - at(system.lagrangian, resting)
    pairs = zip(system.forces or (), system.velocities, strict=bool(system.forces))
    power = sum(at(force, values) * values[rate.name] for force, rate in pairs if force != 0)
    return [energy, power, *sorted(abs(at(each, values)) for each in system.constraints)]


def compare(robot: Any, expected: list[float], folder: Any) -> None:
    found = quantities(robot, state_of(robot), robot.write(folder))
    np.testing.assert_allclose(found[:2], expected[:2], rtol=1e-9, atol=1e-9)
    equations = [*expected[2:]]
    assert (len(found) == 2) == (not equations)
    for residual in found[2:]:  # dependent equations are omitted
        assert np.abs(np.subtract(equations, residual)).min() < 1e-9


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("seed", [*range(2, SEEDS), 0, 1])
@pytest.mark.parametrize("kind", ["mjcf", "urdf"])
def test_random_robots_have_the_recorded_energies(kind, seed, tmp_path):
    robot = {"mjcf": Mjcf, "urdf": Urdf}[kind](seed)
    compare(robot, json.loads(RECORDED.read_text())[kind][seed], tmp_path)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("seed", MORE)
def test_random_models_have_the_energies_of_mujoco(seed, tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    robot = Mjcf(seed)
    try:
        compare(robot, by_mujoco(robot, state_of(robot), robot.write(tmp_path)), tmp_path)
    except SystemDefinitionError:
        if not singular(robot.write(tmp_path)):
            raise


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("seed", MORE)
def test_random_robots_have_the_energies_of_pinocchio(seed, tmp_path):
    pytest.importorskip("pinocchio", reason="pip install pin")
    robot = Urdf(seed)
    compare(robot, by_pinocchio(robot, state_of(robot), robot.write(tmp_path)), tmp_path)


def singular(file: Any) -> bool:
    """Whether MuJoCo finds no inverse of the mass matrix: two hinges of a body may be drawn with one axis."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(file))
    mujoco.mj_forward(model, data := mujoco.MjData(model))
    return bool(data.warning[int(mujoco.mjtWarning.mjWARN_INERTIA)].number > 0)


@pytest.mark.rotated
@pytest.mark.parametrize("seed", range(120))
def test_models_with_all_that_is_read_move_as_by_mujoco(seed, tmp_path):
    pytest.importorskip("mujoco", reason="pip install mujoco")
    robot = Whole(seed)
    file, meshes = robot.write(tmp_path), 'mesh="m' in robot.included  # whose axes have 8 digits in MuJoCo
    try:
        system = sc.LagrangianSystem.from_mjcf(file, actuators=True)
    except SystemDefinitionError:
        assert singular(file)
        return
    assert max(errors_of_motion(system, file)) < (1e-6 if meshes else 1e-8)


@pytest.mark.rotated
@pytest.mark.parametrize("seed", range(SEEDS, 80))
def test_random_robots_move_as_by_pinocchio(seed, tmp_path):
    pytest.importorskip("pinocchio", reason="pip install pin")
    robot = Urdf(seed)
    system = sc.LagrangianSystem.from_urdf(file := robot.write(tmp_path), floating=robot.floating)
    joints, motion = motion_by_pinocchio(robot, state_of(robot), file)
    kinds = [0 if name == "l0" else 3 for name in joints]
    assert equations_of(system, joints, kinds)(motion, [0.0])[2] < 1e-8


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
