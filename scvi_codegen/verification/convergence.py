"""Checks of convergence to the exact motion, in h and in the degree, in 60-digit arithmetic, above all round-off.

The compiled step equals the step in 60 digits up to round-off, which :mod:`~scvi_codegen.verification.stepping` checks;
here the latter is compared with the exact motion, which is computed from the formula of L or H alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.methods import method_from_specification
from scvi_codegen.methods.method import Method
from scvi_codegen.tables.precision import Number, mp
from scvi_codegen.verification.certificate import Check, Finding, ViolationError, checked
from scvi_codegen.verification.system_under_test import State, SystemUnderTest

TARGET_ERROR = mp.mpf(10) ** -17
"""Error at which the order is measured: below the round-off of doubles, so that errors of that size show."""
FLOOR = mp.mpf(10) ** -38
"""Error below which a step counts as exact."""
SMALLEST = 1e-9
"""Smallest step size tried, relative to h: an error that is not small there is of order 0."""
MAX_TRIALS, MAX_HALVINGS = 12, 5
SLACK = 0.2
"""Difference allowed between measured and claimed order."""
LEAST_ORDER = 0.8
"""Smallest order of methods that claim none: they converge all the same."""
ERROR_RATIO = 0.25
"""Largest ratio of the errors of methods whose degrees differ by two."""

EXPECTED: Mapping[str, Callable[[int], tuple[int, bool, bool]]] = {
    "gauss": lambda s: (2 * s, True, True),
    "radau-iia": lambda s: (2 * s - 1, False, False),
    "radau-ia": lambda s: (2 * s - 1, False, False),
    "lobatto-iiia": lambda s: (2 * s - 2, False, True),
    "chebyshev-gauss": lambda s: (s + s % 2, s == 1, True),
    "chebyshev-lobatto": lambda s: (s + s % 2, False, True),
}
"""Order, symplecticity (in phase space) and symmetry of Runge-Kutta methods with s stages (paper, Table 4)."""

RULES: Mapping[str, Callable[[int], int]] = {
    "gauss-legendre": lambda n: 2 * n,
    "gauss-lobatto": lambda n: 2 * n - 2,
    "gauss-radau-left": lambda n: 2 * n - 1,
    "gauss-radau-right": lambda n: 2 * n - 1,
    "clenshaw-curtis": lambda n: n + n % 2,
    "fejer": lambda n: n + n % 2,
}
"""Order of quadrature rules with n points."""


def convergence_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield all checks of this module."""
    method = tested.method
    statement = "order, symplecticity and symmetry are those in the literature"
    yield from checked("known properties", statement, partial(_known_properties, method))
    order = f"order {method.order} in h" if method.order else "steps converge to the exact motion (no order is claimed)"
    yield from checked("order", order, partial(_order, tested))
    statement = "two degrees more reduce the error of a step at least fourfold"
    yield from checked("rate in degree", statement, partial(_rate_in_degree, tested))


def _known_properties(method: Method) -> Finding | None:
    """Compare the properties that the method computes from its coefficients with the known ones."""
    expected, actual = _expected(method), (method.order, method.symplectic, method.symmetric)
    if expected is None:
        return None
    if actual != expected:
        raise ViolationError(f"(order, symplectic, symmetric) is {actual}, in the literature {expected}")
    return Finding(0.0, 0.0, f"order {actual[0]}")


def _expected(method: Method) -> tuple[int | None, bool, bool] | None:
    what = method.specification()
    kind = str(what["method"])
    if kind in EXPECTED:
        order, symplectic, symmetric = EXPECTED[kind](int(str(what["stages"])))
        return order, symplectic and what["form"] == "phase-space", symmetric
    family, _, count = str(what.get("quadrature", "")).partition(":")
    if kind == "svi" and family in RULES and "space" not in what:
        degree, points = int(str(what["degree"])), int(count)
        order = min(2 * degree, RULES[family](points))
        return order if points >= degree else None, True, "radau" not in family
    return {"stoermer-verlet": (2, True, True), "explicit-euler": (1, False, False)}.get(kind)


def _order(tested: SystemUnderTest) -> Finding | None:
    if tested.method.frequency is not None:
        return None
    order = tested.method.order
    measured, error = _measured_order(tested)
    if measured is None:
        return Finding(error, float(FLOOR), "exact step")
    least = order - SLACK if order else LEAST_ORDER
    return Finding(measured, least, f"at a local error of {error:.1e}", at_least=True)


def _measured_order(tested: SystemUnderTest) -> tuple[float | None, float]:
    """Return the order from the errors of h and h/2, and the larger error; ``None`` for an exact step."""
    state, power = tested.states[0], (tested.method.order or 1) + 1
    h = mp.mpf(state.h)
    error = _error(tested, tested.method, state, h)
    for _ in range(MAX_TRIALS):
        if error <= TARGET_ERROR or abs(h) < SMALLEST * abs(state.h):
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
    what = tested.method.specification()
    key = "degree" if "degree" in what else "stages" if "stages" in what else None
    if key is None or "abscissae" in what or tested.method.order is None:
        return None
    size = int(str(what[key]))
    less, more = (_of_size(what, key, size + change) for change in (-2, 2))
    pair = (less, tested.method) if less else (tested.method, more) if more else None
    if pair is None:
        raise StateError("no method of a neighbouring degree exists with this quadrature")
    h, (coarse, fine) = _errors_of(tested, pair)
    remark = f"{pair[0].name}: {float(coarse):.1e}, {pair[1].name}: {float(fine):.1e}, h = {float(h):.3g}"
    if coarse < FLOOR:
        return Finding(float(fine), float(FLOOR), remark)
    return Finding(float(fine / coarse), ERROR_RATIO, remark)


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


def _of_size(what: Mapping[str, Any], key: str, size: int) -> Method | None:
    """Return the method of another degree, with the same number of additional quadrature points."""
    if size < 1:
        return None
    changed = {**what, key: size}
    family, colon, count = str(what.get("quadrature", "")).partition(":")
    if colon and count.isdigit():
        changed["quadrature"] = f"{family}:{int(count) + size - int(what[key])}"
    try:
        return method_from_specification(changed)
    except MethodError:
        return None
