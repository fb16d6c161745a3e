"""Lagrangians that are linear in all velocities: gauges, runs, files, certificates."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
import sympy
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.systems.first_order import FirstOrderSystem

PARTICLE = (
    "-(y + x**2*y + y**3/6 + x*y**2/6)/2*x_dot + (x + x**3/3 + x*y**2/2 + x**2*y/6)/2*y_dot"
    " - (1 + cos(x)/2 + y**2 + x**4/4)"
)
SLAB = (
    "-(y + y**3/6 + x**2*y/2)*x_dot/2 + (x + x*y**2/2 + x**3/6)/2*y_dot + u*z_dot - u**2/2"
    " - mu*(1 + x**2/2 + y**2/2)*(1 + z**2/3)"
)
COUPLED = "(a + b*y/3)*x_dot + (b + b**3/5)*y_dot - (a**2 + b**2 + x**2 + 2*y**2 + x*b/2)/2"
PREY = "log(y)/x/2*x_dot - log(x)/y/2*y_dot - (x + y - log(x) - 2*log(y))"
CASES = {
    "Lotka-Volterra": (["x", "y"], PREY, {}, [2.0, 1.0]),
    "massless particle": (["x", "y"], PARTICLE, {}, [1.0, 0.2]),
    "coupled": (["x", "y", "a", "b"], COUPLED, {}, [0.5, 0.3, 0.2, 0.4]),
    "guiding centre": (["x", "y", "z", "u"], SLAB, {"mu": 0.1}, [0.5, 0.3, 0.2, 0.4]),
}


def system(name: str) -> FirstOrderSystem:
    coordinates, lagrangian, parameters, _ = CASES[name]
    return sc.LagrangianSystem.from_text(name, coordinates, lagrangian, parameters=parameters)


def rates(name: str):
    """Right-hand side omega^-1 dH from the text alone, without a choice of gauge."""
    names, text, parameters, _ = CASES[name]
    z, v = sympy.symbols(names, real=True), sympy.symbols([f"{each}_dot" for each in names], real=True)
    lagrangian = sympy.sympify(text, locals={str(each): each for each in (*z, *v)}).subs(parameters)
    theta = [lagrangian.diff(each) for each in v]
    hamiltonian = -lagrangian.subs(dict.fromkeys(v, 0))
    omega = [[theta[j].diff(z[i]) - theta[i].diff(z[j]) for j in range(len(z))] for i in range(len(z))]
    evaluate = sympy.lambdify(z, [omega, [hamiltonian.diff(each) for each in z]])

    def right(_: float, state: np.ndarray) -> np.ndarray:
        form, gradient = evaluate(*state)
        return np.linalg.solve(np.array(form, float), np.array(gradient, float))

    return right


METHODS = (
    ("svi:1", 2, 40),
    ("stoermer-verlet", 2, 40),
    ("radau-iia:2", 3, 20),
    ("svi:2", 4, 20),
    ("lobatto-iiia:3", 4, 20),
    ("svi:3", 6, 10),
)
"""Methods with their order and the smaller number of steps."""


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", CASES)
def test_order_2s_against_the_equations_without_gauge(name: str) -> None:
    start = CASES[name][3]
    expected = solve_ivp(rates(name), (0.0, 3.0), start, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    for method, order, steps in METHODS:
        stepper = sc.compile_stepper(system(name), method)
        errors = [
            np.abs(stepper.integrate(start, h=3.0 / n, steps=n).variables[-1] - expected).max()
            for n in (steps, 2 * steps)
        ]
        assert math.log2(errors[0] / errors[1]) > order - 0.3 or errors[1] < 1e-11
    adaptive = stepper.integrate(start, t_end=3.0)
    assert np.abs(adaptive.variables[-1] - expected).max() < 1e-12


@pytest.mark.second
def test_a_gauge_that_depends_on_time() -> None:
    """theta_x = y (1 + sin(t)/2)/2 and theta_y = -x (1 + sin(t)/2)/2 require the term F_t in H."""
    text = "(1 + sin(t)/2)*(y + y**3/3)*x_dot/2 - (1 + sin(t)/2)*x*y_dot/2 - x**2/2 - y**2/2"
    driven = lagrange("driven", "x y", text)

    def right(t: float, state: np.ndarray) -> list[float]:
        x, y = state
        s, rate = 1 + math.sin(t) / 2, math.cos(t) / 2
        omega = s * (2 + y**2) / 2  # d theta_x / dy - d theta_y / dx
        return [(y - rate * x / 2) / omega, -(x + rate * (y + y**3 / 3) / 2) / omega]

    expected = solve_ivp(right, (0.0, 3.0), [1.0, 0.2], method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    run = sc.compile_stepper(driven, "svi:4").integrate([1.0, 0.2], h=0.1, steps=30)
    assert np.abs(run.variables[-1] - expected).max() < 1e-11


def test_velocities_where_a_pivot_vanishes() -> None:
    """The Jacobian of theta by (d, c) is regular, with a leading entry sin(t) that vanishes at t = 0 and pi."""
    text = "a_dot*(c + c*sin(b)/5 + d*sin(t)) + b_dot*(d + a*d/10) - (a**2 + b**2 + c**2 + d**2)/2 - c*d/3"
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("pivot", ["d", "a", "b", "c"], text), "svi:2")
    d, a, b, c = state = 0.5, 0.3, -0.2, 0.4
    for t in (0.0, 1e-17, 1e-15, 0.7, math.pi):
        transposed = [[1 + math.sin(b) / 5, 0.0], [math.sin(t), 1 + a / 10]]
        expected = np.linalg.solve(transposed, [c + d / 3, d + c / 3])
        run = stepper.integrate(state, h=1e-3, steps=0, t=t)
        assert run.velocity[0] == pytest.approx(expected, rel=1e-14)
    with pytest.raises(sc.StateError, match="singular"):
        _ = stepper.integrate((d, -10.0, b, c), h=1e-3, steps=0).velocity


@pytest.mark.rotated
def test_one_forms_that_depend_on_time_change_the_energy() -> None:
    """H changes by 20 %, without a warning that the motion amplifies errors; at rest in time it is conserved."""
    for factor, conserved in (("sin(t)", False), ("1/3", True)):
        text = f"(y + {factor}*y/2)*x_dot - (x**2 + y**2)/2"
        stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("swinging", ["x", "y"], text), "svi:4")
        assert stepper.interface.conserves_energy == conserved
        run = stepper.integrate([1.0, 0.2], t_end=10.0)  # warnings are errors
        assert (abs(run.energy() / run.energy()[0] - 1).max() < 1e-12) == conserved


@pytest.mark.rotated
def test_lotka_volterra_in_four_dimensions_agrees_with_the_published_reference() -> None:
    """GeometricProblems.jl, ``lotka_volterra_4d``: ``reference_solution`` at t = 100; in logarithms, sheared."""
    energy = "(exp({a}) + exp(b) + exp(c) + exp(d) - {a} - 2*b - c - d)"
    theta = "(b + d)*{a_dot} + c*b_dot + ({a} + d)*c_dot + b*d_dot - "
    found = r"omega\(a, b\) = -1, .* Put a \+ c in the place of a, .* omega vanishes between b and c"
    with pytest.raises(sc.SystemDefinitionError, match=found):
        sc.LagrangianSystem.from_text("prey", [*"abcd"], (theta + energy).format(a="a", a_dot="a_dot"))
    moved = (theta + energy).format(a="(a + c)", a_dot="(a_dot + c_dot)")
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("prey", [*"abcd"], moved), "svi:8")
    a, b, c, d = stepper.integrate([math.log(2.0), 0.0, 0.0, 0.0], h=0.05, steps=2000).variables[-1]
    published = [1.6390462434739954, 1.3764800055785835, 0.37903204434372284, 1.4399236281802124]
    assert np.abs(np.exp([a + c, b, c, d]) - published).max() < 1e-11


@pytest.mark.rotated
@pytest.mark.parametrize("size", ["3", "N"])
def test_arrays_of_vortices(size: str) -> None:
    pairs = f"sum(i in {size}, j in {size}, G[i]*G[j]*log((x[i] - x[j])**2 + (y[i] - y[j])**2 + 0.1))/(8*pi)"
    text = f"sum(i in {size}, G[i]*x[i]*y_dot[i]) + {pairs}"
    cloud = lagrange("vortices", [f"x[{size}]", f"y[{size}]"], text, parameters={f"G[{size}]": 1.0})
    start = {"x": [0.0, 1.0, 0.3], "y": [0.0, 0.2, 1.2]}
    run = sc.compile_stepper(cloud, "svi:2").integrate(start, h=0.1, steps=10)
    one = "+".join(f"x{i}*y{i}_dot" for i in range(3))
    potential = "+".join(f"log((x{i} - x{j})**2 + (y{i} - y{j})**2 + 0.1)/(4*pi)" for i, j in ((0, 1), (0, 2), (1, 2)))
    named = sc.LagrangianSystem.from_text("vortices", ["x0", "x1", "x2", "y0", "y1", "y2"], f"{one} + {potential}")
    expected = sc.compile_stepper(named, "svi:2").integrate([*start["x"], *start["y"]], h=0.1, steps=10)
    assert np.abs(run.variables - expected.variables).max() < 1e-14


@pytest.mark.rotated
def test_canonical_one_forms_use_the_fixed_point_iteration() -> None:
    oscillator = sc.LagrangianSystem.from_text("oscillator", ["x", "y"], "x*y_dot - x**2/2 - y**2/2")
    assert oscillator.is_canonical
    stepper = sc.compile_stepper(oscillator, "svi:4")
    assert stepper.interface.solver == "fixed-point"
    run = stepper.integrate({"x": 1.0, "y": 0.0}, h=0.1, steps=10)
    assert run.variables[-1] == pytest.approx([math.cos(1.0), math.sin(1.0)], abs=1e-13)


@pytest.mark.rotated
def test_states_by_name_and_in_order() -> None:
    stepper = sc.compile_stepper(system("guiding centre"), "svi:2")
    start = dict(zip("xyzu", CASES["guiding centre"][3], strict=True))
    run = stepper.integrate(start, h=0.1, steps=5)
    assert np.array_equal(run.variables, stepper.integrate(list(start.values()), h=0.1, steps=5).variables)
    assert np.array_equal(run.variables[0], list(start.values()))
    assert run.to_dataframe()["u"].iloc[-1] == run.variables[-1, 3]
    many = stepper.integrate_ensemble({**start, "x": [0.5, 0.6]}, h=0.1, steps=5)
    assert many.variables.shape == (6, 2, 4)
    assert np.abs(many.variables[-1, 0] - run.variables[-1]).max() < 1e-14
    restarted = stepper.integrate(run.q[-1], run.p[-1], h=-0.1, steps=5)
    assert np.abs(restarted.variables[-1] - run.variables[0]).max() < 1e-13


def test_the_choice_with_the_shortest_one_form_is_used() -> None:
    """The integral over x leaves -2*x*y for theta_y, that over y only y**2 for theta_x."""
    short = sc.LagrangianSystem.from_text("short", ["x", "y"], "(y + y**2)*x_dot + x*y_dot - x**2 - y**2")
    fields = short.coordinates, short.momenta, short.one_form, short.integrated, short.hamiltonian
    x, y = short.variables
    assert fields == ((x,), (y,), (y**2,), x * y, x**2 + y**2)


@pytest.mark.rotated
@pytest.mark.parametrize("name", ["Lotka-Volterra", "massless particle"])
def test_integrals_are_expanded_about_the_origins_of_the_lagrangian(name: str) -> None:
    """A motion at 1000 takes the steps of the same one at 0, also near an equilibrium, with errors of u |q|."""
    names, text, _, start = CASES[name]
    text = re.sub(r"\b([xy])\b", r"(\1 - 1000)", text)
    here, there = system(name), sc.LagrangianSystem.from_text("moved", names, text)
    moved = dict(zip(here.variables, (z - 1000 for z in there.variables), strict=True))
    assert there.one_form == tuple(each.xreplace(moved) for each in here.one_form)
    steppers = [sc.compile_stepper(each, "svi:2") for each in (here, there)]
    equilibrium = {"Lotka-Volterra": (1.0, 2.0), "massless particle": (0.0, 0.0)}[name]
    for state in (start, np.array(equilibrium) + 1e-3):
        ends: dict[float | None, list[np.ndarray]] = {}
        for tolerance in (None, 1e-6):
            runs = [
                stepper.integrate(np.array(state) + origin, t_end=2.0, tolerance=tolerance)
                for stepper, origin in zip(steppers, (0.0, 1000.0), strict=True)
            ]
            fewer, more = sorted(len(run.t) + run.rejected_steps for run in runs)
            assert more < 1.5 * fewer + 4
            ends[tolerance] = [runs[0].variables[-1], runs[1].variables[-1] - 1000]
        true = ends[None][0]
        assert np.abs(ends[None][1] - true).max() < 1e-11
        assert np.abs(ends[1e-6][1] - true).max() < 10 * np.abs(ends[1e-6][0] - true).max()


@pytest.mark.rotated
def test_velocities_are_refused_and_available() -> None:
    stepper = sc.compile_stepper(system("coupled"), "svi:2")
    start = CASES["coupled"][3]
    with pytest.raises(sc.StateError, match="velocities follow from the state: omit velocity"):
        stepper.integrate(start, velocity=[1.0, 1.0], h=0.1, steps=1)
    run = stepper.integrate(start, h=0.1, steps=1)
    expected = rates("coupled")(0.0, np.array(start))
    names = [*"xyab"]
    assert run.velocity[0] == pytest.approx([expected[names.index(name)] for name in stepper.coordinates], abs=1e-15)


@pytest.mark.rotated
def test_model_files(tmp_path) -> None:
    model = sc.Model(system=system("guiding centre"), method="svi:2", q=CASES["guiding centre"][3], h=0.1, span=1.0)
    sc.save_model(model, tmp_path / "model.toml")
    again = sc.load_model(tmp_path / "model.toml")
    assert np.array_equal(again.integrate().variables, model.integrate().variables)
    sc.generate_package(model, tmp_path / "generated")
    package = sc.load_package(tmp_path / "generated")
    assert np.array_equal(package.integrate(model.q, model.p, h=0.1, steps=10).variables, model.integrate().variables)


@pytest.mark.second
def test_inputs(tmp_path) -> None:
    driven = lagrange("driven", "x y", "(x + x**3)*y_dot - x**2/2 - y**2/2 - f*x - f**2*y", inputs="f")
    times = np.linspace(0.0, 2.0, 3)
    run = sc.compile_stepper(driven, "svi:4").integrate(
        [0.3, 0.2], h=0.05, steps=40, inputs={"f": (times, [0.0, 1.0, 0.0])}
    )

    def right(t: float, z: np.ndarray) -> list[float]:
        f = min(t, 2.0 - t)
        return [-(z[1] + f**2) / (1 + 3 * z[0] ** 2), (z[0] + f) / (1 + 3 * z[0] ** 2)]

    model = sc.Model(system=driven, method="svi:2", q=[0.3, 0.2], h=0.1, span=1.0)
    sc.save_model(model, tmp_path / "driven.toml")
    assert sc.load_model(tmp_path / "driven.toml").system == driven
    half = solve_ivp(right, (0.0, 1.0), [0.3, 0.2], method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    expected = solve_ivp(right, (1.0, 2.0), half, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]
    assert np.abs(run.variables[-1] - expected).max() < 1e-10
