"""Common first mistakes in Python and on the command line: errors name the argument, its value and the remedy."""

import math
from pathlib import Path

import pytest
from click.testing import CliRunner
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.cli import main
from scvi_codegen.errors import ScviCodegenError
from scvi_codegen.runtime.inputs.segments import input_of

TEXT = {"name": "swing", "coordinates": ["q"], "lagrangian": "q_dot**2/2 + cos(q)"}
MODEL = """\
[system]
name = "swing"
coordinates = ["q"]
lagrangian = "q_dot**2/2 + cos(q)"

[initial]
q = [1.0]
q_dot = [0.0]

[run]
step = 0.1
span = 1.0
"""


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(sc.LagrangianSystem.from_text(**TEXT), "svi:2", flags=QUICK_FLAGS)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"q": [1.0]}, "give either p or velocity with q; got neither"),
        ({"q": [1.0, 2.0], "p": [0.0]}, "q must have shape (1,) for (q), not (2,)"),
        ({"q": [1.0], "velocity": [0.0, 0.0]}, "velocity must have shape (1,) for (q), not (2,)"),
        ({"q": ["1.0"], "p": [0.0]}, "q must be real numbers, not text: ['1.0'], write it without quotes"),
        ({"q": "q.csv", "p": [0.0]}, "read the file first, as by numpy.loadtxt('q.csv', delimiter=',', skiprows=1)"),
        ({"q": ["one"], "p": [0.0]}, "q must be real numbers, not text: ['one'], give numbers"),
        ({"q": {"x": 1.0}, "p": [0.0]}, "there is no 'x' in q"),
        ({"q": [math.nan], "p": [0.0]}, "q[0] (q) is nan: it must be finite"),
        ({"q": [1.0], "p": [0.0], "h": 0.0}, "the step size h is 0: it must be positive, or negative to integrate"),
        ({"q": [1.0], "p": [0.0], "h": math.nan}, "the step size h is nan: it must be finite"),
        ({"q": [1.0], "p": [0.0], "h": "0.1"}, "the step size h must be real numbers, not text: '0.1'"),
        ({"q": [1.0], "p": [0.0], "steps": -3}, "steps must be at least 0, not -3"),
        ({"q": [1.0], "p": [0.0], "parameters": {"g": 9.8}}, "no parameter 'g': 'swing' has none. Declare it"),
    ],
    ids=lambda part: part if isinstance(part, str) else None,
)
def test_first_mistakes_with_runs(given, message, stepper):
    with pytest.raises(ScviCodegenError) as caught:
        stepper.integrate(**{"h": 0.1, "steps": 3} | given)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"lagrangian": "q_dot**2/2 + k*cos(q)"},
            "unknown name 'k'. Known here: q, q_dot, t, pi; declare a constant as a parameter",
        ),
        ({"forces": {"x": "1"}}, "there is a force on 'x', which is not a coordinate. Coordinates: q"),
        ({"lagrangian": "q'**2/2"}, 'unexpected character "\'": write the velocity of q as q_dot'),
        ({"lagrangian": "L = q_dot**2/2"}, "unexpected character '=': write the right-hand side only"),
        ({"lagrangian": "|q_dot|"}, "unexpected character '|': write abs(x)"),
        ({"lagrangian": "q_dot²/2"}, "unexpected character '²': powers are written x**2"),
    ],
    ids=["a constant", "a force", "a prime", "an equation", "bars", "a superscript"],
)
def test_first_mistakes_with_systems(given, message):
    with pytest.raises(ScviCodegenError) as caught:
        sc.LagrangianSystem.from_text(**TEXT | given)
    assert message in str(caught.value)


def test_functions_report_what_they_require(stepper):
    kepler = sc.problem("kepler").system
    for call, message in (
        (lambda: sc.advise(kepler, "svi:4", [1.0, 0.0], [0.0, 1.0], 10.0), "advise requires tolerance, the error at"),
        (lambda: sc.advise(kepler, "svi:4", [1.0, 0.0], span=10.0, tolerance=1e-6), "give either p or velocity"),
        (lambda: sc.periodic_orbit(stepper, [0.1], [0.0], period=6.0), r"\(steps=200\).*\(h=0.05\); it got neither"),
        (lambda: input_of("u", "torque.csv"), "the input 'u' must be .*read a file first: t, values = numpy.loadtxt"),
    ):
        with pytest.raises(ScviCodegenError, match=message):
            call()


def test_system_accepts_positional_arguments_and_scalar_states(stepper):
    for kind, formula in ((sc.LagrangianSystem, TEXT["lagrangian"]), (sc.HamiltonianSystem, "p_q**2/2 - cos(q)")):
        by_name = {"lagrangian": formula} if kind is sc.LagrangianSystem else {"hamiltonian": formula}
        assert kind.from_text("swing", ["q"], formula) == kind.from_text(name="swing", coordinates=["q"], **by_name)
    text = "sum(a in N, q_dot[a]**2/2)"
    assert sc.LagrangianSystem.from_text("chain", ["q[N]"], text).name == "chain"
    run = stepper.integrate(1.0, 0.5, h=0.1, steps=3)
    assert run.q.tolist() == stepper.integrate([1.0], [0.5], h=0.1, steps=3).q.tolist()
    assert stepper.energy(1.0, 0.5) == stepper.energy([1.0], [0.5])
    with pytest.raises(ScviCodegenError, match=r"q must have shape \(2,\) for \(q1, q2\), not \(\)"):
        sc.compile_stepper(sc.problem("kepler").system, "svi:2", flags=QUICK_FLAGS).energy(1.0, 0.5)


def test_zero_mass_and_step_size_underflow_are_explained():
    text = {"lagrangian": "m*q_dot**2/2 - q**2/2", "parameters": {"m": 1.0}}
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text(**TEXT | text), "svi:2", flags=QUICK_FLAGS)
    for given, message in (
        ({"h": 0.1, "steps": 9}, "no mass is 0"),
        ({"t_end": 1.0}, "below machine precision.*mass of 0"),
    ):
        with pytest.raises(sc.StepFailedError, match=message):
            stepper.integrate([1.0], [0.0], parameters={"m": 0.0}, **given)


@pytest.mark.parametrize(
    ("name", "meant"),
    [("verlet", "stoermer-verlet"), ("leapfrog", "stoermer-verlet"), ("midpoint", "gauss:1"), ("svl:4", "svi")],
)
def test_first_mistakes_with_methods(name, meant, stepper):
    with pytest.raises(ScviCodegenError, match=f"did you mean '{meant}'"):
        sc.compile_stepper(sc.LagrangianSystem.from_text(**TEXT), name)


@pytest.mark.parametrize(
    ("old", "new", "words", "message"),
    [
        (
            "q_dot = [0.0]",
            "",
            "",
            "there is no p or q_dot in [initial]; for a start from rest write q_dot = [0.0, ..], or --velocity",
        ),
        ("q = [1.0]", 'q = ["1.0"]', "", "[initial] q, q, must be a number, not '1.0'"),
        ("lagrangian", "lagrangain", "", "unknown key 'lagrangain' in [system]; did you mean 'lagrangian'?"),
        ("", "", "--step 0", "the step size is 0: it must be positive, or negative for a run backward in time"),
        ("", "", "--method verlet", "did you mean 'stoermer-verlet'?"),
        ("", "", "-o nowhere/run.npz", "there is no folder 'nowhere'"),
    ],
)
def test_first_mistakes_with_files_and_commands(old, new, words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("swing.toml").write_text(MODEL.replace(old, new, 1))
    result = CliRunner().invoke(main, ["run", "swing.toml", *words.split()])
    assert result.exit_code == 2, result.output
    assert message in result.stderr


def test_first_mistakes_with_command_names():
    result = CliRunner().invoke(main, ["runn", "kepler"])
    assert result.exit_code == 2
    assert "there is no command 'runn'; did you mean 'run'? Known: cache," in result.stderr
