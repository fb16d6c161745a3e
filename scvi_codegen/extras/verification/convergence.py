"""Checks of convergence to the exact motion, in h and in the degree, in 60-digit arithmetic, above all round-off.

The compiled step equals the step in 60 digits up to round-off, which
:mod:`~scvi_codegen.extras.verification.stepping` checks; here the latter is compared with the exact motion, which is
computed from the formula of L or H alone.

Methods that are the same map are solved in 60 digits by different paths through the generator, and compared.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial, singledispatch
from typing import Any, NamedTuple, cast

import numpy as np

from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.api.methods import Method
from scvi_codegen.api.systems import MechanicalSystem, forms_of
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.extras.exact.solution import exact_motion, numbers
from scvi_codegen.extras.exact.step import derived_step
from scvi_codegen.extras.verification.certificate import Check, Finding, checked
from scvi_codegen.extras.verification.system_under_test import (
    EPSILON,
    EQUAL,
    LARGEST_RATIO,
    TRIALS,
    State,
    SystemUnderTest,
)
from scvi_codegen.methods import (
    SCVI,
    SVI,
    CollocationRK,
    Composition,
    Gauss,
    RungeKutta,
    SpectralCollocation,
    StoermerVerlet,
    as_method,
)
from scvi_codegen.methods.tables.quadrature import (
    Quadrature,
    clenshaw_curtis,
    fejer,
    gauss_legendre,
    gauss_lobatto,
    gauss_radau,
)
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import hamiltonian_of, lagrangian_of

TARGET_ERROR = mp.mpf(10) ** -17
"""Error at which the order is measured: below the round-off of doubles, so that errors of that size show."""
FLOOR = mp.mpf(10) ** -42
"""Error below which a step counts as exact."""
MAX_HALVINGS = 4
SLACK = 0.2
"""Difference allowed between measured and claimed order, 1 of methods that claim none: they converge all the same."""


def convergence_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield all checks of this module."""
    method = tested.method
    order = f"order {method.order} in h" if method.order else "steps converge to the exact motion (no order is claimed)"
    yield from checked("order", order, partial(_order, tested))
    statement = "two degrees more reduce the error of a step at least fourfold"
    yield from checked("rate in degree", statement, partial(_rate_in_degree, tested))


def _order(tested: SystemUnderTest) -> Finding | None:
    if tested.method.frequency is not None:
        return None
    order = tested.method.order
    measured, error = _measured_order(tested)
    if measured is None:
        return Finding(error, float(FLOOR), "exact step")
    return Finding(measured, (order or 1) - SLACK, f"at a local error of {error:.1e}", at_least=True)


def _measured_order(tested: SystemUnderTest) -> tuple[float | None, float]:
    """Return the order from the errors of h and h/2, and the larger error; ``None`` for an exact step."""
    state, power = tested.states[0], (tested.method.order or 1) + 1
    h = mp.mpf(state.h)
    error = _error(tested, tested.method, state, h)
    for _ in range(TRIALS):
        if error <= TARGET_ERROR or abs(h) < EPSILON * abs(state.h):
            break
        h *= min(mp.mpf("0.5"), max((TARGET_ERROR / error / 10) ** (mp.one / power), mp.mpf("1e-4")))
        error = _error(tested, tested.method, state, h)
    best: tuple[float | None, float] = (None, float(error))
    for _ in range(MAX_HALVINGS):
        half = _error(tested, tested.method, state, h / 2)
        if error < FLOOR:
            break
        if half < FLOOR:
            h *= 2
            error = _error(tested, tested.method, state, h)
            continue
        measured = float(mp.log(error / half, 2)) - 1
        if best[0] is None or measured > best[0]:
            best = (measured, float(error))
        if measured >= (tested.method.order or 1) - SLACK:
            break
        h, error = h / 2, half
    return best


def _error(tested: SystemUnderTest, method: Method, state: State, h: Number) -> Number:
    """Return the error of one step of size h, relative to the sizes of q and of p."""
    start = tested.motion.met(state.q, state.p, state.t)
    result = tested.derived(method)(*start, h, state.t)
    q, p = tested.motion.flow(*start, h, state.t)
    m, scales = len(state.q), tested.scales(state)
    return max(*(abs(result.q - q) / scales[:m]), *(abs(result.p - p) / scales[m:]))


def _rate_in_degree(tested: SystemUnderTest) -> Finding | None:
    specification = tested.method.specification()
    key = next((name for name in ("degree", "stages") if name in specification), None)
    if key is None or "abscissae" in specification or tested.method.order is None:
        return None
    size = int(str(specification[key]))
    if less := _of_size(specification, key, size - 2):
        pair = less, tested.method
    elif more := _of_size(specification, key, size + 2):
        pair = tested.method, more
    else:
        raise StateError("no method of a neighbouring degree exists with this quadrature")
    h, (coarse, fine) = _errors_of(tested, pair)
    remark = f"{pair[0].name}: {float(coarse):.1e}, {pair[1].name}: {float(fine):.1e}, h = {float(h):.3g}"
    if coarse < FLOOR:
        return Finding(float(fine), float(FLOOR), remark)
    return Finding(float(fine / coarse), LARGEST_RATIO, remark)


def _errors_of(tested: SystemUnderTest, pair: tuple[Method, Method]) -> tuple[Number, list[Number]]:
    """Return the errors of one step of both methods, and a step size at which both succeed."""
    state = tested.states[0]
    h = mp.mpf(state.h)
    for _ in range(MAX_HALVINGS):
        try:
            return h, [_error(tested, method, state, h) for method in pair]
        except (StateError, ArithmeticError):
            h /= 2
    return h, [_error(tested, method, state, h) for method in pair]


def _of_size(specification: Mapping[str, Any], key: str, size: int) -> Method | None:
    """Return the method of another degree, with the same number of additional quadrature points."""
    if size < 1:
        return None
    changed = {**specification, key: size}
    family, colon, count = str(specification.get("quadrature", "")).partition(":")
    if colon and count.isdigit():
        changed["quadrature"] = f"{family}:{int(count) + size - int(specification[key])}"
    try:
        return as_method(changed)
    except MethodError:
        return None


ROUNDED = 1e-13
"""Bound for equations whose tables are rounded to 53 bits."""
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


class _Identity(NamedTuple):
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
    other = lagrangian_of(system) if isinstance(system, HamiltonianSystem) else hamiltonian_of(cast(Any, system))
    return _compared(tested, other, method, EQUAL)


def _oscillator(method: Method) -> Finding | None:
    """Check that curves fitted to a frequency, with their own quadrature, are exact on the harmonic oscillator."""
    if not isinstance(method, SVI) or method.frequency is None:
        return None
    if method.quadrature != method.curves.default_rule(method.degree):
        return None
    formula, frequency = "(q_dot**2 - w**2*q**2)/2", {"w": method.frequency}
    system = LagrangianSystem.from_text(name="oscillator", coordinates=["q"], lagrangian=formula, parameters=frequency)
    result = derived_step(system, method)([0.7], [0.4], 1)
    q, p = exact_motion(system).flow([0.7], [0.4], 1)
    return Finding(float(max(abs(result.q[0] - q[0]), abs(result.p[0] - p[0]))), ROUNDED)


def _euler(tested: SystemUnderTest) -> Finding | None:
    """Compare explicit Euler with its formula; order 1 alone would also hold for implicit Euler."""
    specification = tested.method.specification()
    if specification["method"] != "explicit-euler" or forms_of(tested.system).one_form:
        return None
    state, motion = tested.states[0], tested.motion
    q, p, h, t = numbers(state.q), numbers(state.p), mp.mpf(state.h), mp.mpf(state.t)
    v, force = motion.rates(q, p, t)
    if specification["form"] == "phase-space":
        end = [*(q + v * h), *(p + force * h)]
    elif motion.hamiltonian:
        raise StateError("no formula for the position form of a Hamiltonian")
    else:
        end = [*(q + v * h), *motion.momentum(q + v * h, v + motion.acceleration(q, v, t) * h, t + h)]
    solved = tested.solved(0)
    return Finding(float(max(abs(np.array([*solved.q, *solved.p]) - end) / tested.scales(state))), EQUAL)
