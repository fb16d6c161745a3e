"""Functions with kinks, as ``wrap``, ``abs``, ``max`` and ``where``, in formulas: values, derivatives, C, orders."""

from __future__ import annotations

import math
import re
from fractions import Fraction

import numpy as np
import pytest
import sympy
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.systems.formulas.expressions import Tape, evaluated, kinks_of
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.formulas.translation import format_expression

X, L = symbol("x"), symbol("L")
KNOWN = {"x": X, "L": L}
VALUES = {
    "wrap(x, L)": lambda x, length: x - length * np.rint(x / length),
    "positive_part(x)": lambda x, _: np.maximum(x, 0.0),
    "unit_step(x - 1)": lambda x, _: np.where(x >= 1.0, 1.0, 0.0),
    "rint(3*x)": lambda x, _: np.rint(3 * x),
    "abs(L - x)": lambda x, length: np.abs(length - x),
    "abs(x)**3 + sqrt(x**2)": lambda x, _: np.abs(x) ** 3 + np.abs(x),
    "sign(1 - x)": lambda x, _: np.sign(1 - x),
    "max(x, L, 2*x - 1) - min(-x, 0.4)": lambda x, length: (
        np.max([x, 0 * x + length, 2 * x - 1], axis=0) - np.minimum(-x, 0.4)
    ),
    "min(x, -1, 7 - x, L, 2)": lambda x, length: np.min([x, 0 * x - 1, 7 - x, 0 * x + length], axis=0),
    "where(x >= L, L, where(-x < 1, 2, x))": lambda x, length: np.where(x >= length, length, np.where(-x < 1, 2, x)),
    "where(x > L, 1, 0) + where(L >= x, 5, 0)": lambda x, length: (
        np.where(x > length, 1, 0) + np.where(x <= length, 5, 0)
    ),
}


@pytest.mark.parametrize("text", VALUES)
def test_values_in_60_digits_and_in_arrays(text: str) -> None:
    points = np.array([-7.3, -1.6, -0.2, 0.4, 1.7, 3.0, 12.1])
    expression = parse_expression(text, KNOWN)
    expected = VALUES[text](points, 3.0)
    assert array_value(expression, {X: points, L: 3.0}) == pytest.approx(expected)
    tape = Tape([expression], [X, L])
    assert [float(tape([mp.mpf(x), mp.mpf(3)])[0]) for x in points] == pytest.approx(expected)
    assert parse_expression(format_expression(expression), KNOWN) == expression


WHOLE = {
    "floor": lambda x, _: np.floor(x),
    "ceil": lambda x, _: np.ceil(x),
    "ceiling": lambda x, _: np.ceil(x),
    "round": lambda x, _: np.rint(x),
    "trunc": lambda x, _: np.trunc(x),
    "mod": np.mod,
    "Mod": np.mod,
    "fmod": np.fmod,
}


@pytest.mark.parametrize("name", WHOLE)
def test_functions_of_whole_numbers_are_written_as_their_message_says(name: str) -> None:
    with pytest.raises(sc.ExpressionError) as error:
        parse_expression(f"{name}(x, L)", KNOWN)
    written = re.search(r": write (.*?)(?:, the nearest.*)?\. Known", str(error.value))[1]  # type: ignore[index]
    points = np.array([-7.3, -1.6, -0.2, 0.4, 1.7, 3.2, 12.1])
    formula = parse_expression(re.sub(r"\by\b", "L", written), KNOWN)
    assert array_value(formula, {X: points, L: 3.0}) == pytest.approx(WHOLE[name](points, 3.0))


OF_SYMPY = {
    sympy.Abs(X - L): "abs(x - L)",
    sympy.sign(X) * X**2: "sign(x)*x**2",
    sympy.Max(X, L): "max(x, L)",
    sympy.Min(X, 2 * L): "min(x, 2*L)",
    sympy.Heaviside(X - L): "unit_step(x - L)",
    sympy.Piecewise((X, (X > 0) & (X <= L)), (-L, ~(X < 1)), (L, True)): "where(x > 0, where(x <= L, x, 0), 0)"
    " + (1 - where(x > 0, where(x <= L, 1, 0), 0))*where(x >= 1, -L, L)",
}


@pytest.mark.parametrize("formula", OF_SYMPY, ids=str)
def test_functions_of_sympy_are_those_of_text(formula: sympy.Expr) -> None:
    tape = Tape([evaluated(formula), parse_expression(OF_SYMPY[formula], KNOWN)], [X, L])
    for x in (-7.3, 0.0, 0.4, 1.7, 3.0, 12.1):
        value, expected = tape([mp.mpf(x), mp.mpf(3)])
        assert value == expected


def test_arguments_that_differ_by_a_factor_have_one_switching_function() -> None:
    texts = "abs(x - L)", "unit_step(3*L - 3*x)", "max(x, L)", "min(L, x)", "where(L < x, 1, 2)", "sign(pi*(x - L)/2)"
    assert kinks_of([parse_expression(text, KNOWN) for text in texts]) in ({X - L}, {L - X})
    assert lagrange("plain", "x", "sqrt(L**2)*x_dot**2/2 - abs(x)", L=2.0).kinks == ("x",)


def test_declared_names_replace_functions() -> None:
    text, parameters = "abs*x_dot**2/2 - abs*x**2/2", {"abs": 2.0}
    with pytest.warns(sc.SystemDefinitionWarning, match=r"'abs' is a name of this system.*rename"):
        system = sc.LagrangianSystem.from_text("named", ["x"], text, parameters=parameters)
    assert system.kinks == ()
    with pytest.warns(sc.SystemDefinitionWarning, match="'max'"):
        sc.LagrangianSystem.from_text("arrays", ["max[N]"], "sum(i in N, max_dot[i]**2/2 - abs(max[i]))")


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.parametrize("precision", ["double", "double-double"])
def test_steps_are_those_of_exact_forces(precision: str) -> None:
    """One explicit step of unit mass in rational numbers: p1/2 = p + h F(q)/2, q1 = q + h p1/2, p1 = p1/2 + h F(q1)/2.

    Also from points on the surfaces, where ``unit_step`` is 1 and ``sign`` too.
    """
    potential = "where(x > y, (x - y)**2, 0) + max(x, 2*x, -3*x) + abs(x + y)**3 + min(y, 1) + wrap(y - x, 3)**2/7"
    friction = {"x": "sign(y - 1) - where(t < 1, x, 0)", "y": "abs(x)*2 + sign(-y)"}
    system = lagrange("kinks", "x y", f"(x_dot**2 + y_dot**2)/2 - ({potential})", forces=friction)
    stepper, h = sc.compile_stepper(system, "stoermer-verlet", precision=precision), 1 / 8

    def force(x: Fraction, y: Fraction) -> tuple[Fraction, Fraction]:
        periodic = Fraction(2, 7) * (y - x - 3 * round((y - x) / 3))
        of_pair, of_sum = 2 * max(x - y, 0) - periodic, 3 * (x + y) * abs(x + y)
        of_x = (1 if y >= 1 else -1) - x - of_pair - (-3 if x < 0 else 2) - of_sum
        return of_x, 2 * abs(x) + (1 if -y >= 0 else -1) + of_pair - of_sum - (y < 1)

    starts = [*np.random.default_rng(7).uniform(-2, 2, (20, 2)), [-0.5, 0.0], [0.25, 1.0], [-1.0, 0.5]]
    for start in starts:
        if precision == "double":  # a single step, which takes kinks as formulas
            words = [stepper.step(start, [0.0, 0.0], h)[1]]
        else:
            run = stepper.integrate(start, velocity=[0.0, 0.0], h=h, steps=1)
            words = [run.p[-1], run.p_low[-1]]
        q = [*map(Fraction, start)]
        half = [Fraction(h) / 2 * f for f in force(*q)]
        ends = [x + Fraction(h) * v for x, v in zip(q, half, strict=True)]
        exact = [v + Fraction(h) / 2 * f for v, f in zip(half, force(*ends), strict=True)]
        errors = [float(sum(map(Fraction, parts)) - p) for *parts, p in zip(*words, exact, strict=True)]
        assert np.abs(errors).max() < (1e-29 if precision == "double-double" else 1e-14)


def pair(power: int) -> sc.LagrangianSystem:
    return lagrange(
        "pair", "x y", f"(x_dot**2 + y_dot**2)/2 - positive_part(1 - (wrap(x - y, L)/1.2)**2)**{power}", L=3.0
    )


@pytest.mark.rotated
def test_order_is_preserved_up_to_the_smoothness_at_the_cut_off() -> None:
    """positive_part()**k has k - 1 continuous derivatives: order 4 with k = 6, and where runs locate k = 1."""

    def order(power: int) -> float:
        stepper = sc.compile_stepper(pair(power), "svi:2")
        start = {"q": [0.1, 0.7], "velocity": [0.3, 3.0]}
        exact = stepper.integrate(**start, h=3.0 / 20_000, steps=20_000).q[-1]
        errors = [np.abs(stepper.integrate(**start, h=3.0 / n, steps=n).q[-1] - exact).max() for n in (150, 600)]
        return math.log(errors[0] / errors[1], 4)

    assert order(6) > 3.7
    assert order(1) > 3.7
