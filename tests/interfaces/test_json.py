"""``--json`` and ``--quiet``: the numbers behind the text, or neither."""

import json
import math
import re
from pathlib import Path

import click
import numpy as np
import pytest
from commands import invoke, json_of
from scipy.special import ellipk

import scvi_codegen as sc
from scvi_codegen.interfaces.cli import command_group, main
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

pytestmark = pytest.mark.usefixtures("here")
KEPLER = ("kepler", "--step", "0.1", "--steps", "50", "--method", "svi:4")
QUIET_COMMANDS = (
    ("run", *KEPLER),
    ("export", "orbit.run", "-o", "orbit.csv"),
    ("systems",),
    ("systems", "kepler"),
    ("methods",),
    ("methods", "--tableau", "gauss:2"),
    ("cache",),
    ("generate", "kepler", "-o", "kepler_svi"),
    ("derive", "planar-pendulum", "--method", "svi:1"),
    ("derive", str(Path(__file__).parents[2] / "examples" / "fput_ring.toml"), "--method", "stoermer-verlet"),
    ("verify", "planar-pendulum", "--method", "svi:1"),
    ("reproduce", "--list"),
    ("doctor",),
    ("page", "planar-pendulum", "-o", "pendulum.html"),
    ("path", "kepler", "--from", "1,0", "--to=-0.5,0.8", "--span", "2", "--step", "0.1"),
    ("family", "planar-pendulum", "--q", "0.1", "--amplitude", "0.1", "--count", "2"),
)
"""Of every command one at least, after a run in the folder ``orbit.run``."""


def test_every_command_is_tested():
    assert {words[0] for words in QUIET_COMMANDS} == set(main.list_commands(click.Context(main)))


@pytest.mark.tiers(2, 2)
@pytest.mark.parametrize("words", QUIET_COMMANDS, ids=lambda words: " ".join(words[:2]).replace("/", " "))
def test_quiet_prints_nothing_and_json_prints_one_document(words):
    if words[0] == "page":
        pytest.importorskip("ziglang", reason="pip install 'scvi-codegen[compiler]'")
    invoke("run", *KEPLER, "-o", "orbit.run")
    assert invoke(*words).stdout
    quiet = invoke(*words, "--quiet")
    assert (quiet.stdout, quiet.stderr) == ("", "")
    assert json_of(*words)


@pytest.mark.parametrize(
    ("words", "status", "error"),
    [
        ("run keplr", 2, {"type": "SystemDefinitionError", "message": "there is no problem 'keplr'; did you mean"}),
        ("run kepler --steps x", 2, {"type": "BadParameter", "message": "'x' is not a valid integer"}),
        ("run kepler --nothing", 2, {"type": "NoSuchOption", "message": "--nothing"}),
        ("rum kepler", 2, {"type": "UsageError", "message": "there is no command 'rum'; did you mean 'run'?"}),
        (
            "run kepler --q 1,0 --velocity 0,0 --tolerance 1e-9 --span 3",
            1,
            {"type": "StepFailedError", "message": "failed", "status": "", "step": 1, "t": 1.0, "residual": 1.0},
        ),
        ("run wrong.toml", 2, {"type": "ModelFileError", "message": "wrong.toml: ", "text": "", "column": 0}),
    ],
)
def test_errors_are_entries_of_the_document(words, status, error):
    Path("wrong.toml").write_text(
        '[system]\nname = "a"\ncoordinates = ["x"]\nlagrangian = "x_dot**2/2 +"\n'
        "[initial]\nq = [0]\np = [0]\n[run]\nspan = 1\n"
    )
    result = invoke(words, "--json", status=status)
    found = json.loads(result.stdout)["error"]
    assert found.keys() == error.keys() | {"exit_status"}
    assert found["type"] == error["type"]
    assert error["message"] in found["message"]
    assert found["exit_status"] == status
    assert found["message"] in result.stderr
    assert all(type(found[name]) is type(value) for name, value in error.items())


@pytest.mark.second
def test_json_of_a_derivation_has_its_formulas():
    derived, found = sc.derive(sc.problem("kepler").system, "scvi:3"), json_of("derive", "kepler", "--method", "scvi:3")
    residuals = [[str(each.residual) for each in part] for part in (derived.equations, derived.end_position)]
    assert [each["residual"] for each in found["equations"]] == residuals[0]
    assert found["end"]["q"] == residuals[1]
    assert found["end"]["p"] == [str(each.residual) for each in derived.end_momentum]
    assert found["unknowns"] == [symbol.name for symbol in derived.unknowns]
    assert found["initial_guess"] == {symbol.name: str(value) for symbol, value in derived.initial_guess.items()}
    assert found["entries"] == {entry.symbol.name: float(entry.value) for entry in derived.entries}


@pytest.mark.rotated
def test_json_of_paths_is_that_of_the_model_file_and_of_the_interface():
    words = ("--from", "0,0", "--to", "0.1,0.3", "--span", "3", "--step", "0.25", "--starts", "2", "--method", "svi:4")
    found = json_of("path", "henon-heiles", *words, "-o", "path.npz")
    text = invoke("systems", "henon-heiles").stdout
    text = re.sub("(span|step) = .*", lambda line: f"{line[1]} = {3.0 if line[1] == 'span' else 0.25}", text)
    text += "\n[path]\nfrom = [0.0, 0.0]\nto = [0.1, 0.3]\nstarts = 2\n"
    Path("own.toml").write_text(text)
    assert json_of("path", "own.toml", "--method", "svi:4")["paths"] == found["paths"]
    assert parse_model(dump_model(parse_model(text))) == parse_model(text)
    stepper = sc.compile_stepper(sc.problem("henon-heiles").system, "svi:4")
    direct = stepper.path([0.0, 0.0], [0.1, 0.3], 3.0, steps=12)
    assert any(abs(each["action"] - direct.action) < 1e-12 for each in found["paths"])
    assert found["paths"] == sorted(found["paths"], key=lambda each: each["action"])
    with np.load("path.npz") as file:
        assert np.abs(file["q"][[0, -1]] - [[0, 0], [0.1, 0.3]]).max() < 1e-12
        assert file["p"][0].tolist() == list(found["paths"][0]["momenta"].values())
    closed = ("--closed=-q", "--q", "0", "--velocity", "1.5", "--span", "4", "--step", "0.2")
    (swing,) = json_of("path", "planar-pendulum", *closed)["paths"]
    assert swing["period"] == 8.0
    assert 4 * ellipk((1 + swing["energy"]) / 2) == pytest.approx(8.0, abs=1e-9)
    for wrong, status, message in (
        (("--to", "1,2"), 2, "give those of q"),
        ((), 2, "give the end of the path"),
        (("--to", "1", "--closed", "true"), 2, "not both"),
        (("--q", "1", "--to", "0.3", "--span", str(math.pi), "--step", "0.2"), 1, "no path was found"),
    ):
        assert message in invoke("path", "harmonic-oscillator", *wrong, status=status).output


@pytest.mark.rotated
def test_json_of_families_is_that_of_the_model_file_and_of_a_file_that_continues():
    words = ("--q", "0", "--amplitude", "0.3", "--stride", "0.2", "--fixed", "p_q", "--method", "svi:4")
    whole = json_of("family", "planar-pendulum", *words, "--count", "4")
    symmetric = json_of("family", "planar-pendulum", *words, "--count", "2", "--reversor", "detect")
    for half_way, orbit in zip(symmetric["orbits"], whole["orbits"], strict=False):
        assert half_way["period"] == pytest.approx(orbit["period"], rel=1e-10)
    text = invoke("systems", "planar-pendulum").stdout.replace("q = [0.5]", "q = [0.0]")
    section = '[family]\namplitude = 0.3\nstride = 0.2\nfixed = "p_q"\ncount = 2\n'
    Path("own.toml").write_text(f"{text}\n{section}")
    model = parse_model(f"{text}\n{section}")
    assert model.family == {"amplitude": 0.3, "stride": 0.2, "fixed": "p_q", "count": 2}
    assert parse_model(dump_model(model)) == model
    half = json_of("family", "own.toml", "--q", "0", "--method", "svi:4", "-o", "half.npz")
    assert half["orbits"] == whole["orbits"][:2]
    again = json_of("family", "own.toml", "--method", "svi:4", "--resume", "half.npz")
    assert [orbit["period"] for orbit in again["orbits"]] == pytest.approx(
        [orbit["period"] for orbit in whole["orbits"]], rel=1e-9
    )
    assert again["orbits"][-1]["period"] == pytest.approx(4 * ellipk((1 + again["orbits"][-1]["energy"]) / 2), rel=1e-9)
    refused = invoke("family", "own.toml", "--method", "svi:4", "--resume", "half.npz", "--vary", "g", status=2).output
    assert "--vary is not allowed with --resume" in refused
    for wrong, message in (
        ("until = 3", r"[family] until must be a text, not 3"),
        ("form = 1", "unknown key 'form'"),
        ("reversor = 1", r"[family] reversor must be a text, not 1"),
    ):
        Path("wrong.toml").write_text(f"{text}\n[family]\n{wrong}\n")
        assert message in invoke("family", "wrong.toml", status=2).output


@pytest.mark.parametrize(
    ("run", "tolerance"),
    [("span = 3.0\nerror = 1e-6", 0.0), ("span = 3.0\ntolerance = 1e-6", 1e-6), ("step = 0.1\nsteps = 9", None)],
)
def test_adaptive_steps_are_verified_at_the_tolerance_of_the_model(run, tolerance, monkeypatch):
    """0 stands for round-off; None for a fixed step size."""
    seen = []

    def verify(*_, **arguments):
        seen.append(arguments["tolerance"])
        raise sc.StateError("seen")

    monkeypatch.setattr("scvi_codegen.extras.verification.command.measured", verify)
    Path("model.toml").write_text(f"[system]\ncatalogue = 'kepler'\n[method]\nmethod = 'svi:4'\n[run]\n{run}\n")
    invoke("verify", "model.toml", status=2)
    assert seen == [tolerance]


def test_undefined_numbers_are_null():
    values = {"a": math.nan, "b": [math.inf, 1.5], "c": np.array([1.0, np.nan]), "d": np.int64(3), "e": Path("x")}
    assert command_group._plain(values) == {"a": None, "b": [None, 1.5], "c": [1.0, None], "d": 3, "e": "x"}
