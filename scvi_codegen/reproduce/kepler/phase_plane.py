"""Fig. 27: four methods on Kepler's problem in the phase plane, SCVI with four points in both forms."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.methods import Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.kepler.many_points import (
    ECCENTRICITY,
    PRINTED,
    STEP,
    TWO_FORMS,
    VARIATIONAL,
    shooting,
)
from scvi_codegen.reproduce.kepler.orbits import PRESERVED, Orbit, ellipse, orbit_of
from scvi_codegen.reproduce.laboratory.drawing import COLORS, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
    judged,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

SPAN = 60 * math.pi
ROUNDER = 0.2
FOUR_POINTS = 4, 3
PRINTED_NAME = f"SCVI ({PRINTED})"
METHODS: Mapping[str, tuple[Method, float, str]] = {
    "SRK4": (Gauss(2), STEP, "SRK"),
    PRINTED_NAME: (shooting(*FOUR_POINTS, PRINTED), STEP, "printed"),
    f"SCVI ({VARIATIONAL})": (shooting(*FOUR_POINTS, VARIATIONAL), STEP, "SCVI"),
    "Stoermer-Verlet": (StoermerVerlet(), STEP / 2, "Verlet"),
    "SC": (SpectralCollocation(3), STEP, "SC"),
}
SETTING = (
    "Kepler's problem. The caption names neither eccentricity nor time: e = 0.5 and T = 60 pi are taken, those of "
    "Figs. 24-26. SRK4 (Gauss, two stages), SCVI and SC with h = 0.3, Stoermer-Verlet with h = 0.15.",
    "SCVI and SC have four Chebyshev points; the caption names no quadrature: three Gauss points.",
    "Each panel shows (q1, p1) and (q2, p2).",
    TWO_FORMS,
)


@experiment("figure-27", "Kepler: phase trajectories of four methods")
def _figure_27(_: Mapping[str, Result]) -> Result:
    orbits = {name: orbit_of(method, h, SPAN) for name, (method, h, _) in METHODS.items()}
    return Result(
        title="Phase trajectories for the Kepler two-body problem",
        setting=SETTING,
        checks=(
            _kept_check(orbits, [name for name in orbits if name not in ("SC", PRINTED_NAME)]),
            _kept_check(orbits, [PRINTED_NAME], _with_less_eccentricity()),
            _sc_check(orbits["SC"]),
        ),
        tables=(_orbits_table(orbits),),
        picture=Picture(draw=partial(_draw_phases, orbits=_phases(orbits)), width=11.0, height=7.6),
    )


def _with_less_eccentricity() -> str:
    """Return the errors of the printed form on an orbit of smaller eccentricity, as text."""
    energy, momentum = orbit_of(METHODS[PRINTED_NAME][0], STEP, SPAN, ROUNDER).largest
    return f" With e = {ROUNDER:g}: energy {energy:.1e}, momentum {momentum:.1e}."


def _kept_check(orbits: Mapping[str, Orbit], names: list[str], more: str = "") -> Comparison:
    parts = []
    for name in names:
        energy, momentum = orbits[name].largest
        lost = f", lost at t = {orbits[name].lost:.1f}" if orbits[name].lost < orbits[name].end else ""
        parts.append(f"{name}: energy {energy:.1e}, momentum {momentum:.1e}{lost}")
    preserved = [not orbits[name].failed and orbits[name].largest[0] < PRESERVED for name in names]
    return Comparison(
        claim=f"The phase trajectories are preserved by {', '.join(names)}.",
        measured=f"Largest errors: {'; '.join(parts)}.{more}",
        verdict=judged(*preserved),
        bears_on=("scvi-structure",) if any("SCVI" in name for name in names) else (),
    )


def _sc_check(orbit: Orbit) -> Comparison:
    early, late = orbit.halves()
    return Comparison(
        claim="SC does not preserve the phase trajectory.",
        measured=(
            f"Its largest energy error is {early:.3f} in the first half and {late:.3f} in the second, its momentum is "
            f"off by {orbit.largest[1]:.3f} at most."
        ),
        verdict=holds(late > 1.5 * early),
        bears_on=("long-time",),
    )


def _orbits_table(orbits: Mapping[str, Orbit]) -> TableBlock:
    return TableBlock(
        columns=("method", "energy error", "momentum error", "energy off by a tenth at t", "last t"),
        rows=tuple(
            (name, *orbit.largest, orbit.lost if orbit.lost < orbit.end else None, orbit.end)
            for name, orbit in orbits.items()
        ),
        formats={"last t": ".1f", "energy off by a tenth at t": ".1f"},
    )


Phases: TypeAlias = Mapping[str, tuple[Array, Array, str]]


def _phases(orbits: Mapping[str, Orbit]) -> Phases:
    return {n: (o.run.q, o.run.p, METHODS[n][2]) for n, o in orbits.items()}


def _draw_phases(figure: Figure, orbits: Phases) -> None:
    *axes, legend = panels(figure, 2, 3)
    for panel, (name, (q, p, scheme)) in zip(axes, orbits.items(), strict=True):
        for i, marker in enumerate((".", "x")):
            style: dict[str, Any] = {
                "markersize": 2.0,
                "markeredgewidth": 0.4,
                "linestyle": "none",
                "color": COLORS[scheme],
            }
            panel.plot(q[:, i], p[:, i], marker=marker, rasterized=True, label=f"$(q_{i + 1}, p_{i + 1})$", **style)
        _draw_exact_phases(panel)
        panel.set(title=name, xlabel="q", ylabel="p", xlim=(-2.1, 2.1), ylim=(-2.1, 2.1))
    legend.axis("off")
    legend.legend(*axes[0].get_legend_handles_labels(), loc="center")


def _draw_exact_phases(axes: Axes) -> None:
    (x, y), b = ellipse(ECCENTRICITY), math.sqrt(1 - ECCENTRICITY**2)
    cosine, sine = x + ECCENTRICITY, y / b
    r = 1 - ECCENTRICITY * cosine
    axes.plot(x, -sine / r, color="black", linewidth=0.7, label="exact")
    axes.plot(y, b * cosine / r, color="black", linewidth=0.7)
