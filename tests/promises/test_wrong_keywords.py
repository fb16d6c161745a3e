"""Unknown keywords raise an error with the intended keyword or its location."""

from functools import partial

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.errors import ArgumentError, StateError
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.validation import hints, keyword_hint

PUSHED = sc.LagrangianSystem.from_text(
    name="pushed pendulum", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)", forces={"q": "u"}, inputs=["u"]
)
DATA = {"u": ([0.0, 1.0], [0.0, 1.0])}


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(PUSHED, "svi:2", flags=QUICK_FLAGS)


@pytest.fixture(scope="module")
def chain():
    system = sc.LagrangianSystem.from_text(
        name="pushed chain",
        coordinates=["q[N]"],
        lagrangian="sum(i in N, q_dot[i]**2/2)",
        forces={"q[0]": "u"},
        inputs=["u"],
    )
    return sc.compile_stepper(system, "svi:2")


def test_inputs_are_arguments_of_integrate(stepper, chain):
    for start in (partial(stepper.start, [0.2], [0.0]), partial(chain.start, np.zeros(3))):
        with pytest.raises(ArgumentError, match=r"start\(\) takes no 'inputs': pass them to \.integrate\("):
            start(h=0.1, inputs=DATA)
    assert stepper.integrate([0.2], [0.0], h=0.1, steps=3, inputs=DATA).t[-1] == pytest.approx(0.3)


def test_states_of_runs_with_inputs_are_saved_at_steps(stepper):
    for integrate, state in ((stepper.integrate, [0.2]), (stepper.integrate_ensemble, [[0.2]])):
        with pytest.raises(StateError, match="t_eval is not available with inputs: omit t_eval"):
            integrate(state, state, t_end=0.3, inputs=DATA, t_eval=[0.1])


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ({"dt": 0.1}, "'dt'; did you mean 'h'?"),
        ({"n_steps": 10}, "'n_steps'; did you mean 'steps'?"),
        ({"velocty": [0.0]}, "'velocty'; did you mean 'velocity'?"),
        ({"v0": [0.0]}, "'v0'; did you mean 'velocity'?"),
        ({"solver": "newton"}, "'solver': pass it when compiling"),
        ({"method": "svi:4"}, "'method': pass it when compiling"),
        ({"colour": "red"}, "'colour': it takes q, p, inputs, velocity, h, steps, t_end"),
    ],
    ids=str,
)
def test_keywords_of_other_programs_are_recognised(wrong, meant, stepper):
    with pytest.raises(TypeError) as caught:
        stepper.integrate([0.2], **wrong)
    assert str(caught.value).startswith(f"Stepper.integrate() takes no {meant}")


@pytest.mark.parametrize(
    ("function", "wrong", "meant"),
    [
        (sc.compile_stepper, {"h": 0.1}, "takes no 'h': pass it to a stepper"),
        (sc.compile_stepper, {"degree": 8}, "takes no 'degree': include it in the method, 'svi:8'"),
        (sc.LagrangianSystem.from_text, {"L": "x"}, "takes no 'L'; did you mean 'lagrangian'?"),
    ],
    ids=lambda each: getattr(each, "__name__", None) or str(each),
)
def test_functions_suggest_the_intended_keyword(function, wrong, meant):
    with pytest.raises(ArgumentError) as caught:
        function(**wrong)
    assert meant in str(caught.value)


def test_no_synonym_hides_a_keyword():
    """A known keyword is never reported as a synonym, and every suggested location exists."""
    assert keyword_hint("q", ["y0"]) == "; did you mean 'y0'?"
    assert keyword_hint("n", ["mass"]).startswith(": pass the number to run.advance(n)")
    assert not [here for here, elsewhere in hints()["synonyms"].items() if {*here.split()} & {*elsewhere.split()}]
    for name in ("integrate", "integrate_ensemble", "momentum"):
        assert hasattr(Stepper, name)
        assert any(f".{name}" in place for place in hints()["explanations"].values())


def test_undeclared_input_is_explained(stepper, chain):
    free = sc.compile_stepper(
        sc.LagrangianSystem.from_text(name="free", coordinates=["q"], lagrangian="q_dot**2/2"),
        "svi:2",
        flags=QUICK_FLAGS,
    )
    with pytest.raises(StateError, match=r"'u' is not an input: the system has none. .* inputs=\['u'\]"):
        free.integrate([0.2], [0.0], h=0.1, steps=3, inputs=DATA)
    with pytest.raises(StateError, match=r"'u1' is not an input; the system has u; did you mean 'u'\?"):
        stepper.integrate([0.2], [0.0], h=0.1, steps=3, inputs={"u1": DATA["u"]})
    with pytest.raises(StateError, match="'w' is not an input; the system has u"):
        chain.start(np.zeros(3), h=0.1).set_inputs(w=1.0)
