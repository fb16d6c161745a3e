"""Kernels read back are the SymPy originals; sharing and size are what they should be; printed C means the same."""

import ctypes
import math
import operator
import random
import subprocess
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import mpmath
import numpy as np
import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import lowered

from scvi_codegen import SCVI, SVI, Gauss, SpectralCollocation, SystemDefinitionError, problem
from scvi_codegen.codegen.ir.arithmetic import DEEPEST_EXPRESSION, lower_kernel
from scvi_codegen.codegen.ir.kernel import Constant, Expression, Kernel, Load, Operation, loads
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.codegen.rendering.kernels.printer import print_expression, print_number
from scvi_codegen.codegen.rendering.kernels.simd import with_factors_in_roots
from scvi_codegen.interfaces.models.systems import fput_chain
from scvi_codegen.systems.formulas.expressions import gradient, jacobian

DOUBLE_PENDULUM, DUFFING, KEPLER = (problem(name).system for name in ("double-pendulum", "duffing", "kepler"))

mp = mpmath.mp.clone()
mp.dps = 120

x, y, t, a = sympy.symbols("x y t a", real=True)


def kernel_of(*values: sympy.Expr) -> Kernel:
    """A kernel over x, y (arguments), t and a (parameter)."""
    return lower_kernel("kernel", arguments=(x, y), time=t, parameters=(a,), values=values)


# Reading back: the meaning of the intermediate representation, for any kind of number.

CALLED = """
    sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh exp log sqrt pow
""".split()  # noqa: SIM905  (a line of words reads better than quoted ones)
FLOATS: dict[str, Callable[..., Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "neg": operator.neg,
    **{name: getattr(math, name) for name in CALLED},
    **{f"inverse_root_{k}": lambda x, k=k: 1.0 / (x ** (k // 2) * math.sqrt(x)) for k in (1, 3, 5, 7)},
}


def interpret(
    kernel: Kernel, u: Sequence[Any], t: Any, parameters: Sequence[Any], convert: Any, functions: Any
) -> list:
    """Results of a kernel in the arithmetic of ``convert`` and ``functions``."""
    w: list[Any] = []
    sources = {"u": u, "parameters": parameters, "w": w}

    def value(expression: Expression) -> Any:
        if isinstance(expression, Constant):
            return convert(expression.value)
        if isinstance(expression, Load):
            return t if expression.source == "t" else sources[expression.source][expression.index]
        return functions[expression.operator](*(value(operand) for operand in expression.operands))

    for temporary in kernel.temporaries:
        w.append(value(temporary))  # noqa: PERF401  (each may use those before it)
    return [value(result) for result in kernel.results]


def depth(expression: Expression) -> int:
    return 1 + max(map(depth, expression.operands)) if isinstance(expression, Operation) else 0


def exact(expression: sympy.Expr, point: dict[sympy.Symbol, Any]) -> Any:
    """SymPy's own value, to 60 digits."""
    return mp.mpf(sympy.N(expression.subs(point), 60, maxn=2000))


# Random expressions. Constants are multiples of 1/8, exact in binary64, so that nothing but arithmetic is compared.

CATALOGUE = ["planar-pendulum", "duffing", "kepler", "double-pendulum", "spherical-pendulum", "relativistic-particle"]


@pytest.mark.sampled(8)
@pytest.mark.parametrize("name", CATALOGUE)
@pytest.mark.parametrize("method", [SVI(3), SCVI(2), SpectralCollocation(2), Gauss(2)], ids=lambda m: m.name)
def test_kernels_have_the_values_and_derivatives_of_their_formulas(name, method):
    system = problem(name).system
    program = lowered(system, method)
    points = random.Random(name)
    for group, own in zip(method.stage_system(system).stage_groups, program.equations.stage_groups, strict=True):
        symbols = (*group.arguments, system.time, *system.parameters)
        point = {symbol: sympy.Rational(points.randint(1, 30), 64) for symbol in symbols}
        point |= {symbol: 1 + value for symbol, value in point.items() if symbol in system.parameters}
        numbers = [float(point[symbol]) for symbol in symbols]
        m = len(group.arguments)
        expected = [float(exact(e, point)) for e in (*group.results, *derivatives_in_order(group))]
        found = interpret(own.derivative, numbers[:m], numbers[m], numbers[m + 1 :], float, FLOATS)
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)
        values = interpret(own.value, numbers[:m], numbers[m], numbers[m + 1 :], float, FLOATS)
        np.testing.assert_allclose(values, expected[: len(values)], rtol=1e-12, atol=1e-14)


def derivatives_in_order(group: Any) -> list[sympy.Expr]:
    return [
        derivative
        for scatter in group.scatters
        for gather in group.gathers
        for derivative in jacobian(scatter.results, gather.arguments).values()
    ]


# Sharing and size.


def test_gradient_of_kepler_has_no_division():
    system = KEPLER
    forces = gradient(system.lagrangian, system.coordinates)
    partials = jacobian(tuple(forces.values()), system.coordinates)
    kernel = lower_kernel(
        "kepler",
        arguments=system.coordinates,
        time=system.time,
        parameters=system.parameters,
        values=tuple(forces.values()),
        partials=tuple(partials.values()),
    )
    counts = kernel.operation_counts()
    assert (counts["inverse_root_3"], counts["inverse_root_5"]) == (1, 1)
    assert "/" not in counts
    assert sum(counts.values()) < 40


def test_integer_powers_are_products_and_others_are_calls():
    assert set(kernel_of(x**7 + y**-4).operation_counts()) == {"*", "/", "+"}
    assert kernel_of(x ** sympy.Rational(1, 3)).operation_counts() == {"pow": 1}
    assert kernel_of(x**y).operation_counts() == {"pow": 1}


@pytest.mark.rotated
def test_a_chain_of_256_masses_lowers_without_recursion():
    system = fput_chain(256)
    state = (*system.coordinates, *system.velocities)
    kernel = lower_kernel(
        "chain", arguments=state, time=system.time, parameters=system.parameters, values=(system.lagrangian,)
    )
    assert max(map(depth, (*kernel.temporaries, *kernel.results))) <= DEEPEST_EXPRESSION + 1
    assert sum(kernel.operation_counts().values()) < 256 * 16


def test_long_sum_is_split_into_temporaries_with_equal_value():
    values = [sympy.Rational(k, 8) for k in range(1, 1500)]
    kernel = kernel_of(sympy.Add(*(c * x ** (k % 30) for k, c in enumerate(values)), *(y**k for k in range(2, 40))))
    assert max(map(depth, kernel.temporaries)) <= DEEPEST_EXPRESSION + 1
    (result,) = interpret(kernel, (0.5, -0.25), 0.0, (0.0,), float, FLOATS)
    expected = sum(float(c) * 0.5 ** (k % 30) for k, c in enumerate(values)) + sum((-0.25) ** k for k in range(2, 40))
    assert result == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("constant", [10**400, sympy.Rational(-(10**400), 3), sympy.exp(1000), sympy.exp(10**30)])
def test_constants_beyond_a_double_are_rejected(constant):
    with pytest.raises(SystemDefinitionError, match="constant"):
        kernel_of(constant * x + y)


def test_functions_without_a_c_counterpart_are_rejected():
    with pytest.raises(SystemDefinitionError, match="not supported in C"):
        kernel_of(sympy.gamma(x))


# The printer. Every expression of two levels over these leaves is compiled and compared bit for bit.

LEAVES = (Load("u", 0), Load("w", 0), Constant(-2.5))
POINT = (0.75, -3.0)


def level(below: Sequence[Expression]) -> list[Expression]:
    pairs = [Operation(sign, pair) for sign in "+-*/" for pair in product(below, repeat=2)]
    return [*below, *pairs, *(Operation("neg", (operand,)) for operand in below)]


def compiled_values(expressions: Sequence[Expression], tmp_path: Any) -> np.ndarray:
    """The values of expressions over u[0] and w0, by the C compiler."""
    lines = [f"  value[{k}] = {print_expression(e)};" for k, e in enumerate(expressions)]
    text = "\n".join(["#include <math.h>", "void f(const double *u, double w0, double *value)", "{", *lines, "}"])
    (tmp_path / "f.c").write_text(text)
    strict = ["-std=c99", "-O0", "-ffp-contract=off", "-fPIC", "-shared", "-w"]
    subprocess.run([*find_compiler(), *strict, "f.c", "-lm", "-o", "f.so"], cwd=tmp_path, check=True)
    values = np.empty(len(expressions))
    double = ctypes.POINTER(ctypes.c_double)
    u = (ctypes.c_double * 1)(POINT[0])
    ctypes.CDLL(str(tmp_path / "f.so")).f(u, ctypes.c_double(POINT[1]), values.ctypes.data_as(double))
    return values


@pytest.mark.rotated
def test_printed_c_evaluates_to_the_expression(tmp_path):
    expressions = level(level(LEAVES))
    sources = {"u": np.float64(POINT[0]), "w": np.float64(POINT[1])}

    def value(expression: Expression) -> Any:
        if isinstance(expression, Constant):
            return np.float64(expression.value)
        if isinstance(expression, Load):
            return sources[expression.source]
        return FLOATS[expression.operator](*map(value, expression.operands))

    with np.errstate(all="ignore"):
        expected = np.array([value(expression) for expression in expressions])
    found = compiled_values(expressions, tmp_path)
    np.testing.assert_array_equal(found, expected)
    assert len(expressions) > 5000


@pytest.mark.second
@settings(deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_printed_numbers_read_back_as_the_same_double(number):
    text = print_number(number)
    assert float(text) == number
    assert any(mark in text for mark in ".e")


@pytest.mark.parametrize(
    ("forces", "products"),
    [
        ((-a * x * (x**2 + y**2) ** sympy.Rational(-3, 2), -a * y * (x**2 + y**2) ** sympy.Rational(-3, 2)), 2),
        ((x * y * (a + y**2) ** sympy.Rational(-5, 2) + t, -x), 1),
        (((x**2 + y**2) ** sympy.Rational(-3, 2) + x, x * (x**2 + y**2) ** sympy.Rational(-3, 2)), 0),
        ((x * (1 + x**2) ** sympy.Rational(-1, 2), y * (1 + y**2) ** sympy.Rational(-1, 2)), 0),
    ],
    ids=["kepler", "sum", "alone", "two roots"],
)
def test_factors_of_few_roots_are_part_of_them(forces, products):
    kernel = kernel_of(*forces)
    rewritten = with_factors_in_roots(kernel)
    counts = rewritten.operation_counts()
    assert sum(count for name, count in counts.items() if name.endswith("_times")) == products
    assert (rewritten == kernel) == (products == 0)
    functions = FLOATS | {f"inverse_root_{k}_times": lambda x, f, k=k: f * x ** (-k / 2) for k in (1, 3, 5, 7)}
    point = [0.7, -0.4], 0.3, [1.9]
    found, expected = (interpret(each, *point, float, functions) for each in (rewritten, kernel))
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    used = {
        load.index
        for each in (*rewritten.temporaries, *rewritten.results)
        for load in loads(each)
        if load.source == "w"
    }
    assert used == set(range(len(rewritten.temporaries)))
