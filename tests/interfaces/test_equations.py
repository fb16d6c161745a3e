"""The closed form: the paper's own example, names and displays; ``test_printed_formulas.py`` solves what is printed."""

import re

import pytest
import sympy
from notation import lagrange
from sympy import sin, sqrt

import scvi_codegen as sc
from scvi_codegen.common.display.mathml import latex_name
from scvi_codegen.interfaces.derivation.notation import readable
from scvi_codegen.methods.discretise import paper_equations

KEPLER, PENDULUM = (sc.problem(name).system for name in ("kepler", "planar-pendulum"))
UNIT = {"m": 1, "l": 1, "g": 1}


def unit_pendulum(expression):
    return expression.subs({sympy.Symbol(name, real=True): value for name, value in UNIT.items()})


def test_two_point_pendulum_equals_equations_36_and_37():
    derived = sc.derive(PENDULUM, sc.SCVI(1, "gauss-legendre:2"), radicals=True)
    q1, v, q, p, h = sympy.symbols("Q_1 v_0 q_k p_k h", real=True)
    first, second = (3 + sqrt(3)) / 6, (3 - sqrt(3)) / 6
    equation_36 = q1 / h**2 + sin(q1) - v / h - q / h**2
    G = -(3 + sqrt(3)) * h / 12 * sin(first * q + second * q1) - (3 - sqrt(3)) * h / 12 * sin(second * q + first * q1)
    equation_37 = -q1 / h + q / h + G + p
    stage, momentum = (unit_pendulum(e.residual) for e in derived.equations)
    assert [e.number for e in derived.equations] == ["34a", "34d"]
    assert sympy.simplify(stage - equation_36) == 0
    assert sympy.simplify(momentum - equation_37) == 0
    assert derived.entries == ()


def test_derivation_names_avoid_names_of_the_system():
    system = lagrange("clash", "q", "h*q_dot**2/2 - w_1*q**2", h=1.0, w_1=2.0)
    derived = sc.derive(system, sc.SVI(1, "gauss-legendre:2"))
    assert derived.step.name == "_h"
    symbols = (*derived.unknowns, *(entry.symbol for entry in derived.entries), derived.step)
    assert not {symbol.name for symbol in symbols} & {"q", "h", "w_1"}


def test_equations_have_displays():
    derived = sc.derive(KEPLER, sc.SCVI(2))
    assert "lambda_1_q1" in derived.to_text()
    assert r"\tag{34d}" in derived._repr_latex_()
    assert derived._repr_latex_().count(r"\begin{align*}") == 3  # equations, tables, momentum maps
    symbols = set().union(*(e.residual.free_symbols for e in derived.equations))
    names = {symbol: latex_name(symbol.name) for symbol in symbols}
    written = [sympy.latex(readable(e.residual), symbol_names=names) for e in derived.equations]
    assert re.findall(r"^0 &= (.*) \\tag", derived.to_latex(), re.MULTILINE) == written
    kinds = {e.kind for e in derived.stage_equations}
    assert kinds == {"stage", "multiplier"}
    assert [e.number for e in derived.idel_equations] == ["34d", "34d", "34e", "34e"]
    assert derived.jacobian.shape == (10, 10)


def test_numbers_of_many_digits_are_shown_as_decimals():
    mass = sympy.Rational(1234567, 10**7)
    derived = sc.derive(lagrange("numbers", "q", f"{mass}*q_dot**2/2 - q**4/3"), sc.SVI(1, "gauss-legendre:2"))
    assert "L = -q**4/3 + 0.06172835*q_dot**2" in derived.to_text()
    shown = (derived.to_text(), derived.to_latex(), derived.equations[0].residual)
    assert ["1234567" in str(each).replace("0.1234567", "") for each in shown] == [False, False, True]


def test_singular_hamiltonians_have_no_printed_equations_where_velocities_are_needed():
    """H = x y determines no velocities: a method in position form has no step to print."""
    shear = sc.HamiltonianSystem.from_text(name="shear", coordinates=["x"], momenta=["y"], hamiltonian="x*y")
    assert not shear.is_regular
    with pytest.raises(sc.MethodError, match="singular"):
        paper_equations(shear, sc.Gauss(2, form="position"))
