"""Symmetries that are found, those that are refused, and what compiled runs conserve of their momentum maps."""

import re
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import sympy
from notation import hamilton, lagrange
from sympy import Symbol

import scvi_codegen as sc
from scvi_codegen.interfaces.models.systems import point_vortices
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.symmetry import invariants
from scvi_codegen.systems.symmetry.symmetry import Symmetry, all_symmetries, symmetries
from scvi_codegen.systems.system import MechanicalSystem

ROUNDOFF = 3e-14


def particle(potential: str = "0", axes: str = "xy", **parameters: float) -> sc.LagrangianSystem:
    """One mass m, kinetic energy less a potential."""
    kinetic = " + ".join(f"{axis}_dot**2" for axis in axes)
    return lagrange("particle", list(axes), f"m*({kinetic})/2 - ({potential})", parameters={"m": 1.3} | parameters)


def bodies(axes: str = "xy", *, gravity: bool = False, names: str = "abc") -> sc.LagrangianSystem:
    """Three masses that attract each other, softly, perhaps falling."""
    pairs = combinations(names, 2)
    terms = [f"m_{b}*({' + '.join(f'{b}_{axis}_dot**2' for axis in axes)})/2" for b in names]
    terms += [
        f"G*m_{b}*m_{c}/sqrt(1 + {' + '.join(f'({b}_{axis} - {c}_{axis})**2' for axis in axes)})" for b, c in pairs
    ]
    if gravity:
        terms += [f"-m_{b}*g*{b}_y" for b in names]
    return sc.LagrangianSystem.from_text(
        name="bodies",
        coordinates=[f"{b}_{axis}" for b in names for axis in axes],
        lagrangian=" + ".join(terms).replace("+ -", "- "),
        parameters={"G": 1.0, "g": 0.7} | {f"m_{b}": 1.0 + k for k, b in enumerate(names)},
    )


MAGNETIC = "m*(x_dot**2 + y_dot**2 + z_dot**2)/2 + e*B*x*y_dot + e*E*x"


def magnetic(e_field: float = 0.3) -> sc.LagrangianSystem:
    """A charge in crossed constant fields."""
    return lagrange("crossed fields", "x y z", MAGNETIC, m=1.3, e=0.7, B=1.1, E=e_field)


def formulas(system: MechanicalSystem) -> dict[str, str]:
    return {symmetry.name: symmetry.formula for symmetry in symmetries(system)}


# What is found.


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("kepler", ["angular momentum"]),
        ("henon-heiles", []),
        ("duffing", []),
        ("harmonic-oscillator", []),
        ("spherical-pendulum", ["momentum of phi"]),
        ("cart-pole", ["momentum of x"]),
        ("double-pendulum", []),
        ("relativistic-particle", []),
        ("charged-particle", ["momentum of y", "momentum of z", "boost of z"]),
        ("outer-solar-system", [f"{k}{a}" for k in ("linear momentum ", "angular momentum ", "boost ") for a in "xyz"]),
        ("point-vortices", ["momentum of all coordinates", "linear invariant", "quadratic invariant"]),
        ("fput-chain", []),
    ],
)
def test_symmetries_of_the_catalogue_are_found(name, expected):
    assert [symmetry.name for symmetry in symmetries(sc.problem(name).system)] == expected


def test_symmetries_of_a_central_force_in_space():
    assert formulas(particle("k/sqrt(x**2 + y**2 + z**2)", "xyz", k=1.0)) == {
        "angular momentum x": "y*p_z - z*p_y",
        "angular momentum y": "z*p_x - x*p_z",
        "angular momentum z": "x*p_y - y*p_x",
    }


def test_symmetries_of_a_free_particle():
    assert formulas(particle()) == {
        "momentum of x": "p_x",
        "momentum of y": "p_y",
        "angular momentum": "x*p_y - y*p_x",
        "boost of x": "m*x - p_x*t",
        "boost of y": "m*y - p_y*t",
    }


def test_long_decimal_numbers_are_exact():
    system = sc.LagrangianSystem.from_text(name="measured", coordinates=["x"], lagrangian="1.00000597682*x_dot**2/2")
    assert symmetries(system)[1].momentum_map.coeff(Symbol("x", real=True)) == sympy.Rational("1.00000597682")


def test_symmetries_in_other_linear_coordinates():
    """Kepler's problem in x = 2 u + w, y = u - 3 w: the rotation has no simple form there."""
    system = lagrange(
        "skew", "u w", "((2*u_dot + w_dot)**2 + (u_dot - 3*w_dot)**2)/2 + 1/sqrt((2*u + w)**2 + (u - 3*w)**2)"
    )
    assert formulas(system) == {"linear symmetry of u, w": "u*p_u + 5*u*p_w - 10*w*p_u - w*p_w"}


def test_very_small_force_breaks_a_symmetry():
    assert symmetries(particle("1/sqrt(x**2 + y**2) + 1e-14*x")) == ()


def test_magnetic_fields_have_gauges():
    found = {symmetry.name: symmetry for symmetry in symmetries(magnetic())}
    assert list(found) == ["momentum of x", "momentum of y", "momentum of z", "angular momentum z", "boost of z"]
    assert found["momentum of x"].formula == "p_x - B*e*y - E*e*t"
    assert str(found["momentum of x"].gauge) == "B*e*y + E*e*t"
    assert found["momentum of x"].direction == (1, 0, 0)


def test_more_than_twelve_coordinates_are_searched_together():
    chain = " ".join(f"+ cos(q{k} - q{(k + 1) % 14})" for k in range(14))
    kinetic = " + ".join(f"M*q{k}_dot**2/2" for k in range(14))
    closed = lagrange("closed chain", [f"q{k}" for k in range(14)], f"{kinetic} {chain}", M=2.0)
    assert list(formulas(closed)) == ["momentum of all coordinates", "boost of all coordinates"]
    assert formulas(closed)["boost of all coordinates"].startswith("M*q0 + M*q1 + M*q2 ")
    loose = lagrange("cyclic ones", [f"q{k}" for k in range(14)], f"{kinetic} + cos(q1) + q2**2 * q3_dot**2", M=2.0)
    assert "momentum of q3" in formulas(loose)
    assert "momentum of q1" not in formulas(loose)


@pytest.mark.parametrize(
    "text",
    [
        "exp(c*t)*(x_dot**2 + y_dot**2 - x**2 - 2*y**4)/2",
        "(1 + c*cos(t))*(x_dot**2 + y_dot**2)/2 - x**2/2 - y**4",
        "(x_dot**2 + y_dot**2)/2 - x**4 - c*y**4",
        "(x_dot**2 + y_dot**2)/2 - (x**2 + y**2)**2 - 1e-6*c*x*y",
    ],
)
def test_systems_without_symmetries(text):
    system = sc.LagrangianSystem.from_text(name="none", coordinates=["x", "y"], lagrangian=text, parameters={"c": 0.1})
    assert symmetries(system) == ()


@pytest.mark.parametrize("sum_", ["1e300 - m", "atanh(m) + m", "(m - 9)**1.5 + 1"])
def test_sum_of_parameters_without_a_value_does_not_hide_a_symmetry(sum_):
    """The sum might stand in a coefficient, so it is tried as a factor of one."""
    system = lagrange("sums", "q x", f"(q_dot**2 + x_dot**2)/2 + {sum_}", m=0.5)
    assert "p_q" in formulas(system).values()


def test_parameter_with_default_zero_breaks_symmetries():
    """Momentum maps are compiled for all values of the parameters."""
    assert symmetries(particle("(x**2 + y**2)**2 + eps*x**4", eps=0.0)) == ()


def test_a_hamiltonian_has_the_symmetries_of_its_lagrangian():
    for system in (particle("m*g*y", g=2.0), magnetic(), sc.problem("kepler").system):
        assert formulas(sc.hamiltonian_of(system)) == formulas(system)


def phase_space(hamiltonian: str, coordinates: str, momenta: str, **parameters: float) -> sc.HamiltonianSystem:
    return hamilton("phase space", coordinates.split(), hamiltonian, momenta=momenta.split(), parameters=parameters)


ROTATOR = phase_space("(x**2 + p**2)**2/4", "x", "p")
CYLINDER = phase_space(
    "(log((x1**2 + y1**2 - 1)*(x2**2 + y2**2 - 1)/((x1 - x2)**2 + (y1 - y2)**2))"
    " + log((x1*x2 + y1*y2 - 1)**2 + (x1*y2 - x2*y1)**2))/(4*pi)",
    "x1 x2",
    "y1 y2",
)
"""Two vortices of strength 1 outside a cylinder of radius 1, with their images."""


def test_symmetries_that_mix_positions_and_momenta():
    assert formulas(ROTATOR) == {"quadratic invariant": "x**2 + p**2"}
    assert formulas(CYLINDER) == {"quadratic invariant": "x1**2 + x2**2 + y1**2 + y2**2"}
    isotropic = phase_space("(p**2 + r**2)/(2*m) + k*(x**2 + y**2)/2", "x y", "p r", m=1.3, k=2.0)
    assert formulas(isotropic) == {
        "angular momentum": "x*r - y*p",
        "quadratic invariant": "k*m*x*y + p*r",
        "quadratic invariant (2)": "k*m*x**2 + p**2",
    }  # with the energy, Fradkin's tensor


def rate(system: MechanicalSystem, symmetry: Symmetry) -> sympy.Expr:
    """dJ/dt along a motion, by SymPy's own derivatives: accelerations from the Euler-Lagrange equations, solved."""
    at = dict(zip(symmetry.momenta, forms_of(system).momentum, strict=True))
    J = symmetry.momentum_map
    terms = [J.diff(p) * f for p, f in zip(symmetry.momenta, forms_of(system).force, strict=True)]
    terms += [J.diff(q) * v for q, v in zip(system.coordinates, system.velocities, strict=True)]
    return sympy.simplify((sympy.Add(*terms) + J.diff(system.time)).subs(at))


@pytest.mark.parametrize("system", [particle("m*g*y", g=9.81), magnetic(), particle("1/sqrt(x**2 + y**2)")], ids=str)
def test_each_momentum_map_is_conserved_identically(system):
    found = symmetries(system)
    assert found
    assert forms_of(system).euler_lagrange
    for symmetry in found:
        assert rate(system, symmetry) == 0
        products = [p * xi for p, xi in zip(symmetry.momenta, symmetry.direction, strict=True)]
        assert sympy.expand(sympy.Add(*products) - symmetry.gauge - symmetry.momentum_map) == 0


# What is given.


def test_supplied_directions_are_checked():
    kepler = sc.problem("kepler").system
    x, y = kepler.coordinates
    for direction in (["-q2", "q1"], [-y, x], [-Symbol("q2"), Symbol("q1")]):
        assert sc.check_symmetry(kepler, direction).formula == "q1*p_q2 - q2*p_q1"
    assert sc.check_symmetry(particle("m*g*y", g=9.81), [0, "-t"]).formula == "m*y - p_y*t - g*m*t**2/2"
    assert sc.check_symmetry(sc.hamiltonian_of(kepler), ["-q2", "q1"]).formula == "q1*p_q2 - q2*p_q1"


def test_supplied_generators_are_checked():
    assert sc.check_symmetry(ROTATOR, generator="x**2 + p**2").direction == (2 * Symbol("p", real=True),)
    assert sc.check_symmetry(CYLINDER, generator="x1**2 + y1**2 + x2**2 + y2**2", name="impulse").name == "impulse"
    kepler = sc.problem("kepler").system
    lenz = sc.check_symmetry(kepler, generator="(q1*p_q2 - q2*p_q1)*p_q2 - mu*q1/sqrt(q1**2 + q2**2)")
    assert sympy.simplify(rate(kepler, lenz)) == 0
    turned = sum(p * xi for p, xi in zip(lenz.momenta, lenz.direction, strict=True)) - lenz.gauge
    assert sympy.expand(turned - lenz.momentum_map) == 0


WRONG_GENERATORS = {
    "'y' is not a coordinate, momentum, time or parameter": {"generator": Symbol("y")},
    "a generator may on momenta": {"direction": [Symbol("p")]},
}


@pytest.mark.parametrize("message", WRONG_GENERATORS)
def test_wrong_generator_is_rejected_with_its_rate(message):
    with pytest.raises(sc.SystemDefinitionError, match=re.escape(message)):
        sc.check_symmetry(ROTATOR, **WRONG_GENERATORS[message])


HALF, QUARTER = Fraction(1, 2), Fraction(1, 4)
DIAGONAL = Tableau(name="two midpoints", A=((QUARTER, 0), (HALF, QUARTER)), b=(HALF, HALF), c=(QUARTER, 3 * QUARTER))
"""Symplectic, of order 2 with two stages: no method of Gauss."""


@pytest.mark.parametrize(
    ("method", "polynomials", "curve", "quadrature"),
    [
        (sc.Gauss(2), 2, 2, 4),
        (sc.Gauss(3), 2, 3, 6),
        (sc.RungeKutta(DIAGONAL), 2, -1, -1),
        (sc.RadauIIA(2), 1, -1, -1),
        (sc.LobattoIIIA(3), 1, -1, -1),
        (sc.Gauss(2, form="position"), 0, -1, -1),
        (sc.SVI(3), 2, 3, 6),
        (sc.SVI(2, "gauss-lobatto:3"), 0, 2, 4),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_conservation_claims_of_methods(method, polynomials, curve, quadrature):
    """GNI, theorems IV.2.1 and IV.2.2; Gauss methods are variational, their curves of degree s."""
    claim = method.exactness
    assert (claim.polynomials, claim.curve, claim.quadrature) == (polynomials, curve, quadrature)


def test_user_defined_gauge():
    cart = sc.problem("cart-pole").system
    found = sc.check_symmetry(cart, ["t", 0], gauge="(M + m)*x + m*l*sin(theta)", name="centre of mass")
    assert str(found) == "centre of mass = -l*m*sin(theta) + p_x*t - x*(M + m)"
    assert not sc.SVI(4).exactness.conserves(found)


GAUGED = {
    "periodic": ("x_dot**2/2 - k*x**2/2", ["cos(sqrt(k)*t)"], "sqrt(k)*x*sin(sqrt(k)*t) + p_x*cos(sqrt(k)*t)"),
    "growing": ("x_dot**2/2 + k*x**2/2", ["exp(sqrt(k)*t)"], "-sqrt(k)*x*exp(sqrt(k)*t) + p_x*exp(sqrt(k)*t)"),
    "transcendental in x": ("x_dot**2/2 + cos(x)*x_dot", ["1"], "p_x - cos(x) + 1"),
}


@pytest.mark.parametrize("name", GAUGED)
def test_a_gauge_that_is_not_quadratic_is_found(name):
    lagrangian, direction, expected = GAUGED[name]
    system = lagrange(name, "x", lagrangian, parameters={"k": 2.0} if "k*" in lagrangian else {})
    found = sc.check_symmetry(system, direction)
    assert str(found.momentum_map) == expected
    assert sc.check_symmetry(system, direction, gauge=found.gauge).momentum_map == found.momentum_map


@pytest.mark.rotated
def test_undecided_symmetries_are_not_denied():
    drift = "exp(x**2)*sin(x)"
    system = lagrange("drift", "x", f"x_dot**2/2 + {drift}*x_dot")
    with pytest.raises(sc.SystemDefinitionError, match=r"a symmetry of 'drift': .* Give f as gauge"):
        sc.check_symmetry(system, ["1"])
    assert sc.check_symmetry(system, ["1"], gauge=drift).gauge != 0


WRONG = {
    "'momentum' is not a coordinate, time or parameter": [Symbol("momentum"), 0],
    "text or a SymPy expression, not None": [None, 0],
}


@pytest.mark.parametrize("message", WRONG)
def test_wrong_direction_is_rejected_with_its_defect(message):
    with pytest.raises(sc.SystemDefinitionError, match=message):
        sc.check_symmetry(sc.problem("kepler").system, WRONG[message])


def test_wrong_gauge_is_rejected():
    with pytest.raises(sc.SystemDefinitionError, match=r"differs by .*, not 0"):
        sc.check_symmetry(particle(), ["t", 0], gauge="2*m*x")


def test_symmetry_of_another_system_or_with_a_used_name_is_rejected():
    kepler = sc.problem("kepler").system
    with pytest.raises(sc.SystemDefinitionError, match="of another system"):
        all_symmetries(kepler, [symmetries(particle())[0]])
    with pytest.raises(sc.SystemDefinitionError, match="two symmetries are called 'angular momentum'"):
        all_symmetries(kepler, symmetries(kepler))


# Compiled, tracked, shown.


SYSTEMS = {
    "fields": (magnetic(), [0.3, 0.2, 0.1], [0.5, 0.4, 0.2]),
    "falling": (particle("m*g*y", g=2.1), [0.3, 0.2], [0.5, 0.4]),
    "bodies": (bodies(gravity=True), [0.0, 0.1, 4.0, 0.2, -0.5, 5.9], [0.1, 0.4, -0.2, 1.1, 1.3, -0.8]),
    "vortices": (point_vortices(3), [-0.5, 0.5, -0.25], [0.1, 0.2, -0.1]),
}
EXACT = [
    *(
        ("fields", m)
        for m in (sc.SVI(2), sc.SVI(3, "gauss-legendre:4"), sc.SCVI(3), sc.Gauss(2), sc.SVI(2, "gauss-lobatto:3"))
    ),
    *(("falling", m) for m in (sc.SVI(3), sc.SCVI(2), sc.StoermerVerlet(), sc.Composition(8), sc.Gauss(3))),
    *(("bodies", m) for m in (sc.SVI(4), sc.SVI(1), sc.StoermerVerlet())),
    ("vortices", sc.SVI(3)),
]


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(7)
@pytest.mark.parametrize(("name", "method"), EXACT, ids=lambda value: getattr(value, "name", value))
def test_claimed_conservation_is_measured(quickly_compiled, name, method):
    system, q, p = SYSTEMS[name]
    stepper = quickly_compiled(system, method)
    errors = np.abs(stepper.integrate(q, p, h=0.05, steps=400).momentum_errors()).max(axis=0)
    exact = np.array(stepper.interface.map_exact)
    assert exact.sum() >= 3
    assert errors[exact].max() < ROUNDOFF


@pytest.mark.parametrize("smallest", [0.0, 1e-12, 0.9e-9, 1.1e-9, 1e-6, 1.0])
def test_only_large_singular_values_are_called_large(smallest):
    rng = np.random.default_rng(7)
    left, right = (np.linalg.qr(rng.normal(size=(size, size)))[0] for size in (50, 40))
    matrix = left[:, :40] * np.append(np.geomspace(1.0, max(smallest, 1e-3), 39), smallest) @ right
    message_text = invariants._all_larger(matrix, 1e-9)
    assert not message_text or smallest > 1e-9
    assert message_text or smallest < 1e-6
