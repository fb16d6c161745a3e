"""Systems from text, from SymPy and from sympy.physics.mechanics; every definition that must be refused."""

import dataclasses
import math
import pickle
import warnings
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import sympy
from notation import lagrange
from sympy import Rational, Symbol, cos, sin
from sympy.physics.mechanics import LagrangesMethod, dynamicsymbols

from scvi_codegen import ExpressionError, LagrangianSystem, SystemDefinitionError, SystemDefinitionWarning
from scvi_codegen.systems.checks import definition
from scvi_codegen.systems.derived_expressions import curve_rates, forms_of

T = dynamicsymbols._t
Q1, Q2 = dynamicsymbols("q1 q2")
M, L, G = sympy.symbols("m l g")
PHYSICS = {M: 1.5, L: 2, G: Rational(981, 100)}
X, V = sympy.symbols("x x_dot")


def from_text(coordinates: str, lagrangian: str, **parameters: float) -> LagrangianSystem:
    return lagrange("system", coordinates.split(), lagrangian, parameters=parameters)


def from_sympy(lagrangian: Any, *coordinates: Any, **options: Any) -> LagrangianSystem:
    return LagrangianSystem.from_sympy(name="system", lagrangian=lagrangian, coordinates=coordinates, **options)


def real(names: str) -> tuple[Symbol, ...]:
    return tuple(sympy.symbols(names, real=True, seq=True))


def test_fields_from_text() -> None:
    system = from_text("x y", "m*(x_dot**2 + y_dot**2)/2\n  - 0.1*x*y*cos(t)", m=2)
    x, y, vx, vy, t, m = real("x y x_dot y_dot t m")
    assert (system.coordinates, system.velocities, system.time) == ((x, y), (vx, vy), t)
    assert (system.parameters, system.defaults, system.dimension) == ((m,), (2.0,), 2)
    assert system.lagrangian == m * (vx**2 + vy**2) / 2 - x * y * cos(t) / 10


def test_text_round_trip() -> None:
    system = from_text("x y", "(x_dot**2 + y_dot**2)/2 + mu/sqrt(x**2 + y**2) - 0.3*x*t", mu=1)
    assert from_text("x y", system.to_text(), mu=1) == system


def test_equality_hash_and_pickle_are_structural() -> None:
    one, two = from_text("x", "x_dot**2/2 - k*x**2/2", k=1), from_text("x", "-0.5*k*x*x + x_dot**2*0.5", k=1)
    assert one == two
    assert hash(one) == hash(two)
    assert pickle.loads(pickle.dumps(one)) == one
    assert one != from_text("x", "x_dot**2/2 - k*x**2/2", k=2)
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.name = "other"  # type: ignore[misc]  # that is the point


def test_plain_symbols_with_and_without_velocities() -> None:
    u = Symbol("u")
    expected = from_text("x", "x_dot**2/2 - x**2/2")
    assert from_sympy(V**2 / 2 - X**2 / 2, X) == expected
    assert from_sympy(u**2 / 2 - X**2 / 2, X, velocities=[u]) == expected


def test_functions_of_time_are_plain_symbols_inside() -> None:
    expected = from_text("q1", "m*q1_dot**2/2 - q1**2*cos(t)", m=1)
    assert from_sympy(M * Q1.diff(T) ** 2 / 2 - Q1**2 * cos(T), Q1, parameters={M: 1}) == expected
    tau, u = sympy.symbols("tau u")
    q = sympy.Function("q1")(tau)
    assert from_sympy(M * q.diff(tau) ** 2 / 2 - q**2 * cos(tau), q, parameters={"m": 1}) == expected
    assert from_sympy(M * u**2 / 2 - q**2 * cos(tau), q, velocities=[u], parameters={"m": 1}) == expected
    velocity = [q.diff(tau)]
    assert from_sympy(M * velocity[0] ** 2 / 2 - q**2 * cos(tau), q, velocities=velocity, parameters={M: 1}) == expected


def test_unevaluated_derivatives_are_carried_out() -> None:
    height = sympy.Derivative(Q1**2, T)
    assert from_sympy(height**2 / 2 + Q1.diff(T) ** 2 / 2, Q1) == from_text("q1", "2*q1**2*q1_dot**2 + q1_dot**2/2")


def test_floats_become_the_rationals_of_their_decimals() -> None:
    lagrangian = 0.5 * V**2.0 - 0.1 * X**2 + sympy.Float("0.1234567890123456789012345", 30) * X
    system = from_sympy(lagrangian, X)
    x, v = real("x x_dot")
    assert system.lagrangian == v**2 / 2 - x**2 / 10 + Rational("0.1234567890123456789012345") * x
    assert not system.lagrangian.atoms(sympy.Float)


def test_unevaluated_nodes_are_evaluated_for_the_text_round_trip() -> None:
    x, v = real("x x_dot")
    system = from_sympy(sympy.Mul(2, v**2 + x, evaluate=False), x)
    assert from_text("x", system.to_text()) == system


@pytest.mark.parametrize(
    ("given", "spelled"),
    [
        (r"\theta_1", "theta_1"),
        (r"\theta_{1}", "theta_1"),
        ("θ_1", "theta_1"),
        ("Δ", "Delta"),
        ("λ", "lambda"),
        ("big q", "big_q"),
    ],
)
def test_unusual_names_are_transliterated(given: str, spelled: str) -> None:
    q, u, k = Symbol(given), Symbol("u"), Symbol("k " + given)
    system = from_sympy(u**2 / 2 - k * q**2, q, velocities=[u], parameters={k: 1})
    assert [symbol.name for symbol in (*system.coordinates, *system.velocities)] == [spelled, spelled + "_dot"]
    assert from_text(spelled, system.to_text(), **{system.parameters[0].name: 1.0}) == system


def test_with_parameters_replaces_values() -> None:
    system = from_text("x", "m*x_dot**2/2 - k*x**2", m=1, k=2)
    assert system.with_parameters(k=3) == from_text("x", "m*x_dot**2/2 - k*x**2", m=1, k=3)
    assert system.defaults == (1.0, 2.0)
    with pytest.raises(SystemDefinitionError, match=r"no parameter 'kk'; did you mean 'k'\? It has: m, k"):
        system.with_parameters(kk=1)
    with pytest.raises(SystemDefinitionError, match="'m' is not a finite"):
        system.with_parameters(m=math.inf)
    with pytest.raises(SystemDefinitionError, match="singular"):
        system.with_parameters(m=0)


def lagranges_method(**options: Any) -> LagrangesMethod:
    lagrangian = M * L**2 * (Q1.diff(T) ** 2 + Q2.diff(T) ** 2 * sin(Q1) ** 2) / 2 + M * G * L * cos(Q1)
    return LagrangesMethod(lagrangian, [Q1, Q2], **options)


def test_lagranges_method_has_equal_equations_of_motion() -> None:
    method = lagranges_method()
    system = LagrangianSystem.from_lagranges_method(method, name="system", parameters=PHYSICS)
    assert system.defaults == (1.5, 2.0, 9.81)
    expected = "m*l**2*(q1_dot**2 + q2_dot**2*sin(q1)**2)/2 + m*g*l*cos(q1)"
    assert system == from_text("q1 q2", expected, m=1.5, l=2, g=9.81)


def test_constraints_on_velocities_are_not_dropped() -> None:
    method = lagranges_method(nonhol_coneqs=[Q1.diff(T) - Q2.diff(T)])
    found = LagrangianSystem.from_lagranges_method(method, name="system", parameters=PHYSICS)
    assert found.constraints == (found.velocities[0] - found.velocities[1],)


@pytest.mark.parametrize("k", [1j, np.complex128(1), None, 10**400])
def test_numbers_that_are_not_finite_and_real_are_rejected(k: Any) -> None:
    with pytest.raises(SystemDefinitionError, match="'k' is not a finite real number"):
        from_text("x", "x_dot**2/2 - x*k", k=k)


def test_text_errors_carry_the_column() -> None:
    with pytest.raises(ExpressionError) as caught:
        from_text("x", "x_dot**2/2 - k*x")
    assert caught.value.column == 13


KINETIC = V**2 / 2


@pytest.mark.parametrize(
    ("lagrangian", "message"),
    [
        (KINETIC - M * X, "'m' in the Lagrangian is neither"),
        (KINETIC - sympy.I * X, "ImaginaryUnit"),
        (KINETIC - sympy.nan * X, "not finite"),
        (KINETIC - sympy.oo, "not finite"),
        (KINETIC - sympy.zoo, "not finite"),
        (KINETIC - sympy.Piecewise((X, X > 0), (0, X < -1)), "undefined unless.*condition True"),
        (KINETIC - sympy.Piecewise((X, sympy.Eq(X, 1)), (0, True)), r"condition 'Eq\(x, 1\)'.*not supported"),
        (KINETIC - sympy.Integral(sympy.exp(X**2), X), "Integral"),
        (KINETIC - sympy.besselj(0, X), "besselj"),
        (KINETIC - sympy.sqrt(-1 - sympy.pi) * X, "real"),
        (KINETIC - sympy.Function("f")(X), r"f\(x\)"),
        (KINETIC - Q1, r"'q1\(t\)'"),
        ("x_dot**2", "from_text"),
        (sympy.Matrix([KINETIC]), "not a SymPy expression"),
        (KINETIC - Symbol("m") * Symbol("m", positive=True) * X, "different symbols"),
        (KINETIC - Symbol(r"\theta") * Symbol("theta") * X, "different symbols"),
    ],
    ids=str,
)
def test_invalid_expressions_are_rejected(lagrangian: Any, message: str) -> None:
    with pytest.raises(SystemDefinitionError, match=message):
        from_sympy(lagrangian, X)


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ((KINETIC, "x"), {}, "neither a symbol nor a function of time"),
        ((KINETIC, X), {"velocities": []}, "list one velocity per coordinate"),
        ((KINETIC, X), {"velocities": [V + 1]}, "neither a symbol nor a derivative"),
        ((KINETIC - Symbol("a'") * X, X), {"parameters": {"a'": 1}}, "not a valid name"),
        ((KINETIC, X), {"velocities": [X]}, "used both as"),
        ((KINETIC, X), {"parameters": {X: 1}}, "used as a parameter"),
        ((KINETIC, X), {"parameters": {1: 1}}, "a parameter must be a symbol or a name"),
        ((KINETIC, X), {"parameters": {"k": 1, Symbol("k"): 2}}, "same name"),
        ((Q1.diff(T) ** 2, Q1), {"parameters": {Q1: 1}}, "used as a parameter"),
        ((Q1.diff(T) ** 2 - Q2, Q1), {}, r"'q2\(t\)' in the Lagrangian"),
        ((Q1.diff(T) ** 2 - Q1.diff(T, 2) * Q1, Q1), {}, "higher derivatives"),
        ((Q1.diff(T) ** 2 - Symbol("q1"), Q1), {}, "different symbols"),
        ((V**2, sympy.Function("x")(X, T)), {}, "not a function of time"),
        ((sympy.Function("t")(T).diff(T) ** 2, sympy.Function("t")(T)), {}, "both"),
        (
            (KINETIC, X),
            {"forces": {X: "E*x"}},
            "the force on x is a str, not a SymPy expression",
        ),  # SymPy's E is 2.718..
        ((KINETIC, X), {"forces": {X: None}}, "the force on x is a NoneType"),
        ((KINETIC, X), {"forces": [X]}, "forces must be a mapping"),
        ((KINETIC, X), {"parameters": ["k"]}, "parameters must be a mapping"),
        ((KINETIC, X), {"dissipation": "x_dot**2"}, "the dissipation is a str"),
        ((KINETIC, X), {"constraints": X - 1}, "constraints must be a list"),
        ((KINETIC, X), {"constraints": ["x = 1"]}, "the constraint is a str"),
        ((KINETIC, X), {"constraints": [X < 1]}, "the constraint is a StrictLessThan"),
        ((KINETIC, X), {"inputs": Symbol("u")}, "inputs must be a list"),
        ((KINETIC, X), {"inputs": "uw"}, "inputs must be a list"),
    ],
    ids=str,
)
def test_invalid_arguments_are_rejected(arguments: tuple[Any, ...], options: dict[str, Any], message: str) -> None:
    with pytest.raises(SystemDefinitionError, match=message):
        from_sympy(*arguments, **options)


@pytest.mark.parametrize(
    "lagrangian",
    [
        "-sqrt(1 - x_dot**2 - y_dot**2)",
        "x_dot*y_dot - x*y",
        "x_dot**4 + y_dot**2*x_dot**2",
        "exp(x_dot) + exp(y_dot)",
        "x_dot**2*x**2 + y_dot**2*(1 + y)",
        "(x_dot + y_dot)**2 + 1e-9*x_dot**2",
        "sqrt(x - 1000)*(x_dot**2 + y_dot**2)",
    ],
)
def test_regular_lagrangians_of_all_kinds_are_accepted(lagrangian: str) -> None:
    assert from_text("x y", lagrangian).dimension == 2


def test_large_coupled_mass_matrix_is_accepted() -> None:
    names = [f"x{index}" for index in range(40)]
    coupled = " + ".join(f"({a}_dot - {b}_dot)**2/2" for a, b in pairwise(names))
    with pytest.raises(SystemDefinitionError, match="singular"):
        from_text(" ".join(names), coupled)
    assert from_text(" ".join(names), coupled + " + x0_dot**2").dimension == 40


def test_products_of_many_velocities_name_the_better_statement(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(definition, "MOST_PRODUCTS", 8)
    names = ["a", "b", "c", "d"]
    with pytest.warns(SystemDefinitionWarning, match=r"couples 10 pairs of velocities.*from_mjcf.*q\[N\].*constraints"):
        from_text(" ".join(names), "(a_dot + b_dot + c_dot + d_dot)**2 + a_dot**2 + b_dot**2 + c_dot**2")
    neighbours = " + ".join(f"({a}_dot - {b}_dot)**2" for a, b in pairwise(names))  # 7 entries of the lower triangle
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        from_text(" ".join(names), f"{neighbours} + a_dot**2")


@pytest.mark.second
def test_rates_along_a_curve_are_those_of_its_taylor_series():
    """dL/dt and d2L/dt2 of a system with velocities in every term, compared with L along a prescribed curve of time."""
    system = lagrange("twisted", "x y", "x_dot**2*y/2 + y_dot**2*exp(x)/2 + t*x*y_dot - x**2*y + sin(t)*x")
    t = system.time
    curve = dict(zip(system.coordinates, (sympy.sin(t), t**3 + 2 * t), strict=True))
    names = [*system.coordinates, *system.velocities, *(s for group in curve_rates(system, 2) for s in group)]
    along = [x.diff(t, k) for k in range(4) for x in curve.values()]
    values = dict(zip(names, along, strict=False))
    exact = system.lagrangian.subs(values)
    for k, rate in enumerate(forms_of(system).rates(2), 1):
        assert sympy.simplify(rate.subs(values) - exact.diff(t, k)) == 0
