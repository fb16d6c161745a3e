"""The closed form: the paper's own example, and agreement with the compiled steps, which solve other unknowns."""

import mpmath
import numpy as np
import pytest
import sympy
from notation import lagrange
from sympy import sin, sqrt

import scvi_codegen as sc
from scvi_codegen.methods.discretise import paper_equations

DOUBLE_PENDULUM, DUFFING, KEPLER, PENDULUM = (
    sc.problem(name).system for name in ("double-pendulum", "duffing", "kepler", "planar-pendulum")
)

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


SYSTEMS = [PENDULUM, KEPLER, DOUBLE_PENDULUM, DUFFING.with_parameters(gamma=0.3, omega=1.3)]
METHODS = [
    sc.SVI(1), sc.SVI(2, "gauss-lobatto:3", "legendre-lobatto"), sc.SVI(3, "gauss-legendre:4", "equispaced"),
    sc.SCVI(1, "gauss-legendre:2"), sc.SCVI(2), sc.SCVI(3, "gauss-legendre:4"), sc.SCVI(2, variational=False),
    sc.SpectralCollocation(2), sc.SpectralCollocation(3, form="phase-space"), sc.Gauss(2), sc.RadauIIA(2),
    sc.RadauIA(2, form="position"), sc.LobattoIIIA(3), sc.StoermerVerlet(), sc.ExplicitEuler(),
]  # fmt: skip
STATES = {1: ([0.7], [0.4], 0.2), 2: ([0.7, -0.3], [0.3, 0.9], 0.15)}


def solved(derived, stepper):
    """End state by Newton's iteration in 30 digits on the closed form, from its own first guess."""
    q, p, h = STATES[derived.system.dimension]
    t = 0.3
    known = dict(zip(derived.state[0], q, strict=True)) | dict(zip(derived.state[1], p, strict=True))
    known |= {derived.time: t, derived.step: h}
    known |= dict(zip(derived.system.parameters, stepper.defaults, strict=True))
    velocity = stepper.velocity(q, p, t)
    names = [f"{x.name}_dot_k" for x in derived.system.coordinates]
    velocities = {sympy.Symbol(n, real=True): v for n, v in zip(names, velocity, strict=True)}

    def number(expression):
        return derived.numeric(expression).subs(known)

    with mpmath.workdps(30):
        residuals = [number(e.residual) for e in derived.equations]
        jacobian = derived.jacobian.applyfunc(number)
        function = sympy.lambdify(derived.unknowns, residuals, "mpmath")
        derivative = sympy.lambdify(derived.unknowns, sympy.Matrix(jacobian), "mpmath")
        x = mpmath.matrix(
            [mpmath.mpf(str(derived.initial_guess[u].subs(known | velocities))) for u in derived.unknowns]
        )
        for _ in range(12):
            x -= mpmath.lu_solve(derivative(*x), mpmath.matrix(function(*x)))
        assert max(abs(r) for r in function(*x)) < mpmath.mpf("1e-25")
        ends = (*derived.end_position, *derived.end_momentum)
        values = sympy.lambdify(derived.unknowns, [number(e.residual) for e in ends], "mpmath")(*x)
    m = derived.system.dimension
    return (q, p, h, t), np.array(values[:m], float), np.array(values[m:], float)


SHORT = (
    sc.SVI(1),
    sc.SCVI(1, "gauss-legendre:2"),
    sc.SpectralCollocation(2),
    sc.Gauss(2),
    sc.StoermerVerlet(),
    sc.ExplicitEuler(),
)
"""Whose equations of two coordinates, written out, are solved in less than a second."""


def every_method_and_system():
    """By default each method on a system of one coordinate, and short ones also on one of two."""
    for number, method in enumerate(METHODS):
        for system in SYSTEMS:
            kind = [each for each in SYSTEMS if each.dimension == system.dimension]
            by_default = system is kind[number % 2] and (system.dimension == 1 or method in SHORT)
            marks = [] if by_default else [pytest.mark.full]
            yield pytest.param(system, method, marks=marks, id=f"{method.name}-{system.name}")


@pytest.mark.tiers(1, 2)
@pytest.mark.sampled(8)
@pytest.mark.parametrize(("system", "method"), [*every_method_and_system()])
def test_closed_form_and_compiled_step_agree(system, method):
    stepper = sc.compile_stepper(system, method)
    (q, p, h, t), q1, p1 = solved(sc.derive(system, method), stepper)
    compiled = stepper.step(q, p, h, t)
    np.testing.assert_allclose(compiled[0], q1, rtol=1e-14, atol=4e-15)
    np.testing.assert_allclose(compiled[1], p1, rtol=1e-14, atol=4e-15)


def test_derivation_names_avoid_names_of_the_system():
    system = lagrange("clash", "q", "h*q_dot**2/2 - w_1*q**2", h=1.0, w_1=2.0)
    derived = sc.derive(system, sc.SVI(1, "gauss-legendre:2"))
    assert derived.step.name == "_h"
    stepper = sc.compile_stepper(system, sc.SVI(1, "gauss-legendre:2"))
    (q, p, h, t), q1, p1 = solved(derived, stepper)
    np.testing.assert_allclose(stepper.step(q, p, h, t), (q1, p1), rtol=1e-14)


def test_equations_have_displays():
    derived = sc.derive(KEPLER, sc.SCVI(2))
    assert "lambda_1_q1" in derived.to_text()
    assert r"\tag{34d}" in derived._repr_latex_()
    assert derived._repr_latex_().count(r"\begin{align*}") == 3  # equations, tables, momentum maps
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
