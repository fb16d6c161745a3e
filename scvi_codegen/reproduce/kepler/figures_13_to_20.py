"""Section 3.3.4: SVI and SC on Kepler's problem.

This module has Figs. 13-15, long runs; 16-20 are in :mod:`scvi_codegen.reproduce.refinement.kepler`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.methods import SVI, SpectralCollocation
from scvi_codegen.reproduce.kepler.orbits import (
    SYSTEM,
    angular_momentum,
    draw_ellipse,
    draw_states,
    exact_flow,
    off_ellipse,
    perihelion,
    perihelion_turn,
)
from scvi_codegen.reproduce.laboratory.drawing import COLORS, draw_error, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
    series_table,
)
from scvi_codegen.reproduce.laboratory.running import trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

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


@lru_cache(maxsize=8)
def _run(scheme: str, degree: int = DEGREE) -> tuple[Array, Array, Array, Array]:
    """Return (t, q, p, energy) over the whole span."""
    method = SVI(degree) if scheme == "SVI" else SpectralCollocation(degree)
    result = trajectory(SYSTEM, method, *perihelion(ECCENTRICITY), h=STEP, span=SPAN)
    return result.t, result.q, result.p, result.energy()


@lru_cache(maxsize=8)
def numbers(scheme: str, degree: int = DEGREE) -> Numbers:
    """Return the errors of :func:`_run`."""
    t, q, p, energy = _run(scheme, degree)
    momentum = angular_momentum(q, p)
    exact, _ = exact_flow(*perihelion(ECCENTRICITY), t[-1])
    return Numbers(
        float(np.abs(energy - energy[0]).max()),
        float(energy[-1] - energy[0]),
        float(np.abs(momentum - momentum[0]).max()),
        float(np.abs(off_ellipse(q, ECCENTRICITY)).max()),
        perihelion_turn(q, p),
        float(np.hypot(*(q[-1] - exact[0]))),
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


def _series(column: str, values: Mapping[str, Array]) -> TableBlock:
    named = {f"{column} {scheme}": series.tolist() for scheme, series in values.items()}
    return series_table({"t": _run("SVI")[0].tolist(), **named})


@experiment("figure-13", "Kepler, e = 0.5: orbits of SVI and SC over 318 revolutions")
def _figure_13(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    return Result(
        title="Kepler two body, orbit",
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
        picture=Picture(draw=partial(_draw_orbits, runs={s: _run(s)[:2] for s in SCHEMES}), width=12.0, height=4.2),
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


@experiment("figure-14", "Kepler, e = 0.5: energy of SVI and SC over 318 revolutions")
def _figure_14(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    energies = {scheme: _run(scheme)[3] for scheme in SCHEMES}
    return Result(
        title="Kepler two body, energy",
        setting=SETTING,
        checks=(
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
        ),
        tables=(_table(), _series("energy", energies)),
        picture=Picture(draw=partial(_draw_invariant, t=_run("SVI")[0], values=energies, name="energy")),
    )


@experiment("figure-15", "Kepler, e = 0.5: angular momentum of SVI and SC over 318 revolutions")
def _figure_15(_: Mapping[str, Result]) -> Result:
    svi, sc = numbers("SVI"), numbers("SC")
    momenta = {scheme: angular_momentum(*_run(scheme)[1:3]) for scheme in SCHEMES}
    return Result(
        title="Kepler two body, momentum",
        setting=SETTING,
        checks=(
            Comparison(
                claim="SVI preserves the momentum very well, while it drifts with SC.",
                measured=f"Largest error: SVI {svi.momentum:.1e}, which is round-off, SC {sc.momentum:.1e}.",
                verdict=holds(svi.momentum < ROUNDOFF_OF_A_RUN and sc.momentum > 1e-6),
                bears_on=("accuracy", "long-time"),
            ),
        ),
        tables=(_table(), _series("momentum", momenta)),
        picture=Picture(draw=partial(_draw_invariant, t=_run("SVI")[0], values=momenta, name="angular momentum")),
    )


def _draw_invariant(figure: Figure, t: Array, values: Mapping[str, Array], name: str) -> None:
    """Draw an invariant as in the paper, and its error on a logarithmic axis."""
    left, right = panels(figure, 1, 2)
    every = 4
    for scheme in reversed(SCHEMES):
        series = values[scheme]
        left.plot(t[::every], series[::every], color=COLORS[scheme], label=scheme, linewidth=0.8)
        draw_error(right, t, series - series[0], scheme)
    left.set(title=name, xlabel="t", ylabel=name)
    right.set(title=f"error of the {name}", xlabel="t", ylabel="|error|, largest in each bin")
    left.ticklabel_format(useOffset=False)
    left.legend(loc="lower left")
    right.legend(loc="center right")
