"""Files of NumPy arrays (.npz): every kind of result with all that describes it, where nothing is a default."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.results.export import States, loaded

PARAMETERS = {"m": 1.0, "k": 1.0}
GIVEN: dict[str, Any] = {"h": 0.05, "steps": 12, "t": 0.7, "save_every": 3}
Result = tuple[Any, dict[str, Any]]


def pushed() -> sc.LagrangianSystem:
    return lagrange(
        "pushed", "x y", "m*(x_dot**2 + 2*y_dot**2)/2 - k*(x**2 + x*y**3)/2 + u*x", parameters=PARAMETERS, inputs="u"
    )


def free() -> sc.LagrangianSystem:
    return lagrange(
        "free", "x y", "m*(x_dot**2 + 2*y_dot**2)/2 - k*(x**2 + x*y**3)/2 + x*cos(t)", parameters=PARAMETERS
    )


def described(found: Any, *names: str) -> Result:
    """Return the result, and its attributes and the description of its system by the names in a file."""
    stepper = found.stepper
    words = {"coordinates": ["x", "y"], "title": stepper.title, "parameter_names": [*PARAMETERS]}
    if "iterations" in names:
        interface = stepper.interface
        words |= {"system": interface.system, "method": interface.method, "version": sc.__version__}
    return found, words | {name: getattr(found, name) for name in names}


def trajectory() -> Result:
    stepper = sc.compile_stepper(free(), "svi:3")
    found = stepper.integrate([0.3, 0.2], [0.1, -0.4], parameters={"m": 1.3, "k": 0.8}, **GIVEN)
    return described(found, "t", "q", "p", "h", "iterations", "parameters")


def ensemble() -> Result:
    stepper = sc.compile_stepper(free(), "svi:3")
    start = np.array([[0.3, 0.2], [0.1, 0.5]])
    found = stepper.integrate_ensemble(start, start[::-1], parameters={"k": [0.8, 1.4], "m": 1.3}, **GIVEN)
    return described(found, "t", "q", "p", "h", "status", "steps", "parameters")


def ensemble_to_ends() -> Result:
    stepper = sc.compile_stepper(free(), "svi:3")
    start = np.array([[0.3, 0.2], [0.1, 0.5]])
    found = stepper.integrate_ensemble(start, start[::-1], t=0.7, t_end=[2.0, 3.1], tolerance=1e-6)
    return described(found, "t", "q", "p", "status", "steps", "parameters")


def driven() -> Result:
    return with_input((np.array([0.0, 1.0, 4.0]), np.array([0.5, -0.2, 0.1])))


def driven_without_breakpoints() -> Result:
    return with_input((np.array([0.0, 4.0]), np.array([0.5, -0.2])))


def with_input(table: Any) -> Result:
    stepper = sc.compile_stepper(pushed(), "svi:3")
    given = GIVEN | {"inputs": {"u": table}, "parameters": {"m": 1.3, "k": 0.8}}
    found = stepper.integrate([0.3, 0.2], [0.1, -0.4], **given)
    return described(found, "t", "q", "p", "h", "iterations")


KINDS = [trajectory, ensemble, ensemble_to_ends, driven, driven_without_breakpoints]


@pytest.mark.tiers(1, 3)
@pytest.mark.parametrize("made", KINDS, ids=lambda made: made.__name__)
def test_files_contain_the_result_and_its_description(made: Callable[[], Result], tmp_path: Path) -> None:
    result, expected = made()
    result.save(tmp_path / "result.npz")
    with np.load(tmp_path / "result.npz") as file:
        for name, value in expected.items():
            values = list(value.values()) if isinstance(value, dict) else value
            assert np.array_equal(file[name], values, equal_nan=np.asarray(values).dtype.kind == "f"), name
        assert {file[name].dtype for name in ("t", "q", "p")} == {np.dtype(float)}
        assert {*file} - {*expected} <= {"parameters"}  # of a run with inputs the last values of the inputs, too


@pytest.mark.parametrize("count", [2, 200])
def test_many_parameters_are_a_labelled_array(count):
    """Few parameters are text in an attribute."""
    parameters = {f"m_{k}": k / 2 for k in range(count)}
    names = {"coordinates": ("x",), "momenta": ("p_x",)}
    labelled = States(count=0, pieces=lambda: iter(()), **names, parameters=parameters, h=0.1, about={}).labelled()
    if count == 2:
        assert labelled.attributes == {"h": 0.1, "parameters": '{"m_0": 0.0, "m_1": 0.5}'}
        assert set(labelled.whole) == {"coordinate"}
    else:
        assert labelled.attributes == {"h": 0.1}
        assert dict(zip(labelled.whole["parameter"], labelled.whole["parameters"], strict=True)) == parameters
        assert labelled.dimensions["parameters"] == ("parameter",)


def test_pickled_objects_are_refused(tmp_path: Path) -> None:
    """They could run any code when they are loaded."""
    np.savez(tmp_path / "a.npz", t=np.array([{"not": "numbers"}], dtype=object))
    with loaded(tmp_path / "a.npz") as content, pytest.raises(ValueError, match="allow_pickle=False"):
        content["t"]
