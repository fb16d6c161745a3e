"""Errors of a single step from the perihelion, in double precision and in 60 digits, of SVI and SC.

Figs. 18-20: error of a single step of Kepler's problem over the step size.

The captions state neither the eccentricity nor, unambiguously, what "N" counts. The lines of Fig. 18 have the slopes
and sizes of the errors on the circle, e = 0, with N points, which is degree N - 1. The same is run with e = 0.5, the
eccentricity of Figs. 13-15, where N is read as the degree.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SVI, Gauss, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, angular_momentum, exact_flow, perihelion
from scvi_codegen.reproduce.laboratory.drawing import COLORS, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Picture,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
    judged,
    series_table,
)
from scvi_codegen.reproduce.laboratory.running import BY_DEGREE, BY_POINTS, stepper_of
from scvi_codegen.tables.precision import DIGITS, Number, mp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SCHEMES = ("SVI", "SC")
LABELS = {"q1": "$q_1$", "q2": "$q_2$", "momentum": "angular momentum", "energy": "energy"}
CIRCLE, ELLIPSE = 0.0, 0.5
"""Eccentricities that are run."""

MOSTLY = 0.9
"""Least share of comparisons at which a claim holds in part."""
ROUNDOFF = 1e-13
"""Round-off level of the error of a step."""
TO_ROUNDOFF = SolverOptions(max_iterations=1000)
ORDER_STEPS = ("0.05", "0.025")
"""Step sizes in units of (1 - e)^(3/2), the time scale at perihelion."""
NEGLIGIBLE = mp.mpf(10) ** (5 - DIGITS)


class StepErrors(NamedTuple):
    """Absolute errors of the four quantities of Figs. 16-20."""

    q1: float
    q2: float
    momentum: float
    energy: float


QUANTITIES = StepErrors._fields


@lru_cache(maxsize=4096)
def one_step(scheme: str, degree: int, e: float, h: float) -> StepErrors | None:
    """Return the errors of the compiled step of h from the perihelion; ``None`` if it has no solution."""
    stepper = stepper_of(SYSTEM, SVI(degree) if scheme == "SVI" else SpectralCollocation(degree), "newton")
    q0, v0 = perihelion(e)
    try:
        q, p = stepper.step(q0, v0, h, options=TO_ROUNDOFF)
    except StepFailedError:
        return None
    exact, _ = exact_flow(q0, v0, h)
    momentum = float(angular_momentum(q, p)) - math.sqrt(1 - e * e)
    return StepErrors(*map(float, np.abs([*(q - exact[0]), momentum, stepper.energy(q, p) + 0.5])))


@lru_cache(maxsize=64)
def orders(scheme: str, degree: int, e: float) -> tuple[float | None, ...]:
    """Return the order in h of each error as h goes to 0; ``None`` for an error below 1e-55.

    Steps are computed in 60 digits, as Runge-Kutta methods: an SVI with as many Gauss points as its degree is Gauss
    collocation, SC is collocation on its nodes.
    """
    method = Gauss(degree) if scheme == "SVI" else SpectralCollocation(degree, form="phase-space")
    scale = (1 - mp.mpf(e)) ** 1.5
    larger, smaller = (_precise_errors(method, e, scale * mp.mpf(h)) for h in ORDER_STEPS)
    return tuple(
        None if min(pair) < NEGLIGIBLE else float(mp.log(pair[0] / pair[1]) / mp.log(2))
        for pair in zip(larger, smaller, strict=True)
    )


def _precise_errors(method: Method, e: float, h: Number) -> tuple[Number, ...]:
    exact_e = mp.mpf(e)
    start = (1 - exact_e, mp.zero), (mp.zero, mp.sqrt((1 + exact_e) / (1 - exact_e)))
    end = derived_step(SYSTEM, method)(*start, h)
    (x, y), (vx, vy) = end.q, end.p
    anomaly = mp.findroot(lambda E: E - exact_e * mp.sin(E) - h, h / (1 - exact_e))
    q1, q2 = mp.cos(anomaly) - exact_e, mp.sqrt(1 - exact_e**2) * mp.sin(anomaly)
    energy = (vx**2 + vy**2) / 2 - 1 / mp.hypot(x, y)
    momentum = x * vy - y * vx - mp.sqrt(1 - exact_e**2)
    return abs(x - q1), abs(y - q2), abs(momentum), abs(energy + mp.mpf(1) / 2)


def shares_won(svi: Array, sc: Array, *, roundoff: float = ROUNDOFF) -> tuple[int, int]:
    """Return how often the error of SVI is smaller, and the number of comparisons with SC above round-off."""
    counted = np.isfinite(svi) & (sc > roundoff)
    return int((svi[counted] < sc[counted]).sum()), int(counted.sum())


def superiority(won: list[tuple[int, int]], *, otherwise: str = "") -> Comparison:
    """Return the check of conclusion (ii) from counts of :func:`shares_won`; ``otherwise`` names exceptions."""
    smaller, all_ = (sum(column) for column in zip(*won, strict=True))
    mostly = MOSTLY * all_ <= smaller < all_
    return Comparison(
        claim="SVI is more accurate than SC with the same number of points and the same step.",
        measured=f"The error of SVI is the smaller one in {smaller} of {all_} comparisons{otherwise}.",
        verdict=Verdict.PARTLY if mostly else holds(smaller == all_),
        bears_on=("accuracy",),
    )


Line: TypeAlias = tuple[float, float]

LEGEND = (2, 4, 6)
STEPS = tuple(float(h) for h in np.geomspace(1e-3, 3.0, 36))
Reading: TypeAlias = tuple[str, float, Callable[[int], int]]


READINGS: tuple[Reading, ...] = (
    ("circle, N points (degree N - 1)", CIRCLE, BY_POINTS.degree),
    ("e = 0.5, N the degree", ELLIPSE, BY_DEGREE.degree),
)
PAPER_POWERS: Mapping[str, tuple[Line, ...]] = {
    "q1": ((1.5, 2), (1e-2, 4), (1e-5, 6), (1e-4, 8), (1e-8, 12)),
    "q2": ((1.5, 3), (1e-2, 5), (1e-5, 7), (1e-7, 10)),
}
"""Constants (c, p) of the lines c h^p in Fig. 18 of the paper."""
H_SETTING = (
    "Kepler's problem, one step of h = 0.001 to 3 from the perihelion; SVI has as many Gauss points as its degree. The "
    "error is that at the end of the step.",
    "The caption says that N counts Chebyshev points and names no eccentricity. Left: so, degree N - 1, with e = 0. "
    "Right: N the degree, as in other figures of section 3, with e = 0.5, that of Figs. 13-15.",
    "Curves are of the compiled steps, solved to round-off. Slopes are for h to 0, from steps in 60 digits of the "
    "Runge-Kutta methods that equal SVI (Gauss) and SC (collocation on its nodes).",
)


def _h_errors(scheme: str, degree: int, e: float, quantity: str) -> Array:
    result = (one_step(scheme, degree, e, h) for h in STEPS)
    return np.array([np.nan if errors is None else getattr(errors, quantity) for errors in result])


def _order(scheme: str, degree: int, e: float, quantity: str) -> float | None:
    return orders(scheme, degree, e)[QUANTITIES.index(quantity)]


def _h_refinement(quantities: tuple[str, ...], title: str, _: Mapping[str, Result]) -> Result:
    checks = [_check_powers()] if "q1" in quantities else [_check_partials(quantities[0])]
    return Result(
        title=title,
        setting=H_SETTING,
        checks=(*checks, _check_superior_h(quantities)),
        tables=(_partials_table(quantities), *(_h_table(quantity) for quantity in quantities)),
        picture=Picture(draw=partial(_draw_h, curves=_h_curves(quantities)), width=9.0, height=4.4 * len(quantities)),
    )


def _check_powers() -> Comparison:
    """Return the check that the exponents of the paper's lines are those of the circle with N points."""
    _, e, degree = READINGS[0]
    result = {
        quantity: {round(_order(s, degree(n), e, quantity) or 0) for n in LEGEND for s in SCHEMES}
        for quantity in PAPER_POWERS
    }
    drawn = {quantity: {round(power) for _, power in lines} for quantity, lines in PAPER_POWERS.items()}
    return Comparison(
        claim="The errors of q1 fall like h^2, h^4, h^6, h^8, h^12, those of q2 like h^3, h^5, h^7, h^10.",
        measured=(
            f"With N points: q1 {_listed(result['q1'])} and q2 {_listed(result['q2'])}; h^11 is a line of SVI with six "
            f"points, whose order is 10. With N the degree: {_partials_text('q1', 1)}; {_partials_text('q2', 1)}."
        ),
        verdict=judged(*(result[quantity] == drawn[quantity] for quantity in drawn)),
    )


def _listed(powers: set[int]) -> str:
    return ", ".join(f"h^{power}" for power in sorted(powers))


def _check_partials(quantity: str) -> Comparison:
    """Return the check of the orders in both readings; an SVI conserves the momentum in any case."""
    e_and_degrees = [(e, degree(n)) for _, e, degree in READINGS for n in LEGEND]
    exact = all(_order("SVI", d, e, quantity) is None for e, d in e_and_degrees)
    faster = all((_order("SVI", d, e, quantity) or 99) > (_order("SC", d, e, quantity) or 0) for e, d in e_and_degrees)
    return Comparison(
        claim=f"The error of the {quantity} falls faster with h for SVI than for SC.",
        measured=f"{_partials_text(quantity, 0)} with N points; {_partials_text(quantity, 1)} with N the degree.",
        verdict=holds(exact if quantity == "momentum" else faster),
        bears_on=("accuracy",),
    )


def _partials_text(quantity: str, reading: int) -> str:
    _, e, degree = READINGS[reading]
    parts = []
    for scheme in SCHEMES:
        result = [_order(scheme, degree(n), e, quantity) for n in LEGEND]
        powers = ", ".join("no error" if derivative is None else f"{derivative:.1f}" for derivative in result)
        parts.append(f"{scheme} {'no error' if not any(result) else powers}")
    return f"{quantity} {' and '.join(parts)}"


def _check_superior_h(quantities: tuple[str, ...]) -> Comparison:
    pairs = [
        (_h_errors("SVI", degree(n), e, q), _h_errors("SC", degree(n), e, q))
        for _, e, degree in READINGS
        for n in LEGEND
        for q in quantities
    ]
    lost = [h for svi, sc in pairs for h, one, other in zip(STEPS, svi, sc, strict=True) if one >= other > ROUNDOFF]
    otherwise = f"; where it is not, h is {min(lost):.2g} or more" if lost else ""
    return superiority([shares_won(svi, sc) for svi, sc in pairs], otherwise=otherwise)


def _partials_table(quantities: tuple[str, ...]) -> TableBlock:
    return TableBlock(
        columns=("reading", "N", "degree", "scheme", *(f"slope of {quantity}" for quantity in quantities)),
        rows=tuple(
            (reading, n, degree(n), scheme, *(_order(scheme, degree(n), e, quantity) for quantity in quantities))
            for reading, e, degree in READINGS
            for scheme in SCHEMES
            for n in LEGEND
        ),
        formats=dict.fromkeys((f"slope of {quantity}" for quantity in quantities), ".2f"),
    )


def _h_table(quantity: str) -> TableBlock:
    columns: dict[str, list[Cell]] = {"h": list(STEPS)}
    for _, e, degree in READINGS:
        for scheme in SCHEMES:
            for n in LEGEND:
                errors = _h_errors(scheme, degree(n), e, quantity).tolist()
                columns[f"{scheme} degree {degree(n)} e {e:g}"] = [None if x != x else x for x in errors]
    return series_table(columns, f"errors-{quantity}")


Curves: TypeAlias = Mapping[tuple[str, str], Mapping[tuple[str, int], Array]]


def _h_curves(quantities: tuple[str, ...]) -> Curves:
    return {
        (reading, q): {(s, n): _h_errors(s, degree(n), e, q) for s in SCHEMES for n in LEGEND}
        for q in quantities
        for reading, e, degree in READINGS
    }


MARKERS = {2: "o", 4: "s", 6: "^"}


def _draw_h(figure: Figure, curves: Curves) -> None:
    for axes, ((reading, quantity), errors) in zip(panels(figure, len(curves) // 2, 2), curves.items(), strict=True):
        for (scheme, n), values in errors.items():
            shown = np.where(values > 0, values, np.nan)
            style: dict[str, Any] = {"marker": MARKERS[n], "markersize": 3.0, "linewidth": 0.9, "markevery": 3}
            axes.plot(STEPS, shown, color=COLORS[scheme], label=f"{scheme}, N = {n}", **style)
        axes.set(xscale="log", yscale="log", ylim=(1e-17, 1e3))
        axes.set(xlabel="step h", ylabel=f"error of {LABELS[quantity]}", title=reading)
        if reading == READINGS[0][0]:
            for constant, power in PAPER_POWERS.get(quantity, ()):
                drawn = constant * np.array(STEPS) ** power
                axes.plot(STEPS, drawn, ":", color=COLORS["exact"], linewidth=0.9)
                first = int(np.argmax(drawn > 1e-16))
                style = {"textcoords": "offset points", "xytext": (-15, 2) if first else (2, 5), "fontsize": 7}
                axes.annotate(f"$h^{{{power:g}}}$", (STEPS[first], drawn[first]), color=COLORS["exact"], **style)
        axes.legend(loc="upper left", ncols=2)


experiment("figure-18", "Kepler: error of q1 and q2 in one step over the step")(
    partial(_h_refinement, ("q1", "q2"), "Kepler two body, error of q1 and q2 with h-refinement")
)
experiment("figure-19", "Kepler: error of the momentum in one step over the step")(
    partial(_h_refinement, ("momentum",), "Kepler two body, error of momentum with h-refinement")
)
experiment("figure-20", "Kepler: error of the energy in one step over the step")(
    partial(_h_refinement, ("energy",), "Kepler two body, error of energy with h-refinement")
)
