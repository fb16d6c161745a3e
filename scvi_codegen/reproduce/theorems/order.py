"""Theorem 4.1: a shooting-based discrete Lagrangian has order min(p, q) in the step."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import sympy

from scvi_codegen.methods import SCVI, SVI, SpectralCollocation
from scvi_codegen.reproduce.laboratory.drawing import Panel, Series, draw_panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Formula,
    Paragraph,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
)
from scvi_codegen.reproduce.theorems.convergence import (
    EXACT,
    FEW,
    FULL,
    GALERKIN,
    METHODS,
    PLATEAU,
    PRINTED,
    QUANTITIES,
    SHOWN,
    START,
    TITLES,
    cell,
    errors,
    fitted_order,
)

DEGREES = (1, 2, 3, 4, 5)
STEPS = {
    "planar-pendulum": tuple(2 ** (1 - k / 2) for k in range(10)),
    "kepler": tuple(2 ** (-k / 2) for k in range(10)),
}
MISS = 0.35
"""Largest distance of a fitted exponent from an integer."""
CURTIS = "Clenshaw-Curtis"


@dataclass(frozen=True, slots=True)
class Order:
    """Orders of one method on one problem: exponents of h, less 1, of errors in one step."""

    name: str
    label: str
    degree: int
    p: int
    q: int
    action: float
    legendre: float
    map: float

    @property
    def bound(self) -> int:
        """Order by Theorem 4.1."""
        return min(self.p, self.q)

    @property
    def expected(self) -> int:
        """Order by the quadratic dependence of L_d on the curve; a Galerkin curve also depends on the quadrature."""
        galerkin = self.label.startswith(GALERKIN)
        return min(2 * self.degree, self.q, 2 * (self.q - self.degree + 1) if galerkin else self.q)


def _order(name: str, label: str, method: SCVI | SVI) -> Order:
    s = method.degree
    result = [errors(name, method, h) for h in STEPS[name]]
    measured = {key: fitted_order(STEPS[name], [getattr(error, key) for error in result]) - 1 for key in QUANTITIES}
    return Order(name, label, s, SpectralCollocation(s).tableau.order, method.rule.order, **measured)


def _orders() -> list[Order]:
    degrees = {GALERKIN: DEGREES, FULL: DEGREES, FEW: DEGREES[1:], PRINTED: DEGREES[1:]}
    orders = [_order(name, label, METHODS[label](s)) for name in STEPS for label, some in degrees.items() for s in some]
    shooting = [SCVI(s, f"clenshaw-curtis:{s + 1}") for s in (3, 4, 5)]
    galerkin = [SVI(s, f"clenshaw-curtis:{g}") for s, g in ((4, 4), (5, 6), (6, 7))]
    orders += [_order("kepler", f"{FULL}, {CURTIS}", method) for method in shooting]
    return orders + [_order("kepler", f"{GALERKIN}, {CURTIS}", method) for method in galerkin]


def _checks(orders: list[Order]) -> tuple[Comparison, ...]:
    shooting = [order for order in orders if order.label in (FULL, FEW, f"{FULL}, {CURTIS}")]
    printed = [order for order in orders if order.label == PRINTED]
    action, of_map, legendre = (
        min(getattr(order, key) - order.bound for order in shooting) for key in ("action", "map", "legendre")
    )
    missed = max(abs(order.map - order.expected) for order in shooting)
    lost = [order.action - order.legendre for order in shooting]
    few = [f"{order.map:.2f}" for order in printed]
    return (
        Comparison(
            claim="The shooting-based discrete Lagrangian of a collocation method of order p and a quadrature of order "
            "q has order min(p, q) (Theorem 4.1).",
            measured=f"In {len(shooting)} cases the order of L_d is at least min(p, q) {action:+.2f}.",
            verdict=holds(action > -MISS),
            bears_on=("order",),
        ),
        Comparison(
            claim="So has the variational integrator that it generates.",
            measured=f"The order of the map is at least min(p, q) {of_map:+.2f}. It is better than the bound: min(2s, "
            f"q) to within {missed:.2f}, because the error of L_d is quadratic in the error of the curve.",
            verdict=holds(of_map > -MISS),
            bears_on=("order",),
        ),
        Comparison(
            claim="By Theorem 2.3.1 of [24], on which this rests, the discrete Legendre transforms along trajectories "
            "have the order of L_d, too.",
            measured=f"They lose a power of h: their orders are lower by {min(lost):.2f} to {max(lost):.2f} than that "
            f"of L_d, and fall to min(p, q) {legendre:+.2f}; the map has the order of L_d all the same.",
            verdict=holds(max(lost) < 0.5),
        ),
        Comparison(
            claim="(34) as printed is the integrator of this discrete Lagrangian.",
            measured=f"For s = 2 .. 5 its map has orders {', '.join(few[:4])} (pendulum) and {', '.join(few[4:])} "
            "(Kepler), about s - 1 and below min(p, q) = s.",
            verdict=holds(min(order.map - order.bound for order in printed) > -MISS),
            bears_on=("order",),
        ),
    )


def _panel(name: str, key: str) -> Panel:
    def curves(label: str, degrees: tuple[int, ...], scheme: str, line: str, steps: tuple[float, ...]) -> list[Series]:
        first = label.removeprefix("SCVI ") if key == "map" else ""
        return [
            Series(
                x=steps,
                y=[getattr(errors(name, METHODS[label](s), h), key) for h in steps],
                scheme=scheme,
                label=first if s == degrees[0] else "",
                end=f"{s}",
                line=line,
            )
            for s in degrees
        ]

    series = curves(FULL, DEGREES, "SCVI", "-", STEPS[name][::-1])
    if key == "map":
        series += curves(PRINTED, (3, 5), "printed", "--", STEPS[name])
    return Panel(title=f"{TITLES[name]}: {SHOWN[key]}", series=tuple(series), steps=True)


def _picture() -> Picture:
    content = tuple(_panel(name, key) for name in STEPS for key in QUANTITIES)
    return Picture(draw=partial(draw_panels, rows=2, columns=3, content=content, floor=PLATEAU), width=10.0, height=6.0)


@experiment("theorem-4.1", "Order of shooting-based discrete Lagrangians")
def _run(_: Mapping[str, Result]) -> Result:
    orders = _orders()
    columns = ("problem", "method", "s", "p", "q", "min(p, q)", "expected", "L_d", "Legendre transforms", "map")
    rows = tuple(
        (
            TITLES[o.name],
            o.label,
            o.degree,
            o.p,
            o.q,
            o.bound,
            o.expected,
            *(cell(getattr(o, key)) for key in QUANTITIES),
        )
        for o in orders
    )
    return Result(
        setting=(
            START,
            f"{EXACT} Orders are exponents of h, less 1, of the errors in one step, fitted to the three smallest steps "
            f"with errors above {PLATEAU:.0e}; successive steps differ by a factor sqrt(2).",
            "Chebyshev-Lobatto nodes, s Gauss points; few points: max(1, s // 2) Gauss points, whose order q decides; "
            "Clenshaw-Curtis: s + 1 points. p is the order of spectral collocation of degree s.",
            "The compiled integrator of the printed form has no discrete Lagrangian; its map is measured.",
            "Numbers at the curves of the picture are degrees.",
        ),
        checks=_checks(orders),
        tables=(TableBlock(columns=columns, rows=rows, formats=dict.fromkeys(columns[7:], ".2f")),),
        picture=_picture(),
        body=_body(orders),
    )


def _body(orders: list[Order]) -> tuple[Paragraph | Formula, ...]:
    galerkin = [order for order in orders if order.label == f"{GALERKIN}, {CURTIS}"]
    result = ", ".join(f"{o.map:.2f} for s = {o.degree}, q = {o.q} ({o.expected})" for o in galerkin)
    h = sympy.Symbol("h")
    third = sympy.Symbol("q'''(0)")
    return (
        Paragraph(
            "Why the Legendre transforms lose a power: q1 - q0 is of size h, so that L_d - L_d^E = "
            "h^(r+1) e(q0, (q1 - q0)/h) has a derivative by q1 of size h^r. The midpoint rule for L = v^2/2 - V(q) "
            "shows it by hand, along the exact solution:"
        ),
        Formula(left=sympy.Symbol("p0 - p0^E"), right=-(h**2) * third / 12 + sympy.Order(h**3)),
        Paragraph(
            "The losses at both ends cancel in the map: G. W. Patrick and C. Cuell, Error analysis of variational "
            "integrators of unconstrained Lagrangian systems, Numer. Math. 113 (2009) 243."
        ),
        Paragraph(
            "In the table the order expected is min(2s, q) for SCVI. For SVI it is min(2s, q, 2(q - s + 1)): the "
            "quadrature must also resolve the stationarity conditions, in which the variation has degree s and becomes "
            "no smoother with h. Gauss and Lobatto rules of s points or more do; with Clenshaw-Curtis rules the order "
            f"of the map on Kepler's problem is {result}; the order expected is in parentheses."
        ),
    )
