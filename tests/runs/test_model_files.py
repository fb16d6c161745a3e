"""Model files with rotations, torques, directions and spins, read, run, written and read again."""

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

TOP = """
[system]
name = "driven top"
coordinates = ["x"]
rotations = { R = "omega" }
lagrangian = "x_dot**2/2 - x**2/2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2 - w*R_33*x"

[torques]
R = ["0", "0", "-c*omega_3"]

[torques_space]
R = [0, "c", 0]

[parameters]
w = 1.5
c = 0.01

[initial]
q = { x = 0.1, R = { euler = "zxz", angles = [0.0, 0.3, 0.0] } }
q_dot = { x = 0.0, omega = [0.1, 0.0, 2.0] }

[method]
method = "svi"
degree = 3

[run]
step = 0.05
steps = 20
"""

SPINS = """
[system]
name = "two spins"
spins = ["a", "b"]
hamiltonian = "a_1*b_1 + a_2*b_2 + 1.5*a_3*b_3"

[initial]
q = { a = [1, 0, 0], b = [0, 0.6, 0.8] }

[run]
step = 0.1
steps = 20
"""


@pytest.mark.second
def test_a_file_with_rotations_runs_as_the_system_built_in_python():
    model = parse_model(TOP)
    system = sc.LagrangianSystem.from_text(
        "driven top",
        ["x"],
        "x_dot**2/2 - x**2/2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2 - w*R_33*x",
        rotations={"R": "omega"},
        parameters={"w": 1.5, "c": 0.01},
        torques={"R": ["0", "0", "-c*omega_3"]},
        torques_space={"R": ["0", "c", "0"]},
    )
    assert model.system == system
    run = sc.compile_stepper(system, "svi:3").integrate(
        {"x": 0.1, "R": {"euler": "zxz", "angles": [0.0, 0.3, 0.0]}},
        velocity={"x": 0.0, "omega": [0.1, 0.0, 2.0]},
        h=0.05,
        steps=20,
    )
    np.testing.assert_allclose(model.integrate().q, run.q, rtol=0, atol=1e-15)


@pytest.mark.parametrize("text", [TOP, SPINS], ids=["rotation", "spins"])
def test_a_model_is_written_with_its_rotations(text):
    model = parse_model(text)
    written = dump_model(model)
    assert ("rotations" in written) == ("rotations" in text)
    assert ("spins" in written) == ("spins" in text)
    assert parse_model(written) == model


@pytest.mark.parametrize("wrong", ["spin", "rotation R", "motion R omega", "rotation R omega; x", "rotation R omega"])
def test_declarations_in_data_are_checked(wrong):
    """Also one that declares more coordinates than there are."""
    interface = sc.compile_stepper(parse_model(SPINS).system, "svi:2").interface
    record = interface.to_record() | {"rotations": [wrong] * 3}
    with pytest.raises(ValueError, match="it must declare some of the coordinates"):
        Interface.from_record(record)
    assert Interface.from_record(interface.to_record()) == interface


ANGLES = [0.3, 0.5, -0.2]
c, s = np.cos(ANGLES), np.sin(ANGLES)
MATRIX = (
    np.array([[c[0], -s[0], 0], [s[0], c[0], 0], [0, 0, 1]])
    @ np.array([[1, 0, 0], [0, c[1], -s[1]], [0, s[1], c[1]]])
    @ np.array([[c[2], -s[2], 0], [s[2], c[2], 0], [0, 0, 1]])
)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("attitude", [MATRIX, {"euler": "ZXZ", "angles": ANGLES}])
def test_models_in_python_take_attitudes(attitude):
    system = parse_model(TOP).system
    model = sc.Model(
        system=system,
        method="svi:3",
        q={"x": 0.1, "R": attitude},
        velocity={"x": 0.0, "omega": [0.1, 0.0, 2.0]},
        h=0.05,
        steps=20,
    )
    run = model.integrate()
    assert np.abs(run.rotation()[0] - MATRIX).max() < 1e-15
    np.testing.assert_allclose(run.angular_velocity()[0], [0.1, 0.0, 2.0], rtol=0, atol=1e-15)
    assert np.array_equal(parse_model(dump_model(model)).integrate().q, run.q)
    with pytest.raises(sc.ModelFileError, match="the matrix of 'R' is not a rotation"):
        sc.Model(
            system=system, method="svi:3", q={"x": 0, "R": np.ones((3, 3))}, velocity=None, p=[0] * 5, h=1, steps=1
        )
