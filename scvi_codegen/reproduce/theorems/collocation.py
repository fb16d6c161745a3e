"""Theorem 2.1: the collocation method (22) is the Runge-Kutta method with the coefficients (23).

Both sides are computed from their definitions, independently. The left side is the polynomial u of degree s,

    u(t0) = q0,    u'(t0 + c_i h) = f(u(t0 + c_i h)),    q1 = u(t0 + h),

determined by its coefficients in powers of time, without (23). On the right side the stage equations are solved with
the tableau.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

from scvi_codegen.methods import RungeKutta
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Formula,
    Paragraph,
    Result,
    TableBlock,
    experiment,
    holds,
)
from scvi_codegen.reproduce.theorems.convergence import quick_stepper
from scvi_codegen.tables.nodes import nodes_by_name
from scvi_codegen.tables.precision import Vector, mp
from scvi_codegen.tables.tableau import Tableau, collocation_tableau, radau_ia, tableau_by_name

Array: TypeAlias = NDArray[Any]
Field: TypeAlias = Callable[[Array], Array]

STAGES = (1, 2, 3, 4, 5)
COMPILED_STAGES = 3
STEP = mp.mpf(1) / 10
LEAST_STAGES = {"gauss": 1, "radau-iia": 1, "lobatto-iiia": 2, "chebyshev-gauss": 1, "chebyshev-lobatto": 2}
"""Smallest numbers of stages of the families of :mod:`scvi_codegen.tables.tableau`."""
NODES = {"spectral collocation": "chebyshev-lobatto", "equispaced": "equispaced"}
"""Names of nodes x_0 .. x_s whose x_1 .. x_s, mapped to [0, 1], are the abscissae."""
FAMILIES = (*LEAST_STAGES, *NODES, "irregular")
STATES = {
    "planar-pendulum": ("0.7", "0.4"),
    "kepler": ("0.3", "0.8", "-1.1", "0.4"),
}


def _pendulum(state: Array) -> Array:
    q, p = state
    return np.array([p, -mp.sin(q)], dtype=object)


def _kepler(state: Array) -> Array:
    x, y, p, r = state
    cube = (x * x + y * y) ** mp.mpf("1.5")
    return np.array([p, r, -x / cube, -y / cube], dtype=object)


FIELDS: Mapping[str, Field] = {"planar-pendulum": _pendulum, "kepler": _kepler}
"""Hamilton's equations (32), (24), written by hand."""


def abscissae(family: str, s: int) -> Vector:
    """Return the s collocation points of a family in [0, 1]."""
    if family in LEAST_STAGES:
        return tableau_by_name(f"{family}:{s}").c
    if family == "irregular":
        return tuple(mp.sqrt(mp.mpf(k)) / 3 for k in range(1, s + 1))
    return nodes_by_name(NODES[family], s).abscissae[1:]


def fixed_point(step: Field, first: Array) -> Array:
    """Return the limit of first, step(first), step(step(first)) ..., to 54 digits."""
    here = first
    for _ in range(500):
        following = step(here)
        if max(map(abs, (following - here).ravel())) < mp.mpf(10) ** -54:
            return following
        here = following
    raise ArithmeticError("the stage iteration does not converge: the step is too large")


def collocation_step(f: Field, start: Array, h: Any, c: Sequence[Any]) -> Array:
    """Return the step (22): u(t0 + h x) = start + sum_k g_k x^k with u' = f(u) at the points."""
    powers = np.arange(1, len(c) + 1)
    x = np.array(c, dtype=object)[:, None]
    values, derivatives = x**powers, powers * x ** (powers - 1)
    inverse = np.array(mp.inverse(mp.matrix(derivatives.tolist())).tolist(), dtype=object)

    def step(g: Array) -> Array:
        return np.array(inverse @ np.array([f(start + point) * h for point in values @ g]))

    result: Array = fixed_point(step, np.full((len(c), len(start)), mp.zero, dtype=object))
    return np.array(start + result.sum(axis=0))


def tableau_step(f: Field, start: Array, h: Any, tableau: Tableau) -> Array:
    """Return the Runge-Kutta step."""
    A, b = np.array(tableau.A, dtype=object), np.array(tableau.b, dtype=object)

    def step(K: Array) -> Array:
        return np.array([f(start + point) for point in (A @ K) * h])

    K = fixed_point(step, np.array([f(start)] * len(b), dtype=object))
    return np.array(start + (b @ K) * h)


def _difference(left: Array, right: Array) -> float:
    return float(max(map(abs, left - right)))


def _start(name: str) -> Array:
    return np.array([mp.mpf(x) for x in STATES[name]], dtype=object)


def _integral_defect(tableau: Tableau) -> float:
    """Return the error of A and b as integrals of polynomials of degree below s, for which (23) is exact."""
    c, rows = tableau.c, (*tableau.A, tableau.b)
    ends = (*c, mp.one)
    return float(
        max(
            abs(mp.fdot(row, [x ** (k - 1) for x in c]) - end**k / k)
            for row, end in zip(rows, ends, strict=True)
            for k in range(1, len(c) + 1)
        )
    )


def _row(family: str, tableau: Tableau) -> tuple[str, int, int, float, float, float]:
    """Return family, s, order, defect of (23), and the difference of both sides for each problem."""
    differences = []
    for name, f in FIELDS.items():
        both = collocation_step(f, _start(name), STEP, tableau.c), tableau_step(f, _start(name), STEP, tableau)
        differences.append(_difference(*both))
    pendulum, kepler = differences
    return (family, tableau.stages, tableau.order, _integral_defect(tableau), pendulum, kepler)


def _compiled_difference(family: str, name: str) -> float:
    """Return the difference of the compiled Runge-Kutta step of three stages and the collocation polynomial."""
    c = abscissae(family, COMPILED_STAGES)
    start = _start(name).astype(float)
    method = RungeKutta(collocation_tableau(c, f"{family.replace(' ', '-')}:{COMPILED_STAGES}"))
    stepper = quick_stepper(name, method)
    q, p = np.split(start, 2)
    result = np.concatenate(stepper.step(q, p, float(STEP)))
    exact = collocation_step(FIELDS[name], np.array([mp.mpf(x) for x in start]), mp.mpf(float(STEP)), c)
    return float(np.abs(result - exact.astype(float)).max())


def _tableaux() -> list[tuple[str, Tableau]]:
    stages = ((family, s) for family in FAMILIES for s in STAGES if s >= LEAST_STAGES.get(family, 1))
    return [(family, collocation_tableau(abscissae(family, s))) for family, s in stages]


def _body() -> tuple[Paragraph | Formula, ...]:
    tau, end, a, b = sympy.symbols("tau c_i a_ij b_j")
    cardinal = sympy.Function("ell_j")(tau)
    return (
        Formula(left=a, right=sympy.Integral(cardinal, (tau, 0, end)), number="23"),
        Formula(left=b, right=sympy.Integral(cardinal, (tau, 0, 1)), number="23"),
        Paragraph(
            "Spectral collocation (21) on nodes x_0 .. x_s is the case c_i = (x_i + 1)/2, i = 1 .. s; the irregular "
            "abscissae are c_k = sqrt(k)/3, neither symmetric nor containing an end."
        ),
    )


@experiment("theorem-2.1", "Collocation methods are Runge-Kutta methods")
def _run(_: Mapping[str, Result]) -> Result:
    rows = [_row(family, tableau) for family, tableau in _tableaux()]
    control = [_row("radau-ia (not a collocation method)", radau_ia(s)) for s in (2, 3, 4)]
    largest = max(max(row[4:]) for row in rows)
    least_control = min(min(row[4:]) for row in control)
    compiled = max(_compiled_difference(family, "kepler") for family in FAMILIES)
    return Result(
        setting=(
            f"One step h = {mp.nstr(STEP, 3)} of Hamilton's equations of the pendulum from (q, p) = (0.7, 0.4) and of "
            "Kepler's problem from (0.3, 0.8; -1.1, 0.4); the theorem names no problem.",
            f"{len(FAMILIES)} families of abscissae, s = 1 .. {STAGES[-1]}; both sides in 60 digits, the polynomial by "
            "its coefficients in powers of time, the Runge-Kutta method by its stages.",
        ),
        checks=(
            Comparison(
                claim="The collocation method (22) is equivalent to the s-stage Runge-Kutta method with (23).",
                measured=f"In 60 digits the largest difference of {2 * len(rows)} steps is {largest:.1e}; that of "
                f"compiled {COMPILED_STAGES}-stage methods in double precision is {compiled:.1e}; Radau IA, which is "
                f"not (23) on its points, differs by {least_control:.1e} or more.",
                verdict=holds(largest < 1e-50 and compiled < 1e-14 and least_control > 1e-20),
            ),
        ),
        tables=(
            TableBlock(
                columns=("abscissae", "s", "order", "defect of (23)", "difference, pendulum", "difference, Kepler"),
                rows=tuple(rows + control),
                formats=dict.fromkeys(("defect of (23)", "difference, pendulum", "difference, Kepler"), ".1e"),
            ),
        ),
        body=_body(),
    )
