"""Intermediate quantities: derivatives, replacements and steps against formulas that are written out."""

from dataclasses import replace
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest
import sympy
from sympy import Add, Mul, Rational, S, Symbol, cos, exp, sin, sqrt, symbols

import scvi_codegen as sc
from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.ir.kernel import exact_number
from scvi_codegen.common.cache import identity
from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.precision import mp
from scvi_codegen.systems.formulas.expressions import evaluate, gradient, hessian, jacobian, unsupported_part
from scvi_codegen.systems.formulas.intermediates import (
    intermediate,
    intermediates,
    product,
    symbols_of,
    total,
    written_out,
    written_size,
)
from scvi_codegen.systems.formulas.numpy_values import array_value, varies

X, Y, Z = VARIABLES = tuple(Symbol(name, real=True) for name in "xyz")
POINT = {X: mp.mpf("0.3"), Y: mp.mpf("-0.7"), Z: mp.mpf("1.1")}


def nested(depth: int) -> sympy.Expr:
    """Formula in which every quantity is used three times by the next ones."""
    a, b = intermediate(sin(X) + Y * Z), intermediate(exp(Y / 3) - X)
    for _ in range(depth):
        a, b = intermediate(cos(b) * a + Z * b), intermediate(a / sqrt(2 + b**2) - Y)
    return a * b + b**2 * X + Z


def values(entries):
    return {place: evaluate(entry, POINT) for place, entry in entries.items()}


def assert_near(found, expected):
    assert found.keys() == expected.keys()
    assert all(abs(found[k] - expected[k]) < mp.mpf("1e-50") for k in expected)


@pytest.mark.rotated
def test_derivatives_are_those_of_the_formula_written_out():
    formula = nested(2)
    plain = written_out(formula)
    assert not intermediates(plain)
    assert evaluate(formula, POINT) == pytest.approx(evaluate(plain, POINT))
    expected = {i: evaluate(plain.diff(x), POINT) for i, x in enumerate(VARIABLES)}
    assert_near(values(gradient(formula, VARIABLES)), expected)
    second = {
        (i, j): evaluate(plain.diff(x, y), POINT) for i, x in enumerate(VARIABLES) for j, y in enumerate(VARIABLES)
    }
    assert_near(values(hessian(formula, VARIABLES)), second)
    rows = [formula, nested(1) + formula, X * Y]
    first = {
        (i, j): evaluate(written_out(row).diff(x), POINT) for i, row in enumerate(rows) for j, x in enumerate(VARIABLES)
    }
    del first[2, 2]
    assert_near(values(jacobian(rows, VARIABLES)), first)
    assert_near({0: evaluate(formula.diff(X), POINT)}, {0: expected[0]})


@pytest.mark.rotated
def test_deep_formulas_take_linear_time():
    """Written out, this formula has more terms than there are atoms."""
    formula = nested(400)
    assert written_size(formula) > 10**80
    assert len(intermediates(formula)) == 802
    assert formula.free_symbols == {*VARIABLES}
    assert unsupported_part(formula) is None
    assert len(identity(formula).splitlines()) < 5000
    known = dict(zip(VARIABLES, (0.3, -0.7, 1.1), strict=True))
    exact = float(evaluate(formula, POINT))
    assert array_value(formula, dict(known)) == pytest.approx(exact, rel=1e-6)
    moved = formula.xreplace({X: X + 1}).xreplace({X: X - 1})
    assert float(evaluate(moved, POINT)) == pytest.approx(exact, rel=1e-12)
    derivative = gradient(formula, VARIABLES)[0]
    nearby = float(evaluate(formula, POINT | {X: POINT[X] + mp.mpf("1e-25")}) - evaluate(formula, POINT)) * 1e25
    assert float(evaluate(derivative, POINT)) == pytest.approx(nearby, rel=1e-9)
    kernel = lower_kernel("k", arguments=VARIABLES, time=Symbol("t"), parameters=(), values=[formula, derivative])
    assert sum(kernel.operation_counts().values()) < 20_000
    with pytest.raises(SystemDefinitionError, match="written out"):
        written_out(formula)


def test_symbols_of_shared_parts_take_linear_time():
    shared = X
    for _ in range(60):  # 2^60 nodes as a tree
        shared = Add(shared, Mul(shared, Y, evaluate=False), evaluate=False)
    assert symbols_of(shared + nested(5)) == {X, Y, Z}


def test_replacements_are_those_of_their_own_rule():
    formula = nested(3)
    for shift in (1, 2, 1):
        moved = evaluate(formula.xreplace({X: X + shift}), POINT)
        assert abs(moved - evaluate(formula, POINT | {X: POINT[X] + shift})) < mp.mpf("1e-50")


def test_constants_have_the_digits_of_the_formula_written_out():
    small = intermediate(1 / sqrt(2**120 + S.One))
    for constant in (small, 3 * small, sin(small) - intermediate(S.Pi / 3)):
        assert exact_number(constant) == exact_number(written_out(constant))


def test_mass_matrix_of_a_planar_chain_takes_few_operations():
    """3.3 n^2, and 8 n^2 if quantities are eliminated in the order of their cost alone, not of the bodies."""
    n = 12
    angles, rates = (tuple(Symbol(f"{name}{i}", real=True) for i in range(n)) for name in ("q", "v"))
    angle, rate, x, y, energy = (sympy.S.Zero,) * 5
    for q, v in zip(angles, rates, strict=True):
        angle, rate = intermediate(angle + q), intermediate(rate + v)
        x, y = intermediate(x - sin(angle) * rate), intermediate(y + cos(angle) * rate)
        energy += (x**2 + y**2) / 2
    momenta = gradient(energy, rates)
    masses = jacobian([momenta[i] for i in range(n)], rates)
    kernel = lower_kernel(
        "k", arguments=(*angles, *rates), time=Symbol("t"), parameters=(), values=tuple(masses.values())
    )
    assert 0 < sum(kernel.operation_counts().values()) < 4 * n**2


def chain(folder: Path, n: int) -> sc.LagrangianSystem:
    """Chain of bodies with hinges about alternate axes."""
    axes = ("1 0 0", "0 1 0")
    bodies = "".join(
        f'<body pos="0 0 {-0.4 * (i > 0)}"><joint name="q{i}" axis="{axes[i % 2]}" damping="0.01"/>'
        '<inertial pos="0 0 -.2" mass="1" diaginertia="0.08 0.07 0.01"/>'
        for i in range(n)
    )
    path = folder / f"chain{n}.xml"
    path.write_text(f"<mujoco><worldbody>{bodies}{'</body>' * n}</worldbody></mujoco>")
    return sc.LagrangianSystem.from_mjcf(path)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("method", "solver", "options"), [
    ("svi:2", "fixed-point", {"h": 0.02, "steps": 50}),
    ("svi:2", "newton", {"h": 0.02, "steps": 50}),
    ("sc:3", "auto", {"h": 0.02, "steps": 50}),
    ("svi:3", "auto", {"t_end": 1.0, "tolerance": 1e-10}),
])  # fmt: skip
def test_steps_are_those_of_the_lagrangian_written_out(tmp_path, method, solver, options):
    system = chain(tmp_path, 3)
    plain = replace(system, lagrangian=written_out(system.lagrangian))
    start, speed = np.array([0.5, -0.4, 0.8]), np.array([0.1, 2.0, -1.0])
    ends = []
    for each in (system, plain):
        run = sc.compile_stepper(each, method, solver=solver).integrate(start, velocity=speed, **options)
        ends.append(np.concatenate([run.q[-1], run.p[-1]]))
    np.testing.assert_allclose(ends[0], ends[1], rtol=2e-12, atol=2e-12)


def test_products_and_sums_are_those_of_sympy() -> None:
    x, y = symbols("x y", real=True)
    parts = [S.Zero, S.One, Rational(-3, 7), x, y, 2 * x, cos(x), -sin(y), x**2, 1 / x, x + y, 2 * (x + y), sqrt(2)]
    parts += [intermediate(x + y), -intermediate(x * y), x * cos(x), Rational(5, 3) * intermediate(x * y) * y]
    for a, b, c in combinations_with_replacement(parts, 3):
        assert product(a, b).args == Mul(a, b).args
        assert product(product(a, b), c) == Mul(Mul(a, b), c)
        assert total([a, b, c]) == Add(a, b, c)
        assert total([c, a, b]).args == Add(a, b, c).args


def test_variation_of_second_differences() -> None:
    x, y, m = symbols("x y m", real=True)
    square = intermediate(x + y) ** 2
    assert not varies(m * square, [x], {m})
    assert varies(m * square, [x], set())
    assert varies(cos(y) * square, [x], {m})
    assert varies(square**2, [x], {m})
    assert not varies(x**4, [x], {m})  # without intermediate quantities derivatives are computed
