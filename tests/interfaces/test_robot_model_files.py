"""Robots' files as models: default motion, partial states, keys beside them, and their pages' sections."""

import json
from pathlib import Path

import numpy as np
import pytest
from commands import output_of

import scvi_codegen as sc
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.extras.pages.section import drawn_system_of_model
from scvi_codegen.extras.pictures.recognition import shape_of
from scvi_codegen.interfaces.models.model_files.model_file import (
    document_in,
    dump_model,
    load_model,
    model_texts,
    parse_model,
)
from scvi_codegen.methods.galerkin import SVI

ROBOTS = Path(__file__).parents[1] / "systems" / "robots"
BALL = '[system]\nrobot = "ball.xml"\n'


def test_a_robot_file_is_a_model_at_rest_in_its_reference_configuration():
    model = load_model(ROBOTS / "ball.xml")
    assert model.system == sc.LagrangianSystem.from_mjcf(ROBOTS / "ball.xml")
    assert model.system.links
    assert model.q == (0.0, 1.0, 0.0, 0.0, 0.0)
    assert not any(model.velocity)
    assert (model.method, model.span, model.h) == (SVI(3), 10.0, 0.005)
    assert load_model(ROBOTS / "ball.xml", {"run": {"tolerance": 1e-9}}).h is None


def test_a_free_body_starts_in_the_pose_of_the_file(tmp_path):
    body = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><freejoint name="f"/>'
    text = f'<mujoco><worldbody><body pos="1 2 3" euler="0 0 90">{body}</body></worldbody></mujoco>'
    (tmp_path / "free.xml").write_text(text, encoding="utf-8")
    model = load_model(tmp_path / "free.xml")
    assert model.q == pytest.approx([1, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    seen = {each: shape_of(drawn_system_of_model(each)).followed for each in (model, load_model(ROBOTS / "ball.xml"))}
    assert list(seen.values()) == [0, None]  # the view of a page follows a free base


def test_a_table_by_name_changes_a_part_of_the_state_and_a_list_all_of_it():
    text = BALL + "[initial]\nq = { swing = 0.5 }\nq_dot = { omega_ball = [0, 0, 2] }\n"
    model = parse_model(text, folder=ROBOTS)
    assert model.q == (0.5, 1.0, 0.0, 0.0, 0.0)
    assert model.velocity == pytest.approx([0, 0, 0, 0, 1])  # R_dot = R omega/2
    listed = parse_model(BALL, {"initial": {"q": [0.5, 0, 1, 0, 0]}}, folder=ROBOTS)
    assert listed.q == (0.5, 0.0, 1.0, 0.0, 0.0)
    assert listed.velocity == (0.0,) * 5
    solar = parse_model('[system]\ncatalogue = "outer-solar-system"\n[initial]\nq = { sun_x = 0.1 }\n')
    assert (solar.q[0], solar.q[1:]) == (0.1, sc.problem("outer-solar-system").q[1:])


@pytest.mark.tiers(0, 1)
def test_urdf_has_inputs_and_a_floating_base():
    text = '[system]\nrobot = "arm.urdf"\nfloating = true\nactuated = true\ngravity = [0, 0, -1.6]\n'
    with pytest.warns(sc.SystemDefinitionWarning, match="limits of joints"):
        model = parse_model(text, folder=ROBOTS)
    with pytest.warns(sc.SystemDefinitionWarning, match="limits of joints"):
        system = sc.LagrangianSystem.from_urdf(ROBOTS / "arm.urdf", floating=True, actuated=True, gravity=(0, 0, -1.6))
    assert model.system == system
    assert "tau_shoulder" in model.system.inputs


def test_impossible_inertias_are_integrated_if_the_file_says_so(tmp_path):
    text = (ROBOTS / "arm.urdf").read_text().replace('izz="0.003"', 'izz="0.3"')
    (tmp_path / "arm.urdf").write_text(text)
    with pytest.warns(sc.SystemDefinitionWarning, match="which no body has"):
        parse_model('[system]\nrobot = "arm.urdf"\ncheck_inertias = false\n', folder=tmp_path)


SERVO = """<mujoco><worldbody><body><joint name="j" axis="0 1 0" range="0 30"/><geom size=".1" pos="0 0 -1"/></body>
</worldbody><actuator><position name="servo" joint="j"/></actuator><keyframe><key qpos=".3" ctrl=".2"/></keyframe>
</mujoco>"""


@pytest.mark.tiers(0, 1)
def test_flags_of_the_command_line_are_keys_of_robots(tmp_path):
    (tmp_path / "servo.xml").write_text(SERVO)
    flags = ["--limits", "contact", "--friction", "ignore", "--contacts", "ignore", "--actuators", "--keyframe", "0"]
    printed = json.loads(output_of("run", str(tmp_path / "servo.xml"), *flags, "--steps", "5", "--json"))
    keys = 'limits = "contact"\nactuators = true\nkeyframe = "0"\n'
    model = parse_model(f'[system]\nrobot = "servo.xml"\n{keys}[run]\nsteps = 5\n', folder=tmp_path)
    assert (model.q, model.inputs, len(model.system.contacts)) == ((0.3,), {"servo": 0.2}, 2)
    assert printed["final"]["q"]["j"] == pytest.approx(model.integrate().q[-1, 0], rel=1e-12)
    with pytest.warns(sc.SystemDefinitionWarning, match="without limits of joints j; actuators servo"):
        assert load_model(tmp_path / "servo.xml", {"system": {"keyframe": "0"}}).q == (0.3,)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (BALL + 'lagrangian = "x"\n', r"unknown key 'lagrangian' in \[system\] beside robot"),
        (BALL + "floating = true\n", "unknown key 'floating'"),
        (BALL + '[forces]\nswing = "1"\n', r"\[forces\] are not supported for a system of the catalogue or of a robot"),
        (BALL + "[initial]\nq = { swng = 1.0 }\n", "swng"),
        ('[system]\nrobot = "none.xml"\n', r"\[system\] robot: .*none.xml cannot be read"),
        ('[system]\nrobot = "arm.urdf"\nfloating = 1\n', "floating must be true or false, not 1"),
        ("[system]\nrobot = 3\n", "robot must be text between quotes"),
        (BALL + "actuated = 3\n", "actuated"),
        (BALL + "check_inertias = 0\n", "check_inertias must be true or false, not 0"),
        (BALL + 'contacts = "contact"\n', "contacts must be 'planes' or 'ignore', not 'contact'"),
        (BALL + "actuators = 1\n", "actuators must be true or false, not 1"),
        (BALL + 'keyframe = "qpos"\n', "there is no keyframe 'qpos' in ball.xml; did you mean 'qpos0'?"),
        ('[system]\nname = "x"\nlimits = "contact"\n', r"\[system\] limits belongs to files of robots: write robot"),
    ],
)
def test_mistakes_in_the_section_of_a_robot_are_named(text, message):
    with pytest.raises(ModelFileError, match=message):
        parse_model(text, folder=ROBOTS)


@pytest.mark.tiers(0, 1)
def test_formulas_of_large_robots_and_ball_joints_are_not_written():
    """Packages and recordings are then without a model file."""
    for name, message in (("ball.xml", r"write \[system\] robot = FILE"), ("figure.xml", "keep the file from which")):
        model = load_model(ROBOTS / name)
        with pytest.raises(ModelFileError, match=message):
            dump_model(model)
        assert model_texts(model) == {}


def test_the_sections_of_a_robot_file_name_it():
    assert document_in(ROBOTS / "ball.xml") == {"system": {"robot": "ball.xml"}}
