"""The grammar: what it accepts, everything it refuses, and the way back to text."""

import math

import pytest
import sympy
from counting import at_most
from hypothesis import example, given, settings
from hypothesis import strategies as st
from notation import lagrange
from sympy import Integer, Rational, S, Symbol, pi

import scvi_codegen as sc
from scvi_codegen.common.errors import ExpressionError, SystemDefinitionError
from scvi_codegen.common.precision import mp
from scvi_codegen.systems.formulas.expressions import (
    ARGUMENTS,
    FUNCTIONS,
    REWRITTEN,
    REWRITTEN_CONSTANTS,
    evaluate,
    evaluated,
    unsupported_part,
)
from scvi_codegen.systems.formulas.grammar import MAX_CHARACTERS, parse_expression
from scvi_codegen.systems.formulas.translation import format_expression

X, Y, Z = sympy.symbols("x y z", real=True)
SYMBOLS = {"x": X, "y": Y, "z": Z}


def parse(text: str) -> sympy.Expr:
    return parse_expression(text, SYMBOLS)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x", X),
        ("+-+x", -X),
        ("0.1", Rational(1, 10)),
        ("1e-3*x", X / 1000),
        ("1.5E+2", Integer(150)),
        (".5", Rational(1, 2)),
        ("3.", Integer(3)),
        ("2.95912208286e-4", Rational(295912208286, 10**15)),
        ("0.1234567890123456789012345", Rational(1234567890123456789012345, 10**25)),
        ("-x**2", -(X**2)),
        ("2**-x", 2 ** (-X)),
        ("x**-2", X**-2),
        ("x - y - z", X - Y - Z),
        ("x/y/z", X / (Y * Z)),
        ("x/y*z", X * Z / Y),
        ("-x/-y", X / Y),
        ("1/2*x", X / 2),
        ("(x**y)**z", (X**Y) ** Z),
        ("x**(y**z)", X ** (Y**Z)),
        ("pi*x", pi * X),
        ("atan2(y, x)", sympy.atan2(Y, X)),
        ("sqrt(x)**3", X ** Rational(3, 2)),
        ("(  x\n\t+ y\r\n)", X + Y),
        ("2*(x + y)*z", 2 * Z * (X + Y)),
        ("2**64", Integer(2**64)),
    ],
)
def test_valid_text_is_accepted(text: str, expected: sympy.Expr) -> None:
    assert parse(text) == expected


@pytest.mark.parametrize(
    ("text", "column", "message"),
    [
        ("", 0, "empty"),
        ("  \n ", 0, "empty"),
        ("x +", 3, "ends where a value"),
        ("(x", 2, "missing"),
        ("x)", 1, r"'\)'"),
        ("x, y", 1, "','"),
        ("x + yy", 4, "did you mean 'y'.*Known here: x, y, z, pi"),
        ("x\n  + nope", 6, "unknown name 'nope'"),
        ("x.real", 1, "attribute"),
        ("x[0]", 1, "subscript"),
        ("'x'", 0, "string"),
        ('"x"', 0, "string"),
        ("x < y", 2, "comparison"),
        ("x == y", 2, "equalit"),
        ("x + (y > 1)", 7, "first argument of where"),
        ("where(x, 1, 2)", 7, "comparison first"),
        ("where(x > 0 > y, 1, 2)", 12, "first argument of where"),
        ("where(x > 0, 1)", 0, "3 arguments, not 2"),
        ("max(x)", 0, "2 or more arguments, not 1"),
        ("Max(x, y)", 0, r"write max\(x, y\)"),
        ("Heaviside(x)", 0, r"write unit_step\(x\)"),
        ("x^2", 1, r"x\*\*2"),
        ("x % 2", 2, "remainder"),
        ("x # y", 2, "comment"),
        ("lambda x: x", 8, "lambda"),
        ("sin(x=1)", 5, "keyword"),
        ("sin(*x)", 4, "value is expected"),
        ("sin(x,)", 6, "value is expected"),
        ("sin()", 4, "value is expected"),
        ("sin", 0, r"write sin\(...\)"),
        ("sin(x, y)", 0, "1 argument, not 2"),
        ("log(x, 2)", 0, "1 argument, not 2"),
        ("atan2(x)", 0, "2 arguments, not 1"),
        ("eval(x)", 0, "not a function of the grammar"),
        ("sinn(x)", 0, "did you mean 'sin'"),
        ("x(y)", 0, "not a function"),
        ("(x)(y)", 3, "only the functions"),
        ("2x", 1, r"write \* for a product"),
        ("x y", 2, r"write \*"),
        ("1j", 0, "complex"),
        ("2.5J*x", 0, "complex"),
        ("1_000", 1, "operator is missing"),
        ("x**y**z", 4, "tower"),
        ("9**9**9", 4, "tower"),
        ("9**(9**9)", 3, "exponent"),
        ("(9**60)**60", 0, "2048 bits"),
        ("((2*x)**64)**64", 0, "2048 bits"),
        ("9**60*9**60*9**60*9**60*9**60*9**60*9**60*9**60*9**60*9**60*9**60", 60, "2048 bits"),
        ("x**65", 3, r"make it a parameter: x\*\*n, parameters=\{'n': 65.0\}"),
        ("erfc(x)", 0, "write a table"),
        ("log10(x)", 0, r"write log\(x\)/log\(10\)"),
        ("Catalan*x", 0, r"parameters=\{'Catalan': 0.9159655"),
        ("E**x", 0, r"did you mean 'exp\(1\)'"),
        ("x**-65", 3, "exponent"),
        ("x**0.00001", 3, "denominator"),
        ("(x**64)**2", 7, "constant 128 in an exponent"),
        ("2**(x + 1e300)", 3, "in an exponent is not supported"),
        ("asin(sin(1e300))", 16, "SymPy cannot evaluate"),
        ("1/0", 2, "division by zero"),
        ("x/(y - y)", 2, "division by zero"),
        ("0**-1", 1, "division by zero"),
        ("0**x", 1, "division by zero"),
        ("log(0)", 0, "not finite"),
        ("tan(pi/2)", 0, "not finite"),
        ("exp(1000)", 0, "finite real"),
        ("x*exp(exp(exp(exp(9))))", 10, "finite real"),
        ("sqrt(-1)", 0, "real"),
        ("(-2)**0.5", 4, "real"),
        ("asin(2)", 0, "finite real"),
        ("log(-2)", 0, "real"),
        ("9" * 700, 0, "too many digits"),
        ("9" * 400, 0, "exceeds the range of a C double"),
        ("1e300*1e300*x", 0, "exceeds the range of a C double"),
        ("1e-300*1e-300*x", 0, "exceeds the range of a C double"),
        ("1e400", 0, "range of a C double"),
        ("1e-400", 0, "range of a C double"),
        ("1e99999999999", 0, "too many digits"),
        ("(" * 101 + "x" + ")" * 101, 100, "nested deeper"),
        ("θ + x", 0, "names are made of"),
        ("x + θ", 4, "names are made of"),
        ("x\0", 1, "unexpected character"),
        ("x; y", 1, "unexpected character"),
        ("x\\\ny", 1, "unexpected character"),
        ("__import__('os')", 11, "string"),
    ],
    ids=lambda value: repr(value)[:30],
)
def test_errors_mark_the_column(text: str, column: int, message: str) -> None:
    with pytest.raises(ExpressionError, match=message) as caught:
        parse(text)
    assert (caught.value.column, caught.value.text) == (column, text)


@pytest.mark.parametrize("name", [*REWRITTEN, *REWRITTEN_CONSTANTS])
def test_functions_of_sympy_are_written_by_those_of_the_grammar(name: str) -> None:
    of_sympy = getattr(sympy, name)(X) if name in REWRITTEN else getattr(sympy, name) * X
    read = parse(f"{name}(x)" if name in REWRITTEN else f"{name}*x")
    assert read == evaluated(of_sympy)
    assert unsupported_part(read) is None
    x = 0.5 if name == "asech" else 1.5
    values = [complex(of_sympy.subs(X, side * x).evalf()) for side in (1, -1)]
    for side, exact in zip((1, -1), values, strict=True):
        if abs(exact.imag) < 1e-99:
            assert float(evaluate(read, {X: side * x})) == pytest.approx(exact.real, rel=1e-14)


def test_names_of_functions_of_sympy_may_be_declared() -> None:
    symbol = Symbol("sec", real=True)
    assert parse_expression("sec**2", {"sec": symbol}) == symbol**2


@pytest.mark.parametrize(
    ("part", "words"), [(sympy.erf(X), "a table"), (sympy.EulerGamma, "0.57721"), (sympy.I, "real")]
)
def test_parts_of_sympy_that_are_not_elementary_are_refused_with_a_remedy(part: sympy.Expr, words: str) -> None:
    assert words in str(unsupported_part(part * X))


def test_text_beyond_the_maximum_length_is_rejected() -> None:
    with pytest.raises(ExpressionError, match="too long"):
        parse("x" * (MAX_CHARACTERS + 1))


def test_declared_symbols_may_be_python_keywords() -> None:
    symbol = Symbol("lambda", real=True)
    assert parse_expression("lambda**2", {"lambda": symbol}) == symbol**2


@pytest.mark.rotated
def test_long_sums_and_products_do_not_recurse() -> None:
    with at_most(10_000_000):
        assert parse("+".join(["x"] * 40_000)) == 40_000 * X
        assert parse("-".join(["y"] * 5_000)) == -4_998 * Y
        assert parse("*".join(["x", "y"] * 20)) == X**20 * Y**20
        assert parse("-" * 50_000 + "x") == X


@pytest.mark.tiers(4, 4)
@pytest.mark.sampled(6)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_nested_expressions_are_read_or_rejected_without_crashing(name: str) -> None:
    assert parse("(" * 100 + "x" + ")" * 100) == X
    before = ["x+y, ", "x > y, x, "][ARGUMENTS.get(name, 1) - 2] if name in ARGUMENTS else "x+"
    text = f"{name}({before}" * 100 + "x" + ")" * 100
    try:
        parse(text)
    except ExpressionError as error:
        assert "nested too deeply" in str(error)  # noqa: PT017  (either outcome is right)


@pytest.mark.rotated
def test_coefficients_of_like_terms_are_bounded() -> None:
    with pytest.raises(ExpressionError, match="2048 bits"):
        parse("+".join(f"x/{n}" for n in range(10_001, 19_999, 2)))


def numbers() -> st.SearchStrategy[sympy.Expr]:
    return st.one_of(
        st.integers(-20, 20).map(Integer),
        st.fractions(-9, 9, max_denominator=40).map(lambda value: Rational(value.numerator, value.denominator)),
        st.just(pi),
        st.just(S.Exp1),
    )


def grown(children: st.SearchStrategy[sympy.Expr]) -> st.SearchStrategy[sympy.Expr]:
    exponents = st.sampled_from([Integer(n) for n in (-3, -2, -1, 2, 3)] + [Rational(k, 2) for k in (-3, -1, 1, 3, 5)])
    unary = st.sampled_from([function for name, function in FUNCTIONS.items() if name not in ARGUMENTS])
    built = st.one_of(
        st.lists(children, min_size=2, max_size=4).map(lambda parts: sympy.Add(*parts)),
        st.lists(children, min_size=2, max_size=4).map(lambda parts: sympy.Mul(*parts)),
        st.tuples(children, exponents).map(lambda pair: sympy.Pow(*pair)),
        st.tuples(children, children).map(lambda pair: pair[0] / pair[1]),
        st.tuples(st.sampled_from([X, Integer(2), X + Y]), children).map(lambda pair: sympy.Pow(*pair)),
        st.tuples(unary, children).map(lambda pair: pair[0](pair[1])),
        st.tuples(children, children).map(lambda pair: sympy.atan2(*pair)),
    )
    # SymPy can take for ever over towers of non-real constants: grow on supported expressions only.
    return built.map(lambda expression: X if unsupported_part(expression) else expression)


EXPRESSIONS = st.recursive(st.one_of(st.sampled_from([X, Y, Z]), numbers()), grown, max_leaves=10)


@pytest.mark.rotated
@settings(max_examples=400, deadline=None)
@given(EXPRESSIONS)
def test_round_trip_of_random_expressions(expression: sympy.Expr) -> None:
    text = format_expression(expression)
    assert parse(text) == evaluated(expression), text


@pytest.mark.parametrize(
    ("expression", "text"),
    [
        (X / (3 * Y), "x/(3*y)"),
        (X / 2 / (Y + 1), "x/2/(y + 1)"),
        (-X / 3, "-x/3"),
        (S.Half, "1/2"),
        (-S.Half, "-1/2"),
        (1 / sympy.sqrt(X), "1/sqrt(x)"),
        (X ** Rational(-3, 2), "1/x**(3/2)"),
        (2 ** (-Y), "2**(-y)"),
        ((-X) ** Y, "(-x)**y"),
        ((X**Y) ** Z, "(x**y)**z"),
        (S.Exp1 * sympy.exp(2 * X), "exp(1)*exp(2*x)"),
        (S.Exp1, "exp(1)"),
        (X - Y, "x - y"),
        (sympy.sqrt(2) / 2, "sqrt(2)/2"),
    ],
    ids=str,
)
def test_expressions_are_written_as_text(expression: sympy.Expr, text: str) -> None:
    assert format_expression(expression) == text
    assert parse(text) == expression


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        (sympy.Abs(X), "Abs"),
        (sympy.Float("0.5") * X, "Float"),
        (sympy.I * X, "ImaginaryUnit"),
        (sympy.oo + X, "not finite"),
        (sympy.nan, "not finite"),
        (sympy.zoo, "not finite"),
        (sympy.Piecewise((X, X > 0), (0, True)), "Piecewise"),
        (sympy.sign(X), "sign"),
        (sympy.Integral(sympy.exp(X**2), X), "Integral"),
        (sympy.gamma(X), "gamma"),
        (sympy.GoldenRatio * X, "GoldenRatio"),
        (X**100, "exponent"),
        (2**3000 * X, "2048 bits"),
        (sympy.asin(2) * X, "finite real"),
    ],
    ids=str,
)
def test_unsupported_expressions_are_not_written(expression: sympy.Expr, message: str) -> None:
    with pytest.raises(SystemDefinitionError, match=message):
        format_expression(expression)


@pytest.mark.second
@settings(max_examples=40, deadline=None)
@given(EXPRESSIONS)
@example(sympy.atan2(0, sympy.atan2(0, X)))
def test_evaluation_agrees_with_sympy(expression: sympy.Expr) -> None:
    point = {X: Rational(3, 7), Y: Rational(5, 11), Z: Rational(13, 9)}
    try:
        value = evaluate(expression, {symbol: mp.mpf(int(r.p)) / int(r.q) for symbol, r in point.items()})
    except ArithmeticError:
        return
    expected = expression.subs(point).evalf(30, maxn=200)
    if expected is sympy.nan:  # atan2(0, 0), which is 0 in C
        return
    assert abs(mp.mpf(str(sympy.re(expected))) - value) <= mp.mpf("1e-20") * max(1, abs(value))


ROOTS = ["sqrt(a**2*(1 + x**2))", "(a**2/(x**2 + 1))**(3/2)", "(a**4*(1 + x**2))**(1/4)", "sqrt((a - b)**2)*x**2"]
"""Even roots of squares of parameters, which may be negative."""


@pytest.mark.parametrize("potential", ROOTS)
def test_even_roots_of_parameters_are_smooth_formulas(potential: str) -> None:
    system = lagrange("root", "x", f"(b**2 + 1)*x_dot**2/2 - {potential}", a=-2.0, b=0.5)
    values = {"x": 0.3, "a": -2.0, "b": 0.5, "x_dot": 0.0}
    exact = -float(eval(potential, {"sqrt": math.sqrt}, values))
    numbers = {each: values[each.name] for each in (*system.coordinates, *system.velocities, *system.parameters)}
    assert float(system.lagrangian.xreplace(numbers)) == pytest.approx(exact, rel=1e-15)
    again = lagrange("root", "x", format_expression(system.lagrangian), a=-2.0, b=0.5)
    assert again == system
    for parameter in system.parameters:
        derivative = system.lagrangian.diff(parameter).xreplace(numbers)
        assert derivative.is_finite


def test_even_roots_of_positive_entries_of_arrays_are_not_refused() -> None:
    smooth = "sum(i in N, m[i]*x_dot[i]**2/2 - sqrt(m[i]**2*(1 + x[i]**2)))"
    sc.LagrangianSystem.from_text("smooth", ["x[N]"], smooth, parameters={"m[N]": 1.0})
