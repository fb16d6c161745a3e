"""Models whose steps the reversible controller chooses: files, the command line, ``solve_ivp`` and inputs."""

from dataclasses import replace
from pathlib import Path

import pytest
from commands import error_of

import scvi_codegen as sc
from scvi_codegen import ModelFileError, generate_package
from scvi_codegen.interfaces.models.model_files.model_file import catalogue_model, dump_model, parse_model

pytestmark = pytest.mark.second

SHAKEN = """
[system]
name = "shaken comet"
coordinates = ["x", "y"]
lagrangian = "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2) + x*cos(t)/100"
time_transformation = "(x**2 + y**2)**(3/4)"

[forces]
x = "-x_dot/1000"

[initial]
q = [0.2, 0.0]
p = [0.0, 3.0]

[method]
method = "svi:6"

[run]
step = 0.1
controller = "reversible"
span = 12.0
"""


@pytest.fixture
def shaken(tmp_path: Path) -> Path:
    path = tmp_path / "shaken.toml"
    path.write_text(SHAKEN)
    return path


@pytest.mark.rotated
def test_controller_of_a_time_transformation_can_be_replaced() -> None:
    both = {
        "system": {"time_transformation": "frequency"},
        "run": {"controller": "reversible", "step": 0.2, "span": 5.0},
    }
    reversible = catalogue_model("kepler", both)
    symplectic = parse_model(dump_model(reversible), {"run": {"controller": "symplectic"}})
    assert symplectic == catalogue_model("kepler", {**both, "run": {"step": 0.2, "span": 5.0}})
    assert parse_model(dump_model(symplectic), {"run": {"controller": "reversible"}}) == reversible


FAR = (
    "run kepler --q 1.97,0 --velocity 0,0.1234 --span 6 --tolerance 1e-10"
    " --time-transformation 1e-3*(1+(q1**2+q2**2)/1000) --controller"
)
"""A transformation that does not resolve the close encounter of an orbit."""


@pytest.mark.rotated
@pytest.mark.parametrize("controller", ["symplectic", "reversible"])
def test_unsuitable_time_transformation_is_reported(controller: str) -> None:
    assert "use another time transformation" in error_of(f"{FAR} {controller}", status=1)


@pytest.mark.quick
@pytest.mark.parametrize(
    ("words", "printed"),
    [
        ("run kepler --controller reversible", "the reversible controller requires a time transformation"),
        ("run kepler --controller pid", "'symplectic', 'predictive', 'reversible'"),
        ("run kepler --time-transformation z --controller reversible", "no time transformation 'z'"),
        ("run FILE --steps 10", "give span, not steps"),
        ("run FILE --advise 1e-9", "--advise is not available with a time transformation"),
        ("run FILE --ensemble grid.toml", "--ensemble is not available with a time transformation"),
        ("run FILE --controller symplectic", "depends on time"),
    ],
)
def test_unsupported_combinations_with_a_controller_are_reported(shaken: Path, words: str, printed: str) -> None:
    assert printed in " ".join(error_of(*words.replace("FILE", str(shaken)).split()).split())


@pytest.mark.second
def test_unsupported_model_fields_are_reported(shaken: Path, tmp_path: Path) -> None:
    model = sc.load_model(shaken)
    with pytest.raises(ModelFileError, match="reversible controller"):
        _ = model.step_count
    with pytest.raises(ModelFileError, match="give one"):
        generate_package(replace(model, h=None, tolerance=1e-9), tmp_path / "none")
    stretched = sc.reparametrise(sc.problem("kepler").system, "frequency")
    with pytest.raises(ModelFileError, match="without a time transformation"):
        sc.Model(
            system=stretched, method=sc.SVI(4), q=(1, 0), p=(0, 1), h=0.1, span=3.0, time_transformation="frequency"
        )
    with pytest.raises(ModelFileError, match=r"unknown .* 'pid': use 'symplectic' or 'predictive' or 'rev"):
        parse_model(SHAKEN.replace('"reversible"', '"pid"'))
