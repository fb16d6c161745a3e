"""Model files with a density: reading, writing with equal bits, the commands, and errors by name."""

from pathlib import Path

import numpy as np
import pytest
from commands import error_of, invoke, json_of, output_of

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

STRING = """
[field]
name = "string"
fields = ["u"]
space = { x = [0, "pi"] }
boundary = { x = ["a*sin(3*t)", "natural"] }
density = "u_t**2/2 - c**2*u_x**2/2 - 0.1*u**4"
dissipation = "0.3*u_t**2/2"
discretisation = { method = "spectral-elements", degree = 8, elements = [0.0, 1.0, 3.141592653589793] }

[parameters]
a = 0.1
c = 1.25

[initial]
q = "0.1*c*sin(x) + t"
q_dot = 0.1

[method]
method = "svi:2"

[run]
step = 0.01
steps = 20
"""
SCHROEDINGER = """
[field]
name = "Schroedinger"
fields = ["a"]
momenta = ["b"]
space = { x = [-12.5, 12.5] }
boundary = { x = "periodic" }
hamiltonian = "(a_x**2 + b_x**2)/4 - k*(a**2 + b**2)**2/4"
discretisation = { method = "finite-differences", order = 4, points = 48 }

[parameters]
k = 1.0

[initial]
q = { a = "cos(x/2)/cosh(x)", b = "sin(x/2)/cosh(x)" }

[method]
method = "svi:2"

[run]
step = 0.01
steps = 10
"""
PLANE = """
[field]
name = "membrane"
fields = ["u", "v"]
space = { x = [0, 1], y = [0, 2] }
boundary = { x = [{ u = "0", v = "t" }, "natural"], y = "periodic" }
density = "(u_t**2 + v_t**2)/2 - (u_x**2 + u_y**2 + v_x**2 + v_y**2)/2 - u*v"
discretisation = { method = "spectral-elements", degree = { x = 3, y = 4 }, elements = { x = 2, y = 4 } }

[initial]
q = { u = "x*cos(pi*y)", v = 0 }

[run]
tolerance = 1e-9
span = 0.5
"""
OSCILLATOR = """
[field]
name = "string with an oscillator"
fields = ["u"]
scalars = ["X"]
space = { x = [0, 1] }
density = "u_t**2/2 - u_x**2/2"
point_lagrangians = [{ x = "1/3", lagrangian = "M*X_t**2/2 - k*(u - X)**2/2" }]
discretisation = { method = "spectral-elements", degree = 8, elements = 3 }

[parameters]
M = 0.3
k = 2.0

[initial]
q = { u = "cos(pi*x)", X = "M/3" }

[run]
step = 0.01
steps = 5
"""


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("text", [STRING, SCHROEDINGER, PLANE, OSCILLATOR])
@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning")
def test_file_is_read_back_with_equal_bits(text):
    model = parse_model(text)
    again = parse_model(dump_model(model))
    assert again == model
    assert again.array_system.mesh.field_system == model.array_system.mesh.field_system
    one, two = model.integrate(), again.integrate()
    assert {name: values.tobytes() for name, values in one.q.items()} == {n: v.tobytes() for n, v in two.q.items()}


def test_state_is_that_of_the_formulas():
    model = parse_model(STRING.replace("[method]", "t = 0.5\n[method]"))
    mesh = model.array_system.mesh
    assert model.q["u"] == pytest.approx(0.125 * np.sin(mesh.points["x"]) + 0.5, abs=1e-16)
    assert np.array_equal(model.velocity["u"], np.full(mesh.weights.shape, 0.1))
    model = parse_model(SCHROEDINGER, {"parameters": {"k": 2.0}})
    mesh = model.array_system.mesh
    x = mesh.points["x"]
    assert model.p["a"] / mesh.weights == pytest.approx(np.sin(x / 2) / np.cosh(x), abs=1e-15)
    assert (model.parameters["k"], model.array_system.defaults) == (2.0, (2.0,))


def test_long_states_are_written_to_tables(tmp_path):
    model = parse_model(SCHROEDINGER.replace("points = 48", "points = 1200"))
    sc.save_model(model, tmp_path / "long.toml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["long.toml", "long_p.csv", "long_q.csv"]
    assert sc.load_model(tmp_path / "long.toml") == model


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("u_x**2/2 -", "u_z**2/2 -", r"\[field\]: unknown name 'u_z'; did you mean 'u_x'"),
        ('fields = ["u"]\n', "", r"there is no fields in \[field\]"),
        ("degree = 8", "dgree = 8", "'spectral-elements' has no option 'dgree'"),
        ('method = "spectral-elements"', 'method = "spectral"', "there is no discretisation 'spectral'"),
        ("discretisation = {", 'discretisation = "fourier" #', r"discretisation must be a table, .*, not 'fourier'"),
        ("[method]", "[forces]\nu = '1'\n[method]", r"\[forces\] is not available beside \[field\]"),
        ("[method]", "[system]\nname = 'a'\n[method]", r"unknown key 'name' in \[system\] beside \[field\]"),
        ("c*sin(x)", "c*sin(y)", r"\[initial\] q, u: .*'y'"),
        ("boundary", "boundry", r"unknown key 'boundry' in \[field\]; did you mean 'boundary'"),
        ("q_dot = 0.1", "q_dot = { v = 0.1 }", r"unknown field 'v' in \[initial\] q_dot"),
        ("q_dot = 0.1", "q_dot = [0.1]", r"has the shape \(1,\)|is 1 here|size Nx"),
    ],
)
def test_invalid_files_are_rejected_by_name(old, new, message):
    assert old in STRING
    with pytest.raises(sc.ModelFileError, match=message):
        parse_model(STRING.replace(old, new, 1)).start()


@pytest.mark.rotated
def test_commands_accept_a_density(here):
    """Equations first; the folder runs and keeps the density."""
    Path("nls.toml").write_text(SCHROEDINGER)
    derived = output_of("derive", "nls.toml")
    assert derived.index("a_t = -a**2*b*k - b**3*k - b_xx/2") < derived.index("q' = q + h*")
    expected = parse_model(SCHROEDINGER.replace("k = 1.0", "k = 0.5")).integrate().q["a"][-1]
    assert json_of("run", "nls.toml", "--parameter", "k=0.5")["final"]["q"]["a"] == expected.tolist()
    assert "the system has no parameter 'z'" in error_of("run", "nls.toml", "--parameter", "z=0.5")
    invoke("generate", "nls.toml", "-o", "nls_svi")
    assert sc.load_model("nls_svi/model.toml") == parse_model(SCHROEDINGER)
