"""Model files of array systems: arrays by number, list, file and formula; sizes; errors."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import load_model
from scvi_codegen.interfaces.models.model_files.values import read_array
from scvi_codegen.systems.formulas.arrays import parse_array

NET = """
[system]
name = "net"
coordinates = ["r[N, 2]"]
lagrangian = '''
    sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)
    - sum(b in B, k/2*sum(a in 2, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2))
'''

[parameters]
k = 2.0
"m[N]" = "1 + i/N"

[tables]
"bonds[B, 2]" = { file = "bonds.csv" }

[initial]
r = { file = "start.npz" }
q = ["cos(2*pi*i/N)", "sin(2*pi*i/N)"]

[sizes]
N = 3

[method]
method = "svi:2"

[run]
step = 0.1
steps = 4
"""


@pytest.fixture
def net(tmp_path: Path) -> Path:
    """A model file with a table in the same folder."""
    path = tmp_path / "net.toml"
    path.write_text(NET.replace('r = { file = "start.npz" }\n', ""))
    (tmp_path / "bonds.csv").write_text("a,b\n0,1\n1,2\n")
    return path


@pytest.mark.second
def test_model_file_is_read_completely(net: Path) -> None:
    """Formulas at every place, a table from a file, and the run by hand."""
    model = sc.load_model(net, {"parameters": {"k": 3.0}, "run": {"span": 0.2}})
    angle = 2 * np.pi * np.arange(3) / 3
    assert model.q["r"] == pytest.approx(np.stack([np.cos(angle), np.sin(angle)], axis=-1), abs=1e-15)
    assert model.parameters["m"] == pytest.approx([1, 4 / 3, 5 / 3])
    assert model.tables["bonds"].tolist() == [[0, 1], [1, 2]]
    assert model.system.defaults == (3.0,)
    assert (model.h, model.step_count, model.method.name) == (0.1, 2, sc.SVI(2).name)
    own = model.integrate()
    other = sc.compile_stepper(model.system, "svi:2").integrate(
        model.q["r"], h=0.1, steps=2, tables={"bonds": [[0, 1], [1, 2]]}, parameters={"m": [1, 4 / 3, 5 / 3]}
    )
    assert np.array_equal(own.q["r"], other.q["r"])


@pytest.mark.rotated
def test_newton_that_requires_known_sizes_runs_with_those_of_the_model(net: Path) -> None:
    """Its states are those of the other solver; C for arrays of run-time sizes is refused."""
    net.write_text(net.read_text().replace('"svi:2"', '"stoermer-verlet"', 1))
    model = sc.load_model(net, {"method": {"solver": "newton"}})
    other = sc.load_model(net)
    assert np.abs(model.integrate().q["r"] - other.integrate().q["r"]).max() < 1e-14
    with pytest.raises(sc.MethodError, match="leave out solver='newton'"):
        sc.generate_package(model, net.parent / "made")


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.5, [0.5, 0.5, 0.5]),
        ([1, 2, 3.5], [1, 2, 3.5]),
        ("g*i**2/N - sqrt(4)", [-2, -2 + 9.81 / 3, -2 + 4 * 9.81 / 3]),
        ("atan2(i, 2) + asinh(i) + exp(-i)", np.arctan2(range(3), 2) + np.arcsinh(range(3)) + np.exp(-np.arange(3.0))),
        ({"file": "a.npy"}, [7, 8, 9]),
        ({"file": "a.npz", "array": "y"}, [4, 5, 6]),
        ({"file": "a.csv"}, [1, 2, 3]),
    ],
)
def test_arrays_are_read_from_the_file(value: Any, expected: Any, tmp_path: Path) -> None:
    """Each notation of arrays is read."""
    np.save(tmp_path / "a.npy", [7, 8, 9])
    np.savez(tmp_path / "a.npz", x=[1, 2, 3], y=[4, 5, 6])
    (tmp_path / "a.csv").write_text("q,v\n1,0\n2,0\n3,0\n")
    found = read_array(parse_array("q[N]"), value, "q", folder=tmp_path, sizes={"N": 3}, parameters={"g": 9.81})
    assert found == pytest.approx(expected, rel=1e-15)


def test_index_has_one_meaning() -> None:
    """A parameter of its name is refused where a formula of places is read."""
    with pytest.raises(sc.ModelFileError, match="i is the name of an index in formulas of arrays"):
        read_array(parse_array("q[N]"), "i", "q", folder=".", sizes={"N": 3}, parameters={"i": 1.0})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"svi:2"', '"svi:2"\nsolver = "krylov"', "use 'fixed-point' or 'newton'"),
        ('"svi:2"', '"svi:2"\nsolver = 2', "unknown solver 2 of an array system"),
        ("N = 3", "M = 3", r"unknown size 'M' in \[sizes\]"),
        ("N = 3", "N = 0", "N"),
        ("N = 3", "", "the size N is undefined"),
        ('"cos(2*pi*i/N)"', '"cos(2*pi*x/N)"', "x"),
        ('"cos(2*pi*i/N)"', "\"__import__('os')\"", "strings are not part of the grammar"),
        ('"cos(2*pi*i/N)", ', "", r"1 formulas: give one, or one for each component of r\[N, 2\]"),
        ('q = ["cos(2*pi*i/N)", "sin(2*pi*i/N)"]', "q = [[0.0, 1.0], [1.0]]", "lists of one length"),
        ('q = ["cos(2*pi*i/N)", "sin(2*pi*i/N)"]', "q = [[0.0, 1.0]]", "the size N is 1 here, but 3 elsewhere"),
        ("bonds.csv", "bonds.txt", "arrays must be in .npy, .npz, .csv files"),
        ("bonds.csv", "none.csv", "cannot be read"),
        ('file = "bonds.csv"', 'file = "bonds.csv", colum = "a"', "unknown key 'colum' in"),
        ('file = "bonds.csv"', "file = 3", "must be a file, .* with text between quotes"),
        ('{ file = "bonds.csv" }', "[[0.5, 1], [1, 2]]", "must be whole numbers"),
        ("steps = 4", "steps = 4\ntolerance = 1e-9", "step.*tolerance"),
        ("steps = 4", 'steps = 4\ncontroller = "reversible"', "controller requires a time transformation"),
        ("steps = 4", "", "span"),
        ("step = 0.1", "", "steps requires a fixed step size"),
        ("[sizes]", "[inputs]\nu = [1]\n\n[sizes]", r"\[inputs\] u must be .*a table"),
    ],
)
def test_invalid_files_are_rejected(net: Path, old: str, new: str, message: str) -> None:
    """Errors contain the path and the key."""
    text = net.read_text()
    assert old in text
    net.write_text(text.replace(old, new, 1))
    with pytest.raises(sc.ModelFileError, match=message) as caught:
        load_model(net)
    assert str(caught.value).startswith(str(net))


DRIVEN = """
[system]
name = "driven ring"
coordinates = ["q[N]"]
lagrangian = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2)"
inputs = ["u"]
[forces]
"q[i]" = "u"
[sizes]
N = 4
[inputs]
u = { t = [0.0, 0.55, 1.0], values = [0.0, 1.0, -1.0] }
[initial]
q = "i/10"
[method]
method = "svi:4"
[run]
step = 0.1
span = 1.0
"""


@pytest.mark.tiers(0, 1)
def test_models_of_arrays_have_inputs(tmp_path: Path) -> None:
    """The mean moves as the exact integral of the force; known sizes give the same states."""
    path = tmp_path / "driven.toml"
    path.write_text(DRIVEN)
    model = sc.load_model(path)
    run = model.integrate()
    assert run.t[-1] == 1.0
    # x'' = u: after the ramp to 1 at a = 0.55, x = a**2/6, v = a/2; then b = 0.45 with u = 1 - 2 s/b
    a, b = 0.55, 0.45
    mean = a**2 / 6 + a / 2 * b + b**2 / 2 - b**2 / 3
    assert run.q["q"][-1].mean() == pytest.approx(0.15 + mean, abs=1e-13)
    known = model.with_known_sizes().integrate()
    assert known.q[-1] == pytest.approx(run.q["q"][-1], abs=1e-14)
    sc.save_model(model, tmp_path / "again.toml")
    assert sc.load_model(tmp_path / "again.toml") == model


RING = """
[system]
name = "ring"
coordinates = ["x", "q[3]"]
lagrangian = "M*x_dot**2/2 + sum(i in 3, m[i]*q_dot[i]**2/2) - sum(i in 3 periodic, (q[i+1] - q[i] - x)**2/2)"
[parameters]
M = 2
"m[3]" = [1, 2, 3]
[initial]
q = { x = 0.5, q = [0, 1, 2] }
q_dot = { x = 0, q = 0 }
[run]
step = 0.1
span = 1.0
"""


def test_model_files_with_arrays_of_known_sizes(tmp_path: Path) -> None:
    path = tmp_path / "ring.toml"
    path.write_text(RING)
    model = sc.load_model(path)
    assert (model.q, model.velocity) == ((0.5, 0.0, 1.0, 2.0), (0.0, 0.0, 0.0, 0.0))
    assert model.parameters == {"M": 2.0, "m_0": 1.0, "m_1": 2.0, "m_2": 3.0}
    sc.save_model(model, tmp_path / "again.toml")
    assert 'coordinates = [\n    "x",\n    "q[3]",\n]' in (tmp_path / "again.toml").read_text()
    assert "sum(i in 3, m[i]*q_dot[i]**2/2)" in (tmp_path / "again.toml").read_text()
    assert sc.load_model(tmp_path / "again.toml") == model
    path.write_text(RING.replace("q = [0, 1, 2]", 'q = "i"'))
    assert sc.load_model(path) == model
    path.write_text(RING.replace("[0, 1, 2]", "[0, 1]"))
    with pytest.raises(sc.ModelFileError, match="q"):
        sc.load_model(path)
