"""The degree of the default method follows the tolerance of adaptive runs: the bits are those of the named method."""

import pickle
import warnings

import numpy as np
import pytest
from click.testing import CliRunner
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.interfaces.cli import main
from scvi_codegen.interfaces.models.model_files.model_file import catalogue_model
from scvi_codegen.methods import default_method

Q, V = [0.5, 0.0], [0.0, 3**0.5]
LOOSE = {"t_end": 7.0, "tolerance": 1e-4}
EVENTS = "q1"


@pytest.fixture(scope="module")
def steppers():
    """The default stepper, which has compiled nothing yet, and those of both methods by name."""
    kepler = sc.problem("kepler").system
    return [sc.compile_stepper(kepler, method) for method in (None, "svi:4", "svi:8")]


def test_loose_runs_are_those_of_the_lower_degree(steppers):
    default, four, eight = steppers
    assert "binding" not in vars(default)
    loose = default.integrate(Q, velocity=V, **LOOSE, events=EVENTS, action=True)
    named = four.integrate(Q, velocity=V, **LOOSE, events=EVENTS, action=True)
    assert loose.method == named.method == "svi-4-gauss-legendre-4"
    assert loose.q.tobytes() == named.q.tobytes()
    assert loose.action() == named.action()
    assert [len(of) for of in loose.events] == [len(of) for of in named.events] != [0]
    assert default.supports("adaptive")
    assert "binding" not in vars(default)  # svi:8 was derived, and is compiled when a run needs it
    for plan in ({"t_end": 7.0}, {"t_end": 7.0, "tolerance": 9e-5}, {"h": 0.1, "steps": 5}):
        run = default.integrate(Q, velocity=V, **plan)
        assert run.method == eight.method
        assert run.p.tobytes() == eight.integrate(Q, velocity=V, **plan).p.tobytes()


def test_ensembles_pickles_and_continued_runs_keep_it(steppers):
    default, four, _ = steppers
    loose = four.integrate(Q, velocity=V, **LOOSE)
    members = default.integrate_ensemble([Q, Q], velocity=[V, V], **LOOSE)
    again = pickle.loads(pickle.dumps(default)).integrate(Q, velocity=V, **LOOSE)
    begun = default.start(Q, velocity=V, **LOOSE)
    begun.advance(3)
    continued = default.from_checkpoint(begun.checkpoint(), t_end=7.0)
    while not continued.arrived:
        continued.advance(1)
    for run, q in ((members, members.q[-1, 1]), (again, again.q[-1]), (continued, continued.q)):
        assert run.method == loose.method
        assert q.tobytes() == loose.q[-1].tobytes()
    assert default.from_checkpoint(default.start(Q, velocity=V, h=0.1).checkpoint()).method == default.method


def test_bounded_runs_are_repeated_by_their_tolerance(steppers):
    """The bits of a run with error= are those of its tolerance, from 1e-4 on by the lower degree."""
    for default in (steppers[0], sc.compile_stepper(sc.problem("kepler").system, precision="auto")):
        bounded = default.integrate(Q, velocity=V, t_end=7.0, error=0.1)
        same = default.integrate(Q, velocity=V, t_end=7.0, **bounded.confirmation.steps)
        assert bounded.method == same.method
        assert bounded.q.tobytes() == same.q.tobytes()


def test_arrays_follow_it_bound_and_at_known_sizes():
    ring = lagrange(
        "ring", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**4/4)"
    )
    q = np.sin(np.arange(6.0))
    stepper, named = sc.compile_stepper(ring), sc.compile_stepper(ring, "svi:4")
    loose = stepper.integrate(q, **LOOSE)
    assert loose.method == named.method
    assert loose.p.tobytes() == named.integrate(q, **LOOSE).p.tobytes()
    assert stepper.integrate(q, t_end=1.0).method == stepper.method
    bound = pickle.loads(pickle.dumps(stepper.bind(q)[0]))
    assert bound.integrate(q, np.zeros(6), **LOOSE).p.tobytes() == loose.p.tobytes()


def test_constraints_and_contacts_do_not_follow_it():
    rod = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 - 1"])
    slide = lagrange("slide", "x", "x_dot**2/2 - x**2/2", forces={"x": "-sign(x_dot)/9"})
    for system in (rod, slide):
        assert default_method(system, 0.1) == default_method(system) == sc.SVI(8, "gauss-lobatto:9")
    assert default_method(sc.problem("kepler").system, 1e-4) == sc.SVI(4)


@pytest.mark.parametrize(
    ("arguments", "degree"),
    [(["--tolerance", "1e-3"], 4), (["--tolerance", "1e-3", "--method", "svi:8"], 8), (["--step", "0.1"], 8)],
)
def test_the_command_line_follows_it(arguments, degree):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sc.AccuracyWarning)
        result = CliRunner().invoke(main, ["run", "kepler", "--span", "7", *arguments])
    assert result.exit_code == 0, result.output
    assert f"degree {degree}, gauss-legendre:{degree}; order {2 * degree}" in result.output


def test_models_that_name_their_method_do_not_follow_it():
    loose = {"run": {"tolerance": 1e-3}}
    assert catalogue_model("kepler", loose).method_of_runs == sc.SVI(4)
    assert catalogue_model("kepler", {**loose, "method": {"method": "svi", "degree": 8}}).method_of_runs == sc.SVI(8)
