"""Section 3.3.4: SVI and SC on Kepler's problem.

This module has Figs. 13-15, long runs; 16-20 are in :mod:`scvi_codegen.reproduce.refinement.kepler`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from scvi_codegen.methods import SVI, SpectralCollocation
from scvi_codegen.reproduce.kepler.orbits import (
    Orbit,
    angular_momentum,
    draw_ellipse,
    draw_invariant,
    draw_states,
    exact_flow,
    off_ellipse,
    orbit_of,
    perihelion,
    time_series,
)
from scvi_codegen.reproduce.laboratory.drawing import Array, Figure, draw_error, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
)
from scvi_codegen.reproduce.laboratory.running import SECTION_3

ECCENTRICITY, STEP, SPAN = 0.5, 0.2, 2000.0
DEGREE = 5
"""Degree of six Chebyshev points."""
SCHEMES = ("SVI", "SC")
VISIBLE = 0.01
"""Smallest distance that is visible in a plot of the orbit, in semi-major axes."""
ROUNDOFF_OF_A_RUN = 1e-12
SETTING = (
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.2, T = 2000 (10000 steps, 318 revolutions), six Chebyshev "
    "points: degree 5.",
    "The captions name no quadrature: SVI has 5 Gauss points.",
    "Degree 6 is in the table, too, because the legends of section 3 count the degree in some figures.",
)


@dataclass(frozen=True, slots=True)
class Numbers:
    """Largest errors of energy, momentum and orbit of a run, and the error of the last position."""

    energy: float
    last_energy: float
    momentum: float
    orbit: float
    turn: float
    position: float


def _orbit(scheme: str, degree: int = DEGREE) -> Orbit:
    method = SVI(degree) if scheme == "SVI" else SpectralCollocation(degree)
    return orbit_of(method, STEP, SPAN, ECCENTRICITY, SECTION_3)


@lru_cache(maxsize=8)
def numbers(scheme: str, degree: int = DEGREE) -> Numbers:
    """Return the errors of a scheme over the whole span."""
    orbit = _orbit(scheme, degree)
    exact, _ = exact_flow(*perihelion(ECCENTRICITY), orbit.end)
    return Numbers(
        orbit.largest[0],
        float(orbit.energy[-1]),
        orbit.largest[1],
        float(np.abs(off_ellipse(orbit.run.q, ECCENTRICITY)).max()),
        orbit.turn,
        float(np.hypot(*(orbit.run.q[-1] - exact[0]))),
    )


def _table() -> TableBlock:
    rows = [(scheme, degree, numbers(scheme, degree)) for degree in (5, 6) for scheme in SCHEMES]
    return TableBlock(
        columns=("scheme", "degree", "energy", "energy at T", "momentum", "off the ellipse", "turn", "position at T"),
        rows=tuple(
            (scheme, degree, n.energy, n.last_energy, n.momentum, n.orbit, n.turn, n.position)
            for scheme, degree, n in rows
        ),
    )


@experiment("figure-13", "Kepler, e = 0.5: orbits of SVI and SC over 318 revolutions")
def _figure_13(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    return Result(
        setting=SETTING,
        checks=(
            Comparison(
                claim="SVI stays on the exact orbit, SC leaves it.",
                measured=(
                    f"Largest distance from the ellipse, in semi-major axes: SVI {svi.orbit:.1e}, SC {sc.orbit:.1e}; "
                    f"the perihelion has turned by {abs(svi.turn):.0e} and by {abs(sc.turn):.0e} rad. Below "
                    f"{VISIBLE:g} a picture of the orbit shows nothing."
                ),
                verdict=holds(svi.orbit < 1e-4 < sc.orbit),
                bears_on=("long-time",),
            ),
            Comparison(
                claim="SVI is more accurate than SC in phase with the same points and step.",
                measured=f"Error of the position at T = 2000: SVI {svi.position:.1e}, SC {sc.position:.1e}.",
                verdict=holds(svi.position < sc.position),
                bears_on=("accuracy",),
            ),
        ),
        tables=(_table(),),
        picture=Picture(
            draw=partial(_draw_orbits, runs={s: (_orbit(s).run.t, _orbit(s).run.q) for s in SCHEMES}),
            width=12.0,
            height=4.2,
        ),
    )


def _draw_orbits(figure: Figure, runs: Mapping[str, tuple[Array, Array]]) -> None:
    """Draw the orbits, and the distance from the ellipse, which they do not show."""
    *orbits, distance = panels(figure, 1, 3)
    for axes, (scheme, (t, q)) in zip(orbits, runs.items(), strict=True):
        draw_states(axes, q, scheme)
        draw_error(distance, t, off_ellipse(q, ECCENTRICITY), scheme)
        draw_ellipse(axes, ECCENTRICITY)
        axes.set(title=f"{scheme}, T = 2000", xlabel="$q_1$", ylabel="$q_2$", aspect="equal")
        axes.legend(loc="upper right")
    distance.set(title="distance from the ellipse", xlabel="t", ylabel="in semi-major axes, largest in each bin")
    distance.legend(loc="center right")


def _invariant(name: str, values: Mapping[str, Array], check: Comparison) -> Result:
    columns = {f"{name} {scheme}": series for scheme, series in values.items()}
    t = _orbit("SVI").run.t
    return Result(
        setting=SETTING,
        checks=(check,),
        tables=(_table(), time_series(t, columns)),
        picture=Picture(draw=partial(draw_invariant, t=t, values=values, name=name)),
    )


@experiment("figure-14", "Kepler, e = 0.5: energy of SVI and SC over 318 revolutions")
def _figure_14(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    return _invariant(
        "energy",
        {scheme: _orbit(scheme).run.energy() for scheme in SCHEMES},
        Comparison(
            claim="SVI preserves the energy very well, while it drifts with SC.",
            measured=(
                f"Largest error: SVI {svi.energy:.1e}, SC {sc.energy:.1e}; at T = 2000 SC has "
                f"{-0.5 + sc.last_energy:.5f} for -0.5, and its error there is "
                f"{abs(sc.last_energy) / sc.energy:.0%} of the largest: it grows all the time."
            ),
            verdict=holds(svi.energy < 1e-6 < sc.energy and abs(sc.last_energy) > 0.9 * sc.energy),
            bears_on=("accuracy", "long-time"),
        ),
    )


@experiment("figure-15", "Kepler, e = 0.5: angular momentum of SVI and SC over 318 revolutions")
def _figure_15(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    return _invariant(
        "momentum",
        {scheme: angular_momentum(_orbit(scheme).run.q, _orbit(scheme).run.p) for scheme in SCHEMES},
        Comparison(
            claim="SVI preserves the momentum very well, while it drifts with SC.",
            measured=f"Largest error: SVI {svi.momentum:.1e}, which is round-off, SC {sc.momentum:.1e}.",
            verdict=holds(svi.momentum < ROUNDOFF_OF_A_RUN and sc.momentum > 1e-6),
            bears_on=("accuracy", "long-time"),
        ),
    )
