"""Identities between methods: the same map by different paths through the generator, solved in 60 digits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial, singledispatch

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.exact.solution import exact_motion, numbers
from scvi_codegen.exact.step import derived_step
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.legendre import hamiltonian_of, lagrangian_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import (
    SCVI,
    SVI,
    CollocationRK,
    Composition,
    Gauss,
    Method,
    RungeKutta,
    SpectralCollocation,
    StoermerVerlet,
)
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.quadrature import (
    Quadrature,
    clenshaw_curtis,
    fejer,
    gauss_legendre,
    gauss_lobatto,
    gauss_radau,
)
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.system_under_test import SystemUnderTest

EQUAL, ROUNDED = 1e-30, 1e-13
"""Bounds: for equations in 60 digits; for equations whose tables are rounded to 53 bits."""
OTHER_FORM = "position form is phase-space form for constant mass"
MAX_LEGENDRE_COORDINATES = 6
"""Largest number of coordinates for which the Legendre transform is done symbolically."""

POINTS: dict[str, Callable[[int], Quadrature]] = {
    "gauss": gauss_legendre,
    "radau-iia": lambda s: gauss_radau(s, "right"),
    "lobatto-iiia": gauss_lobatto,
    "chebyshev-gauss": fejer,
    "chebyshev-lobatto": clenshaw_curtis,
}
"""Quadrature rule whose points are the abscissae of a collocation tableau."""


@dataclass(frozen=True, slots=True)
class _Identity:
    """Method that is the same map by another path."""

    name: str
    method: Method
    bound: float = EQUAL


def identity_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the identities that apply to the method and the system."""
    statement = "another method or formulation gives the same step"
    for identity in _identities(tested.method, forms_of(tested.moved).separable):
        measure = partial(_compared, tested, tested.moved, identity.method, identity.bound)
        yield from checked(f"identity: {identity.name}", statement, measure)
    yield from checked("identity: from H as from L", statement, partial(_legendre_identity, tested))
    statement = "steps of the oscillator with the curves' frequency are exact"
    yield from checked("oscillator", statement, partial(_oscillator, tested.method))
    yield from checked("Euler", "a step is h times the rates at its start", partial(_euler, tested))


def _compared(tested: SystemUnderTest, system: MechanicalSystem, method: Method, bound: float) -> Finding:
    state, solution = tested.states[0], tested.solved(0)
    other = tested.derived(method, system)(state.q, state.p, state.h, state.t)
    difference = np.abs(np.array([*solution.q, *solution.p]) - np.array([*other.q, *other.p])) / tested.scales(state)
    return Finding(float(max(difference)), bound, method.name)


@singledispatch
def _identities(method: Method, separable: bool) -> Iterator[_Identity]:
    """Yield methods with the same step for separable or other systems; nothing for a method without such identities."""
    return iter(())


@_identities.register
def _(method: StoermerVerlet, separable: bool) -> Iterator[_Identity]:
    if separable:
        yield _Identity("SVI of degree 1 with the trapezoidal rule", SVI(1, "gauss-lobatto:2"), ROUNDED)
        yield _Identity("kick, drift, kick", Composition(2), ROUNDED)


@_identities.register
def _(method: Composition, separable: bool) -> Iterator[_Identity]:
    if method.composition_order == 2:
        yield _Identity("Lobatto IIIA-IIIB", StoermerVerlet(), ROUNDED)


@_identities.register
def _(method: SVI, separable: bool) -> Iterator[_Identity]:
    s, rule = method.degree, method.rule
    if not method.curves.nodal or rule.derivative_weights:
        return
    if s > 1:
        other = "equispaced" if method.node_set.name != "equispaced" else "chebyshev-lobatto"
        yield _Identity("independent of its nodes", SVI(s, rule, other))
    if rule.name == f"gauss-legendre:{s}":
        yield _Identity("SVI(s, s Gauss points) = Gauss(s)", Gauss(s))
    if s == 1:
        yield _Identity("SVI(1) = SCVI(1)", SCVI(1, rule))
        if rule.name == "gauss-lobatto:2" and separable:
            yield _Identity("SVI(1, trapezoidal rule) = Stoermer-Verlet", StoermerVerlet(), ROUNDED)


@_identities.register
def _(method: SCVI, separable: bool) -> Iterator[_Identity]:
    s, rule = method.degree, method.rule
    if s == 1:
        yield _Identity("SCVI(1) = SVI(1)", SVI(1, rule))
    elif method.variational and method.abscissae is None:
        abscissae = method.node_set.abscissae[1:]
        yield _Identity("its nodes as abscissae", SCVI(s, rule, abscissae=abscissae), ROUNDED)
    elif method.abscissae == "gauss" and rule.name == f"gauss-legendre:{s}" and separable:
        yield _Identity("SCVI on Gauss points = SVI", SVI(s, rule), ROUNDED)


@_identities.register
def _(method: SpectralCollocation, separable: bool) -> Iterator[_Identity]:
    abscissae = method.node_set.abscissae[1:]
    yield _Identity("collocation at its nodes", CollocationRK(abscissae, form=method.form))
    if separable:
        yield _Identity(OTHER_FORM, replace(method, form=_other_form(method.form)))


@_identities.register
def _(method: RungeKutta, separable: bool) -> Iterator[_Identity]:
    family, _, stages = method.tableau.name.partition(":")
    if family in POINTS:
        points = POINTS[family](int(stages)).abscissae
        yield _Identity("collocation at the points of a quadrature", CollocationRK(list(points), form=method.form))
    if family == "gauss" and method.form == "phase-space":
        s = int(stages)
        yield _Identity("Gauss(s) = SVI(s, s Gauss points)", SVI(s))
    if separable:
        yield _Identity(OTHER_FORM, replace(method, form=_other_form(method.form)))


def _other_form(form: str) -> str:
    return "position" if form == "phase-space" else "phase-space"


def _legendre_identity(tested: SystemUnderTest) -> Finding | None:
    """Compare with the step of the Legendre transform: H from L, or L from H."""
    system, method = tested.moved, tested.method
    singular = isinstance(system, HamiltonianSystem) and not system.is_regular
    shot = isinstance(method, SCVI) and bool(system.forces)
    if singular or shot or method.needs_lagrangian or system.constraints:
        return None
    if system.dimension > MAX_LEGENDRE_COORDINATES:
        raise StateError(f"Legendre transform: more than {MAX_LEGENDRE_COORDINATES} coordinates")
    identity = hamiltonian_of(system) if isinstance(system, LagrangianSystem) else _lagrangian(system)
    return _compared(tested, identity, method, EQUAL)


def _oscillator(method: Method) -> Finding | None:
    """Check that curves fitted to a frequency, with their own quadrature, are exact on the harmonic oscillator."""
    if not isinstance(method, SVI) or method.frequency is None:
        return None
    if method.quadrature != method.curves.default_rule(method.degree):
        return None
    formula, frequency = "(q_dot**2 - w**2*q**2)/2", {"w": method.frequency}
    system = LagrangianSystem.from_text(name="oscillator", coordinates=["q"], lagrangian=formula, parameters=frequency)
    result, (q, p) = derived_step(system, method)([0.7], [0.4], 1), exact_motion(system).flow([0.7], [0.4], 1)
    return Finding(float(max(abs(result.q[0] - q[0]), abs(result.p[0] - p[0]))), ROUNDED)


def _euler(tested: SystemUnderTest) -> Finding | None:
    """Compare explicit Euler with its formula; order 1 alone would also hold for implicit Euler."""
    what = tested.method.specification()
    if what["method"] != "explicit-euler":
        return None
    state, motion = tested.states[0], tested.motion
    q, p, h, t = numbers(state.q), numbers(state.p), mp.mpf(state.h), mp.mpf(state.t)
    v, force = motion.rates(q, p, t)
    if what["form"] == "phase-space":
        end = [*(q + v * h), *(p + force * h)]
    elif motion.hamiltonian:
        raise StateError("no formula for the position form of a Hamiltonian")
    else:
        end = [*(q + v * h), *motion.momentum(q + v * h, v + motion.acceleration(q, v, t) * h, t + h)]
    solved = tested.solved(0)
    return Finding(float(max(abs(np.array([*solved.q, *solved.p]) - end) / tested.scales(state))), EQUAL)


def _lagrangian(system: MechanicalSystem) -> LagrangianSystem:
    assert isinstance(system, HamiltonianSystem)
    return lagrangian_of(system)
