"""Warnings for definitions that are probably mistakes: unused parameters and negative masses."""

import warnings

import pytest
import sympy

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import parse_model

UNUSED = (
    "does not occur in the {}, the forces and the constraints of 'system': remove it, unless events or a time "
    "transformation contain it; pass contacts that do to the system."
)
x, v, k, m, z = sympy.symbols("x x_dot k m z")


def scalar(formula, **given):
    return sc.LagrangianSystem.from_text("system", ["x"], formula, **given)


def hamiltonian(formula, **given):
    return sc.HamiltonianSystem.from_text("system", ["x"], formula, **given)


def arrays(formula, **given):
    return sc.LagrangianSystem.from_text("system", ["q[N]"], formula, **given)


def messages(define, *given, **named):
    with warnings.catch_warnings(record=True, action="always") as heard:
        define(*given, **named)
    assert all(each.category is sc.SystemDefinitionWarning and each.filename == __file__ for each in heard)
    return [str(each.message) for each in heard]


@pytest.mark.parametrize(
    ("define", "formula", "function"),
    [
        (scalar, "m*x_dot**2/2", "Lagrangian"),
        (hamiltonian, "p_x**2/(2*m)", "Hamiltonian"),
        (arrays, "sum(i in N, m*q_dot[i]**2/2)", "Lagrangian"),
        (arrays, "sum(i in N, m*q_dot[i]**2/2) + sum(i in N, u*q[i])", "Lagrangian"),
        (arrays, "sum(i in N, m[i]*q_dot[i]**2/2) + sum(i in N, u*q[i])", "Lagrangian"),
    ],
)
def test_unused_parameter_or_input_is_reported(define, formula, function):
    heard = messages(
        define, formula, parameters={"m[N]" if "[i]*q_dot" in formula else "m": 1.0, "k": 2.0}, inputs=["u"]
    )
    where = UNUSED.format(function)
    assert heard == ["input 'u' " + where] * ("u*" not in formula) + ["parameter 'k' " + where]


@pytest.mark.parametrize(
    ("define", "formula", "parameters", "reported"),
    [
        (scalar, "m*x_dot**2/2", {"m": -1.0}, "d2L/dx_dot2 = m of 'system' is -1 with the default parameters (m = -1)"),
        (scalar, "(a - m)*x_dot**2", {"a": 1.0, "m": 3.0}, "= 2*a - 2*m of 'system' is -4 "),
        (hamiltonian, "p_x**2/(2*m)", {"m": -4.0}, "d2H/dp_x2 = 1/m of 'system' is -0.25 "),
        (arrays, "sum(i in N, m[i]*q_dot[i]**2/2)", {"m[N]": -1.0}, "d2L/dq_dot2 = m of 'system' is -1 "),
        (scalar, "-m*x_dot**2/2", {"m": 1.0}, None),  # negative for every positive m: meant
        (scalar, "-x_dot**2/2 + m*x", {"m": -1.0}, None),
        (scalar, "m*(1 + x**2)*x_dot**2/2", {"m": -1.0}, None),  # depends on the state
        (arrays, "-sum(i in N, m*q_dot[i]**2/2)", {"m": 1.0}, None),
    ],
)
def test_a_mass_that_default_values_make_negative_is_reported(define, formula, parameters, reported):
    heard = messages(define, formula, parameters=parameters)
    assert len(heard) == (reported is not None)
    assert all(reported in each for each in heard)


def test_sympy_expressions_are_examined_too():
    kinetic = sc.LagrangianSystem.from_sympy
    given = {"name": "system", "coordinates": [x], "velocities": [v]}
    unused = messages(kinetic, lagrangian=m * v**2 / 2, parameters={m: 1.0, k: 1.0}, **given)
    assert unused == ["parameter 'k' " + UNUSED.format("Lagrangian")]
    assert "is -1 with" in messages(kinetic, lagrangian=m * v**2 / 2, parameters={m: -1.0}, **given)[0]
    hamilton = messages(
        sc.HamiltonianSystem.from_sympy,
        name="system",
        coordinates=[x],
        momenta=[z],
        hamiltonian=z**2 / 2,
        parameters={k: 1.0},
    )
    assert hamilton == ["parameter 'k' " + UNUSED.format("Hamiltonian")]


FILE = """
[system]
name = "system"
coordinates = ["x"]
lagrangian = "x_dot**2/2 - x**2/2"
{}
[parameters]
k = 1.0
[initial]
q = [1.0]
q_dot = [0.0]
[run]
span = 1.0
{}
"""


@pytest.mark.parametrize(
    ("time_transformation", "controller", "count"),
    [
        ("", "", 1),
        ('time_transformation = "1 + k*x**2"', "", 0),
        ('time_transformation = "1 + k*x**2"', 'controller = "reversible"', 0),
    ],
)
def test_a_model_file_is_examined_with_its_time_transformation(time_transformation, controller, count):
    assert len(messages(parse_model, FILE.format(time_transformation, controller))) == count


BY_FILE = """
[system]
name = "system"
coordinates = ["q[N]"]
lagrangian = "sum(i in N, q_dot[i]**2/2)"
{system}
[sizes]
N = 2
[parameters]
k = 1.0
{parameters}
[initial]
q = {q}
q_dot = "0"
[run]
step = 0.1
span = 1.0
{more}
"""


@pytest.mark.parametrize(
    ("changed", "count"),
    [
        ({}, 1),
        ({"q": '"k*i"'}, 0),
        ({"system": 'constraints = ["q[0] - k*t"]'}, 0),
        ({"more": '[forces]\n"q[i]" = "-k*q[i]"'}, 0),
        ({"more": "[[events]]\nfunction = 'q[0] - k'"}, 0),
        ({"more": "[[events]]\nfunction = 'q[0]'\nrestitution = 'k'"}, 0),
        ({"more": "[[events]]\nfunction = 'q[0]'\nthen = { 'p_q[0]' = '-k*p_q[0]' }"}, 0),
    ],
    ids=["unused", "initial formulas", "constraints", "forces", "events", "restitution", "changes by events"],
)
def test_a_parameter_that_any_formula_of_a_file_contains_is_used(changed, count):
    text = BY_FILE.format(**{"system": "", "parameters": "", "q": '"0"', "more": "", **changed})
    assert [each[:29] for each in messages(parse_model, text)] == ["parameter 'k' does not occur "] * count


@pytest.mark.parametrize("coordinates", [["x", "y"], ["x[1]", "y[1]"]])
def test_parameters_of_contacts_are_used(coordinates):
    x, y = (name.replace("[1]", "[0]") for name in coordinates)
    floor = sc.contact(y, slip=x.replace("x", "x_dot"), friction="mu", restitution="e")
    formula = f"({x.replace('x', 'x_dot')}**2 + {y.replace('y', 'y_dot')}**2)/2 - {y}"
    named = {"parameters": {"mu": 0.3, "e": 0.5}, "contacts": [floor]}
    assert not messages(sc.LagrangianSystem.from_text, "system", coordinates, formula, **named)
