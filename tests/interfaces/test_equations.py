"""The closed form: the paper's own example, names and displays; ``test_printed_formulas.py`` solves what is printed."""

import textwrap

import numpy as np
import pytest
import sympy
from notation import lagrange
from scipy.linalg import expm
from sympy import sin, sqrt

import scvi_codegen as sc

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


def test_numbers_of_many_digits_are_shown_as_decimals():
    mass = sympy.Rational(1234567, 10**7)
    derived = sc.derive(lagrange("numbers", "q", f"{mass}*q_dot**2/2 - q**4/3"), sc.SVI(1, "gauss-legendre:2"))
    assert "L = -q**4/3 + 0.06172835*q_dot**2" in derived.to_text()
    shown = (derived.to_text(), derived.to_latex(), derived.equations[0].residual)
    assert ["1234567" in str(each).replace("0.1234567", "") for each in shown] == [False, False, True]


@pytest.mark.second
@pytest.mark.parametrize("method", [sc.Composition(4), sc.StoermerVerlet("drift-kick-drift")], ids=lambda m: m.name)
def test_printed_statements_and_tables_are_the_step(method):
    """The lines of the text as they stand, with NumPy arrays in place of the index i."""
    system = lagrange("springs", "x y", "3*x_dot**2/2 + y_dot**2 - (x - y)**2 - y**4/4 + x*sin(t)")
    derived = sc.derive(system, method)
    printed = derived.to_text().split("\nstatements of the C: ")[1:]
    statements, tables = (textwrap.dedent(part.partition("\n")[2].partition("\n\n")[0]) for part in printed)
    q0, p0, t, h = np.array([0.4, -0.3]), np.array([0.2, 0.5]), 0.75, 0.25

    def force(u, at):
        return np.array([-2 * (u[0] - u[1]) + np.sin(at), 2 * (u[0] - u[1]) - u[1] ** 3])

    values = {
        "q0": q0,
        "p0": p0,
        "t": t,
        "h": h,
        "force": force,
        "known": False,
        "inverse_mass": np.array([1 / 3, 0.5]),
    }
    values |= {"q": np.zeros(2), "p": np.zeros(2)}
    values |= {line.partition(" = ")[0]: eval(f"[{line.partition(' = ')[2]}]") for line in tables.splitlines()}
    exec(statements.replace("[i]", ""), values | {"LEAPS": range(len(values["KICK"]))})
    end = sc.compile_stepper(system, method).step(q0, p0, h, t=t)
    np.testing.assert_allclose([q0 + values["q"], p0 + values["p"]], end[:2], rtol=1e-15, atol=2e-16)
    assert derived.to_latex().endswith("\\end{verbatim}")
    assert "verbatim" not in derived._repr_latex_()


def test_statements_of_constraints_are_those_of_their_masses():
    constant, varying = (
        lagrange("rod", "x y", f"x_dot**2/2 + y_dot**2*{mass}/2 - y", constraints=["x**2 + y**2 = 1"])
        for mass in ("2", "(1 + x**2)")
    )
    first, second = ("".join(sc.derive(system, "svi:2").statements.values()) for system in (constant, varying))
    assert "d[i] = mass(f[i])" in first
    assert [text.count("z[i] = ") for text in (first, second)] == [1, 1]  # the curve at the end of the step
    assert "momentum_terms" not in first
    assert "invert(masses)" in second
    assert not sc.derive(PENDULUM, "svi:2").statements


def test_printed_half_step_of_a_heat_bath_is_exact():
    """Its lines with columns of normals: E p of exp(-R M^-1 tau), and noise of fluctuation and dissipation."""
    bath = {"damping": 0.0, "dissipation": "g*x_dot**2/2", "temperature": "kT", "parameters": {"kT": 1.3, "g": 0.7}}
    system = sc.LagrangianSystem.from_text(
        "pair", coordinates=["x", "y"], lagrangian="x_dot**2 + x_dot*y_dot/2 + y_dot**2/2 - x**2", **bath
    )
    (text,) = sc.derive(system, "svi:2").statements.values()
    M, R, tau, kT = np.array([[2, 0.5], [0.5, 1]]), np.diag([0.7, 0]), 0.4, 1.3
    L = np.linalg.cholesky(M)
    rates, U = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, R).T))
    decay, matrices = np.expm1(-tau * rates)[:, np.newaxis], {"modes": np.linalg.inv(L @ U), "rotated": U.T}
    values = {name: (lambda x, A=A: A @ x) for name, A in (matrices | {"momenta": L @ U}).items()}
    values |= {"mean": 0.5, "carry": 0.0, "decay": decay, "strength": np.sqrt(-kT * decay * (2 + decay)), "heat": 0.0}
    exact = expm(-tau * R @ np.linalg.inv(M))

    def half_step(p, xi):
        now = values | {"p": 0.5 + p, "xi": xi}
        exec(text.replace("[i]", ""), now)
        return now["p"] - 0.5

    assert np.abs(half_step(np.eye(2), np.zeros((2, 2))) - exact).max() < 1e-14
    noise = half_step(np.zeros((2, 2)), np.eye(2))
    assert np.abs(noise @ noise.T - kT * (M - exact @ M @ exact.T)).max() < 1e-14
