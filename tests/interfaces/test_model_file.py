"""Model files: what is written reads back equal, and what is wrong is named."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from scvi_codegen.common.errors import MethodWarning, ModelFileError
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, load_model, parse_model, save_model
from scvi_codegen.interfaces.models.problems import PROBLEMS, problem
from scvi_codegen.methods import METHODS, SCVI, SVI, CollocationRK, Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import lobatto_iiib
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.systems.lagrangian import LagrangianSystem

PENDULUM = """
[system]
name = "pendulum"
coordinates = ["q"]
lagrangian = "m*q_dot**2/2 + cos(q)"

[parameters]
m = 2.0

[initial]
q = [0.5]
q_dot = [0]
t = 1.5

[method]
method = "svi"
degree = 3

[run]
step = 0.25
span = 10
save_every = 4
"""


def kepler(**changes: object) -> Model:
    return replace(Model.from_problem(problem("kepler")), **changes)


def test_model_file_is_read():
    model = parse_model(PENDULUM)
    assert model.system.name == "pendulum"
    assert [symbol.name for symbol in model.system.coordinates] == ["q"]
    assert model.system.defaults == (2.0,)
    assert model.method == SVI(3)
    assert (model.q, model.p, model.velocity, model.t) == ((0.5,), None, (0.0,), 1.5)
    assert (model.h, model.span, model.steps, model.save_every, model.step_count) == (0.25, 10.0, None, 4, 40)


def test_vectors_may_be_tables_by_coordinate():
    assert parse_model(PENDULUM.replace("q_dot = [0]", "velocity = [0]")) == parse_model(PENDULUM)
    by_name = PENDULUM.replace("q = [0.5]\nq_dot = [0]\nt = 1.5", "t = 1.5\nq = {q = 0.5}\n[initial.q_dot]\nq = 0")
    assert parse_model(by_name) == parse_model(PENDULUM)


@pytest.mark.parametrize("name", [*PROBLEMS, "fput-chain:40"])
def test_every_problem_survives_a_round_trip(name, tmp_path):
    model = Model.from_problem(problem(name))
    save_model(model, tmp_path / "model.toml")
    assert load_model(tmp_path / "model.toml") == model


@pytest.mark.parametrize(
    "method",
    [
        SVI(3, "clenshaw-curtis:5", "equispaced"),
        SCVI(3, "gauss-lobatto:4", "legendre-lobatto", variational=False),
        SpectralCollocation(4, form="phase-space"),
        Gauss(3, form="position"),
        CollocationRK((0.1, 1 / 3, 0.9)),
        StoermerVerlet(),
        METHODS["explicit-euler"](form="position"),
    ],
    ids=lambda method: method.name,
)
def test_every_kind_of_method_survives_a_round_trip(method):
    model = kepler(method=method)
    assert parse_model(dump_model(model)) == model


def test_methods_without_a_name_are_rejected():
    own = Quadrature(name="mine", points=(-0.5, 0.5), weights=(1, 1))
    for method in (
        SVI(2, own),
        METHODS["collocation"](("0.3333333333333333333", 1)),
        replace(Gauss(3), tableau=lobatto_iiib(3)),
    ):
        with pytest.raises(ModelFileError, match=r"quadrature|method"):
            dump_model(kepler(method=method))


def test_catalogue_reference_alone_is_a_complete_system():
    assert parse_model('[system]\ncatalogue = "kepler"\n') == kepler()


def test_a_catalogue_reference_may_be_changed():
    text = '[system]\ncatalogue = "kepler"\n[parameters]\nmu = 2\n[run]\nstep = 0.5\nsteps = 3\n'
    model = parse_model(text)
    assert model.system == kepler().system.with_parameters(mu=2.0)
    assert (model.h, model.steps, model.span, model.method) == (0.5, 3, None, SVI(8))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[run]", "[rum]", "unknown section 'rum' in the file; did you mean 'run'?"),
        (
            "[system]",
            "[[events]]\nfunctio = 'q'\n[system]",
            "unknown key 'functio' in [[events]]; did you mean 'function'?",
        ),
        ("[method]", "[zzz]", "Known: system, field, forces, torques, torques_space, functions, inputs, sizes, "),
        ("lagrangian", "lagrangain", "unknown key 'lagrangain' in [system]; did you mean 'lagrangian'?"),
        ("lagrangian", "forces", "unknown key 'forces' in [system]; there is a section [forces]. Known: name, coord"),
        ("degree", "degre", "unknown key 'degre' in [method] for svi; did you mean 'degree'?"),
        ('method = "', 'name = "', "unknown key 'name' in [method]; did you mean 'method'?"),
        ("save_every", "save_evry", "unknown key 'save_evry' in [run]; did you mean 'save_every'?"),
        ("save_every", "h", "unknown key 'h' in [run]; did you mean 'step'?"),
        ("save_every", "t_end", "unknown key 't_end' in [run]; did you mean 'span'?"),
        ("save_every", "solver", "unknown key 'solver' in [run]; 'solver' belongs in [method]."),
        ("save_every", "degree", "unknown key 'degree' in [run]; 'degree' belongs in [method]."),
        ("degree", "n", "unknown key 'n' in [method] for svi; did you mean 'degree'?"),
        ("lagrangian", "L", "unknown key 'L' in [system]; did you mean 'lagrangian'?"),
        ("[parameters]", "[constants]", "unknown section 'constants' in the file; did you mean 'parameters'?"),
        ('name = "pendulum"\n', "", "there is no name in [system]"),
        ("step = 0.25\nspan = 10\n", "steps = 40\n", "[run] steps requires a fixed step size: give step"),
        ("degree = 3\n", "", "svi needs 'degree'"),
        ("span = 10\n", 'span = 10\ncontroller = "pi"\n', "unknown [run] controller 'pi': use 'symplectic' or 'pred"),
        ("[run]\n", "[path]\nform = 1\n[run]\n", "unknown key 'form' in [path]; 'form' belongs in [method]."),
        ("q = [0.5]\n", "", "there is no q in [initial]"),
        ("q_dot = [0]\n", "", "there is no p or q_dot in [initial]"),
        ("q_dot = [0]\n", "q_dot = [0]\nvelocity = [0]\n", "velocity and q_dot are two names of one key"),
        ("span = 10\n", "", "there is no span or steps in [run]"),
        ("step = 0.25\nspan = 10\n", "tolerance = 1e-9\nsteps = 40\n", "omit it and give span"),
        ("step = 0.25\nspan = 10\n", "span = 0\n", "[run] span = 0 must be"),
        ("q = [0.5]", "q = 0.5", "[initial] q must be a list of numbers or a table"),
        ("q = [0.5]", "q = [0.5, 1]", "[initial] q must have 1 numbers for (q), not 2"),
        ("q = [0.5]", "q = {q_ = 1}", "unknown coordinate 'q_' in [initial] q; did you mean 'q'?"),
        ("q = [0.5]", "q = {}", "[initial] q lacks 'q'"),
        ("q = [0.5]", "q = [nan]", "[initial] q, q, is nan"),
        ("q = [0.5]", 'q = ["a"]', "[initial] q, q, must be real numbers, not text: 'a'"),
        ("q = [0.5]", "q = [true]", "must be real numbers, not bool: True"),
        ("t = 1.5", "t = inf", "[initial] t is inf"),
        ("m = 2.0", "m = nan", "[parameters] m is nan"),
        ("m = 2.0", 'm = "2"', "[parameters] m must be real numbers, not text: '2', write it without quotes"),
        ("m = 2.0", "m = 1" + "0" * 400, "[parameters] m must be real numbers"),
        ("step = 0.25", "step = 1e-300", "less than 2^53 steps"),
        ("span = 10", "span = -10", "a run backward in time has step = -0.25 and span = 10"),
        ("save_every = 4", "save_every = 1.5", "[run] save_every must be a whole number, not 1.5"),
        ('"svi"', '"svj"', "there is no method 'svj'"),
        ('"svi"', "3", "[method] method must be text between quotes, not 3"),
        ("degree = 3", "degree = 0", "[method]: "),
        ("degree = 3", 'degree = 3\nquadrature = "gauss:3"', "unknown quadrature 'gauss'"),
        ("degree = 3", "degree = 3\nquadrature = 3", "[method]: quadrature must be a Quadrature"),
        ('"svi"\ndegree = 3', '"scvi"\ndegree = 3\nvariational = "no"', "[method] variational must be true or false"),
        ('"svi"\ndegree = 3', '"collocation"\nabscissae = 0.5', "[method] abscissae must be a list"),
        ('["q"]', '"q"', "[system] coordinates must be a list of names"),
        ("cos(q)", "cos(x)", "unknown name 'x'"),
        ("m*q_dot**2/2 + ", "", "[system]: the Lagrangian of 'pendulum' is degenerate"),
        ("[system]", "system = 3\n[zzz]", "unknown section 'zzz'"),
        ("[system]", '[system]\ncatalogue = "kepler"', "unknown key 'name' in [system] beside catalogue"),
        ("[run]", "[run", "this is not TOML"),
        ("[run]", '[tables]\n"b[N]" = [1]\n[run]', "[tables] belongs to coordinates that are arrays"),
        ('"svi"', '"svi:4"', "[method] method = svi:4 and [method] degree = 3 contradict each other"),
        ('["q"]', '["q"]\nmomenta = ["p"]', "[system] has momenta and a lagrangian"),
        (
            'lagrangian = "m*q_dot**2/2 + cos(q)"',
            'hamiltonian = "p_q**2/2"\ndissipation = "q_dot**2"',
            "[system] has a dissipation, in velocities, and a hamiltonian: write the forces in [forces]",
        ),
    ],
)
def test_invalid_entries_are_named(old, new, message, tmp_path):
    assert old in PENDULUM
    path = tmp_path / "model.toml"
    path.write_text(PENDULUM.replace(old, new, 1))
    with pytest.raises(ModelFileError, match=re.escape(message)) as caught:
        load_model(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_forces_require_an_explicit_system():
    with pytest.raises(ModelFileError, match=r"\[forces\] are not supported for a system of the catalogue"):
        parse_model('[system]\ncatalogue = "kepler"\n[forces]\nq1 = "-q1_dot"\n')


@pytest.mark.parametrize("more", [{"damping": "m/4"}, {"forces": {"q": "-m*q_dot**3"}}, {"dissipation": "q_dot**2"}])
def test_forces_and_constraints_survive_a_round_trip(more):
    formula = "m*q_dot**2/2 + cos(q)"
    system = LagrangianSystem.from_text(
        name="pendulum", coordinates=["q"], lagrangian=formula, parameters={"m": 2.0}, **more
    )
    model = replace(parse_model(PENDULUM), system=system)
    assert parse_model(dump_model(model)) == model != parse_model(PENDULUM)


def test_all_missing_entries_are_reported_together():
    with pytest.raises(ModelFileError, match=r"there is no span or steps in \[run\]"):
        parse_model(PENDULUM[: PENDULUM.index("[run]")])
    assert parse_model(PENDULUM.replace("step = 0.25\n", "")).tolerance is None
    everything = ["name", "coordinates", "hamiltonian.or.lagrangian", "q", "p.or.q_dot"]
    everything.append("span.or.steps")
    with pytest.raises(ModelFileError, match=r" in \[\w+\], no ".join(everything)):
        parse_model("")
    with pytest.raises(ModelFileError, match="must be a section"):
        parse_model("run = 3\n" + PENDULUM[: PENDULUM.index("[run]")])


def test_missing_method_selects_the_default():
    text = PENDULUM.replace('[method]\nmethod = "svi"\ndegree = 3\n', "")
    assert text != PENDULUM
    assert parse_model(text).method == SVI(8)


def test_overriding_sections_extend_and_replace():
    system = PENDULUM[: PENDULUM.index("[initial]")]
    given = {"initial": {"q": [0.5], "p": [0.0]}, "run": {"step": 0.1, "steps": 3}, "method": {"degree": 4}}
    model = parse_model(system, given)
    assert (model.q, model.p, model.h, model.steps, model.method) == ((0.5,), (0.0,), 0.1, 3, SVI(4))
    model = parse_model(PENDULUM, {**given, "parameters": {"m": 7.0}})
    assert (model.p, model.velocity, model.steps, model.span) == ((0.0,), None, 3, None)
    assert model.system.defaults[0] == 7.0
    assert (model.t, model.save_every) == (1.5, 4)
    with pytest.raises(ModelFileError, match="no parameter 'nu'"):
        parse_model(PENDULUM, {"parameters": {"nu": 1.0}})


def test_unreadable_files_are_errors_of_the_model_file(tmp_path):
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_model(tmp_path / "missing.toml")
    with pytest.raises(ModelFileError, match="cannot be read"):
        load_model(tmp_path)
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelFileError, match="not a text file in UTF-8"):
        load_model(tmp_path / "binary.toml")


def test_models_from_python_are_checked_and_accept_arrays():
    model = kepler(q=np.array([0.5, 0.0]), steps=np.int64(7), span=None, h=np.float64(0.5))
    assert model == kepler(steps=7, span=None, h=0.5)
    assert hash(model) == hash(kepler(steps=7, span=None, h=0.5))
    for changes, message in (
        ({"q": (1.0,)}, "q must have 2 numbers for (q1, q2), not 1"),
        ({"q": 1.0}, "q must be 2 numbers"),
        ({"velocity": (1.0, float("nan"))}, "velocity[1] (q2) is nan"),
    ):
        with pytest.raises(ModelFileError, match=re.escape(message)):
            kepler(**changes)


def test_the_last_step_of_a_span_may_be_shorter():
    assert kepler(h=0.3, span=1.0).step_count == 4
    assert kepler(h=-0.3, span=1.0).step_count == 4
    assert kepler(h=5.0, span=1.0).step_count == 1
    assert kepler(steps=0, span=None).step_count == 0
    assert [kepler(h=0.1, span=span).has_shorter_last_step for span in (0.3, 0.31, 1e8)] == [False, True, False]
    for h, expected in ((0.3, [0.3, 0.3, 0.3, 0.1]), (-0.3, [-0.3, -0.3, -0.3, -0.1]), (5.0, [1.0])):
        model = kepler(h=h, span=1.0)
        run = model.start(compile_stepper(model.system, model.method))
        (found,) = (run.record(steps) for steps in model.segments(run))
        assert found.t[-1] == math.copysign(1.0, h)
        assert found.step_sizes[:-1] == pytest.approx(expected)


@pytest.mark.parametrize(("h", "steps", "end"), [(0.3, 3, "0.9"), (-0.3, 3, "-0.9"), (0.28, 4, "1.12"), (5.0, 1, "5")])
def test_equal_steps_end_near_the_span_with_a_warning(h, steps, end):
    with pytest.warns(MethodWarning, match=re.escape(f"{steps} steps end at t = {end}, not {math.copysign(1, h):g}")):
        assert kepler(h=h, span=1.0).whole_step_count() == steps
    assert kepler(h=0.1, span=1.0).whole_step_count() == 10  # without a warning


def test_initial_states_of_first_order_systems_are_whole_or_in_halves():
    text = (
        "[system]\nname = 'vortex'\ncoordinates = ['x', 'y']\nlagrangian = 'x*y_dot - x**2/2 - y**2/2'\n"
        "[method]\nmethod = 'svi:2'\n[run]\nstep = 0.1\nsteps = 3\n[initial]\n"
    )
    whole = parse_model(text + "q = [0.3, 0.2]\n")
    assert sorted((*whole.q, *whole.p)) == [0.2, 0.3]
    assert parse_model(text + f"q = {list(whole.q)}\np = {list(whole.p)}\n") == whole
