"""Statements of steps as C: where loops end, and what is refused; the arithmetic has golden bits."""

import pytest
from notation import lagrange

from scvi_codegen import MethodError, compile_stepper
from scvi_codegen.codegen.statements.printing import Layout, Place, Printer, Quantity, point_loops, target_name
from scvi_codegen.methods.statements import read, selected

OPERATIONS = {"mass": "find(ARGUMENT, TARGET);", "force": "force(ARGUMENT, TIME, TARGET);", "solve": "solve(ARGUMENT);"}
STATES = {x: Quantity(f"step->{x}", Place.STATE, low=f"step->low_{x}", uniform=True) for x in ("q0", "p0")}


def without_points(text: str, layout: Layout, **quantities: Quantity) -> list[str]:
    """Return the lines of C of a step without points."""
    own = {"h": Quantity("h", Place.NUMBER, layout.words, uniform=True)} | STATES | quantities
    return Printer(own, layout, OPERATIONS).function_body(read(text))


def cut(text: str) -> list[str]:
    """Return the letters of the targets of each loop over points."""
    return ["".join(target_name(each) or "" for each in loop) for loop in point_loops(read(text))]


@pytest.mark.parametrize(
    ("text", "loops"),
    [
        pytest.param("a[i] = u[i]\nb[i] = A @ u[i]", ["ab"], id="values of earlier loops are summed without a cut"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]", ["a", "b"], id="a sum of a value of the loop cuts"),
        pytest.param("a[i] = u[i]\nb[i] = former(a[i])", ["a", "b"], id="so does the value at the point before"),
        pytest.param("a[i] = u[i]\nb[i] = h * (a[i] - A @ a[i])", ["a", "b"], id="within an operation, too"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]\nc[i] = B @ a[i]", ["a", "bc"], id="a cut for two sums"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]\nc[i] = B @ b[i]", ["a", "b", "c"], id="sums in turn"),
        pytest.param("d[i] = u[i]\na[i] = u[i]\nb[i] = A @ a[i] + d[i]", ["da", "b"], id="statements keep their order"),
    ],
)
def test_loops_over_points_end_where_all_points_are_needed(text, loops):
    assert cut(text) == loops


def test_steps_without_points_have_no_sums_over_them():
    for text in ("q[i] = A @ p0[i]", "q[i] = former(p0[i])"):
        with pytest.raises(MethodError, match=r"values of 'step->p0' at other points are needed"):
            without_points(text, Layout(), q=Quantity("q", uniform=True))


@pytest.mark.parametrize(("operator", "increment"), [("+", "x[i]"), ("-", "-x[i]")])
def test_increments_of_states_are_compensated_sums(operator, increment):
    lines = without_points(f"p0[i] {operator}= x[i]", Layout(), x=Quantity("x", uniform=True))
    assert lines[1] == f"  add_to_state(&step->p0[i], &step->low_p0[i], {increment});"


def test_features_are_decided_when_a_text_is_read():
    text = "if fast:\n    if not known:\n        q[i] += h\nelse:\n    q[i] -= h"
    assert selected(text, ["fast"]) == "if not known:\n    q[i] += h"
    assert selected(text, []) == "q[i] -= h"
    assert read(text, ["fast"]) == read(selected(text, ["fast"]))


VARYING, CONSTANT = "(1 + y1**2)", "2"
"""Masses of rods."""


@pytest.mark.tiers(1, 2)
@pytest.mark.parametrize(
    ("method", "mass", "precision"),
    [
        ("svi:1", VARYING, "double"),
        ("svi:1", CONSTANT, "double"),
        ("svi:1", CONSTANT, "double-double"),
        ("svi:3", VARYING, "double"),
        ("svi:3", CONSTANT, "double"),
    ],
)
def test_iterations_of_rods_converge_without_the_fallback(method, mass, precision):
    """Newton's method, the fallback, would hide an iteration that does not converge."""
    squares = f"x1_dot**2*{mass} + y1_dot**2*2 + x2_dot**2 + y2_dot**2"
    rods = ["x1**2 + y1**2 = 1", "(x2 - x1)**2 + (y2 - y1)**2 = 1"]
    system = lagrange("rods", "x1 y1 x2 y2", f"({squares})/2 - y1 - y2", constraints=rods)
    stepper = compile_stepper(system, method, precision=precision)
    run = stepper.integrate([1.0, 0.0, 2.0, 0.0], velocity=[0.0] * 4, h=0.02, steps=20)
    assert run.fallback_steps == 0
    assert max(run.iterations) <= 4
