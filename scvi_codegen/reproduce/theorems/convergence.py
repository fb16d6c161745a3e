"""Errors of discrete Lagrangians, Legendre transforms and maps relative to the exact ones, and their rates.

The exact quantities are computed by :mod:`scvi_codegen.exact.discrete_lagrangian` with 18 digits, those of a method by
its compiled integrator in double precision; rates are fitted to errors above :data:`PLATEAU`, below which round-off
dominates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StepFailedError
from scvi_codegen.exact.discrete_lagrangian import ExactStep, exact_map
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods import SCVI, SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.models.problems import problem
from scvi_codegen.reproduce.laboratory.drawing import Array
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.tables.quadrature import Quadrature, gauss_legendre

STARTS: Mapping[str, tuple[tuple[tuple[float, ...], tuple[float, ...]], ...]] = {
    "planar-pendulum": (((0.7,), (0.4,)), ((1.5,), (-0.6,)), ((-0.4,), (1.3,))),
    "kepler": (((0.3, 0.8), (-1.1, 0.4)), ((0.7, -0.4), (0.5, 1.0)), ((-0.6, 0.5), (-0.7, -0.9))),
}
"""Positions and velocities; the largest error of three trajectories does not vanish by accident."""
QUICK_FLAGS = ("-O0", "-ffp-contract=off")
"""Compiler flags for a few steps with each of a hundred integrators: compiling takes a third of the time."""
PLATEAU = 1e-13
DIGITS = 18
QUANTITIES = {"action": "L_d", "legendre": "Legendre transforms", "map": "map"}
SHOWN = QUANTITIES | {"action": "$L_d$"}
"""Names in pictures."""
TITLES = {"planar-pendulum": "pendulum", "kepler": "Kepler"}
START = (
    "The theorem names no problem: the pendulum and Kepler's problem, each from three states (q; q') without symmetry: "
    + "; ".join(
        f"{TITLES[name]} " + ", ".join(f"({', '.join(map(str, q))}; {', '.join(map(str, v))})" for q, v in starts)
        for name, starts in STARTS.items()
    )
    + ". Errors are the largest of the three trajectories."
)
EXACT = "The exact discrete Lagrangian (6), its Legendre transforms and the exact flow are computed with 18 digits."
GALERKIN, FULL, FEW, PRINTED = "SVI", "SCVI", "SCVI, few points", "SCVI as printed"
METHODS: Mapping[str, Callable[[int], SCVI | SVI]] = {
    GALERKIN: SVI,
    FULL: SCVI,
    FEW: lambda s: SCVI(s, gauss_legendre(max(1, s // 2))),
    PRINTED: lambda s: SCVI(s, variational=False),
}
"""Methods as functions of the degree; s Gauss points unless the name says otherwise."""
SMALLEST = 3
"""Number of the smallest step sizes above the plateau that determine a slope."""
CURVE = SVI(8)
CURVE_STEPS = 16
"""Number of steps for the exact curve inside a step, to round-off."""


@dataclass(frozen=True, slots=True)
class MapErrors:
    """Largest errors in one step; NaN if a method has no such quantity or its equations have no solution.

    Attributes:
        action: error of L_d(q0, q1).
        legendre: error of p0 and p1 = F-, F+ L_d(q0, q1).
        map: error of (q1, p1) from (q0, p0).
    """

    action: float
    legendre: float
    map: float


@lru_cache(maxsize=8)
def system_named(name: str) -> LagrangianSystem:
    """Return the problem's system, one object per process."""
    system = problem(name).system
    assert isinstance(system, LagrangianSystem)
    return system


@lru_cache(maxsize=512)
def quick_stepper(name: str, method: Method) -> Stepper:
    """Return the integrator, compiled for a few steps."""
    return compile_stepper(system_named(name), method, flags=QUICK_FLAGS)


@lru_cache(maxsize=256)
def exact_steps(name: str, h: float) -> tuple[ExactStep, ...]:
    """Return the exact steps from the starts of a problem (whose velocities are momenta)."""
    return tuple(exact_map(system_named(name), q, v, h, digits=DIGITS) for q, v in STARTS[name])


@lru_cache(maxsize=4096)
def errors(name: str, method: Method, h: float) -> MapErrors:
    """Return the errors of one step of a method, the largest over the starts."""
    result = [_errors(quick_stepper(name, method), exact, h) for exact in exact_steps(name, h)]
    worst = np.max([(error.action, error.legendre, error.map) for error in result], axis=0)
    return MapErrors(*map(float, worst))


def _errors(stepper: Stepper, exact: ExactStep, h: float) -> MapErrors:
    q0, p0, q1, p1 = _floats(exact.q0, exact.p0, exact.q1, exact.p1)
    try:
        of_map = _largest(*zip(stepper.step(q0, p0, h), (q1, p1), strict=True))
    except StepFailedError:
        of_map = math.nan
    if not stepper.interface.has_action:
        return MapErrors(math.nan, math.nan, of_map)
    try:
        action = stepper.discrete_lagrangian(q0, q1, h)
        minus, plus = stepper.discrete_legendre_minus(q0, q1, h)[1], stepper.discrete_legendre_plus(q0, q1, h)[1]
    except StepFailedError:
        return MapErrors(math.nan, math.nan, of_map)
    return MapErrors(abs(action - float(exact.action)), _largest((minus, p0), (plus, p1)), of_map)


def _floats(*vectors: Sequence[float]) -> tuple[Array, ...]:
    return tuple(np.array([float(x) for x in vector]) for vector in vectors)


def _largest(*pairs: tuple[Array, Array]) -> float:
    return float(max(np.abs(left - right).max() for left, right in pairs))


@lru_cache(maxsize=256)
def quadrature_error(name: str, rule: Quadrature, h: float) -> float:
    """Return the error of (h/2) sum_n w_n L(q(t_n), q'(t_n)) on the exact solution q, the largest over the starts."""
    weights = np.array(rule.unit_weights, dtype=float)
    return max(
        float(abs(h * weights @ _along(name, exact, h, rule) - float(exact.action))) for exact in exact_steps(name, h)
    )


def _along(name: str, exact: ExactStep, h: float, rule: Quadrature) -> Array:
    """Return L at the points of a rule, all after the start, along the exact solution."""
    stepper, values = quick_stepper(name, CURVE), []
    q0, p0 = _floats(exact.q0, exact.p0)
    for c in map(float, rule.abscissae):
        run = stepper.integrate(q0, p0, h=c * h / CURVE_STEPS, steps=CURVE_STEPS, save_every=CURVE_STEPS)
        q, p = run.q[-1], run.p[-1]
        values.append(p @ stepper.velocity(q, p) - stepper.energy(q, p))
    return np.array(values)


def fitted_order(h: Sequence[float], error: Sequence[float]) -> float:
    """Return the exponent r of error = C h^r at the smallest steps above the plateau; NaN if there are few."""
    seen = [(x, y) for x, y in zip(h, error, strict=True) if y > PLATEAU]
    if len(seen) < SMALLEST:
        return math.nan
    x, y = np.log(sorted(seen)[:SMALLEST]).T
    return float(np.polyfit(x, y, 1)[0])


def rate(degree: Sequence[int], error: Sequence[float]) -> tuple[float, float]:
    """Return (C, K) of error = C K^degree, fitted to the errors above the plateau; NaN with fewer than three."""
    seen = [(x, y) for x, y in zip(degree, error, strict=True) if y > PLATEAU]
    if len(seen) < SMALLEST:
        return math.nan, math.nan
    exponent, constant = np.polyfit([x for x, _ in seen], np.log([y for _, y in seen]), 1)
    return float(np.exp(constant)), float(np.exp(exponent))


def cell(value: float) -> float | None:
    """Return a cell of a table; NaN becomes empty."""
    return None if math.isnan(value) else value
