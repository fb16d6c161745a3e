"""Files that documents name are in their folder, or named on the command line."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from commands import error_of, output_of

import scvi_codegen as sc
from scvi_codegen.interfaces.cli import main
from scvi_codegen.interfaces.models.model_files.model_file import load_model

ARM = """<mujoco><worldbody><body><joint name="a" type="hinge" axis="0 1 0"/>
<geom type="sphere" size="0.1" mass="1" pos="0 0 -1"/></body></worldbody></mujoco>"""
PUSHED = """[system]
name = "pushed"
coordinates = ["x"]
lagrangian = "x_dot**2/2 - x**2/2"
inputs = ["u"]
[forces]
x = "u"
[inputs]
u = {{ file = "{file}" }}
[initial]
q = [1.0]
q_dot = [0.0]
[method]
method = "svi:1"
[run]
step = 0.1
steps = 5
"""
ROBOT = """[system]
robot = "{file}"
[method]
method = "svi:1"
[run]
step = 0.01
steps = 5
"""
ARRAY = """[system]
name = "chain"
coordinates = ["x[N]"]
lagrangian = "sum(i in N, x_dot[i]**2/2 - m[i]*x[i]**2/2)"
[parameters]
"m[N]" = {{ file = "{file}" }}
[initial.q]
x = [0.1, 0.2]
[method]
method = "svi:1"
[run]
step = 0.1
steps = 5
"""
KINDS = {"u.csv": PUSHED, "arm.xml": ROBOT, "m.npy": ARRAY}


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Return a folder of documents, and another one with the files that they may not name."""
    own, other = tmp_path / "own", tmp_path / "other"
    for folder in (own / "below", other):
        folder.mkdir(parents=True)
        (folder / "u.csv").write_text("t,u\n0,0\n1,1\n")
        (folder / "arm.xml").write_text(ARM)
        np.save(folder / "m.npy", np.ones(2))
    return own, other


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("way", ["below", "parent", "absolute", "link"])
def test_files_outside_the_folder_of_a_model_file_are_refused(folders, name, way):
    own, other = folders
    (own / "link").symlink_to(other)
    file = {"below": f"below/{name}", "parent": f"../other/{name}", "absolute": str(other / name)}.get(
        way, f"link/{name}"
    )
    document = own / "model.toml"
    document.write_text(KINDS[name].format(file=file))
    if way == "below":
        assert load_model(document).steps == 5
        return
    with pytest.raises(sc.ModelFileError, match=f"{file}.*outside the folder {own}.*copy it there"):
        load_model(document)


@pytest.mark.parametrize("file", ["../other/arm.xml", "link/arm.xml"])
def test_includes_outside_the_folder_of_a_robot_are_refused(folders, file):
    own, other = folders
    (own / "link").symlink_to(other)
    robot = own / "robot.xml"
    robot.write_text(f'<mujoco><include file="{file}"/></mujoco>')
    with pytest.raises(
        sc.SystemDefinitionError, match=rf"names '{file}' outside the .* folders=\['{other}'\]\), --folder"
    ):
        sc.LagrangianSystem.from_mjcf(robot)
    with pytest.raises(sc.SystemDefinitionError, match=f"names '{file}' outside the folder"):
        sc.LagrangianSystem.from_mjcf(robot, folders=[own / "below"])
    assert sc.LagrangianSystem.from_mjcf(robot, folders=[other]).dimension == 1
    for read in (sc.LagrangianSystem.from_mjcf, load_model):
        with pytest.raises(sc.ScviCodegenError, match="folders must be a list of paths, not"):
            read(robot, folders=str(other))
    robot.write_text('<mujoco><include file="below/arm.xml"/></mujoco>')
    assert sc.LagrangianSystem.from_mjcf(robot).dimension == 1


@pytest.mark.second
def test_files_named_on_the_command_line_may_be_anywhere(folders):
    own, other = folders
    document = own / "model.toml"
    document.write_text(PUSHED.format(file="../other/u.csv"))
    printed = output_of("run", str(document), "--input", f"u={other / 'u.csv'}", "--json")
    assert json.loads(printed)["steps"] == 5


@pytest.mark.rotated
@pytest.mark.parametrize("name", KINDS)
def test_files_in_folders_that_a_user_names_may_be_anywhere(folders, name):
    own, other = folders
    document = own / "model.toml"
    document.write_text(KINDS[name].format(file=f"../other/{name}"))
    assert load_model(document, folders=[other]).steps == 5
    with pytest.raises(sc.ModelFileError, match="or name its folder \\(--folder DIR"):
        load_model(document)
    assert json.loads(output_of("run", str(document), "--folder", str(other), "--json"))["steps"] == 5
    assert "outside the folder" in error_of("run", str(document), "--folder", str(own))


def test_includes_in_folders_that_a_user_names_may_be_anywhere(folders):
    own, other = folders
    (own / "robot.xml").write_text('<mujoco><include file="../other/arm.xml"/></mujoco>')
    assert load_model(own / "robot.xml", folders=[other]).dimension == 1


@pytest.mark.second
def test_model_is_read_from_standard_input(folders, monkeypatch):
    own, _ = folders
    monkeypatch.chdir(own)
    result = CliRunner().invoke(main, ["run", "-", "--json"], input=PUSHED.format(file="below/u.csv"))
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["steps"] == 5
    refused = CliRunner().invoke(main, ["run", "-"], input="[system")
    assert refused.exit_code == 2
    assert "this is not TOML" in refused.output
