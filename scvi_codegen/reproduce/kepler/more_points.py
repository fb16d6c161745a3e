"""Figs. 16 and 17: the error of a single step of Kepler's problem when points are added.

The captions do not name the eccentricity. The lines that the paper draws along its curves tell: they have the slopes
and the sizes of the errors on the circle, e = 0. The same is run with e = 0.5, the eccentricity of Figs. 13-15.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.reproduce.kepler.one_step import (
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
from scvi_codegen.reproduce.laboratory.experiment import Comparison, Experiment, Picture, Result, TableBlock, holds

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS", "bases"]

Array = NDArray[np.float64]
Line: TypeAlias = tuple[float, float]

LONG_STEP = 5.0
POINTS = (8, 9, 10, 11, 12, 14, 16, 18, 20, 22)
FIT_WINDOW = 1e-13, 1e-1
"""Errors to which the geometric rate is fitted: above round-off and below the size of the orbit."""
PAPER_BASES: Mapping[tuple[str, str], Line] = {
    ("SC", "q1"): (1e7, 0.1),
    ("SC", "q2"): (1e7, 0.1),
    ("SVI", "q1"): (1e10, 0.03),
    ("SVI", "q2"): (1e10, 0.03),
    ("SC", "momentum"): (1e6, 0.1),
    ("SC", "energy"): (1e6, 0.1),
    ("SVI", "energy"): (1e13, 0.004),
}
"""(c, b) of the lines c b^N drawn by the paper."""
N_SETTING = (
    "Kepler's problem, one step h = 5 from the perihelion, N = 8, 10, ..., 22 Chebyshev points, which is degree N - 1; "
    "SVI has N - 1 Gauss points. The error is that at the end of the step.",
    "The caption names no eccentricity. Both the circle e = 0 and e = 0.5, that of Figs. 13-15, are run: only on the "
    "circle do the errors lie along the paper's lines.",
    "The stage equations are solved to round-off from the straight line: TOL = 1e-14 is less than the rounding of the "
    "stage velocities at this h. A missing point means that the iteration found no solution.",
)


def _errors(scheme: str, e: float, quantity: str) -> Array:
    """Over :data:`POINTS`; NaN where a step has no solution."""
    found = (one_step(scheme, points - 1, e, LONG_STEP) for points in POINTS)
    return np.array([np.nan if errors is None else getattr(errors, quantity) for errors in found])


def bases(scheme: str, e: float, quantity: str) -> Line | None:
    """(c, b) of the line c b^N fitted to the errors inside the window; ``None`` with fewer than three of them."""
    errors, low_high = _errors(scheme, e, quantity), FIT_WINDOW
    inside = (errors > low_high[0]) & (errors < low_high[1])
    if inside.sum() < 3:
        return None
    slope, offset = np.polyfit(np.array(POINTS)[inside], np.log(errors[inside]), 1)
    return float(np.exp(offset)), float(np.exp(slope))


def _n_refinement(name: str, quantities: tuple[str, str], title: str, _: Mapping[str, Result]) -> Result:
    return Result(
        name=name,
        title=title,
        setting=N_SETTING,
        checks=(
            _check_bases(quantities),
            _check_lines(quantities),
            _check_superior(quantities),
        ),
        tables=(_bases_table(quantities), _n_table(quantities)),
        picture=Picture(draw=partial(_draw_n, curves=_n_curves(quantities)), width=9.0, height=7.0),
    )


def _check_bases(quantities: tuple[str, str]) -> Comparison:
    found = {
        (scheme, quantity): (line[1], paper[1])
        for (scheme, quantity), paper in PAPER_BASES.items()
        if quantity in quantities and (line := bases(scheme, CIRCLE, quantity))
    }
    parts = [f"{s} {q} {base:.2g} (paper {paper:g})" for (s, q), (base, paper) in found.items()]
    return Comparison(
        claim="Under N-refinement the errors fall geometrically, like b^N with the bases b of the drawn lines.",
        measured=f"Fitted bases on the circle: {', '.join(parts)}.",
        verdict=holds(all(paper / 2 < base < 2 * paper for base, paper in found.values())),
        bears_on=("geometric",),
    )


def _check_lines(quantities: tuple[str, str]) -> Comparison:
    """Which eccentricity the lines of the paper belong to."""
    circle, ellipse = (_distance_from_lines(quantities, e) for e in (CIRCLE, ELLIPSE))
    return Comparison(
        claim="The lines c b^N run along the errors.",
        measured=(
            f"The typical factor between an error and its line is {circle:.0f} on the circle and {ellipse:.0e} with "
            "e = 0.5: the lines belong to the circle."
        ),
        verdict=holds(circle < 30.0),
    )


def _distance_from_lines(quantities: tuple[str, str], e: float) -> float:
    """The median factor by which errors inside the window are above or below their line."""
    factors: list[float] = []
    for (scheme, quantity), (c, b) in PAPER_BASES.items():
        if quantity in quantities:
            errors = _errors(scheme, e, quantity)
            inside = (errors > FIT_WINDOW[0]) & (errors < FIT_WINDOW[1])
            factors += list(np.abs(np.log(errors[inside] / (c * b ** np.array(POINTS)[inside]))))
    return float(np.exp(np.median(factors)))


def _check_superior(quantities: tuple[str, str]) -> Comparison:
    pairs = {(e, q): (_errors("SVI", e, q), _errors("SC", e, q)) for e in (CIRCLE, ELLIPSE) for q in quantities}
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
        found = bases(scheme, e, quantity)
        return found or (None, None)

    return TableBlock(
        columns=("e", "scheme", "error of", "c", "b in c b^N", "paper's c", "paper's b"),
        rows=tuple(
            (e, s, q, *line(s, e, q), *PAPER_BASES.get((s, q), (None, None)))
            for e in (CIRCLE, ELLIPSE)
            for q in quantities
            for s in SCHEMES
        ),
    )


def _n_table(quantities: tuple[str, str]) -> TableBlock:
    def rows() -> Iterator[tuple[float | None, ...]]:
        for e in (CIRCLE, ELLIPSE):
            columns = [_errors(scheme, e, quantity).tolist() for quantity in quantities for scheme in SCHEMES]
            for points, *errors in zip(POINTS, *columns, strict=True):
                yield e, points, *(None if error != error else error for error in errors)

    names = tuple(f"{quantity} {scheme}" for quantity in quantities for scheme in SCHEMES)
    return TableBlock(name="errors", columns=("e", "N", *names), rows=tuple(rows()))


Curves: TypeAlias = Mapping[tuple[float, str], Mapping[str, Array]]


def _n_curves(quantities: tuple[str, str]) -> Curves:
    return {(e, q): {s: _errors(s, e, q) for s in SCHEMES} for e in (CIRCLE, ELLIPSE) for q in quantities}


def _draw_n(figure: Figure, curves: Curves) -> None:
    """The lines of the paper are named where they belong, on the circle."""
    for axes, ((e, quantity), errors) in zip(panels(figure, 2, 2), curves.items(), strict=True):
        for scheme, values in errors.items():
            shown = np.where(values > 0, values, np.nan)
            axes.plot(POINTS, shown, "o-", color=COLORS[scheme], markersize=3.5, label=scheme)
            if line := PAPER_BASES.get((scheme, quantity)):
                drawn = line[0] * line[1] ** np.array(POINTS, dtype=float)
                power = f"$10^{{{np.log10(line[0]):.0f}}}\\,({line[1]:g})^N$, the paper's line"
                axes.plot(
                    POINTS, drawn, "--", color=COLORS[scheme], linewidth=0.8, label=power if e == CIRCLE else None
                )
        axes.set(yscale="log", ylim=(1e-17, 1e3), xlabel="Chebyshev points N", ylabel=f"error of {LABELS[quantity]}")
        axes.set_title(f"e = {e:g}, one step h = 5")
        axes.legend(loc="upper right" if e == CIRCLE else "best")


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(
        name="figure-16",
        title="Kepler: error of q1 and q2 in one step h = 5 over the number of points",
        run=partial(
            _n_refinement,
            "figure-16",
            ("q1", "q2"),
            "Kepler two body, error of q1 and q2 over a single step h = 5 with N-refinement",
        ),
    ),
    Experiment(
        name="figure-17",
        title="Kepler: error of momentum and energy in one step h = 5 over the number of points",
        run=partial(
            _n_refinement,
            "figure-17",
            ("momentum", "energy"),
            "Kepler two body, error of momentum and energy over a single step h = 5 with N-refinement",
        ),
    ),
)
"""Figs. 16 and 17."""
