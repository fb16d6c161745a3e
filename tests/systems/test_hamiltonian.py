"""Systems given by a Hamiltonian: reading them, Legendre's transform both ways, and steps in phase space.

A regular Hamiltonian must give the steps of its Lagrangian (identity 10), which the oracle checks elsewhere; a singular
one is checked against closed solutions and against a Runge-Kutta step written out here.
"""

import numpy as np
import pytest
import sympy
from notation import hamilton, lagrange

import scvi_codegen as sc
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.systems.legendre.transform import (
    equivalent_lagrangian,
    hamiltonian_of,
    lagrangian_of,
    positive_parameters,
)

QUICK = ("-O1", "-ffp-contract=off")
ROUND_OFF = 2e-14
METHODS = (
    sc.SVI(2, "gauss-legendre:4"),
    sc.SCVI(3),
    sc.SCVI(3, variational=False),
    sc.SCVI(3, abscissae="radau-iia"),
    sc.SpectralCollocation(3),
    sc.SpectralCollocation(3, form="phase-space"),
    sc.RadauIA(2),
    sc.LobattoIIIA(3, form="position"),
    sc.StoermerVerlet(),
    *(
        pytest.param(method, marks=pytest.mark.full)
        for method in (
            *(sc.SVI(3), sc.SVI(3, "clenshaw-curtis:4"), sc.SCVI(1), sc.SCVI(2, "gauss-lobatto:4"), sc.Gauss(2)),
            *(sc.Gauss(2, form="position"), sc.RadauIIA(3), sc.ExplicitEuler()),
        )
    ),
)


def hyperbolic() -> sc.HamiltonianSystem:
    """Return H = q p: q' = q, p' = -p; velocities do not determine momenta."""
    return sc.HamiltonianSystem.from_text(name="hyperbolic", coordinates=["q"], momenta=["p"], hamiltonian="q*p")


# Reading.


def test_text_and_sympy_define_equal_systems() -> None:
    text = hamilton("pendulum", "q", "p**2/(2*m) - cos(q) + 0.1*t", momenta="p", m=2)
    q, p, m, t = sympy.symbols("q p m t")
    own = sc.HamiltonianSystem.from_sympy(
        name="pendulum",
        coordinates=[q],
        momenta=[p],
        hamiltonian=p**2 / (2 * m) - sympy.cos(q) + 0.1 * t,
        parameters={m: 2},
    )
    T = sympy.Symbol("T")
    Q, P = sympy.Function("q")(T), sympy.Function("p")(T)
    functions = sc.HamiltonianSystem.from_sympy(
        name="pendulum",
        coordinates=[Q],
        momenta=[P],
        hamiltonian=P**2 / (2 * m) - sympy.cos(Q) + 0.1 * T,
        parameters={m: 2},
    )
    assert text == own == functions
    assert text.with_parameters(m=3.0).defaults == (3.0,)
    assert text._repr_latex_().startswith("$")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("hamiltonian =", "lagrangian =", "momenta and a lagrangian"),
        ('hamiltonian = "p*q"', 'hamiltonian = "p*q"\nlagrangian = "q"', "both lagrangian and hamiltonian"),
        ('hamiltonian = "p*q"', "", "no hamiltonian or lagrangian"),
        ('"p",', "1,", "momenta must be a list of names"),
    ],
)
def test_invalid_model_files_are_rejected(old: str, new: str, message: str) -> None:
    text = dump_model(sc.Model(system=hyperbolic(), method=sc.SVI(4), q=(1.0,), p=(2.0,), h=0.1, steps=5))
    assert old in text
    with pytest.raises(Exception, match=message):
        parse_model(text.replace(old, new))


# Legendre's transform.


@pytest.mark.parametrize(
    "name", ["kepler", "double-pendulum", "charged-particle", "cart-pole", "relativistic-particle"]
)
def test_legendre_transform_and_its_inverse(name: str) -> None:
    """At a random point: v = H_p and H = p . v - L; and the Lagrangian of the Hamiltonian is the first one again."""
    system = sc.problem(name).system
    assert isinstance(system, sc.LagrangianSystem)
    hamiltonian = hamiltonian_of(system)
    assert hamiltonian.is_regular
    again = lagrangian_of(hamiltonian)
    generator = np.random.default_rng(5)
    point = {
        symbol: sympy.Float(generator.uniform(0.2, 0.7), 40) for symbol in (*system.coordinates, *system.velocities)
    }
    point |= {symbol: sympy.Float(value, 40) for symbol, value in system.constants.items()}
    momenta = [sympy.diff(system.lagrangian, v).evalf(40, subs=point) for v in system.velocities]
    energy = sum(p * point[v] for p, v in zip(momenta, system.velocities, strict=True)) - system.lagrangian.evalf(
        40, subs=point
    )
    state = point | dict(zip(hamiltonian.momenta, momenta, strict=True))
    assert abs(hamiltonian.hamiltonian.evalf(40, subs=state) - energy) < 1e-30
    for p, v in zip(hamiltonian.momenta, system.velocities, strict=True):
        assert abs(sympy.diff(hamiltonian.hamiltonian, p).evalf(40, subs=state) - point[v]) < 1e-30
    assert abs(again.lagrangian.evalf(40, subs=point) - system.lagrangian.evalf(40, subs=point)) < 1e-30


def test_a_singular_hamiltonian_has_no_lagrangian() -> None:
    assert equivalent_lagrangian(hyperbolic()) is None


# Steps of regular Hamiltonians.


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.covering
@pytest.mark.parametrize("name", ["double-pendulum", "relativistic-particle"])
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_a_regular_hamiltonian_gives_the_steps_of_its_lagrangian(sample, name, method) -> None:
    """Identity 10, for every method: with Newton's iteration on (35), and with the fixed point."""
    system, h, t = sample(name).system, 0.13, 0.4
    q, p = sample(name).state
    expected = np.array(sc.compile_stepper(system, method, solver="newton", flags=QUICK).step(q, p, h, t))
    hamiltonian = hamiltonian_of(system)
    for solver in ("newton", "auto"):
        stepper = sc.compile_stepper(hamiltonian, method, solver=solver, flags=QUICK)
        assert np.abs(np.array(stepper.step(q, p, h, t)) - expected).max() < ROUND_OFF


@pytest.mark.second
def test_transforms_and_energy_are_those_of_the_lagrangian(sample) -> None:
    system = sample("double-pendulum").system
    one, two = (
        sc.compile_stepper(s, sc.SVI(2), solver="newton", flags=QUICK) for s in (system, hamiltonian_of(system))
    )
    q, p = sample("double-pendulum").state
    v = one.velocity(q, p)
    assert np.abs(two.velocity(q, p) - v).max() < ROUND_OFF
    assert np.abs(two.momentum(q, v) - p).max() < ROUND_OFF
    assert abs(two.energy(q, p) - one.energy(q, p)) < ROUND_OFF
    q1 = one.step(q, p, 0.1)[0]
    assert abs(two.discrete_lagrangian(q, q1, 0.1) - one.discrete_lagrangian(q, q1, 0.1)) < ROUND_OFF
    assert np.abs(two.discrete_legendre_minus(q, q1, 0.1)[1] - p).max() < 1e-12


# Singular Hamiltonians.


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("method", "error"),
    [
        (sc.SVI(4), 1e-14),
        (sc.Gauss(3), 1e-10),
        (sc.RadauIIA(3), 1e-8),
        (sc.SVI(3, "gauss-lobatto:3"), 1e-4),
        (sc.SpectralCollocation(5, form="phase-space"), 1e-9),
        (sc.StoermerVerlet(), 1e-2),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_hamiltonian_without_a_lagrangian(method, error) -> None:
    """q' = q, p' = -p; q p is a quadratic invariant, conserved by the symplectic methods to round-off."""
    stepper = sc.compile_stepper(hyperbolic(), method, flags=QUICK)
    run = stepper.integrate([1.0], [1.0], h=0.1, steps=10)
    assert abs(run.q[-1, 0] - np.e) < error
    assert abs(run.p[-1, 0] - 1 / np.e) < error
    if method.symplectic:
        assert np.abs(run.energy() - 1.0).max() < 1e-14


def test_a_singular_hamiltonian_has_no_momenta_of_velocities_and_no_discrete_lagrangian() -> None:
    stepper = sc.compile_stepper(hyperbolic(), sc.SVI(2), flags=QUICK)
    assert stepper.velocity([2.0], [5.0]) == 2.0
    with pytest.raises(sc.StateError, match="give p instead of velocity"):
        stepper.momentum([1.0], [1.0])
    with pytest.raises(sc.MethodError, match="discrete_lagrangian is not available without an action"):
        stepper.discrete_lagrangian([1.0], [1.1], 0.1)


def test_parameters_are_assumed_positive_if_their_values_are():
    """Roots of squares of other parameters have signs; a value of 0 does not determine the sign of others."""
    system = lagrange("signs", "q", "a*q_dot**2/2 - b*q - c*q**2", a=1.0, b=0.0, c=-1.0)
    assert [given.name for given in positive_parameters(system)] == ["a"]


@pytest.mark.rotated
def test_energy_error_is_relative_to_the_action_if_the_energy_starts_at_0():
    pair = sc.HamiltonianSystem.from_text("two spins", spins=["a", "b"], hamiltonian="a_1*b_1 + a_2*b_2")
    run = sc.compile_stepper(pair, sc.SVI(2)).integrate({"a": [1, 0, 0], "b": [0, 0.6, 0.8]}, h=0.1, steps=50)
    assert abs(run.energy()[0]) < 1e-15
    assert run.energy_error() < 1e-13


def test_the_hamiltonian_of_a_direction_has_its_energy():
    pendulum = lagrange("spherical pendulum", (), "(n_1_dot**2 + n_2_dot**2 + n_3_dot**2)/2 - n_3", directions=["n"])
    hamiltonian = hamiltonian_of(pendulum).hamiltonian  # expanded determinants took minutes
    n, v = np.array([0.36, 0.48, 0.8]), np.array([0.8, -0.6, 0.0])
    values = {f"n_{x}": a for x, a in zip("xyz", n, strict=True)} | {
        f"p_n_{x}": a for x, a in zip("xyz", v, strict=True)
    }
    energy = hamiltonian.subs({s: values[s.name] for s in hamiltonian.free_symbols})
    assert float(energy) == pytest.approx(0.5 + 0.8, rel=1e-14)
