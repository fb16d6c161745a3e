"""Forced motion: the order of every method is that without forces, momentum maps unaffected by forces are conserved.

The reference is SciPy's DOP853 on accelerations that SymPy solves for, which shares nothing with the package.
"""

from functools import cache

import numpy as np
import pytest
import sympy
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc

SPAN = 2.0


@cache
def cart_pole():
    """A motor on the cart, friction in the joint, drag by the square of the cart's speed."""
    return sc.LagrangianSystem.from_text(
        name="cart and pole with a motor",
        coordinates=["x", "theta"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*theta_dot*cos(theta) + m*l**2*theta_dot**2/2 + m*g*l*cos(theta)",
        parameters={"M": 2.0, "m": 1.0, "l": 0.8, "g": 3.0, "b": 0.3, "c": 0.4, "F": 1.5, "w": 1.7},
        forces={"x": "F*sin(w*t) - b*x_dot**3 - b*x*theta_dot"},
        dissipation="c*theta_dot**2*(1 + x**2)/2",
    )


@cache
def radial():
    """Friction along the radius, a mass that depends on place: no torque."""
    drag = "-c*{0}*(x*x_dot + y*y_dot)*(1 + x_dot**2 + y_dot**2)/(x**2 + y**2)"
    return sc.LagrangianSystem.from_text(
        name="radial friction",
        coordinates=["x", "y"],
        lagrangian="(x_dot**2 + y_dot**2)*(1 + x**2 + y**2)/2 + 1/sqrt(x**2 + y**2)",
        parameters={"c": 0.3},
        forces={"x": drag.format("x"), "y": drag.format("y")},
    )


STATES = {cart_pole: ((0.3, 1.1), (0.5, -0.4)), radial: ((1.0, 0.1), (0.3, 0.8))}


@cache
def reference(build):
    system, (q, v) = build(), STATES[build]
    L, speeds, places, t = system.lagrangian, system.velocities, system.coordinates, system.time
    mass = sympy.Matrix([[L.diff(a, b) for a in speeds] for b in speeds])
    right = [
        L.diff(x) + f - sum(L.diff(u, y) * v for y, v in zip(places, speeds, strict=True)) - L.diff(u, t)
        for x, u, f in zip(places, speeds, system.forces, strict=True)
    ]
    accelerations = mass.LUsolve(sympy.Matrix(right)).subs(system.constants)
    rates = sympy.lambdify((t, *places, *speeds), list(accelerations))
    m = len(q)
    run = solve_ivp(
        lambda time, z: [*z[m:], *rates(time, *z)], (0.3, 0.3 + SPAN), [*q, *v], method="DOP853", rtol=1e-13, atol=1e-14
    )
    return run.y[:m, -1]


def derivative(stepper, build, counts):
    q, v = STATES[build]
    errors = []
    for count in counts:
        run = stepper.integrate(q, velocity=v, h=SPAN / count, steps=count, save_every=count, t=0.3)
        errors.append(float(np.linalg.norm(run.q[-1] - reference(build))))
    return np.log2(errors[0] / errors[1]), errors


QUICK = [
    (sc.SVI(3), 6, (20, 40)),
    (sc.SVI(2, "gauss-lobatto:3"), 4, (40, 80)),
    (sc.SCVI(3), 6, (20, 40)),
    (sc.SpectralCollocation(4), 4, (40, 80)),
]
FULL = [
    (sc.SVI(1), 2, (80, 160)),
    (sc.SVI(4), 8, (10, 20)),
    (sc.SVI(4, "gauss-legendre:6"), 8, (7, 14)),
    (sc.SCVI(1), 2, (80, 160)),
    (sc.SCVI(2), 4, (40, 80)),
    (sc.SCVI(4), 8, (10, 20)),
    (sc.SCVI(3, abscissae="gauss"), 6, (20, 40)),
    (sc.SCVI(3, nodes="legendre-lobatto"), 6, (20, 40)),
    (sc.SpectralCollocation(3, form="phase-space"), 3, (80, 160)),
    (sc.Gauss(2), 4, (40, 80)),
    (sc.Gauss(3, form="position"), 6, (20, 40)),
    (sc.RadauIIA(3), 5, (40, 80)),
    (sc.LobattoIIIA(3), 4, (40, 80)),
    (sc.ChebyshevGauss(3), 4, (40, 80)),
    (sc.StoermerVerlet(), 2, (160, 320)),
]


def named(case):
    return case[0].name


@pytest.mark.tiers(1, 2)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("case", QUICK, ids=named)
def test_order_is_that_without_forces(quickly_compiled, case):
    method, order, counts = case
    assert method.order == order
    found, errors = derivative(quickly_compiled(cart_pole(), method), cart_pole, counts)
    assert found == pytest.approx(order, abs=0.25), errors


@pytest.mark.full
@pytest.mark.parametrize("case", FULL, ids=named)
def test_order_of_every_method_is_that_without_forces(quickly_compiled, case):
    method, order, counts = case
    assert method.order == order
    for build in (cart_pole, radial):
        found, errors = derivative(quickly_compiled(build(), method), build, counts)
        assert found == pytest.approx(order, abs=0.3 if order < 8 else 0.7), errors


@pytest.mark.full
@pytest.mark.parametrize(
    "method", [sc.SVI(3), sc.Gauss(3), sc.SpectralCollocation(4, form="phase-space")], ids=lambda m: m.name
)
def test_hamiltonian_with_forces_has_the_same_step(quickly_compiled, method):
    system = radial()
    own, other = (quickly_compiled(each, method) for each in (system, sc.hamiltonian_of(system)))
    q, v = STATES[radial]
    p = own.momentum(q, v)
    for one, two in zip(own.step(q, p, 0.1), other.step(q, p, 0.1), strict=True):
        np.testing.assert_allclose(one, two, rtol=3e-15)


def test_compositions_accept_forces_of_position_and_time(quickly_compiled):
    """x'' = -x + sin(2 t): the solution from rest is (2 sin t - sin 2t) / 3."""
    system = lagrange("pushed", "x", "x_dot**2/2 - x**2/2", forces={"x": "sin(2*t)"})
    errors = []
    for count in (4, 8):
        run = quickly_compiled(system, sc.Composition(8)).integrate([0.0], [0.0], h=SPAN / count, steps=count)
        errors.append(abs(run.q[-1, 0] - (2 * np.sin(SPAN) - np.sin(2 * SPAN)) / 3))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(8, abs=0.4), errors
