"""Transformed time: L^ = g (L(q, q'/g) + E) and K = g (H - E), formulas of g, other coordinates."""

from functools import cache

import pytest
import sympy
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.exact.solution import ExactMotion, numbers
from scvi_codegen.systems.derived_expressions import sample_points
from scvi_codegen.systems.formulas.expressions import evaluate
from scvi_codegen.systems.formulas.symbols import symbol

KEPLER = lagrange("Kepler", "x y", "m*(x_dot**2 + y_dot**2)/2 + m*mu/sqrt(x**2 + y**2)", m=0.75, mu=1.25)
CHARGED = lagrange(
    "charged particle", "x y", "(2*x_dot**2 + x_dot*y_dot + 3*y_dot**2)/2 + x*y_dot - y**2*x_dot - x**4 - cos(y)"
)
THREE_BODIES = sc.LagrangianSystem.from_text(
    name="three softened bodies on a line",
    coordinates=["a", "b", "c"],
    lagrangian="""(a_dot**2 + 2*b_dot**2 + 3*c_dot**2)/2
        + 2/sqrt((a - b)**2 + 1) + 3/sqrt((a - c)**2 + 1) + 6/sqrt((b - c)**2 + 1)""",
)
TIME_RESCALINGS = (
    (KEPLER, "frequency"),
    (KEPLER, "distance"),
    (KEPLER, "potential"),
    (KEPLER, "m*sqrt(x**2 + y**2)"),
    (CHARGED, "1/(1 + x**2 + y**2)"),
)
CASES = [pytest.param(system, g, id=f"{system.name}: {g}") for system, g in TIME_RESCALINGS]


@cache
def transformed(system: sc.LagrangianSystem, g: str) -> sc.LagrangianSystem:
    found = sc.reparametrise(system, g)
    assert isinstance(found, sc.LagrangianSystem)
    return found


@pytest.mark.parametrize(("system", "g"), CASES)
def test_lagrangian_is_rate_times_lagrangian_and_energy(system: sc.LagrangianSystem, g: str) -> None:
    hat = transformed(system, g)
    assert hat.clock is not None
    for point in sample_points(system.velocities, system.coordinates, system.constants):
        energy = mp.mpf("-0.3125")
        rate = evaluate(hat.clock.rate, point)
        slowed = point | {v: point[v] / rate for v in system.velocities}
        value = evaluate(hat.lagrangian, point | {hat.clock.energy: energy})
        expected = rate * (evaluate(system.lagrangian, slowed) + energy)
        assert abs(value - expected) <= mp.mpf(10) ** -50 * (1 + abs(expected))


@pytest.mark.parametrize(("system", "g"), CASES)
def test_velocities_and_forces_are_those_of_the_system_times_the_rate(system: sc.LagrangianSystem, g: str) -> None:
    """Hamilton's equations on the level of the energy, so that the orbits are the same; to 45 digits."""
    hat, own = transformed(system, g), ExactMotion(system)
    for q, p in ((("0.75", "0.5"), ("-0.25", "0.5")), (("-1.5", "0.125"), ("2", "-1"))):
        state = numbers(q), numbers(p), mp.zero
        moved = ExactMotion(hat, [*map(mp.mpf, system.defaults), own.energy(*state)])
        place = dict(zip(system.coordinates, state[0], strict=True)) | system.constants
        rate = evaluate(hat.clock.rate, place)
        for found, expected in zip(moved.rates(*state), own.rates(*state), strict=True):
            assert max(abs(found - rate * expected)) < mp.mpf(10) ** -40
        assert abs(moved.energy(*state)) < mp.mpf(10) ** -40


@pytest.mark.parametrize(("system", "g"), CASES)
def test_hamiltonian_and_lagrangian_transformations_are_equivalent(system: sc.LagrangianSystem, g: str) -> None:
    hat = sc.hamiltonian_of(transformed(system, g))
    given = sc.reparametrise(sc.hamiltonian_of(system), hat.clock.rate)
    assert isinstance(given, sc.HamiltonianSystem)
    assert given.clock == hat.clock
    for point in sample_points(hat.momenta, hat.coordinates, hat.constants | {hat.clock.energy: -0.25}):
        one, other = evaluate(hat.hamiltonian, point), evaluate(given.hamiltonian, point)
        assert abs(one - other) <= mp.mpf(10) ** -50 * (1 + abs(one))


def test_named_time_transformations_of_keplers_problem() -> None:
    x, y, m, mu = map(symbol, ("x", "y", "m", "mu"))
    square = x**2 + y**2
    for name, expected in (
        ("frequency", square ** sympy.Rational(3, 4) / sympy.sqrt(mu)),
        ("distance", square ** sympy.Rational(3, 4)),
        ("potential", sympy.sqrt(square) / (m * mu)),
    ):
        rate = transformed(KEPLER, name).clock.rate
        for point in sample_points((x,), (y,), KEPLER.constants):
            assert abs(evaluate(rate / expected, point) - 1) < mp.mpf(10) ** -50, name


def test_distances_are_found_in_the_potential() -> None:
    rate = transformed(THREE_BODIES, "distance").clock.rate
    a, b, c = THREE_BODIES.coordinates
    pairs = ((a - b) ** 2 + 1, (a - c) ** 2 + 1, (b - c) ** 2 + 1)
    point = {a: mp.mpf(1), b: mp.mpf("1.25"), c: mp.mpf(3)}
    expected = mp.fsum(evaluate(square, point) ** mp.mpf("-1.5") for square in pairs) ** mp.mpf("-0.5")
    assert abs(evaluate(rate, point) - expected) < mp.mpf(10) ** -50


def test_arclength_is_that_of_the_curve_in_phase_space() -> None:
    system = sc.HamiltonianSystem.from_text(name="pendulum", coordinates=["q"], hamiltonian="p_q**2/2 - cos(q)")
    q, p = map(symbol, ("q", "p_q"))
    assert sc.reparametrise(system, "arclength").clock.rate == (p**2 + sympy.sin(q) ** 2) ** sympy.Rational(-1, 2)


def test_levi_civita_s_coordinates_make_an_oscillator() -> None:
    plane = sc.change_coordinates(
        transformed(KEPLER, "sqrt(x**2 + y**2)"), {"x": "u**2 - w**2", "y": "2*u*w"}, coordinates=["u", "w"]
    )
    u, w, m, mu, energy = map(symbol, ("u", "w", "m", "mu", "E"))
    rates = sum(v**2 for v in plane.velocities)
    oscillator = 2 * m * rates + energy * (u**2 + w**2) + m * mu
    for point in sample_points(plane.velocities, plane.coordinates, KEPLER.constants | {energy: -0.5}):
        assert abs(evaluate(plane.lagrangian - oscillator, point)) < mp.mpf(10) ** -50
        assert abs(evaluate(plane.clock.rate - u**2 - w**2, point)) < mp.mpf(10) ** -50


def test_energy_parameter_has_an_unused_name() -> None:
    system = lagrange("beam", "q", "q_dot**2/2 - E*q**4", E=1.0)
    assert sc.reparametrise(system, "1/(1 + q**2)").clock.energy.name == "E_0"
