"""The balance of energy that ``run`` prints where forces or damping act: E - E0 - W, of the run's own steps."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from scvi_codegen import load_model, problem
from scvi_codegen.cli import main
from scvi_codegen.cli.reports import MAX_BALANCE_COORDINATES, MAX_BALANCE_STEPS, energy_balance

MODEL = """
[system]
name = "damped pair"
coordinates = ["x", "y"]
lagrangian = "(x_dot**2 + y_dot**2)/2 - (x - y)**4/4"

[forces]
x = "-x_dot/10"

[initial]
q = [1.0, 0.0]
q_dot = [0.0, 0.5]

[method]
method = "svi:4"

[run]
step = 0.1
steps = 70
save_every = 7
"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def output_of(model, *words):
    Path("model.toml").write_text(model)
    result = CliRunner().invoke(main, ["run", "model.toml", *words])
    assert result.exit_code == 0, result.output
    return result.stdout


def test_printed_balance_is_that_of_the_run():
    text = output_of(MODEL)
    model = load_model("model.toml")
    run = model.stepper().integrate(model.q, velocity=model.velocity, h=0.1, steps=70, save_every=7)
    energy, work = run.energy(), run.work()
    error = np.abs(energy - energy[0] - work).max()
    assert work[-1] < -0.01
    assert 0.0 < error < 1e-6
    changed = np.abs(energy - energy[0]).max()
    line = f"energy: forces act, it changed by {changed:.3g} at most; energy balance |E - E0 - W| {error:.1e} at most"
    assert line in text
    found = json.loads(output_of(MODEL, "--json"))
    assert found["work"] == pytest.approx(work[-1])
    assert found["energy_balance"] == pytest.approx(error)


def test_damping_and_inputs_have_a_work_balance():
    damped = MODEL.replace("lagrangian", "damping = 0.1\nlagrangian").replace('[forces]\nx = "-x_dot/10"\n', "")
    assert "energy: damping takes it" in (text := output_of(damped))
    assert "energy balance |E - E0 - W|" in text
    driven = MODEL.replace("-x_dot/10", "u").replace("coordinates", 'inputs = ["u"]\ncoordinates')
    inputs = "[inputs]\nu = { t = [0.0, 3.0, 7.0], values = [0.0, 1.0, 0.0] }\n"
    assert "energy balance |E - E0 - W|" in output_of(driven + inputs)


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "changed",
    [
        {"(x - y)**4/4": "(2 + cos(t))*(x - y)**4/12"},
        {"svi:4": "radau-iia:2"},
        {"steps = 70": f"steps = {MAX_BALANCE_STEPS + 1}"},
        {'[forces]\nx = "-x_dot/10"\n': ""},
    ],
    ids=["L has time", "a method without account", "many steps", "no forces"],
)
def test_conservative_systems_have_no_balance(changed):
    model = MODEL
    for old, new in changed.items():
        assert old in model
        model = model.replace(old, new)
    assert "E - E0 - W" not in output_of(model)
    found = json.loads(output_of(model, "--json"))
    assert found["work"] is None
    assert found["energy_balance"] is None


def test_many_coordinates_have_no_balance():
    """The run is not used."""
    system = problem("outer-solar-system").system
    assert system.dimension > MAX_BALANCE_COORDINATES
    assert energy_balance(system, None, 10) is None  # type: ignore[arg-type]
