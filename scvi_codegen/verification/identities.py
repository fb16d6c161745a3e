"""Identities between methods: the same map by different paths through the generator, solved in 60 digits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial, singledispatch

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.exact.motion import exact_motion, numbers
from scvi_codegen.exact.step import derived_step
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem, hamiltonian_of, lagrangian_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
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
from scvi_codegen.verification.subject import Subject

__all__ = ["identity_checks"]

EQUAL, ROUNDED = 1e-30, 1e-13
"""Bounds: for equations in 60 digits; for equations whose tables are rounded to 53 bits."""
OTHER_FORM = "position form is phase-space form for constant mass"
LARGEST_TWIN = 6
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
class _Twin:
    """Method that is the same map by another path."""

    name: str
    method: Method
    bound: float = EQUAL


def identity_checks(subject: Subject) -> Iterator[Check]:
    """Yield the identities that apply to the method and the system."""
    promise = "another method or formulation gives the same step"
    for twin in _twins(subject.method, forms_of(subject.moved).separable):
        measure = partial(_compared, subject, subject.moved, twin.method, twin.bound)
        yield from checked(f"identity: {twin.name}", promise, measure)
    yield from checked("identity: from H as from L", promise, partial(_legendre_twin, subject))
    promise = "steps of the oscillator with the curves' frequency are exact"
    yield from checked("oscillator", promise, partial(_oscillator, subject.method))
    yield from checked("Euler", "a step is h times the rates at its start", partial(_euler, subject))


def _compared(subject: Subject, system: MechanicalSystem, method: Method, bound: float) -> Finding:
    state, own = subject.states[0], subject.solved(0)
    other = subject.derived(method, system)(state.q, state.p, state.h, state.t)
    apart = np.abs(np.array([*own.q, *own.p]) - np.array([*other.q, *other.p])) / subject.scales(state)
    return Finding(float(max(apart)), bound, method.name)


@singledispatch
def _twins(method: Method, separable: bool) -> Iterator[_Twin]:
    """Yield methods with the same step for separable or other systems; nothing for a method without such identities."""
    return iter(())


@_twins.register
def _(method: StoermerVerlet, separable: bool) -> Iterator[_Twin]:
    if separable:
        yield _Twin("SVI of degree 1 with the trapezoidal rule", SVI(1, "gauss-lobatto:2"), ROUNDED)
        yield _Twin("kick, drift, kick", Composition(2), ROUNDED)


@_twins.register
def _(method: Composition, separable: bool) -> Iterator[_Twin]:
    if method.composition_order == 2:
        yield _Twin("Lobatto IIIA-IIIB", StoermerVerlet(), ROUNDED)


@_twins.register
def _(method: SVI, separable: bool) -> Iterator[_Twin]:
    s, rule = method.degree, method.rule
    if not method.curves.nodal or rule.derivative_weights:
        return
    if s > 1:
        other = "equispaced" if method.node_set.name != "equispaced" else "chebyshev-lobatto"
        yield _Twin("independent of its nodes", SVI(s, rule, other))
    if rule.name == f"gauss-legendre:{s}":
        yield _Twin("SVI(s, s Gauss points) = Gauss(s)", Gauss(s))
    if s == 1:
        yield _Twin("SVI(1) = SCVI(1)", SCVI(1, rule))
        if rule.name == "gauss-lobatto:2" and separable:
            yield _Twin("SVI(1, trapezoidal rule) = Stoermer-Verlet", StoermerVerlet(), ROUNDED)


@_twins.register
def _(method: SCVI, separable: bool) -> Iterator[_Twin]:
    s, rule = method.degree, method.rule
    if s == 1:
        yield _Twin("SCVI(1) = SVI(1)", SVI(1, rule))
    elif method.variational and method.abscissae is None:
        abscissae = method.node_set.abscissae[1:]
        yield _Twin("its nodes as abscissae", SCVI(s, rule, abscissae=abscissae), ROUNDED)
    elif method.abscissae == "gauss" and rule.name == f"gauss-legendre:{s}" and separable:
        yield _Twin("SCVI on Gauss points = SVI", SVI(s, rule), ROUNDED)


@_twins.register
def _(method: SpectralCollocation, separable: bool) -> Iterator[_Twin]:
    abscissae = method.node_set.abscissae[1:]
    yield _Twin("collocation at its nodes", CollocationRK(abscissae, form=method.form))
    if separable:
        yield _Twin(OTHER_FORM, replace(method, form=_other(method.form)))


@_twins.register
def _(method: RungeKutta, separable: bool) -> Iterator[_Twin]:
    family, _, stages = method.tableau.name.partition(":")
    if family in POINTS:
        points = POINTS[family](int(stages)).abscissae
        yield _Twin("collocation at the points of a quadrature", CollocationRK(list(points), form=method.form))
    if family == "gauss" and method.form == "phase-space":
        s = int(stages)
        yield _Twin("Gauss(s) = SVI(s, s Gauss points)", SVI(s))
    if separable:
        yield _Twin(OTHER_FORM, replace(method, form=_other(method.form)))


def _other(form: str) -> str:
    return "position" if form == "phase-space" else "phase-space"


def _legendre_twin(subject: Subject) -> Finding | None:
    """Compare with the step of the Legendre transform: H from L, or L from H."""
    system, method = subject.moved, subject.method
    singular = isinstance(system, HamiltonianSystem) and not system.is_regular
    shot = isinstance(method, SCVI) and bool(system.forces)
    if singular or shot or method.needs_lagrangian or system.constraints:
        return None
    if system.dimension > LARGEST_TWIN:
        raise StateError(f"Legendre transform: more than {LARGEST_TWIN} coordinates")
    twin = hamiltonian_of(system) if isinstance(system, LagrangianSystem) else _lagrangian(system)
    return _compared(subject, twin, method, EQUAL)


def _oscillator(method: Method) -> Finding | None:
    """Check that curves fitted to a frequency, with their own quadrature, are exact on the harmonic oscillator."""
    if not isinstance(method, SVI) or method.frequency is None:
        return None
    if method.quadrature != method.curves.default_rule(method.degree):
        return None
    formula, frequency = "(q_dot**2 - w**2*q**2)/2", {"w": method.frequency}
    system = LagrangianSystem.from_text(name="oscillator", coordinates=["q"], lagrangian=formula, parameters=frequency)
    found, (q, p) = derived_step(system, method)([0.7], [0.4], 1), exact_motion(system).flow([0.7], [0.4], 1)
    return Finding(float(max(abs(found.q[0] - q[0]), abs(found.p[0] - p[0]))), ROUNDED)


def _euler(subject: Subject) -> Finding | None:
    """Compare explicit Euler with its formula; order 1 alone would also hold for implicit Euler."""
    what = subject.method.specification()
    if what["method"] != "explicit-euler":
        return None
    state, motion = subject.states[0], subject.motion
    q, p, h, t = numbers(state.q), numbers(state.p), mp.mpf(state.h), mp.mpf(state.t)
    v, force = motion.rates(q, p, t)
    if what["form"] == "phase-space":
        end = [*(q + v * h), *(p + force * h)]
    elif motion.hamiltonian:
        raise StateError("no formula for the position form of a Hamiltonian")
    else:
        end = [*(q + v * h), *motion.momentum(q + v * h, v + motion.acceleration(q, v, t) * h, t + h)]
    solved = subject.solved(0)
    return Finding(float(max(abs(np.array([*solved.q, *solved.p]) - end) / subject.scales(state))), EQUAL)


def _lagrangian(system: MechanicalSystem) -> LagrangianSystem:
    assert isinstance(system, HamiltonianSystem)
    return lagrangian_of(system)
