"""Constraint elimination: rods in a plane become angles, compared with the system with constraints."""

import numpy as np
import pytest
import sympy
from commands import error_of, invoke

import scvi_codegen as sc
from scvi_codegen.analysis.verification.certificate import Outcome
from scvi_codegen.analysis.verification.elimination import elimination_checks
from scvi_codegen.analysis.verification.system_under_test import State
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model

FREE = "(x1_dot**2 + y1_dot**2 + 2*x2_dot**2 + 2*y2_dot**2)/2"
FIRST, SECOND = "x1**2 + y1**2 = l**2", "(x2 - x1)**2 + (y2 - y1)**2 = l**2"
ROD = {"coordinates": ["x", "y"], "lagrangian": "m*(x_dot**2 + y_dot**2)/2 - g*y", "parameters": {"m": 2, "g": 9}}
PAIR = {"coordinates": ["x1", "y1", "x2", "y2"], "parameters": {"l": 1.3, "k": 0.7}}
CASES = {
    "support that moves": (ROD | {"constraints": ["x**2 + (y - sin(3*t)/5)**2 = 4"], "damping": 0.1}, ["angle"], 0),
    "length that changes": (ROD | {"constraints": ["sqrt(x**2 + y**2) = 1 + t**2/9"]}, ["angle"], 0),
    "two masses": (
        ROD | {"lagrangian": "m*x_dot**2/2 + g*y_dot**2 - y", "constraints": ["x**2 + y**2 = 4"]},
        ["angle"],
        0,
    ),
    "wheel": (
        {
            "coordinates": ["c", "x", "y"],
            "lagrangian": "c_dot**2 + x_dot**2 + y_dot**2 - y",
            "constraints": ["(x - cos(c)/3)**2 + (y - sin(c)/3)**2 = 1"],
        },
        ["c", "angle"],
        0,
    ),
    "cart, rods in any order": (
        {
            "coordinates": ["s", "x2", "y2", "x1", "y1"],
            "lagrangian": f"{FREE} + s_dot**2 - s**2 - y1*y2",
            "parameters": {"l": 1.3},
            "constraints": [SECOND, "(x1 - s)**2 + y1**2 = l**2"],
            "forces": {"y1": "x1_dot*s", "s": "cos(t)"},
            "dissipation": "x2_dot**2/5",
        },
        ["s", "angle_2", "angle_1"],
        0,
    ),
    "dumbbell": (PAIR | {"lagrangian": f"{FREE} - k*x1**2*y2", "constraints": [SECOND]}, ["x1", "y1", "angle_2"], 0),
    "magnetic field": (
        PAIR | {"lagrangian": f"{FREE} + k*(x2*y2_dot - y2*x2_dot)", "constraints": [FIRST, SECOND]},
        ["angle_1", "angle_2"],
        0,
    ),
    "loop": (
        PAIR | {"lagrangian": f"{FREE} - y1 - y2", "constraints": [FIRST, SECOND, "(x2 - 2)**2 + y2**2 = l**2"]},
        ["angle_1", "angle_2"],
        1,
    ),
    "slider crank": (
        PAIR | {"lagrangian": f"{FREE} - y1", "constraints": [FIRST, SECOND, "y2 = 0"]},
        ["angle_1", "angle_2"],
        1,
    ),
    "array": (
        {
            "coordinates": ["r[2, 2]"],
            "lagrangian": "sum(i in 2, r_dot[i, 0]**2 + r_dot[i, 1]**2 - r[i, 1])",
            "constraints": ["r[0, 0]**2 + r[0, 1]**2 = 1", "(r[1, 0] - r[0, 0])**2 + (r[1, 1] - r[0, 1])**2 = 1"],
        },
        ["angle_r_0", "angle_r_1"],
        0,
    ),
}


SECOND_TIER = ("two masses", "wheel", "magnetic field", "slider crank", "length that changes")


@pytest.mark.tiers(4)
@pytest.mark.parametrize("case", [pytest.param(x, marks=[pytest.mark.second] * (x in SECOND_TIER)) for x in CASES])
def test_motion_in_angles_is_that_with_constraints(case: str) -> None:
    """Accelerations agree in 60 digits; states return from the original coordinates."""
    _, names, remaining = CASES[case]
    system = sc.eliminate_constraints(_named(case))
    assert [each.name for each in system.coordinates] == names
    elimination = system.elimination
    assert elimination is not None
    assert len(system.constraints) == len(elimination.remaining) == remaining
    q, v = np.array([[0.5, 1.5, 0.3], [0.2, -0.5, 0.3]])[:, : len(names)]
    p_new = _at(sympy.Matrix([system.lagrangian]).jacobian(system.velocities), system, q, v)
    (check,) = elimination_checks(system, State(q, p_new, 0.3, 0.1))
    assert check.outcome == Outcome.SATISFIED, check
    original, p = elimination.to_original(q, v, 0.3)
    positions = sympy.Matrix(elimination.positions)
    rates = positions.jacobian(system.coordinates) * sympy.Matrix(system.velocities) + positions.diff(system.time)
    back = elimination.from_original(original, velocity=_at(rates, system, q, v), t=0.3)
    assert np.abs(back["q"] - q).max() < 1e-15
    assert np.abs(back["velocity"] - v).max() < 4e-15
    assert np.abs(elimination.from_original(original, p, t=0.3)["p"] - p_new).max() < 1e-14


def _at(expressions: sympy.Matrix, system: sc.LagrangianSystem, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the values of expressions by SymPy's own evaluation."""
    known = dict(zip((*system.coordinates, *system.velocities), map(float, (*q, *v)), strict=True))
    return np.array(
        expressions.xreplace({**known, **system.constants, system.time: 0.3}).evalf(30), dtype=float
    ).ravel()


def _named(name: str) -> sc.LagrangianSystem:
    return sc.LagrangianSystem.from_text(name=name, **CASES[name][0])


def test_double_pendulum_is_that_of_textbooks() -> None:
    """L of two equal masses and rods (L. D. Landau, E. M. Lifshitz, Mechanics, section 5, problem 1)."""
    lagrangian = "m*(x1_dot**2 + y1_dot**2 + x2_dot**2 + y2_dot**2)/2 - m*g*(y1 + y2)"
    points = {"coordinates": ["x1", "y1", "x2", "y2"], "parameters": {"m": 1, "g": 9.81, "l": 1}}
    system = sc.LagrangianSystem.from_text(
        name="points", **points, lagrangian=lagrangian, constraints=[FIRST, "sqrt((x2 - x1)**2 + (y2 - y1)**2) = l"]
    )
    textbook = sc.LagrangianSystem.from_text(
        name="textbook",
        coordinates=["angle_1", "angle_2"],
        parameters=points["parameters"],
        lagrangian="m*l**2*(angle_1_dot**2 + angle_2_dot**2/2 + angle_1_dot*angle_2_dot*cos(angle_1 - angle_2))"
        " + m*g*l*(2*cos(angle_1) + cos(angle_2))",
    )
    assert sympy.expand(sc.eliminate_constraints(system).lagrangian - textbook.lagrangian) == 0


@pytest.mark.parametrize(
    ("constraint", "reason"),
    [
        ("x**2 + y**2 + z**2 = 1", "contains the squares of 3 coordinates: a rod in space"),
        ("y = x**2", "is not of the form"),
        ("x_dot = y*y_dot", "contains velocities"),
        ("z = 1", "contains 1 coordinate."),
        ("(x - u)**2 + y**2 = 1", "contains an input"),
    ],
)
def test_constraints_that_are_no_rods_are_named(constraint: str, reason: str) -> None:
    """The error has the constraint and the reason."""
    system = sc.LagrangianSystem.from_text(
        name="point",
        coordinates=["x", "y", "z"],
        lagrangian="x_dot**2 + y_dot**2 + z_dot**2",
        constraints=[constraint],
        inputs=["u"] if "u" in constraint else [],
    )
    with pytest.raises(sc.SystemDefinitionError, match="no constraint of 'point' is a rod") as caught:
        sc.eliminate_constraints(system)
    assert reason in str(caught.value)


def test_other_systems_are_rejected() -> None:
    """Without constraints or in transformed time nothing can be eliminated; arrays require sizes."""
    free = sc.LagrangianSystem.from_text(name="free", **ROD)
    with pytest.raises(sc.SystemDefinitionError, match="of 'free' can be eliminated: it has no constraints"):
        sc.eliminate_constraints(free)
    timed = sc.reparametrise(_named("dumbbell"), "1 + x1**2")
    with pytest.raises(sc.SystemDefinitionError, match="it is in transformed time"):
        sc.eliminate_constraints(timed)
    chain = sc.LagrangianSystem.from_text(name="chain", coordinates=["q[N]"], lagrangian="sum(i in N, q_dot[i]**2)")
    with pytest.raises(sc.SystemDefinitionError, match="depends on the sizes N: give them"):
        sc.eliminate_constraints(chain)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"q": [1.0, 0.0], "velocity": [0, 0]}, r"constraint '.*': the distance of \(x, y\) .* is 1 and must be 2"),
        ({"q": [2.0, 0.0], "velocity": [0.5, 0]}, "initial velocities violate .* at the rate 0.5"),
        ({"q": [2.0, 0.0], "p": [0.5, 0]}, "initial velocities violate"),
        ({"q": [2.0, 0.0]}, "give either p .* or velocity"),
        ({"q": [2.0], "velocity": [0.0]}, r"shape \(1,\): its last axis must be x, y"),
        ({"q": [2.0, 0.0], "velocity": [0, 0], "parameters": {"n": 1}}, "no parameter 'n'"),
    ],
)
def test_initial_values_must_satisfy_the_constraints(arguments: dict, message: str) -> None:
    """The error has the constraint, the value and the remedy."""
    system = sc.LagrangianSystem.from_text(name="rod", **ROD, constraints=["x**2 + y**2 = 4"])
    with pytest.raises(sc.StateError, match=message):
        sc.eliminate_constraints(system).elimination.from_original(**arguments)


MODEL = """
[system]
name = "points"
coordinates = ["r[N, 2]"]
lagrangian = "sum(i in N, r_dot[i,0]**2/2 + r_dot[i,1]**2/2 - g*r[i,1])"
constraints = ["r[0,0]**2 + r[0,1]**2 = 1", "(r[i+1,0] - r[i,0])**2 + (r[i+1,1] - r[i,1])**2 = 1 for i in N-1"]
eliminate_constraints = true
[parameters]
g = 9.81
[initial]
q = [[1.0, 0.0], [2.0, 0.0]]
[[events]]
function = "r[N-1, 1] + 1.5"
[method]
method = "svi:6"
[run]
span = 1.0
"""


@pytest.mark.second
def test_model_files_events_and_derived_quantities(tmp_path) -> None:
    """A chain of arrays in a model file: states in either coordinates, events and columns in the original names."""
    model = parse_model(MODEL)
    assert parse_model(dump_model(model)) == model
    assert model.q == (np.pi / 2, np.pi / 2)
    run = model.integrate()
    assert abs(run.energy()).max() < 1e-13  # the energy is 0, not one rounding of it
    q, p = model.system.elimination.to_original(run.q, run.velocity, run.t)
    assert np.array_equal(run["r_1_1"], q[:, 3])
    assert np.array_equal(run["r_1_1_dot"], p[:, 3])  # of mass 1
    (crossing,) = run.events
    at = model.system.elimination.to_original(crossing.q, crossing.q)[0]
    assert np.abs(at[:, 3] + 1.5).max() < 1e-14
    with pytest.raises(sc.EventError, match="sets 'r_1_1_dot', which follows from the angles of rods"):
        run.stepper.integrate(model.q, run.p[0], t_end=1.0, events=sc.Event("r_1_1", then={"r_1_1_dot": 0}))
    ensemble = run.stepper.integrate_ensemble(np.tile(model.q, (2, 1)), velocity=np.zeros((2, 2)), h=0.1, steps=2)
    assert np.abs(ensemble["r_0_1"][-1] + np.cos(ensemble.q[-1, :, 0])).max() < 1e-15
    plain = parse_model(MODEL.replace("eliminate_constraints = true", "")).with_known_sizes()
    assert sc.eliminate_constraints(plain.system).lagrangian == model.system.lagrangian
    with_constraints = sc.compile_stepper(plain.system, "svi:6").integrate(q[0], p[0], t_end=1.0)
    assert np.abs(with_constraints.q[-1] - q[-1]).max() < 1e-13
    forces = with_constraints.stepper.multipliers(q[-1], p[-1])
    assert np.abs(forces - with_constraints.multipliers()[-1]).max() < 1e-11
    path = tmp_path / "chain.toml"
    path.write_text(MODEL.replace("eliminate_constraints = true", ""))
    invoke("run", path, "--eliminate-constraints", "-o", tmp_path / "run.csv")
    assert "r_1_1_dot" in (tmp_path / "run.csv").read_text().splitlines()[0]
    path.write_text(MODEL.replace("[2.0, 0.0]", "[2.0, 1.0]"))
    assert "violate the constraint" in error_of("run", path)


@pytest.mark.second
def test_advice_names_rods(monkeypatch) -> None:
    """The ratio of measured times of a step is part of the message; systems with slower angles are not advised."""
    points = _named("dumbbell")
    q, p = sc.eliminate_constraints(points).elimination.to_original([0, 0, 0.5], [0.1, 0.2, 0.3])
    seconds = iter([4.0] * 3 + [1.0] * 3 + [1.0] * 3 + [4.0] * 3)
    monkeypatch.setattr("scvi_codegen.analysis.advice.advice._seconds", lambda run: next(seconds))
    messages = [sc.advise(points, "svi:4", q, p, span=1.0, tolerance=1e-6).message for _ in range(2)]
    assert "1 of its 1 constraints are rods in a plane: in their angles" in messages[0]
    assert "a step takes 0.25 of the time" in messages[0]
    assert "rods" not in messages[1]
