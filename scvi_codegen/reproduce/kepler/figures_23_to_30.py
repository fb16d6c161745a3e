"""Section 4.3.2: SCVI on Kepler's problem.

This module has Figs. 23-26, with two points. With more points the printed and the variational equations differ: Figs.
27-30 are in :mod:`.many_points`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from scvi_codegen.methods import SCVI, SpectralCollocation
from scvi_codegen.reproduce.kepler.orbits import (
    SYSTEM,
    Orbit,
    angular_momentum,
    draw_ellipse,
    draw_invariant,
    draw_orbits,
    orbit_of,
    perihelion,
    revolutions,
    time_series,
)
from scvi_codegen.reproduce.laboratory.drawing import COLORS, Array, Figure, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
)
from scvi_codegen.reproduce.laboratory.running import SECTION_4, stepper_of
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

ECCENTRICITY = 0.5
TWO_POINTS = SCVI(1, "gauss-legendre:2")
QUADRATURE = "Section 4.3 names two interpolation points and two Gauss points; printed and variational equations agree."

# Fig. 23: ten thousand periods.

SEGMENTS = ((1, 2150), (198925, 201075), (397850, 400000))
LONG_STEP = math.pi / 20


@dataclass(frozen=True, slots=True)
class TimeInterval:
    """Positions of consecutive steps, the range of their energies, and the largest error of the momentum."""

    q: Array
    lowest: float
    highest: float
    momentum: float


@lru_cache(maxsize=1)
def segments() -> tuple[TimeInterval, ...]:
    """Return the steps that are drawn, of one run of 400000 steps."""
    stepper = stepper_of(SYSTEM, TWO_POINTS)
    q, velocity = perihelion(ECCENTRICITY)
    run = stepper.start(q, stepper.momentum(q, velocity), h=LONG_STEP, options=SECTION_4)
    result = []
    for first, last in SEGMENTS:
        run.record(first - run.steps, save_every=SEGMENTS[-1][-1])
        result.append(_segment(run.record(last - first)))
    return tuple(result)


def _segment(part: Trajectory) -> TimeInterval:
    energy, momentum = part.energy(), angular_momentum(part.q, part.p)
    error = np.abs(momentum - math.sqrt(1 - ECCENTRICITY**2))
    return TimeInterval(part.q, float(energy.min()), float(energy.max()), float(error.max()))


@experiment("figure-23", "Kepler: SCVI with two points over 10000 periods")
def _figure_23(_: Mapping[str, Result]) -> Result:
    parts = segments()
    first, last = parts[0], parts[-1]
    change = max(abs(last.lowest - first.lowest), abs(last.highest - first.highest)) / (first.highest - first.lowest)
    momentum = max(part.momentum for part in parts)
    runs = {f"steps {a} to {b}": (part.q, "SCVI") for (a, b), part in zip(SEGMENTS, parts, strict=True)}
    return Result(
        setting=("Kepler's problem, e = 0.5, from the perihelion, h = pi/20, T = 20000 pi: 400000 steps.", QUADRATURE),
        checks=(
            Comparison(
                claim="After 10000 periods the orbit is what it was in the beginning.",
                measured=(
                    f"The energy lies between {first.lowest:.5f} and {first.highest:.5f} in the first 2150 steps and "
                    f"between {last.lowest:.5f} and {last.highest:.5f} in the last: the ends have moved by "
                    f"{change:.1e} of the range. The largest error of the momentum is {momentum:.1e}."
                ),
                verdict=holds(change < 0.01 and momentum < 1e-10),
                bears_on=("scvi-structure",),
            ),
        ),
        tables=(
            TableBlock(
                columns=("first step", "last step", "lowest energy", "highest energy", "error of the momentum"),
                rows=tuple((*s, p.lowest, p.highest, p.momentum) for s, p in zip(SEGMENTS, parts, strict=True)),
                formats={"first step": "d", "last step": "d", "lowest energy": ".6f", "highest energy": ".6f"},
            ),
        ),
        picture=Picture(draw=partial(draw_orbits, runs=runs, rows=1, e=ECCENTRICITY), width=11.0, height=4.0),
    )


# Figs. 24-26: SCVI with two points, SC with three.

STEP, SPAN = 0.1, 60 * math.pi
COMPARED = {"SCVI": TWO_POINTS, "SC": SpectralCollocation(2)}
SETTING = (
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.1, T = 60 pi (30 periods): SCVI with two points, SC with "
    "three.",
    QUADRATURE,
)
FACTOR = 2.5, 3.0
"""Range of factors that counts as "almost three"."""


def _orbit(scheme: str) -> Orbit:
    return orbit_of(COMPARED[scheme], STEP, SPAN, ECCENTRICITY)


@dataclass(frozen=True, slots=True)
class Periods:
    """Durations of the first and the last full revolution, from apocentre to apocentre.

    Attributes:
        first, last: durations.
        kepler: period of an exact orbit of the last energy.
        turn: rotation of the perihelion over the whole run, in radians.
    """

    first: float
    last: float
    kepler: float
    turn: float

    @property
    def factor(self) -> float:
        """Ratio of the period of the exact orbit to the last period."""
        return 2 * math.pi / self.last


@lru_cache(maxsize=2)
def periods(scheme: str) -> Periods:
    """Return the periods of ``"SCVI"`` with two points or of ``"SC"`` with three."""
    orbit = _orbit(scheme)
    durations = revolutions(orbit.run.t, orbit.run.q, orbit.run.p)
    energy = float(orbit.run.energy()[-1])
    return Periods(float(durations[0]), float(durations[-1]), 2 * math.pi / (-2 * energy) ** 1.5, orbit.turn)


def two_points_fail_at() -> tuple[float, float]:
    """Return (time, energy) of the last state of SC with two points; the end of the span if it succeeds."""
    orbit = orbit_of(SpectralCollocation(1), STEP, SPAN, ECCENTRICITY)
    return orbit.end, float(orbit.run.energy()[-1])


@experiment("figure-24", "Kepler: orbits of SCVI with two points, SC with three")
def _figure_24(_: Mapping[str, Result]) -> Result:
    scvi, sc = periods("SCVI"), periods("SC")
    time, energy = two_points_fail_at()
    return Result(
        setting=SETTING,
        checks=(
            Comparison(
                claim="The orbital period shrinks by a factor of almost three with SC.",
                measured=(
                    f"The first revolution takes {sc.first:.3f}, the last {sc.last:.3f}, which is {sc.factor:.2f} "
                    f"times less than 2 pi; the period of an exact orbit of the last energy is {sc.kepler:.3f}."
                ),
                verdict=holds(FACTOR[0] < sc.factor < FACTOR[1]),
                bears_on=("sc-period",),
            ),
            Comparison(
                claim="The period does not change with SCVI.",
                measured=(
                    f"The first revolution takes {scvi.first:.4f}, the last {scvi.last:.4f}, the exact one "
                    f"{2 * math.pi:.4f}: constant, if {1 - scvi.first / (2 * math.pi):.1%} too short. The perihelion "
                    f"turns by {scvi.turn:.2f} rad in 30 revolutions."
                ),
                verdict=holds(abs(scvi.last / scvi.first - 1) < 0.01),
                bears_on=("sc-period", "scvi-structure"),
            ),
            Comparison(
                claim="SC with two points is not stable at h = 0.1.",
                measured=(
                    f"It falls into the centre: the energy is {energy:.2f} for -0.5 at t = {time:.1f}, and the next "
                    "step has no solution that Newton's method finds."
                    if time < SPAN / 2
                    else f"It reaches t = {time:.0f} with the energy {energy:.3f}."
                ),
                verdict=holds(time < SPAN / 2),
                bears_on=("sc-unstable",),
            ),
        ),
        tables=(
            TableBlock(
                columns=("scheme", "first revolution", "last revolution", "2 pi / last", "period of the last energy"),
                rows=tuple((s, p.first, p.last, p.factor, p.kepler) for s, p in (("SCVI", scvi), ("SC", sc))),
                formats=dict.fromkeys(("first revolution", "last revolution", "period of the last energy"), ".4f"),
            ),
        ),
        picture=Picture(
            draw=partial(
                _draw_periods, runs={scheme: (_orbit(scheme).run.t, _orbit(scheme).run.q) for scheme in COMPARED}
            ),
            width=9.0,
            height=7.6,
        ),
    )


def _draw_periods(figure: Figure, runs: Mapping[str, tuple[Array, Array]]) -> None:
    """Draw all 30 periods on the left, the last 2 pi on the right."""
    axes = panels(figure, 2, 2)
    for row, (scheme, (t, q)) in enumerate(runs.items()):
        whole, last = axes[2 * row], axes[2 * row + 1]
        whole.plot(q[:, 0], q[:, 1], color=COLORS[scheme], linewidth=0.4, label=scheme)
        shown = q[t >= t[-1] - 2 * math.pi]
        last.plot(shown[:, 0], shown[:, 1], ".-", color=COLORS[scheme], markersize=3, linewidth=0.8, label=scheme)
        whole.set_title(f"{scheme}, 30 periods")
        last.set_title(f"{scheme}, the last 2 pi")
        for panel in (whole, last):
            draw_ellipse(panel, ECCENTRICITY)
            panel.set(xlabel="$q_1$", ylabel="$q_2$", aspect="equal", xlim=(-1.6, 1.6), ylim=(-1.6, 1.2))
            panel.legend(loc="upper right")


@experiment("figure-25", "Kepler: momentum of SCVI with two points, SC with three")
def _figure_25(_: Mapping[str, Result]) -> Result:
    momenta = {scheme: angular_momentum(_orbit(scheme).run.q, _orbit(scheme).run.p) for scheme in COMPARED}
    error = {scheme: _orbit(scheme).largest[1] for scheme in COMPARED}
    t = _orbit("SC").run.t / (2 * math.pi)
    return Result(
        setting=SETTING,
        checks=(
            Comparison(
                claim="SCVI preserves the momentum; that of SC falls.",
                measured=(
                    f"Largest error: SCVI {error['SCVI']:.1e}, SC {error['SC']:.2f}; SC ends with "
                    f"{momenta['SC'][-1]:.3f} for {momenta['SC'][0]:.3f}."
                ),
                verdict=holds(error["SCVI"] < 1e-12 and momenta["SC"][-1] < 0.9 * momenta["SC"][0]),
                bears_on=("scvi-structure",),
            ),
        ),
        tables=(time_series(_orbit("SC").run.t, {f"momentum {scheme}": m for scheme, m in momenta.items()}),),
        picture=Picture(draw=partial(draw_invariant, t=t, values=momenta, name="momentum", unit="in periods")),
    )


@experiment("figure-26", "Kepler: energies of SCVI with two points, SC with three")
def _figure_26(_: Mapping[str, Result]) -> Result:
    energies = {scheme: _energies(scheme) for scheme in COMPARED}
    early, late = _orbit("SCVI").halves()
    columns = {f"{part} {s}": series for s, parts in energies.items() for part, series in parts.items()}
    return Result(
        setting=SETTING,
        checks=(
            Comparison(
                claim="The energy error of SCVI stays bounded, while the energy of SC drifts.",
                measured=(
                    f"Largest error of SCVI: {early:.2e} in the first half, {late:.2e} in the second. SC ends with "
                    f"{energies['SC']['total'][-1]:.3f} for -0.5."
                ),
                verdict=holds(late < 1.1 * early and abs(_orbit("SC").energy[-1]) > 0.1),
                bears_on=("scvi-structure",),
            ),
        ),
        tables=(time_series(_orbit("SC").run.t, columns),),
        picture=Picture(draw=partial(_draw_energies, t=_orbit("SC").run.t, energies=energies), height=4.6),
    )


def _energies(scheme: str) -> dict[str, Array]:
    run = _orbit(scheme).run
    kinetic = (run.p**2).sum(axis=1) / 2
    return {"total": run.energy(), "kinetic": kinetic, "potential": run.energy() - kinetic}


STYLES = {"total": "-", "kinetic": "--", "potential": ":"}


def _draw_energies(figure: Figure, t: Array, energies: Mapping[str, Mapping[str, Array]]) -> None:
    for axes, (scheme, parts) in zip(panels(figure, 1, 2), energies.items(), strict=True):
        for part, series in parts.items():
            width = 1.6 if part == "total" else 0.7
            axes.plot(t / (2 * math.pi), series, STYLES[part], color=COLORS[scheme], linewidth=width, label=part)
        axes.set(title=f"energy of {scheme}", xlabel="t, in periods", ylabel="energy", ylim=(-2.6, 2.6))
        axes.legend(loc="upper left", ncols=3)
