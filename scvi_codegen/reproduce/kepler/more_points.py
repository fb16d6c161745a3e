"""Figs. 16 and 17: error of a single step of Kepler's problem over the number of points.

The captions do not state the eccentricity. The lines in the paper have the slopes and sizes of the errors on the
circle, e = 0. The errors for e = 0.2 and 0.5, the eccentricities of Table 8 and of Figs. 13-15, differ; they are
computed and judged, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.reproduce.kepler.smaller_steps import (
    CIRCLE,
    ELLIPSE,
    LABELS,
    ROUNDOFF,
    SCHEMES,
    one_step,
    shares_won,
    superiority,
)
from scvi_codegen.reproduce.laboratory.drawing import COLORS, panels
from scvi_codegen.reproduce.laboratory.experiment import Comparison, Picture, Result, TableBlock, experiment, judged
from scvi_codegen.reproduce.laboratory.geometric import (
    AGREEMENT_FACTOR,
    STRAIGHT,
    Line,
    factors,
    fitted_line,
    is_straight,
    typical,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

LONG_STEP = 5.0
POINTS = (8, 9, 10, 11, 12, 14, 16, 18, 20, 22)
N = np.array(POINTS, dtype=float)
JUDGED = CIRCLE, 0.2, ELLIPSE
"""Eccentricities that are run; verdicts require all of them."""
PAPER_BASES: Mapping[tuple[str, str], Line] = {
    ("SC", "q1"): (1e7, 0.1),
    ("SC", "q2"): (1e7, 0.1),
    ("SVI", "q1"): (1e10, 0.03),
    ("SVI", "q2"): (1e10, 0.03),
    ("SC", "momentum"): (1e6, 0.1),
    ("SC", "energy"): (1e6, 0.1),
    ("SVI", "energy"): (1e13, 0.004),
}
"""Constants (c, b) of the lines c b^N in the paper."""
N_SETTING = (
    "Kepler's problem, one step h = 5 from the perihelion, N = 8, 10, ..., 22 Chebyshev points, which is degree N - 1; "
    "SVI has N - 1 Gauss points. The error is that at the end of the step.",
    "The caption names no eccentricity. The circle e = 0, e = 0.2 of Table 8 and e = 0.5 of Figs. 13-15 are run, and "
    "each verdict is on all three: what is found on the circle alone holds in part.",
    "The stage equations are solved to round-off from the straight line: TOL = 1e-14 is less than the rounding of the "
    "stage velocities at this h. A missing point means that the iteration found no solution.",
)


def _errors(scheme: str, e: float, quantity: str) -> Array:
    """Return the errors over :data:`POINTS`; NaN if a step has no solution."""
    result = (one_step(scheme, points - 1, e, LONG_STEP) for points in POINTS)
    return np.array([np.nan if errors is None else getattr(errors, quantity) for errors in result])


def bases(scheme: str, e: float, quantity: str) -> Line | None:
    """Return (c, b) of the line c b^N fitted to the errors inside the window; ``None`` for fewer than three."""
    return fitted_line(N, _errors(scheme, e, quantity))


def _n_refinement(quantities: tuple[str, str], title: str, _: Mapping[str, Result]) -> Result:
    return Result(
        title=title,
        setting=N_SETTING,
        checks=(
            _check_geometric(quantities),
            _check_bases(quantities),
            _check_lines(quantities),
            _check_superior(quantities),
        ),
        tables=(_bases_table(quantities), _n_table(quantities)),
        picture=Picture(draw=partial(_draw_n, curves=_n_curves(quantities)), width=9.0, height=10.0),
    )


def _curves_with_errors(quantities: tuple[str, str], e: float) -> list[tuple[str, str]]:
    """Return (scheme, quantity) of curves with a fitted line; SVI conserves the momentum."""
    return [(s, q) for q in quantities for s in SCHEMES if bases(s, e, q)]


def _check_geometric(quantities: tuple[str, str]) -> Comparison:
    curves = {e: _curves_with_errors(quantities, e) for e in JUDGED}
    straight = {e: [is_straight(N, _errors(s, e, q)) for s, q in result] for e, result in curves.items()}
    slowest = {e: max(line[1] for s, q in result if (line := bases(s, e, q))) for e, result in curves.items()}
    return Comparison(
        claim="Under N-refinement the errors fall geometrically.",
        measured="Straight (N and the logarithm of the error correlate with r^2 above "
        f"{STRAIGHT:g}) are "
        + ", ".join(f"{sum(result)} of {len(result)} curves with e = {e:g}" for e, result in straight.items())
        + "; the slowest falls by "
        + ", by ".join(f"{base:.2g} (e = {e:g})" for e, base in slowest.items())
        + " a point.",
        verdict=judged(*(one for result in straight.values() for one in result)),
        bears_on=("geometric",),
    )


def _check_bases(quantities: tuple[str, str]) -> Comparison:
    def result(e: float) -> dict[tuple[str, str], tuple[float, float]]:
        return {
            key: (line[1], paper[1])
            for key, paper in PAPER_BASES.items()
            if key[1] in quantities and (line := bases(key[0], e, key[1]))
        }

    by_e = {e: result(e) for e in JUDGED}
    parts = {e: ", ".join(f"{s} {q} {base:.2g}" for (s, q), (base, _) in by_e[e].items()) for e in JUDGED}
    printed = ", ".join(f"{s} {q} {paper[1]:g}" for (s, q), paper in PAPER_BASES.items() if q in quantities)
    return Comparison(
        claim=f"They fall like b^N with the bases b of the drawn lines: {printed}.",
        measured="; ".join(f"with e = {e:g}: {text}" for e, text in parts.items())
        + ". Bases that differ by less than a factor of two count as the same.",
        verdict=judged(*(all(b / 2 < base < 2 * b for base, b in pairs.values()) for pairs in by_e.values())),
    )


def _check_lines(quantities: tuple[str, str]) -> Comparison:
    """Return the check which eccentricity the lines of the paper match."""
    off = {e: _distance_from_lines(quantities, e) for e in JUDGED}
    return Comparison(
        claim="The lines c b^N run along the errors.",
        measured="The typical factor between an error and its line is "
        + ", ".join(f"{factor:.1g} with e = {e:g}" for e, factor in off.items())
        + f". Below {AGREEMENT_FACTOR:g} counts as along.",
        verdict=judged(*(factor < AGREEMENT_FACTOR for factor in off.values())),
    )


def _distance_from_lines(quantities: tuple[str, str], e: float) -> float:
    """Return the median factor between errors inside the window and their line."""
    return typical(factors(N, _errors(s, e, q), line) for (s, q), line in PAPER_BASES.items() if q in quantities)


def _check_superior(quantities: tuple[str, str]) -> Comparison:
    pairs = {(e, q): (_errors("SVI", e, q), _errors("SC", e, q)) for e in JUDGED for q in quantities}
    lost = [
        f"of {q} with e = {e:g}, N = {points}"
        for (e, q), (svi, sc) in pairs.items()
        for points, one, other in zip(POINTS, svi, sc, strict=True)
        if one >= other > ROUNDOFF
    ]
    otherwise = f"; not {', '.join(lost)}" if lost else ""
    return superiority([shares_won(svi, sc) for svi, sc in pairs.values()], otherwise=otherwise)


def _bases_table(quantities: tuple[str, str]) -> TableBlock:
    def line(scheme: str, e: float, quantity: str) -> tuple[float | None, float | None]:
        result = bases(scheme, e, quantity)
        return result or (None, None)

    return TableBlock(
        columns=("e", "scheme", "error of", "c", "b in c b^N", "paper's c", "paper's b"),
        rows=tuple(
            (e, s, q, *line(s, e, q), *PAPER_BASES.get((s, q), (None, None)))
            for e in JUDGED
            for q in quantities
            for s in SCHEMES
        ),
    )


def _n_table(quantities: tuple[str, str]) -> TableBlock:
    def rows() -> Iterator[tuple[float | None, ...]]:
        for e in JUDGED:
            columns = [_errors(scheme, e, quantity).tolist() for quantity in quantities for scheme in SCHEMES]
            for points, *errors in zip(POINTS, *columns, strict=True):
                yield e, points, *(None if error != error else error for error in errors)

    names = tuple(f"{quantity} {scheme}" for quantity in quantities for scheme in SCHEMES)
    return TableBlock(name="errors", columns=("e", "N", *names), rows=tuple(rows()))


Curves: TypeAlias = Mapping[tuple[float, str], Mapping[str, Array]]


def _n_curves(quantities: tuple[str, str]) -> Curves:
    return {(e, q): {s: _errors(s, e, q) for s in SCHEMES} for e in JUDGED for q in quantities}


def _draw_n(figure: Figure, curves: Curves) -> None:
    """Draw the errors; lines of the paper are labelled on the circle, which they match."""
    for axes, ((e, quantity), errors) in zip(panels(figure, len(JUDGED), 2), curves.items(), strict=True):
        for scheme, values in errors.items():
            shown = np.where(values > 0, values, np.nan)
            axes.plot(POINTS, shown, "o-", color=COLORS[scheme], markersize=3.5, label=scheme)
            if line := PAPER_BASES.get((scheme, quantity)):
                drawn = line[0] * line[1] ** N
                power = f"$10^{{{np.log10(line[0]):.0f}}}\\,({line[1]:g})^N$, the paper's line"
                axes.plot(
                    POINTS, drawn, "--", color=COLORS[scheme], linewidth=0.8, label=power if e == CIRCLE else None
                )
        axes.set(yscale="log", ylim=(1e-17, 1e3), xlabel="Chebyshev points N", ylabel=f"error of {LABELS[quantity]}")
        axes.set_title(f"e = {e:g}, one step h = 5")
        axes.legend(loc="upper right" if e == CIRCLE else "best")


experiment("figure-16", "Kepler: error of q1 and q2 in one step h = 5 over the number of points")(
    partial(
        _n_refinement,
        ("q1", "q2"),
        "Kepler two body, error of q1 and q2 over a single step h = 5 with N-refinement",
    )
)
experiment("figure-17", "Kepler: error of momentum and energy in one step h = 5 over the number of points")(
    partial(
        _n_refinement,
        ("momentum", "energy"),
        "Kepler two body, error of momentum and energy over a single step h = 5 with N-refinement",
    )
)
