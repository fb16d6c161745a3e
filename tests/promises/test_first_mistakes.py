"""Common mistakes in Python and on the command line: errors name the argument, its value and the remedy."""

import math
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from commands import error_of
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen import ScviCodegenError, StateError, Stepper
from scvi_codegen.common.validation import hints, keyword_hint
from scvi_codegen.runs.driver.segments import input_of

TEXT = {"name": "swing", "coordinates": ["q"], "lagrangian": "q_dot**2/2 + cos(q)"}
PUSHED = {"forces": {"q": "u"}, "inputs": ["u"]}
CHAIN = {"coordinates": ["q[N]"], "lagrangian": "sum(i in N, q_dot[i]**2/2)", "forces": {"q[0]": "u"}, "inputs": ["u"]}
DATA = {"u": ([0.0, 1.0], [0.0, 1.0])}
STATE = {"q": [0.2], "p": [0.0]}
KEPLER = sc.problem("kepler").system
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


def system(**changes):
    return sc.LagrangianSystem.from_text(**TEXT | changes)


STEPPERS = {
    "swing": {},
    "pushed": PUSHED,
    "chain": CHAIN,
    "weighed": {"lagrangian": "m*q_dot**2/2 - q**2/2", "parameters": {"m": 1.0}},
}


@cache
def stepper(name="swing"):
    return sc.compile_stepper(system(**STEPPERS[name]), "svi:2", flags=QUICK_FLAGS)


def run(name="swing", **given):
    return stepper(name).integrate(**{"h": 0.1, "steps": 3} | given)


def massless(**given):
    return stepper("weighed").integrate([1.0], [0.0], parameters={"m": 0.0}, **given)


RUNS = [
    ({"q": [1.0]}, "give either p or velocity with q; got neither"),
    ({"q": [1.0, 2.0], "p": [0.0]}, "q must have shape (1,) for (q), not (2,)"),
    ({"q": [1.0], "velocity": [0.0, 0.0]}, "velocity must have shape (1,) for (q), not (2,)"),
    ({"q": ["1.0"], "p": [0.0]}, "q must be real numbers, not text: ['1.0'], write it without quotes"),
    ({"q": "q.csv", "p": [0.0]}, "read the file first, as by numpy.loadtxt('q.csv', delimiter=',', skiprows=1)"),
    ({"q": ["one"], "p": [0.0]}, "q must be real numbers, not text: ['one'], give numbers"),
    ({"q": {"x": 1.0}, "p": [0.0]}, "there is no 'x' in q"),
    ({"q": [math.nan], "p": [0.0]}, "q[0] (q) is nan: it must be finite"),
    (STATE | {"h": 0.0}, "the step size h is 0: it must be positive, or negative to integrate"),
    (STATE | {"h": math.nan}, "the step size h is nan: it must be finite"),
    (STATE | {"h": "0.1"}, "the step size h must be real numbers, not text: '0.1'"),
    (STATE | {"steps": -3}, "steps must be at least 0, not -3"),
    (STATE | {"parameters": {"g": 9.8}}, "no parameter 'g': 'swing' has none. Declare it"),
    (STATE | {"inputs": DATA}, "'u' is not an input: the system has none."),
    ({"dt": 0.1}, "Stepper.integrate() takes no 'dt'; did you mean 'h'?"),
    ({"n_steps": 10}, "Stepper.integrate() takes no 'n_steps'; did you mean 'steps'?"),
    ({"velocty": [0.0]}, "Stepper.integrate() takes no 'velocty'; did you mean 'velocity'?"),
    ({"v0": [0.0]}, "Stepper.integrate() takes no 'v0'; did you mean 'velocity'?"),
    ({"solver": "newton"}, "Stepper.integrate() takes no 'solver': pass it when compiling"),
    ({"method": "svi:4"}, "Stepper.integrate() takes no 'method': pass it when compiling"),
    ({"colour": "red"}, "Stepper.integrate() takes no 'colour': it takes q, p, inputs, velocity, h, steps, t_end"),
]
SYSTEMS = [
    ({"lagrangian": "q_dot**2/2 + k*cos(q)"}, "Known here: q, q_dot, t, pi; declare a constant as a parameter"),
    ({"forces": {"x": "1"}}, "there is a force on 'x', which is not a coordinate. Coordinates: q"),
    ({"lagrangian": "q'**2/2"}, 'unexpected character "\'": write the velocity of q as q_dot'),
    ({"lagrangian": "L = q_dot**2/2"}, "unexpected character '=': write the right-hand side only"),
    ({"lagrangian": "|q_dot|"}, "unexpected character '|': write abs(x)"),
    ({"lagrangian": "q_dot²/2"}, "unexpected character '²': powers are written x**2"),
    ({"L": "x"}, "takes no 'L'; did you mean 'lagrangian'?"),
]
METHODS = {
    "verlet": "stoermer-verlet",
    "rattle": "stoermer-verlet",
    "trapezoidal": "lobatto-iiia:2",
    "leapfrog": "stoermer-verlet",
    "midpoint": "gauss:1",
    "svl:4": "svi",
}
CALLS = [
    *((lambda given=given: run(**given), message) for given, message in RUNS),
    *((lambda given=given: system(**given), message) for given, message in SYSTEMS),
    *((lambda name=name: sc.compile_stepper(system(), name), f"did you mean '{x}'") for name, x in METHODS.items()),
    (lambda: sc.compile_stepper(h=0.1), "takes no 'h': pass it to a stepper"),
    (lambda: sc.compile_stepper(degree=8), "takes no 'degree': include it in the method, 'svi:8'"),
    (lambda: sc.advise(KEPLER, "svi:4", [1.0, 0.0], [0.0, 1.0], 10.0), "advise requires tolerance, the error at"),
    (lambda: sc.advise(KEPLER, "svi:4", [1.0, 0.0], span=10.0, tolerance=1e-6), "give either p or velocity"),
    (lambda: sc.verify(KEPLER, "svi:1", h=0.0), "the step size h"),
    (lambda: sc.periodic_orbit(stepper(), [0.1], [0.0], period=6.0, steps=9, h=1.0), "got both, steps=9 and h=1.0"),
    (lambda: input_of("u", "torque.csv"), "read a file first: t, values = numpy.loadtxt"),
    (lambda: sc.compile_stepper(KEPLER, "svi:2").energy(1.0, 0.5), "q must have shape (2,) for (q1, q2), not ()"),
    (lambda: massless(h=0.1, steps=9), "no mass is 0"),
    (lambda: massless(t_end=1.0), "below machine precision"),
    (lambda: stepper("pushed").start([0.2], [0.0], h=0.1, inputs=DATA), "takes no 'inputs': pass them to .integrate("),
    (lambda: stepper("chain").start(np.zeros(3), h=0.1, inputs=DATA), "takes no 'inputs': pass them to .integrate("),
    (lambda: run("pushed", **STATE, inputs={"u1": DATA["u"]}), "'u1' is not an input; the system has u; did you mean"),
    (lambda: stepper("chain").start(np.zeros(3), h=0.1).set_inputs(w=1.0), "'w' is not an input; the system has u"),
]


@pytest.mark.parametrize(("call", "message"), CALLS, ids=[message for _, message in CALLS])
def test_first_mistakes_are_named_with_the_remedy(call, message):
    with pytest.raises((ScviCodegenError, TypeError), match=re.escape(message)):
        call()


def test_states_of_runs_with_inputs_are_saved_at_steps():
    for integrate, state in ((stepper("pushed").integrate, [0.2]), (stepper("pushed").integrate_ensemble, [[0.2]])):
        with pytest.raises(StateError, match="t_eval is not available with inputs: omit t_eval"):
            integrate(state, state, t_end=0.3, inputs=DATA, t_eval=[0.1])
    assert run("pushed", **STATE, inputs=DATA).t[-1] == pytest.approx(0.3)


def test_no_synonym_hides_a_keyword():
    """A known keyword is never reported as a synonym, and every suggested location exists."""
    assert keyword_hint("q", ["y0"]) == "; did you mean 'y0'?"
    assert keyword_hint("n", ["mass"]).startswith(": pass the number to run.advance(n)")
    assert not [here for here, elsewhere in hints()["synonyms"].items() if {*here.split()} & {*elsewhere.split()}]
    for name in ("integrate", "integrate_ensemble", "momentum"):
        assert hasattr(Stepper, name)
        assert any(f".{name}" in place for place in hints()["explanations"].values())


def test_system_accepts_positional_arguments_and_scalar_states():
    for kind, formula in ((sc.LagrangianSystem, TEXT["lagrangian"]), (sc.HamiltonianSystem, "p_q**2/2 - cos(q)")):
        by_name = {"lagrangian": formula} if kind is sc.LagrangianSystem else {"hamiltonian": formula}
        assert kind.from_text("swing", ["q"], formula) == kind.from_text(name="swing", coordinates=["q"], **by_name)
    assert sc.LagrangianSystem.from_text("chain", ["q[N]"], "sum(a in N, q_dot[a]**2/2)").name == "chain"
    assert run(q=1.0, p=0.5).q.tolist() == run(q=[1.0], p=[0.5]).q.tolist()
    assert stepper().energy(1.0, 0.5) == stepper().energy([1.0], [0.5])


NO_START = "there is no p or q_dot in [initial]; for a start from rest write q_dot = [0.0, ..], or --velocity"
COMMANDS = [
    ("q_dot = [0.0]", "", "", NO_START),
    ("q = [1.0]", 'q = ["1.0"]', "", "[initial] q, q, must be a number, not '1.0'"),
    ("lagrangian", "lagrangain", "", "unknown key 'lagrangain' in [system]; did you mean 'lagrangian'?"),
    ("", "", "--step 0", "the step size is 0: it must be positive, or negative for a run backward in time"),
    ("", "", "--method verlet", "did you mean 'stoermer-verlet'?"),
    ("", "", "-o nowhere/run.npz", "there is no folder 'nowhere'"),
    ("", "", "runn", "there is no command 'runn'; did you mean 'run'? Known: cache,"),
]


@pytest.mark.parametrize(("old", "new", "words", "message"), COMMANDS)
def test_first_mistakes_with_files_and_commands(old, new, words, message, here):
    Path("swing.toml").write_text(MODEL.replace(old, new, 1))
    assert message in error_of(*[words] if words == "runn" else ["run", "swing.toml", *words.split()])
