"""Inputs of models: tables in files or inline, round trips, and messages on faulty ones."""

import numpy as np
import pytest

from scvi_codegen import LagrangianSystem, Model, ModelFileError, compile_stepper, load_model
from scvi_codegen.interfaces.models.input_tables import InputTable
from scvi_codegen.interfaces.models.model_files.model_file import parse_model

MODEL = """
[system]
name = "pushed pendulum"
coordinates = ["q"]
lagrangian = "q_dot**2/2 + (1 + w)*cos(q)"
inputs = ["u", "w"]

[forces]
q = "2*u - c*q_dot"

[inputs]
u = { file = "tables/u.csv", kind = "cubic" }
w = { t = [0, 3.0], values = [0.0, 0.3] }

[parameters]
c = 0.2

[initial]
q = [0.3]
q_dot = [0.1]

[run]
step = 0.1
span = 2.3
"""
T, U = (0.0, 0.37, 0.9, 1.41, 2.05, 2.6), (0.0, 1.2, -0.7, 0.4, 1.9, -1.0)


@pytest.fixture
def file(tmp_path):
    """A model file with its table in a neighbouring folder."""
    (tmp_path / "tables").mkdir()
    _write(tmp_path / "tables" / "u.csv", "t,u")
    (tmp_path / "model.toml").write_text(MODEL)
    return tmp_path / "model.toml"


def _write(path, header):
    path.write_text("\n".join([header, "", *(f"{t!r}, {u!r}" for t, u in zip(T, U, strict=True))]) + "\n")


@pytest.mark.parametrize("header", ["t,value", "t,acceleration", "t,u"])
def test_columns_of_a_table_are_read(file, header):
    _write(file.parent / "tables" / "u.csv", header)
    assert load_model(file).inputs["u"] == InputTable(T, U, "cubic")


def test_one_file_contains_several_inputs(file):
    np.savez(file.parent / "both.npz", t=T, u=U, w=np.arange(6.0), fine=np.arange(12.0), note=np.array(3.0))
    text = MODEL.replace("tables/u.csv", "both.npz").replace(
        "{ t = [0, 3.0], values = [0.0, 0.3] }", '{ file = "both.npz" }'
    )
    inputs = parse_model(text, folder=file.parent).inputs
    assert inputs["u"].values == U
    assert inputs["w"].values == (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("t,u\n0,0\n1,x\n", r"\[inputs\] u: tables/u.csv: line 3, u: 'x' is not a number"),
        ("t,u\n0,0\n\n1,1\n1,2\n", "line 5, t: 1 is not greater than 1"),
        ("t,u\n0,0\n1\n", "line 3 must have a number for each of 2 names"),
        ("t,u\n0,0\n1,inf\n", "line 3, u: inf is not a finite number"),
        ("time,u\n0,0\n1,1\n", "no column t among time, u"),
        ("t,a,b\n0,0,0\n1,1,1\n", "no column u or value among t, a, b"),
        ("t,u\n0,0\n", "the input 'u' must have equally many times and values"),
        ("t,u\n", "at least one line of numbers"),
    ],
)
def test_faulty_table_is_reported(file, table, message):
    (file.parent / "tables" / "u.csv").write_text(table)
    with pytest.raises(ModelFileError, match=message) as caught:
        load_model(file)
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"t": [0.0, 2.0, 1.0], "u": [0.0, 0.0, 0.0]}, "row 2, t: 1 is not greater than 2"),
        ({"t": [0.0, 1.0], "u": [0.0, np.nan]}, "row 1, u: nan is not a finite number"),
        ({"t": [0.0, 1.0], "u": [0.0, 1.0, 2.0]}, "no column u or value"),
        ({"u": [0.0, 1.0]}, "no column t"),
        ({"t": [0.0, 1.0], "u": ["a", "b"]}, "no arrays of numbers"),
        ({"t": [0.0, 1.0], "u": [0.0, 1j]}, "u must be real numbers, not complex128"),
    ],
)
def test_faulty_archive_is_reported(file, arrays, message):
    np.savez(file.parent / "u.npz", **arrays)
    with pytest.raises(ModelFileError, match=message):
        parse_model(MODEL.replace("tables/u.csv", "u.npz"), folder=file.parent)


def test_unreadable_file_is_reported(file):
    for name, message in {"none.csv": "cannot be read", "u.txt": ".csv or .npz", "tables/u.npz": "no arrays"}.items():
        (file.parent / "tables" / "u.npz").write_text("not an archive")
        with pytest.raises(ModelFileError, match=f"u: {name}: .*{message}"):
            parse_model(MODEL.replace("tables/u.csv", name), folder=file.parent)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('"a"', "must be a number or a table"),
        ('{ file = "u.csv", values = [1.0] }', "must have either file, or t and values"),
        ('{ kind = "linear" }', "must have either file, or t and values"),
        ("{ t = [0.0, 1.0] }", "u values must be a list of numbers"),
        ('{ t = [0.0, 1.0], values = [0.0, "a"] }', r"values\[1\] must be real numbers"),
        ("{ t = [0.0, 1.0, 0.5], values = [0.0, 1.0, 1.0] }", "must be ascending: 0.5 follows 1"),
        ("{ t = [0.0, 1.0], values = [0.0, 1.0], kind = 3 }", "kind must be text"),
        ('{ t = [0.0, 1.0], values = [0.0, 1.0], kind = "quintic" }', "constant or linear or cubic"),
        ("{ t = [0.0, 1.0], values = [0.0, 1.0], order = 3 }", "unknown key 'order'"),
        ("{ file = 3 }", "file must be a path"),
    ],
)
def test_invalid_entry_is_reported(entry, message):
    with pytest.raises(ModelFileError, match=message):
        parse_model(MODEL.replace('{ file = "tables/u.csv", kind = "cubic" }', entry))


@pytest.mark.second
def test_names_that_are_not_inputs_are_rejected():
    with pytest.raises(ModelFileError, match="'v' is not an input of 'pushed pendulum', whose inputs are u, w"):
        parse_model(
            MODEL.replace('u = { file = "tables/u.csv", kind = "cubic" }', "v = { t = [0, 1], values = [0, 1] }")
        )
    system = LagrangianSystem.from_text(name="s", coordinates=["q"], lagrangian="q_dot**2/2 + u*q", inputs=["u"])
    given = {"system": system, "method": "svi:2", "q": (0.0,), "p": (0.0,), "h": 0.1, "span": 1.0}
    with pytest.raises(ModelFileError, match="the input 'u' is a Python function"):
        Model(**given, inputs={"u": np.sin})
    model, message = Model(**given), r"the input u is not set: .*--input u=FILE"
    stepper = compile_stepper(system, "svi:2")
    with pytest.raises(ModelFileError, match=message):
        next(model.segments(model.start(stepper)))
    with pytest.raises(ModelFileError, match=message):
        Model(**given | {"h": None}).first_step_size(stepper)
