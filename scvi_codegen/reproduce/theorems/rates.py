"""Theorems 4.2 and 4.3: geometric convergence in the degree, at a fixed step size."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TypeAlias

from scvi_codegen.methods import SpectralCollocation
from scvi_codegen.reproduce.laboratory.drawing import Panel, Series, draw_panels
from scvi_codegen.reproduce.laboratory.experiment import Comparison, Picture, Result, TableBlock, experiment, holds
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
    quadrature_error,
    rate,
)

DEGREES = (2, 3, 4, 5, 6, 8)
STEP = {"planar-pendulum": 2.0, "kepler": 1.0}

Rates: TypeAlias = Mapping[tuple[str, str, str], tuple[float, float]]


def _steps() -> str:
    steps = " and ".join(f"h = {h:g} ({TITLES[name]})" for name, h in STEP.items())
    return f"One step, {steps}; degrees s = {', '.join(map(str, DEGREES))}"


def _series(name: str, label: str, key: str) -> list[float]:
    method = METHODS[label]
    return [getattr(errors(name, method(s), STEP[name]), key) for s in DEGREES]


def _rates() -> Rates:
    result = {}
    for name in TITLES:
        for label in (GALERKIN, FULL, PRINTED):
            for key in QUANTITIES if label != PRINTED else ("map",):
                result[name, label, key] = rate(DEGREES, _series(name, label, key))
    return result


def _bases(rates: Rates, label: str) -> str:
    """Return the three K of a method on both problems, as text."""
    parts = []
    for name, title in TITLES.items():
        values = ", ".join(f"{rates[name, label, key][1]:.3f}" for key in QUANTITIES)
        parts.append(f"{values} ({title})")
    return " and ".join(parts)


def _geometric_check(rates: Rates, label: str) -> Comparison:
    bases = [[rates[name, label, key][1] for key in QUANTITIES] for name in TITLES]
    spread = max(max(three) / min(three) for three in bases)
    return Comparison(
        claim=f"Map, Legendre transforms and L_d of {label} converge geometrically together (Theorem 4.2).",
        measured=f"K of L_d, of the Legendre transforms and of the map: {_bases(rates, label)}; the three differ by a "
        f"factor of at most {spread:.2f}.",
        verdict=holds(max(map(max, bases)) < 1),
        bears_on=("geometric",),
    )


def _printed_check(rates: Rates) -> Comparison:
    printed = {name: rates[name, PRINTED, "map"][1] for name in TITLES}
    measured = {name: rates[name, FULL, "map"][1] for name in TITLES}
    listed = " and ".join(f"{printed[name]:.2f} against {measured[name]:.3f} ({TITLES[name]})" for name in TITLES)
    exponents = ", ".join(f"{math.log(measured[name]) / math.log(printed[name]):.2f}" for name in TITLES)
    return Comparison(
        claim="(34) as printed is the map of the discrete Lagrangian (33), to which Theorem 4.2 applies.",
        measured=f"It is another map. It converges geometrically, but K = {listed} for the map of (33), which is the "
        f"printed one's K to the power {exponents}: its error is linear in that of the curve, not quadratic.",
        verdict=holds(all(printed[name] < 1.5 * measured[name] for name in TITLES)),
        bears_on=("scvi-structure",),
    )


LOOK = {"action": ("o", "-"), "legendre": ("s", ":"), "map": ("^", "-.")}


def _rate_picture() -> Picture:
    content = []
    for label in (GALERKIN, FULL):
        for name in TITLES:
            series = []
            for key, (marker, line) in LOOK.items():
                y = _series(name, label, key)
                series.append(Series(x=DEGREES, y=y, scheme=label, label=SHOWN[key], marker=marker, line=line))
            if label == FULL:
                y = _series(name, PRINTED, "map")
                series.append(Series(x=DEGREES, y=y, scheme="printed", label="map, as printed", marker="^", line="--"))
            content.append(Panel(title=f"{label}, {TITLES[name]}, h = {STEP[name]:g}", series=tuple(series)))
    draw = partial(draw_panels, rows=2, columns=2, content=tuple(content), floor=PLATEAU)
    return Picture(draw=draw, width=9.0, height=6.5)


@experiment("theorem-4.2", "Geometric rates of map, Legendre transforms and L_d")
def _run_rates(_: Mapping[str, Result]) -> Result:
    rates = _rates()
    rows = tuple((TITLES[name], label, QUANTITIES[key], *result) for (name, label, key), result in rates.items())
    series = tuple(
        (TITLES[name], label, QUANTITIES[key], *map(cell, _series(name, label, key))) for name, label, key in rates
    )
    return Result(
        setting=(
            START,
            f"{_steps()}, s Gauss points. {EXACT}",
            f"C K^s is fitted to errors above {PLATEAU:.0e}. The compiled integrator of the printed form has no "
            "discrete Lagrangian; its map is measured.",
        ),
        checks=(_geometric_check(rates, GALERKIN), _geometric_check(rates, FULL), _printed_check(rates)),
        tables=(
            TableBlock(columns=("problem", "method", "error of", "C", "K"), rows=rows),
            TableBlock(
                name="errors",
                columns=("problem", "method", "error of", *(f"s = {s}" for s in DEGREES)),
                rows=series,
                formats={f"s = {s}": ".1e" for s in DEGREES},
            ),
        ),
        picture=_rate_picture(),
    )


CASES = {FULL: DEGREES, FEW: (2, 4, 6, 8)}
"""Degrees; with few points the rule changes with every other degree."""
LARGEST_RATIO = 10.0
"""Bound on the error of L_d relative to its bound: h times the Lipschitz constant of L."""


def _parts(name: str, label: str) -> dict[str, list[float]]:
    """Return the errors of the collocation method, the quadrature and L_d by degree."""
    h, methods = STEP[name], [METHODS[label](s) for s in CASES[label]]
    return {
        "collocation": [errors(name, SpectralCollocation(method.degree), h).map for method in methods],
        "quadrature": [quadrature_error(name, method.rule, h) for method in methods],
        "L_d": [errors(name, method, h).action for method in methods],
    }


def _bound_check(name: str, label: str) -> Comparison:
    parts = _parts(name, label)
    K = {part: rate(CASES[label], values)[1] for part, values in parts.items()}
    ratios = [error / (a + g) for a, g, error in zip(*parts.values(), strict=True) if error > PLATEAU and a > 0]
    return Comparison(
        claim="The error of the L_d of SCVI is at most C K^N, K = max(K_A, K_g) (Theorem 4.3).",
        measured=f"{label}, {TITLES[name]}: K_A = {K['collocation']:.3f} (collocation), K_g = {K['quadrature']:.3f} "
        f"(quadrature), K = {K['L_d']:.3f} (L_d), max(K_A^2, K_g) = {max(K['collocation'] ** 2, K['quadrature']):.3f}; "
        f"the error of L_d is at most {max(ratios):.2g} times the sum of the other two at every degree.",
        verdict=holds(max(K.values()) < 1 and max(ratios) < LARGEST_RATIO),
        bears_on=("geometric",),
    )


def _bound_panel(name: str, label: str) -> Panel:
    look = {"collocation": ("SC", "s"), "quadrature": ("exact", "^"), "L_d": ("SCVI", "o")}
    parts, degrees = _parts(name, label), CASES[label]
    fits = {part: rate(degrees, values) for part, values in parts.items()}
    series = [
        Series(
            x=degrees,
            y=parts[part],
            scheme=scheme,
            marker=marker,
            label=f"{'$L_d$' if part == 'L_d' else part}, K = {fits[part][1]:.2g}",
        )
        for part, (scheme, marker) in look.items()
    ]
    return Panel(title=f"{label}, {TITLES[name]}, h = {STEP[name]:g}", series=tuple(series))


def _bound_picture() -> Picture:
    content = tuple(_bound_panel(name, label) for label in CASES for name in TITLES)
    return Picture(draw=partial(draw_panels, rows=2, columns=2, content=content, floor=PLATEAU), width=9.0, height=6.5)


@experiment("theorem-4.3", "Geometric convergence of the SCVI discrete Lagrangian")
def _run_bounds(_: Mapping[str, Result]) -> Result:
    columns = ("problem", "method", "error of", "C", "K", *(f"s = {s}" for s in DEGREES))
    rows = []
    for label, degrees in CASES.items():
        for name in TITLES:
            for part, values in _parts(name, label).items():
                by_degree = dict(zip(degrees, map(cell, values), strict=True))
                rows.append((TITLES[name], label, part, *rate(degrees, values), *map(by_degree.get, DEGREES)))
    return Result(
        setting=(
            START,
            f"{_steps()}; s Gauss points, and few: s // 2, even degrees. {EXACT}",
            "The error of the collocation method is that of a step of spectral collocation of the same degree, in "
            "position and momentum; that of the quadrature is measured with L along the exact solution. C K^s is "
            f"fitted to errors above {PLATEAU:.0e}; a degree is left out where a step has no solution.",
        ),
        checks=tuple(_bound_check(name, label) for label in CASES for name in TITLES),
        tables=(TableBlock(columns=columns, rows=tuple(rows), formats=dict.fromkeys(columns[5:], ".1e")),),
        picture=_bound_picture(),
    )
