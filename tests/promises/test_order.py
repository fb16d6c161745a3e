"""The claimed order of a method is the slope of its global error over the step size in logarithms."""

from functools import cache

import numpy as np
import pytest
from notation import lagrange
from tiers import family, first_of_each

import scvi_codegen as sc
from scvi_codegen.extras.verification.certificate import Outcome
from scvi_codegen.extras.verification.convergence import convergence_checks
from scvi_codegen.extras.verification.system_under_test import State, SystemUnderTest

PLATEAU = 1e-11
"""Errors below are left out; round-off and the reference contribute up to 1e-13."""
SPANS = {"kepler": 6.0, "planar-pendulum": 6.0}
SPAN = 2.0
"""Of other systems, most with time, forces or damping."""
LOW_ORDER = 2
LOW_ORDER_SPAN = 1.0
"""Longer runs of a first-order method fall into the centre of attraction."""
COUNTS = tuple(int(12 * 1.25**k) for k in range(27))


@cache
def reference(compiled, sample, name, span):
    """Gauss's method of order 16, with steps so short that its error is round-off."""
    run = compiled(name, sc.Gauss(8)).integrate(*sample(name).state, h=span / 300, steps=300, t=0.3)
    return np.concatenate([run.q[-1], run.p[-1]])


def global_error(compiled, sample, name, method, span, count):
    run = compiled(name, method).integrate(*sample(name).state, h=span / count, steps=count, save_every=count, t=0.3)
    return np.linalg.norm(np.concatenate([run.q[-1], run.p[-1]]) - reference(compiled, sample, name, span))


def measured_order(compiled, sample, name, method):
    """Return the slope through the smallest steps (at most three) whose error is above round-off."""
    span = LOW_ORDER_SPAN if (method.order or 1) <= LOW_ORDER else SPANS.get(name, SPAN)
    errors = []
    for count in COUNTS:
        error = global_error(compiled, sample, name, method, span, count)
        if error < PLATEAU:
            break
        errors.append(error)
    used = slice(max(0, len(errors) - 3), len(errors))
    assert len(errors) >= 2
    return -np.polyfit(np.log(COUNTS[used]), np.log(errors[used]), 1)[0]


def pair(name, method):
    """Return a case of a test of systems and methods."""
    return pytest.param(name, method, id=f"{name}-{method.name}")


DERIVATIVES = ("hermite:2", "hermite:3")
"""Quadratures with derivatives of L."""
PLACES = (None, "gauss", "lobatto-iiia")

SPECIAL = (
    *(sc.SVI(s, rule) for s in (1, 2, 3) for rule in DERIVATIVES),
    *(sc.SCVI(s, rule, abscissae=at) for s in (2, 3) for rule in DERIVATIVES for at in PLACES),
    sc.SCVI(1, "hermite:2"),
    *(sc.SVI(s, space="splines:2") for s in (2, 3, 4)),
    sc.SVI(2, "gauss-lobatto:3", space="splines:2"),
)
METHODS = (
    *SPECIAL[1::4], *(sc.SVI(s, f"gauss-legendre:{g}") for s in (1, 2, 3, 4, 5) for g in (s, s + 1)),
    *(sc.SVI(s, f"gauss-lobatto:{g}") for s in (2, 4) for g in (s, s + 1)), sc.SVI(1, "gauss-lobatto:2"),
    sc.SVI(3, "clenshaw-curtis:4"), sc.SVI(3, "clenshaw-curtis:5"), sc.SVI(3, "fejer:4"),
    sc.SVI(4, "clenshaw-curtis:4"), sc.SVI(5, "clenshaw-curtis:5"), sc.SVI(3, "gauss-radau-left:3"),
    sc.SVI(2, "gauss-radau-right:2"), *(sc.SCVI(s) for s in (1, 2, 3, 4, 5)), sc.SCVI(2, "gauss-legendre:3"),
    sc.SCVI(2, abscissae="gauss"), sc.SCVI(3, abscissae="radau-iia"), sc.SCVI(3, abscissae="chebyshev-gauss"),
    sc.SCVI(3, "gauss-legendre:2"), sc.SCVI(3, "gauss-lobatto:3"), sc.SCVI(3, nodes="equispaced"),
    *(sc.SpectralCollocation(s, form=form) for s in (1, 2, 3, 4, 5) for form in ("position", "phase-space")),
    sc.SpectralCollocation(3, nodes="legendre-lobatto"), *(sc.Gauss(s) for s in (1, 2, 3, 4, 5)),
    *(sc.RadauIIA(s) for s in (1, 2, 3, 4, 5)), *(sc.RadauIA(s) for s in (1, 2, 3, 4, 5)),
    *(sc.LobattoIIIA(s) for s in (2, 3, 4, 5)), *(sc.ChebyshevGauss(s) for s in (1, 2, 3, 4, 5)),
    *(sc.ChebyshevLobatto(s) for s in (2, 3, 4, 5)), sc.Gauss(2, form="position"), sc.RadauIA(2, form="position"),
    sc.CollocationRK([0.2, 0.9]), sc.CollocationRK([0.1, 0.5, 0.9]), sc.StoermerVerlet(), sc.ExplicitEuler(),
    sc.ExplicitEuler(form="position"),
)  # fmt: skip
LOW = tuple(method for method in METHODS if method.order <= 6 and method not in SPECIAL)


@pytest.mark.rotated
@pytest.mark.sampled(10)
@pytest.mark.parametrize("method", first_of_each(METHODS, family), ids=lambda method: method.name)
def test_global_error_on_kepler_has_the_claimed_order(compiled, sample, method):
    assert measured_order(compiled, sample, "kepler", method) == pytest.approx(method.order, abs=0.15)


@pytest.mark.full
@pytest.mark.parametrize("method", SPECIAL, ids=lambda method: method.name)
def test_every_method_has_its_order_with_quadratures_of_derivatives_and_other_curves(compiled, sample, method):
    assert measured_order(compiled, sample, "kepler", method) == pytest.approx(method.order, abs=0.15)


@pytest.mark.full
@pytest.mark.parametrize(
    "method", [*METHODS, *(one for one in SPECIAL if one not in METHODS)], ids=lambda method: method.name
)
def test_certificate_measures_the_order_below_rounding(compiled, sample, method):
    state, stepper = State(*sample("kepler").state, 0.3, 0.05), compiled("kepler", method)
    subject = SystemUnderTest(sc.problem("kepler").system, method, stepper, None, state)
    (order,) = (check for check in convergence_checks(subject) if check.name == "order")
    assert order.outcome is Outcome.SATISFIED, order
    assert method.order - 0.25 < order.measured < method.order + 0.3


FORCED = (
    sc.SVI(3), sc.SVI(2, "gauss-lobatto:3"), sc.SCVI(3), sc.SpectralCollocation(4), sc.SVI(1), sc.SVI(4),
    sc.SVI(4, "gauss-legendre:6"), *(sc.SCVI(s) for s in (1, 2, 4)), sc.SCVI(3, abscissae="gauss"),
    sc.SCVI(3, nodes="legendre-lobatto"), sc.SpectralCollocation(3, form="phase-space"), sc.Gauss(2),
    sc.Gauss(3, form="position"), sc.RadauIIA(3), sc.LobattoIIIA(3), sc.ChebyshevGauss(3), sc.StoermerVerlet(),
)  # fmt: skip
DAMPED = (*(sc.SVI(s) for s in (1, 2, 3, 4)), sc.SVI(2, "gauss-lobatto:3"), sc.LobattoIIIA(3), sc.RadauIIA(3))
OTHER_SYSTEMS = {"pumped-cart-pole": LOW, "forced-cart-pole": FORCED, "radial-friction": FORCED, "damped-pair": DAMPED}
"""Time-dependent, forced and damped systems, with methods that support them."""
FEW = {"pumped-cart-pole": LOW[:25:12], "forced-cart-pole": FORCED[:2], "damped-pair": DAMPED[1:3]}


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("name", "method"), [pair(name, method) for name, methods in FEW.items() for method in methods]
)
def test_global_error_with_time_forces_or_damping_has_the_claimed_order(compiled, sample, name, method):
    assert measured_order(compiled, sample, name, method) == pytest.approx(method.order, abs=0.25)


@pytest.mark.full
@pytest.mark.parametrize(
    ("name", "method"), [pair(name, method) for name, methods in OTHER_SYSTEMS.items() for method in methods]
)
def test_every_method_has_its_order_with_time_forces_or_damping(compiled, sample, name, method):
    deviation = 0.3 if method.order < 8 else 0.7
    assert measured_order(compiled, sample, name, method) == pytest.approx(method.order, abs=deviation)


def test_compositions_have_their_order_with_forces_of_time(quickly_compiled):
    """x'' = -x + sin(2 t): the solution from rest is (2 sin t - sin 2t) / 3."""
    system = lagrange("pushed", "x", "x_dot**2/2 - x**2/2", forces={"x": "sin(2*t)"})
    errors = []
    for count in (4, 8):
        run = quickly_compiled(system, sc.Composition(8)).integrate([0.0], [0.0], h=SPAN / count, steps=count)
        errors.append(abs(run.q[-1, 0] - (2 * np.sin(SPAN) - np.sin(2 * SPAN)) / 3))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(8, abs=0.4), errors


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.covering
@pytest.mark.parametrize("name", ["kepler", "planar-pendulum"])
@pytest.mark.parametrize("s", [2, 3, 4, 5])
def test_the_printed_shooting_equations_have_order_one_less_than_their_degree(compiled, sample, name, s):
    method = sc.SCVI(s, variational=False)
    assert method.order is None
    assert measured_order(compiled, sample, name, method) == pytest.approx(s - 1, abs=0.2)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("method", [sc.SVI(2), sc.RadauIIA(3), sc.SCVI(2)], ids=lambda method: method.name)
def test_the_reference_is_the_exact_solution_where_there_is_one(compiled, sample, method):
    """q'' = -q: the order from the closed form is equal, so errors of the reference would be detected."""
    q, p = sample("harmonic-oscillator").state
    exact = q[0] * np.cos(6.0) + p[0] * np.sin(6.0)
    stepper = compiled("harmonic-oscillator", method)
    errors = [abs(stepper.integrate(q, p, h=6.0 / n, steps=n).q[-1, 0] - exact) for n in (60, 90)]
    assert np.log(errors[0] / errors[1]) / np.log(1.5) == pytest.approx(method.order, abs=0.15)
