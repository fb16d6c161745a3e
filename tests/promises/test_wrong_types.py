"""Public calls with an argument of the wrong type: an error of the project's own that names the argument, each time."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import samples
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.common import validation
from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.common.validation import TEXT, checks_arguments, hints, keyword_hint

WRONG = (object(), b"bytes", 1j)
"""No argument of any public function may be one of these."""

CALLED = {
    "composition_order": "the order",
    "events": "event",
    "h": "h",
    "harmonics": "the number of harmonics",
    "pieces": "the number of pieces",
    "q_current": "q1",
    "q_previous": "q0",
    "stages": "s",
    "t": "t",
    "time": "the time",
}
"""What messages call an argument, where not by its name."""

Q, P = [1.0, 0.1], [0.0, 1.0]
STATE = {"q": Q, "p": P}
MOVED = STATE | {"h": 0.1, "t": 0.0, "parameters": None, "options": None}
ENTRY = sc.problem("kepler")
SYSTEM = ENTRY.system
NAMED: dict[str, Any] = {"name": "x", "coordinates": ["x"], "parameters": {}}
COMPILED = {"solver": "auto", "prefix": None, "symmetries": (), "events": None}
MODEL = sc.Model.from_problem(ENTRY)

PLAIN: dict[str, dict[str, Any]] = {
    "compile_stepper": {"system": SYSTEM, "method": "svi:2", "flags": QUICK_FLAGS} | COMPILED,
    "generate_source": {"system": SYSTEM, "method": "svi:2"} | COMPILED,
    "derive": {"system": SYSTEM, "method": "svi:1", "radicals": False},
    "advise": {"system": SYSTEM, "method": "svi:2", **STATE, "span": 1.0, "tolerance": 0.1, "degree": False, "t": 0.0},
    "verify": {"system": SYSTEM, "method": "svi:1", **STATE, "h": 0.1, "t": 0.0, "stepper": None},
    "symmetries": {"system": SYSTEM},
    "check_symmetry": {"system": SYSTEM, "direction": ["-q2", "q1"], "gauge": None, "name": "x"},
    "hamiltonian_of": {"system": SYSTEM, "momenta": None},
    "lagrangian_of": {"system": sc.hamiltonian_of(SYSTEM)},
    "change_coordinates": {"system": SYSTEM, "old": {"q1": "u", "q2": "w"}, "coordinates": ["u", "w"]},
    "reparametrise": {"system": SYSTEM},
    "variational_system": {"system": SYSTEM, "count": 1},
    "exact_map": {"system": SYSTEM, "q0": Q, "p0": P, "h": 0.1, "t": 0.0, "parameters": None, "digits": 16},
    "exact_discrete_lagrangian": {"system": SYSTEM, "q0": Q, "q1": Q, "h": 0.1, "parameters": None, "guess": None},
    "problem": {"name": "kepler"},
    "load_model": {"path": "no such file"},
    "save_model": {"model": MODEL, "path": "no such folder/file"},
    "load_package": {"folder": "no such folder"},
    "generate_package": {"model": MODEL, "folder": "no such/folder", "force": False},
    "generate_fmu": {"model": MODEL, "path": "no such/one.fmu", "force": False},
    "load_run": {"folder": "no such folder"},
    "resume_run": {"folder": "no such folder"},
    "SVI": {"degree": 2, "quadrature": None, "nodes": None, "space": None},
    "SCVI": {"degree": 2, "quadrature": None, "nodes": None, "abscissae": None},
    "SpectralCollocation": {"degree": 2, "nodes": None, "form": "position"},
    "Gauss": {"stages": 2, "form": "position"},
    "CollocationRK": {"abscissae": [0, 1], "form": "position"},
    "RungeKutta": {"tableau": sc.Gauss(2).tableau, "form": "position"},
    "Composition": {"composition_order": 2},
    "Splines": {"pieces": 2},
    "SolverOptions": {"tolerance": 1e-9, "max_iterations": 5, "absolute": False},
    "Event": {"function": "q1", "direction": 0, "terminal": False},
    "Model": {"system": SYSTEM, "method": "svi", **STATE, "h": 0.1, "steps": 3, "save_every": 1, "t": 0.0},
    "gauss_legendre": {"n": 2},
    "gauss_radau": {"n": 2, "side": "left"},
    "hermite": {"n": 2, "derivatives": 1},
    "equispaced": {"degree": 2},
    "LagrangianSystem.from_text": NAMED | {"lagrangian": "x_dot**2"},
    "HamiltonianSystem.from_text": NAMED | {"hamiltonian": "p**2", "momenta": ["p"]},
}
OF_STEPPERS: dict[str, dict[str, Any]] = {
    "integrate": MOVED | {"steps": 3, "save_every": 1, "progress": None, "t_eval": None, "events": None},
    "integrate_ensemble": MOVED | {"q": [Q], "p": [P], "steps": 3, "save_every": 1, "threads": 1},
    "start": MOVED,
    "step": MOVED,
    "jacobian": MOVED,
    "sensitivity": MOVED,
    "momentum": {"q": Q, "v": P, "t": 0.0, "parameters": None},
    "velocity": STATE | {"t": 0.0, "parameters": None},
    "energy": STATE | {"t": 0.0, "parameters": None},
    "momentum_maps": STATE | {"t": 0.0, "parameters": None},
    "discrete_lagrangian": {"q0": Q, "q1": Q, "h": 0.1},
    "step_positions": {"q_previous": Q, "q_current": Q, "h": 0.1},
}
OF_RUNS: dict[str, dict[str, Any]] = {
    "plot_energy": {"path": None, "ax": None},
    "plot_phase": {"path": None, "ax": None, "axes": None},
    "plot_trajectory": {"path": None},
    "animate": {"path": None, "seconds": 1.0, "positions": None},
}


def refused(function: Any, given: dict[str, Any]) -> None:
    """All arguments, one by one."""
    for argument in given:
        for wrong in WRONG:
            with pytest.raises(ScviCodegenError) as caught:
                function(**given | {argument: wrong})
            words = re.escape(CALLED.get(argument, argument)).replace("_", "[_ ]")
            assert re.search(rf"\b{words}\b", str(caught.value)), (argument, wrong, str(caught.value))


@pytest.mark.tiers(4)
@pytest.mark.parametrize("name", PLAIN)
def test_functions_refuse_wrong_types_by_name(name):
    function: Any = sc
    for part in name.split("."):
        function = getattr(function, part)
    refused(function, PLAIN[name])


@pytest.mark.tiers(4)
@pytest.mark.parametrize("name", OF_STEPPERS)
def test_steppers_refuse_wrong_types_by_name(name, quickly_compiled):
    refused(getattr(quickly_compiled(SYSTEM, sc.SVI(2)), name), OF_STEPPERS[name])


@pytest.fixture(scope="module")
def run():
    return samples.compile_quickly(SYSTEM, sc.SVI(2)).integrate(Q, P, h=0.1, steps=5)


@pytest.mark.parametrize("name", OF_RUNS)
def test_pictures_refuse_wrong_types_by_name(name, run):
    first = "trajectories" if name in {"plot_energy", "plot_phase"} else "trajectory"
    refused(getattr(sc, name), {first: run} | OF_RUNS[name])


def test_trajectories_refuse_wrong_types_by_name(run, tmp_path):
    refused(run.at, {"t": 0.1})
    refused(run.pullback, {"cotangents": np.zeros((6, 4))})
    refused(run.tangent, {"directions": Q + P})
    known = {"stepper": run.stepper, "t": run.t, "measured": run.q, "q": Q, "p": P, "h": 0.1, "parameters": None}
    asked = {"unknown": ["mu"], "fit_initial_state": True, "start": 0.0, "observed": ["q1", "q2"], "deviations": 1.0}
    refused(sc.fit, known | asked | {"inputs": None, "bounds": {"mu": (0.0, 2.0)}})
    refused(run.crossings, {"events": "q1"})
    refused(run.save, {"path": tmp_path / "run.npz", "units": None})
    span = {"t_span": (0.0, 1.0), "y0": [*Q, *P], "method": None, "t_eval": None, "dense_output": False}
    refused(sc.solve_ivp, {"system": run.stepper} | span)
    fresh = {"run": run.stepper.start(Q, P, h=0.1), "folder": tmp_path / "a.run", "checkpoint_seconds": 1.0}
    refused(sc.record_run, fresh | {"steps": 3, "save_every": 1, "model": None, "progress": None})


@pytest.mark.parametrize(
    "given", [["k"], {"k"}, {1: 2.0}, {"k": "a"}, {"k": None}, {"nu": 1.0}, [1.0, 2.0], "k"], ids=repr
)
def test_parameters_of_wrong_type_are_rejected(given, run):
    with pytest.raises(ScviCodegenError, match="parameter"):
        run.stepper.integrate(Q, P, h=0.1, steps=1, parameters=given)


def test_checked_functions_retain_their_signature():
    @checks_arguments(name=TEXT)
    def greet(name: str, times: int = 1) -> str:
        """Politely."""
        return f"hello {name}" * times

    assert (greet("a"), greet(name="b", times=2), greet.__doc__) == ("hello a", "hello bhello b", "Politely.")
    with pytest.raises(TypeError, match="name must be text, not 3"):
        greet(3)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="missing 1 required"):
        greet()  # type: ignore[call-arg]


def test_no_synonym_hides_a_keyword():
    """A known keyword is never reported as a synonym, and every suggested location exists."""
    assert keyword_hint("q", ["y0"]) == "; did you mean 'y0'?"
    assert keyword_hint("n", ["mass"]).startswith(": pass the number to run.advance(n)")
    assert not [here for here, elsewhere in hints()["synonyms"].items() if {*here.split()} & {*elsewhere.split()}]
    for name in ("integrate", "integrate_ensemble", "momentum"):
        assert hasattr(sc.Stepper, name)
        assert any(f".{name}" in place for place in hints()["explanations"].values())


def test_system_accepts_positional_arguments_and_scalar_states():
    for kind, formula in ((sc.LagrangianSystem, "q_dot**2/2 + cos(q)"), (sc.HamiltonianSystem, "p_q**2/2 - cos(q)")):
        by_name = {"lagrangian": formula} if kind is sc.LagrangianSystem else {"hamiltonian": formula}
        assert kind.from_text("swing", ["q"], formula) == kind.from_text(name="swing", coordinates=["q"], **by_name)
    assert sc.LagrangianSystem.from_text("chain", ["q[N]"], "sum(a in N, q_dot[a]**2/2)").name == "chain"
    swing = samples.compile_quickly(sc.problem("planar-pendulum").system, sc.SVI(2))
    plan = {"h": 0.1, "steps": 3}
    assert swing.integrate(1.0, 0.5, **plan).q.tolist() == swing.integrate([1.0], [0.5], **plan).q.tolist()
    assert swing.energy(1.0, 0.5) == swing.energy([1.0], [0.5])


def test_tracebacks_end_at_the_call(monkeypatch):
    """Frames of the package are shown with ``python -X dev``, and in these tests."""
    for deep in (False, True):
        monkeypatch.setattr(validation, "KEEPS_FRAMES", deep)
        with pytest.raises(sc.ExpressionError, match=r'coordinates=\["q\[3\]"\]') as raised:
            sc.LagrangianSystem.from_text("s", ["x"], "sum(i in N, m[i]*x_dot**2)")
        files = [Path(frame.path).name for frame in raised.traceback]
        assert files[:2] == ["test_wrong_types.py", "validation.py"]
        assert ("grammar.py" in files) is (len(files) > 2) is deep
