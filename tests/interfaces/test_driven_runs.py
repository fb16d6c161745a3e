"""``scvi-codegen run`` of a system with inputs: its tables, its files, what it refuses, and where it stops."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
from commands import error_of, invoke, output_of
from numpy.testing import assert_allclose

from scvi_codegen import Run, compile_stepper, load_model
from scvi_codegen.interfaces.cli.running import integrate_model

MODEL = """
[system]
name = "pushed pendulum"
coordinates = ["q"]
lagrangian = "q_dot**2/2 + cos(q)"
inputs = ["u"]
[forces]
q = "u"
[inputs]
u = { t = [0.0, 1.0, 1.55, 3.0], values = [0.0, 2.0, -1.0, 0.5] }
[initial]
q = [0.3]
p = [0.1]
[method]
method = "svi:4"
[run]
step = 0.1
span = 2.3
"""


@pytest.fixture(autouse=True)
def model(here):
    Path("pushed.toml").write_text(MODEL)
    Path("u.csv").write_text("t,value\n0,1\n1,0\n2,0.5\n3,-1\n")
    return load_model("pushed.toml")


RUN = ("run", "pushed.toml")


@pytest.mark.tiers(0, 1)
def test_inputs_of_the_command_line_replace_those_of_the_file(model):
    (Path("elsewhere")).mkdir()
    Path("pushed.toml").rename("elsewhere/pushed.toml")
    words = ["run", "elsewhere/pushed.toml", "--input", "u=u.csv:cubic", "--tolerance", "1e-13", "-o", "run.csv"]
    invoke(*words)
    table = ([0.0, 1.0, 2.0, 3.0], [1.0, 0.0, 0.5, -1.0], "cubic")
    expected = compile_stepper(model.system, "svi:8").integrate(model.q, model.p, inputs={"u": table}, t_end=2.3)
    found = np.loadtxt("run.csv", delimiter=",", skiprows=1)
    assert_allclose(found[-1, :3], [2.3, expected.q[-1, 0], expected.p[-1, 0]], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--input", "u"], "not of the form NAME=FILE"),
        (["--input", "v=u.csv"], "'v' is not an input of 'pushed pendulum', whose inputs are u"),
        (["--input", "u=u.csv:quintic"], "constant or linear or cubic"),
        (["--input", "u=none.csv"], "none.csv: it cannot be read"),
        (["--span", "4"], "the input 'u' covers t = 0 to 3, but the run goes from 0 to 4"),
        (["-o", "long.run"], "-o NAME.npz"),
        (["--advise", "1e-9"], "use --tolerance"),
        (["--parameter", "u_0=1"], "no parameter 'u_0'"),
    ],
)
def test_unsupported_options_are_rejected(words, message):
    assert message in error_of(*RUN, *words)


def test_runs_without_steps_and_columns_of_inputs():
    assert "0 steps of 0.1 from t = 0 to t = 0; 1 state saved" in output_of(*RUN, "--steps", "0")
    Path("many.csv").write_text("q,u_0\n0.1,5\n")
    assert "'u_0' is not a coordinate" in error_of(*RUN, "--ensemble", "many.csv")


@pytest.mark.tiers(0, 1)
def test_missing_input_is_reported():
    Path("pushed.toml").write_text(MODEL.replace("[inputs]\nu = {", "[parameters]\n# {"))
    assert "the input u is not set" in error_of(*RUN)
    assert "final state" in output_of(*RUN, "--input", "u=u.csv")


def test_signal_stops_a_run_between_chunks(model, monkeypatch):
    advance, sent = Run._advance, []

    def interrupted(run, steps, save_every, arrays):
        status = advance(run, min(steps, 2), save_every, arrays)
        if run.t > 1.2 and not sent:
            sent.append(os.kill(os.getpid(), signal.SIGTERM))
        return status

    monkeypatch.setattr(Run, "_advance", interrupted)
    outcome = integrate_model(model)
    assert outcome.interrupted
    assert outcome.failure is None
    assert 1.2 < outcome.trajectory.t[-1] < 2.0
    assert outcome.trajectory.t[0] == 0.0
