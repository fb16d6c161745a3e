"""Statements of steps as C: order, storage and arithmetic, on texts of a few lines."""

import re

import pytest
from notation import lagrange

from scvi_codegen import MethodError, compile_stepper
from scvi_codegen.codegen.statements.arithmetic import Value, combine, negated
from scvi_codegen.codegen.statements.printing import Layout, Place, PointsAsLanes, Printer, Quantity
from scvi_codegen.codegen.statements.schedule import in_registers, point_loops
from scvi_codegen.codegen.statements.steps import rattle_iteration, velocities_by_masses
from scvi_codegen.methods.statements import At, Read, read, selected

OPERATIONS = {"mass": "find(ARGUMENT, TARGET);", "force": "force(ARGUMENT, TIME, TARGET);", "solve": "solve(ARGUMENT);"}
STATES = {x: Quantity(f"step->{x}", Place.STATE, low=f"step->low_{x}", uniform=True) for x in ("q0", "p0")}
MEMORY = {
    "u": Quantity("now->u", Place.MEMORY),
    "g": Quantity("now->g", Place.MEMORY, index="k"),
    "force": Quantity("now->force", Place.MEMORY, first="now->first_force"),
    "lam": Quantity("now->lambda", Place.GROUPS, index="k"),
    "change": Quantity("change", Place.FLAT),
    "h": Quantity("step->h", Place.NUMBER, uniform=True),
    "C": Quantity("C", Place.TABLE),
}


def without_points(text: str, layout: Layout, **quantities: Quantity) -> list[str]:
    """Return the lines of C of a step without points."""
    own = {"h": Quantity("h", Place.NUMBER, layout.words, uniform=True)} | STATES | quantities
    return Printer(own, layout, OPERATIONS).function_body(read(text))


def of_points(text: str, words: int = 1, **quantities: Quantity) -> list[str]:
    """Return the lines of C of a step whose points are lanes."""
    return Printer(MEMORY | quantities, PointsAsLanes(words), OPERATIONS).function_of_points(read(text))


def cut(text: str, *stored: str) -> list[str]:
    """Return the letters of the targets of each loop over points."""
    loops = point_loops(read(text), stored)
    return ["".join(each.target.name for each in loop.body if each.target) for loop in loops]


@pytest.mark.parametrize(
    ("text", "loops"),
    [
        pytest.param("a[i] = u[i]\nb[i] = A @ u[i]", ["ab"], id="values of earlier loops are summed without a cut"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]", ["a", "b"], id="a sum of a value of the loop cuts"),
        pytest.param("a[i] = u[i]\nb[i] = former(a[i])", ["a", "b"], id="so does the value at the point before"),
        pytest.param("a[i] = u[i]\nb[i] = h * (a[i] - A @ a[i])", ["a", "b"], id="within an operation, too"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]\nc[i] = B @ a[i]", ["a", "bc"], id="a cut for two sums"),
        pytest.param("a[i] = u[i]\nb[i] = A @ a[i]\nc[i] = B @ b[i]", ["a", "b", "c"], id="sums in turn"),
        pytest.param("d[i] = u[i]\na[i] = u[i]\nb[i] = A @ a[i] + d[i]", ["a", "db"], id="values move to their use"),
        pytest.param("d[i] = u[i]\na[i] = d[i]\nb[i] = A @ a[i] + d[i]", ["da", "b"], id="not past its first use"),
        pytest.param("s[i] = u[i]\na[i] = u[i]\nb[i] = A @ a[i] + s[i]", ["sa", "b"], id="not if it is stored"),
        pytest.param(
            "d[i] = u[i]\nd[i] += h\na[i] = u[i]\nb[i] = A @ a[i] + d[i]", ["dda", "b"], id="not if set twice"
        ),
        pytest.param(
            "d[i] = u[i]\na[i] = u[i]\nb[i] = A @ a[i] + d[i]\nc[i] = B @ b[i] + d[i]", ["a", "db", "c"], id="the first"
        ),
    ],
)
def test_loops_over_points_end_where_all_points_are_needed(text, loops):
    assert cut(text, "s") == loops


def test_values_that_later_loops_sum_are_in_memory():
    first, last = point_loops(read("a[i] = u[i]\nd[i] = u[i]\nb[i] = A @ a[i] + d[i]"), ())
    assert (first.summed_later, last.summed_later) == (("a",), ())


def test_registers_hold_what_a_loop_computes_twice():
    """With the index of its first statement: c of the constraints k is changed by the derivatives e."""
    text = "c[k] = g[k]\nc[row(e)] += force[col(e)]\nu[i] = h\ng[k] = c[k]"
    (loop,) = point_loops(read(text), {"c", "u", "g"})
    body = in_registers(loop, {"c", "u", "g"}).body
    assert [each.target.name for each in body] == ["c_now", "c_now", "u", "g", "c"]
    assert (body[-1].target, body[-1].value) == (Read("c", At("k")), Read("c_now", At("k")))
    assert body[3].value == Read("c_now", At("k"))


def test_sums_over_points_read_memory_not_registers():
    (loop,) = point_loops(read("v[i] = A @ u[i]\nv[i] += h\nw[i] = v[i]"), {"v"})
    assert [each.target.name for each in in_registers(loop, {"v"}).body] == ["v_now", "v_now", "w", "v"]
    assert "store(now->u[i], g, u_now[i])" in " ".join(of_points("u[i] = A @ u[i]\nu[i] += h"))


def test_results_of_operations_and_increments_are_stored():
    lines = of_points("f[i] = h\nu[i] = mass(f[i])\ng[k] += h")
    assert [line.strip() for line in lines if "u_now" in line or "now->g" in line] == [
        f"{lines[1].split()[0]} f[M], u_now[M];",
        "find(f, u_now);",
        "store(now->g[k], g, load(now->g[k], g) + step->h);",
        "store(now->u[i], g, u_now[i]);",
    ]


def test_values_of_several_loops_are_vectors_of_all_points():
    lines = of_points("d[i] = u[i]\nd[i] += h\na[i] = u[i]\nb[i] = A @ a[i] + d[i]")
    assert "lanes d[M][GROUPS];" in lines
    assert any("d[i][g] += step->h;" in line for line in lines)


def test_the_residual_of_varying_masses_has_as_many_values_as_constraints():
    lines = rattle_iteration("coupled_rattle", ())
    assert re.search(r"\bc_now\[CONSTRAINTS\]", lines)
    assert "store(now->c[k], g, c_now[k])" in lines
    assert not re.search(r"now->c\[e\]", lines)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        pytest.param(
            "u[i] = q0[i] + h\nv[i] = u[i] * u[i]\nq[i] = v[i]",
            """\
for (int i = 0; i < M; i++) {
  const number u = step->q0[i] + (step->low_q0[i] + h);
  const number v = u * u;
  q[i] = v;
}""",
            id="one loop with local variables, and low words added first",
        ),
        pytest.param(
            "u[i] = q0[i]\nF[i] = force(u, h)\nq[i] = F[i]",
            """\
number u[M], F[M];
for (int i = 0; i < M; i++)
  u[i] = step->q0[i];
force(u, h, F);
for (int i = 0; i < M; i++)
  q[i] = F[i];""",
            id="arguments and results of kernels are arrays",
        ),
        pytest.param(
            "for n in ROWS:\n    if A[n] != 0 and n > 0:\n        q[i] -= (A[n] - h) * -h",
            """\
for (int n = 0; n < ROWS; n++) {
  if (A[n] != 0 && n > 0) {
    for (int i = 0; i < M; i++)
      q[i] -= (A[n] - h) * (-h);
  }
}""",
            id="rows, conditions and parentheses",
        ),
        pytest.param("S += A[n] / 2 * h", "acted += A[n] / 2 * h;", id="numbers have no loop"),
    ],
)
def test_lines_of_a_step_without_points(text, lines):
    own = {"q": Quantity("q", uniform=True), "S": Quantity("acted", Place.NUMBER, uniform=True)}
    assert "\n".join(without_points(text, Layout(), **own)) == lines


@pytest.mark.parametrize(
    ("layout", "line"),
    [
        (Layout(2), "q[i] = dd_subtract(q[i], dd_multiply(h, dd_of(step->q0[i], step->low_q0[i])));"),
        (
            Layout(2, lanes=True),
            "q[i] = ddl_subtract(q[i], ddl_multiply(ddl_of(h), ddl_of_words(step->q0[i], step->low_q0[i])));",
        ),
        (Layout(), "q[i] -= h * step->q0[i];"),
        (Layout(lanes=True), "q[i] -= h * step->q0[i];"),
    ],
)
def test_one_text_in_each_number_type(layout, line):
    increment = Quantity("q", words=layout.words, uniform=not layout.lanes)
    lines = without_points("q[i] -= h * q0[i]", layout, q=increment)
    assert lines == ["for (int i = 0; i < M; i++)", f"  {line}"]


@pytest.mark.parametrize(
    ("operator", "left", "right", "text"),
    [
        ("-", Value("a"), Value("b - c", precedence=1), "a - (b - c)"),
        ("+", Value("a - b", precedence=1), Value("c"), "a - b + c"),
        ("*", Value("a + b", precedence=1), Value("c / d", precedence=2), "(a + b) * (c / d)"),
        ("*", Value("x", 2), Value("y"), "ddl_scale(x, y)"),
        ("*", Value("y"), Value("x", 2, uniform=True), "ddl_scale(ddl_of(x), y)"),
        ("*", Value("x", 2), Value("2", uniform=True), "ddl_scale(x, lanes_of(2))"),
        ("*", Value("x", 2, uniform=True), Value("2", uniform=True), "dd_scale(x, 2)"),
        ("/", Value("x", 2, uniform=True), Value("2", uniform=True), "dd_divide(x, dd_word(2))"),
        ("-", Value("x", 2), Value("y", 2, uniform=True), "ddl_subtract(x, ddl_of(y))"),
        ("+", Value("x", 2), Value("y"), "ddl_add(x, ddl_word(y))"),
    ],
)
def test_arithmetic_of_words_and_lanes(operator, left, right, text):
    assert combine(operator, left, right).text == text


def test_negatives_have_parentheses_and_words():
    texts = [negated(x).text for x in (Value("a + b", precedence=1), Value("x", 2), Value("x", 2, uniform=True))]
    assert texts == ["-(a + b)", "ddl_negative(x)", "dd_negative(x)"]


def test_places_of_values_at_points():
    lines = of_points(
        "f[i] = former(force[i]) + C * u[i]\nlam[k] -= g[k]\nchange[i] = f[i]\nw[i] = A @ f[i]\nu[i] = w[i]"
    )
    text = "\n".join(line.strip() for line in lines)
    assert "f[M][GROUP_LANES];" in text
    value = r"former\(now->force\[i\], now->first_force\[i\], g\) \+ \w+\(C, g\) \* load\(now->u\[i\], g\)"
    assert re.search(rf"store\(f\[i\], g, {value}\);", text)
    assert "now->lambda[k][g] -= load(now->g[k], g);" in text
    assert "change[i * GROUPS + g] = load(f[i], g);" in text
    assert text.count("for (int g = 0; g < GROUPS; g++) {") == text.count("IN_MEMORY(f);") + 1 == 2
    assert "const lanes w = times(A, DEGREE, f[i], g);" in text


def test_gathered_values_are_loops_of_their_own():
    text = "x[k] = g[k]\nx[row(e)] += force[col(e)]\nx[row(e)] -= h\ny[e] = h\nx[row(e)] -= y[e]\nlam[k] = x[k]"
    lines = of_points(text)
    heads = [line.strip() for line in lines if "for (int" in line and "int g" not in line]
    assert [head.partition("int ")[2][0] for head in heads] == ["k", "e", "e", "e", "e", "k"]
    assert sum("unroll" in line for line in lines) == 4
    assert "x[CONSTRAINT_ENTRY[e][0]] += load(now->force[CONSTRAINT_ENTRY[e][1]], g);" in "\n".join(lines)


def test_velocities_are_momenta_times_inverse_masses():
    written, expected = (f"for n in ROWS:\n    v[i] = {x}" for x in ("velocity(P, t)", "inverse_mass[i] * P[i]"))
    assert tuple(velocities_by_masses(read(written))) == read(expected)


def test_steps_without_points_have_no_sums_over_them():
    for text, words in (("q[i] = A @ p0[i]", "is a sum over points"), ("q[i] = former(p0[i])", "is a value of points")):
        with pytest.raises(MethodError, match=words):
            without_points(text, Layout(), q=Quantity("q", uniform=True))


def test_features_are_decided_when_a_text_is_read():
    text = "if fast:\n    if not known:\n        q[i] += h\nelse:\n    q[i] -= h"
    assert selected(text, ["fast"]) == "if not known:\n    q[i] += h"
    assert selected(text, []) == "q[i] -= h"
    assert read(text, ["fast"]) == read(selected(text, ["fast"]))


VARYING, CONSTANT = "(1 + y1**2)", "2"
"""Masses of rods."""


@pytest.mark.tiers(2)
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
