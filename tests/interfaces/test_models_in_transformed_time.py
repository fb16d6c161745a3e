"""Models in transformed time: files, the command line, and generated folders."""

from pathlib import Path

import pytest
from commands import error_of, output_of

import scvi_codegen as sc
from scvi_codegen.common.errors import ModelFileError
from scvi_codegen.interfaces.models.model_files.model_file import catalogue_model, dump_model, parse_model

pytestmark = pytest.mark.second

BY_CLOCK = {"system": {"time_transformation": "frequency"}, "run": {"step": 0.2, "span": 20.0}}


@pytest.fixture(scope="module")
def model() -> sc.Model:
    return catalogue_model("kepler", BY_CLOCK)


@pytest.mark.quick
@pytest.mark.parametrize("time_transformation", ["frequency", "(q1**2 + q2**2)**(3/4)"])
def test_files_contain_the_time_transformation(time_transformation: str) -> None:
    found = catalogue_model(
        "kepler", {"system": {"time_transformation": time_transformation}, "parameters": {"mu": 1.5}}
    )
    text = dump_model(found)
    assert f'time_transformation = "{time_transformation}"' in text
    assert "E =" not in text
    again = parse_model(text)
    assert again == found
    assert again.system.clock is not None
    assert (again.h, again.tolerance) == (None, None)


@pytest.mark.rotated
def test_step_size_of_another_time_is_not_reused(model: sc.Model) -> None:
    text = dump_model(sc.Model.from_problem(sc.problem("kepler")))
    assert parse_model(text, {"system": {"time_transformation": "frequency"}}).h is None
    assert parse_model(text, BY_CLOCK) == model
    with_a = text.replace("[parameters]", "[parameters]\na = 1.0")
    layer = {"system": {"time_transformation": "1/(a + q1**2)"}, "parameters": {"a": 2.0}}
    assert parse_model(with_a, layer).parameters["a"] == 2.0
    assert parse_model(dump_model(model)).h == 0.2
    with pytest.raises(ModelFileError, match="not known in advance"):
        _ = model.step_count
    with pytest.raises(ModelFileError, match="no time transformation 'frequencies'"):
        catalogue_model("kepler", {"system": {"time_transformation": "frequencies"}})
    changed = sc.change_coordinates(
        sc.reparametrise(sc.problem("kepler").system, "frequency"),
        {"q1": "u**2 - w**2", "q2": "2*u*w"},
        coordinates=["u", "w"],
    )
    with pytest.raises(ModelFileError, match="cannot be represented"):
        dump_model(sc.Model(system=changed, method=sc.SVI(4), q=(1.0, 0.0), p=(0.0, 1.0), h=0.1, steps=3))


def test_folders_contain_a_number_of_steps(tmp_path: Path) -> None:
    folder, by_clock = str(tmp_path / "orbit.run"), ("run", "kepler", "--time-transformation", "frequency")
    assert "give --step and --steps" in error_of(*by_clock, "--step", "0.2", "--span", "9", "-o", folder)
    assert "50 steps in tau (all)" in output_of(*by_clock, "--step", "0.2", "--steps", "50", "-o", folder)
    assert "not --span" in error_of("run", "--resume", folder, "--span", "9")
    assert "60 steps in tau (all)" in output_of("run", "--resume", folder, "--steps", "60")
