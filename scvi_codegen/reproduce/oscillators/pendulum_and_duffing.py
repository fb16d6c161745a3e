"""Figures 9, 10, 21 and 22: the planar pendulum; 11 and 12: the undriven Duffing oscillator."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache, partial

import numpy as np

from scvi_codegen.methods import SCVI, SVI, Gauss, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import duffing, planar_pendulum
from scvi_codegen.reproduce.laboratory.drawing import COLORS, Array, Figure, panels, thinned
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Picture,
    Result,
    TableBlock,
    experiment,
    holds,
    judged,
)
from scvi_codegen.reproduce.laboratory.running import SECTION_4, stepper_of, trajectory
from scvi_codegen.reproduce.oscillators.one_degree import (
    DOTS,
    area_change,
    area_factor,
    draw_phase,
    drift,
    drifts,
    energy_result,
    energy_table,
    largest,
    offset_from_curve,
    scheme_name,
)
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

PENDULUM = planar_pendulum()
POSITION, VELOCITY = (0.5,), (0.0,)
LONG_RUN: dict[str, Method] = {
    "SVI, degree 3": SVI(3),
    "SC, degree 3": SpectralCollocation(3),
    "SRK4": Gauss(2),
    "SVI, degree 4": SVI(4),
    "SC, degree 4": SpectralCollocation(4),
}
TWO_POINTS: dict[str, Method] = {"SCVI": SCVI(1, "gauss-legendre:2"), "SC": SpectralCollocation(1)}
DRAWN = ("SVI, degree 3", "SC, degree 3", "SRK4")
SMALL_STEP = 0.005
MOST_DOTS = 700
SMALL_AREA = 1e-3
"""Relative change of an area that its polygon does not resolve."""

SYSTEM = "m = l = g = 1, q(0) = 0.5, p(0) = 0."
LONG_SETTING = (
    SYSTEM,
    "h = 0.5, T = 1000; nonlinear iteration to 1e-14, the paper's rule.",
    "4 Chebyshev points: degree 3. Degree 4 is run, too, as the paper's N is the degree elsewhere.",
    "The caption gives no quadrature: SVI has as many Gauss points as the degree.",
    "The symplectic Runge-Kutta method of order 4 is Gauss's of two stages.",
)
SHORT_SETTING = (
    SYSTEM,
    "h = 0.005, T = 60 pi; nonlinear iteration to 1e-12, the rule of section 4.",
    "SCVI: degree 1, two Gauss points, (36)-(37); the stationary form and the printed one are the same map there.",
    "SC: degree 1, one equation at the end of the step; this is the implicit Euler method.",
)


@lru_cache
def _long_run(scheme: str) -> Trajectory:
    return trajectory(PENDULUM, LONG_RUN[scheme], POSITION, VELOCITY, h=0.5, span=1000.0)


@lru_cache
def _two_points(scheme: str) -> Trajectory:
    method = TWO_POINTS[scheme]
    return trajectory(PENDULUM, method, POSITION, VELOCITY, h=SMALL_STEP, span=60.0 * math.pi, options=SECTION_4)


def _energy_curve() -> tuple[Array, Array]:
    """Return the exact orbit in the phase plane, p^2/2 - cos q = -cos q(0)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    q = POSITION[0] * np.cos(angle)
    return q, -np.sign(np.sin(angle)) * np.sqrt(np.maximum(0.0, 2.0 * (np.cos(q) - np.cos(POSITION[0]))))


@experiment("figure-9", "Pendulum: phase trajectories of SVI, SC and the 4th-order symplectic Runge-Kutta method")
def _phase_of_long_run(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _long_run(scheme) for scheme in LONG_RUN}
    areas = {scheme: area_change(run) for scheme, run in runs.items()}
    orbits = {scheme: thinned(runs[scheme].q[:, 0], runs[scheme].p[:, 0], most=MOST_DOTS) for scheme in DRAWN}
    return Result(
        setting=LONG_SETTING,
        checks=(
            Comparison(
                claim="SVI and the symplectic Runge-Kutta method preserve the phase area.",
                measured="Between the first and the last fifth of the run the area inside the states changes by "
                f"{areas['SVI, degree 3']:.1e} (SVI) and {areas['SRK4']:.1e} (SRK4), relatively.",
                verdict=holds(max(abs(areas["SVI, degree 3"]), abs(areas["SRK4"])) < SMALL_AREA),
                bears_on=("long-time",),
            ),
            Comparison(
                claim="A drift is observed in the phase trajectory of SC.",
                measured=f"The area changes by {areas['SC, degree 3']:+.1%} (degree 4: {areas['SC, degree 4']:+.2%}).",
                verdict=holds(abs(areas["SC, degree 3"]) > 10.0 * SMALL_AREA),
                bears_on=("long-time",),
            ),
        ),
        tables=(energy_table(runs),),
        picture=Picture(draw=partial(draw_phase, orbits, _energy_curve(), DOTS), width=10.0, height=3.7),
    )


@experiment("figure-10", "Pendulum: energy error of SVI, SC and the 4th-order symplectic Runge-Kutta method")
def _energy_of_long_run(_: Mapping[str, Result]) -> Result:
    rk = "a higher accuracy than the 4th-order symplectic Runge-Kutta method"
    checks = partial(_checks_of_energy, rk, 1.0)
    return energy_result(LONG_SETTING, {scheme: _long_run(scheme) for scheme in LONG_RUN}, checks)


def _checks_of_energy(rk: str, factor: float, errors: Mapping[str, Array]) -> tuple[Comparison, ...]:
    """Return the checks on SVI, SC and a Runge-Kutta method, of which SVI is to be ``factor`` times as accurate."""
    size = {scheme: largest(error) for scheme, error in errors.items()}
    svi, sc, srk, finer_svi, finer_sc = errors
    finer = finer_svi.partition(", ")[2]
    return (
        Comparison(
            claim="SVI and the symplectic Runge-Kutta method preserve the energy very well over the whole time.",
            measured=f"Largest error and drift: SVI {size[svi]:.1e}, {drift(errors[svi]):.0e}; {srk} {size[srk]:.1e}, "
            f"{drift(errors[srk]):.0e}; SVI of {finer} {size[finer_svi]:.1e}, {drift(errors[finer_svi]):.0e}.",
            verdict=judged(*(not drifts(errors[scheme]) for scheme in (svi, srk, finer_svi))),
            bears_on=("long-time",),
        ),
        Comparison(
            claim="The energy error of SC drifts.",
            measured=f"It grows to {size[sc]:.1e} ({finer}: {size[finer_sc]:.1e}), "
            f"{drift(errors[sc]) / errors[sc][-1]:.0%} of it between the first and the last fifth of the run.",
            verdict=judged(drifts(errors[sc]), drifts(errors[finer_sc])),
            bears_on=("long-time",),
        ),
        Comparison(
            claim="SVI is more accurate in energy than SC with the same points and step.",
            measured=f"SVI {size[svi]:.1e}, SC {size[sc]:.1e}; {finer}: {size[finer_svi]:.1e}, {size[finer_sc]:.1e}.",
            verdict=judged(size[svi] < size[sc], size[finer_svi] < size[finer_sc]),
            bears_on=("accuracy",),
        ),
        Comparison(
            claim=f"SVI achieves {rk}.",
            measured=f"Its energy error is {size[srk] / size[svi]:.0f} times smaller.",
            verdict=holds(size[srk] > factor * size[svi]),
            bears_on=("efficiency",),
        ),
    )


@experiment("figure-21", "Pendulum: phase trajectories of SCVI and SC with two points")
def _phase_with_two_points(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _two_points(scheme) for scheme in TWO_POINTS}
    areas = {scheme: area_change(run) for scheme, run in runs.items()}
    factors = {
        scheme: area_factor(stepper_of(PENDULUM, method), 0.3, 0.2, SMALL_STEP) - 1.0
        for scheme, method in TWO_POINTS.items()
    }
    orbits = {scheme: (run.q[:, 0], run.p[:, 0]) for scheme, run in runs.items()}
    return Result(
        setting=SHORT_SETTING,
        checks=(
            Comparison(
                claim="SCVI preserves the area in phase space, as a symplectic integrator does.",
                measured=f"The determinant of one step at (0.3, 0.2) is 1 {factors['SCVI']:+.0e} by differences; the "
                f"area inside the states changes by {areas['SCVI']:.0e} over the run.",
                verdict=judged(abs(factors["SCVI"]) < 1e-10, abs(areas["SCVI"]) < SMALL_AREA),
                bears_on=("scvi-structure",),
            ),
            Comparison(
                claim="The trajectory of SC decays in phase space.",
                measured=f"The determinant of one step is 1 {factors['SC']:+.1e}; the area changes by "
                f"{areas['SC']:+.0%} between the first and the last fifth of the run.",
                verdict=holds(areas["SC"] < -10.0 * SMALL_AREA),
            ),
        ),
        tables=(energy_table(runs),),
        picture=Picture(draw=partial(draw_phase, orbits, _energy_curve(), {}), width=8.0, height=4.2),
    )


@experiment("figure-22", "Pendulum: energy error of SCVI and SC with two points")
def _energy_with_two_points(_: Mapping[str, Result]) -> Result:
    return energy_result(SHORT_SETTING, {scheme: _two_points(scheme) for scheme in TWO_POINTS}, _checks_of_two_points)


def _checks_of_two_points(errors: Mapping[str, Array]) -> tuple[Comparison, ...]:
    sizes = {scheme: largest(error) for scheme, error in errors.items()}
    depth = 1.0 - math.cos(POSITION[0])
    return (
        Comparison(
            claim="SCVI preserves the energy very well.",
            measured=f"Largest error {sizes['SCVI']:.1e}, {sizes['SCVI'] / depth:.0e} of the energy above rest; "
            f"drift {drift(errors['SCVI']):.0e}.",
            verdict=judged(sizes["SCVI"] < 1e-5 * depth, not drifts(errors["SCVI"])),
            bears_on=("scvi-structure",),
        ),
        Comparison(
            claim="SC performs much more poorly in preserving the energy.",
            measured=f"It loses {-errors['SC'][-1]:.1e}, {-errors['SC'][-1] / depth:.0%} of the energy above rest.",
            verdict=holds(sizes["SC"] > 100.0 * sizes["SCVI"]),
        ),
    )


DUFFING = duffing()
DUFFING_POSITION, DUFFING_VELOCITY = (0.0,), (1.0,)
DUFFING_RUN: dict[str, Method] = {
    "SVI, degree 5": SVI(5),
    "SC, degree 5": SpectralCollocation(5),
    "SRK6": Gauss(3),
    "SVI, degree 6": SVI(6),
    "SC, degree 6": SpectralCollocation(6),
}
DUFFING_DRAWN = ("SVI, degree 5", "SC, degree 5", "SRK6")
DUFFING_DOTS = 450
WINDOW = (0.6, 1.1)
"""Range of both coordinates in the paper's magnified part."""

DUFFING_SETTING = (
    "L = v^2/2 + q^2/2 - 2 q^4/3 (alpha = -1, beta = 8/3, undriven, undamped), q(0) = 0, p(0) = 1.",
    "h = 0.6; nonlinear iteration to 1e-14, the paper's rule.",
    "6 Chebyshev points: degree 5. Degree 6 is run, too, as the paper's N is the degree elsewhere.",
    "The caption gives no quadrature: SVI has as many Gauss points as the degree.",
    "The symplectic Runge-Kutta method of order 6 is Gauss's of three stages.",
)


@lru_cache
def _duffing_run(scheme: str, span: float) -> Trajectory:
    return trajectory(DUFFING, DUFFING_RUN[scheme], DUFFING_POSITION, DUFFING_VELOCITY, h=0.6, span=span)


def _duffing_curve() -> tuple[Array, Array]:
    """Return the exact orbit in the phase plane, p^2 = 1 + q^2 - 4 q^4/3."""
    end = np.sqrt((3.0 + np.sqrt(57.0)) / 8.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 600)
    q = end * np.cos(angle)
    return q, np.sign(np.sin(angle)) * np.sqrt(np.maximum(0.0, 1.0 + q**2 - 4.0 / 3.0 * q**4))


def _roughness(run: Trajectory) -> float:
    """Return the largest jump of the distance from the exact curve between neighbours along it."""
    offset = offset_from_curve(run)[np.argsort(np.arctan2(run.p[:, 0], run.q[:, 0]))]
    return float(np.abs(np.diff(offset)).max())


@experiment(
    "figure-11", "Duffing oscillator: phase trajectories of SVI, SC and the 6th-order symplectic Runge-Kutta method"
)
def _phase_of_duffing(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _duffing_run(scheme, 500.0) for scheme in DUFFING_RUN}
    rough = {scheme: _roughness(run) for scheme, run in runs.items()}
    away = {scheme: largest(offset_from_curve(run)) for scheme, run in runs.items()}
    svi, sc, srk, *_finer = DUFFING_RUN
    orbits = {
        scheme: (runs[scheme].q[:, 0], runs[scheme].p[:, 0], offset_from_curve(runs[scheme]))
        for scheme in DUFFING_DRAWN
    }
    rows: list[tuple[Cell, ...]] = [
        (scheme, away[scheme], rough[scheme], area_change(runs[scheme])) for scheme in DUFFING_RUN
    ]
    columns = (
        "scheme",
        "largest distance from the exact curve",
        "largest jump between neighbours",
        "change of the area",
    )
    return Result(
        setting=(*DUFFING_SETTING, "T = 500."),
        checks=(
            Comparison(
                claim="Magnified, the phase trajectories of SVI and SRK are very regular, that of SC much less so.",
                measured="Between neighbours along the curve the distance from the exact curve jumps by at most "
                f"{rough[svi]:.0e} (SVI), {rough[srk]:.0e} (SRK6) and {rough[sc]:.0e} (SC).",
                verdict=judged(rough[sc] > 3.0 * rough[svi], rough[sc] > 3.0 * rough[srk]),
                bears_on=("long-time",),
            ),
            Comparison(
                claim="SVI is more accurate in phase than SC with the same points and step.",
                measured=f"Largest distance from the exact curve: SVI {away[svi]:.1e}, SC {away[sc]:.1e}, "
                f"SRK6 {away[srk]:.1e}.",
                verdict=holds(away[svi] < away[sc]),
                bears_on=("accuracy",),
            ),
        ),
        tables=(TableBlock(columns=columns, rows=tuple(rows), formats=dict.fromkeys(columns[1:], ".1e")),),
        picture=Picture(draw=partial(_draw_phase_magnified, orbits, _duffing_curve()), width=10.0, height=8.6),
    )


def _draw_phase_magnified(orbits: Mapping[str, tuple[Array, ...]], exact: tuple[Array, Array], figure: Figure) -> None:
    rows = np.reshape(np.array(panels(figure, 3, len(orbits)), dtype=object), (3, -1))
    for (whole, part, distance), (scheme, (q, p, offset)) in zip(rows.T, orbits.items(), strict=True):
        color = COLORS[scheme_name(scheme)]
        near = (q > WINDOW[0]) & (q < WINDOW[1]) & (p > WINDOW[0]) & (p < WINDOW[1])
        whole.plot(*thinned(q, p, most=DUFFING_DOTS), ".", color=color, markersize=2)
        part.plot(q[near], p[near], ".", color=color, markersize=4)
        distance.plot(q[near], offset[near], ".", color=color, markersize=4)
        for axes in (whole, part):
            axes.plot(*exact, color="black", linewidth=0.6, zorder=1)
            axes.set(xlabel="q", ylabel="p", aspect="equal")
        whole.set(title=scheme, xlim=(-1.5, 1.5), ylim=(-1.5, 1.5))
        part.set(title="magnified", xlim=WINDOW, ylim=WINDOW)
        distance.set(xlabel="q", ylabel="distance", xlim=WINDOW)
        distance.set_title("distance from the exact curve, magnified", loc="right")
        distance.ticklabel_format(axis="y", scilimits=(0, 0))


@experiment("figure-12", "Duffing oscillator: energy error of SVI, SC and the 6th-order symplectic Runge-Kutta method")
def _energy_of_duffing(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _duffing_run(scheme, 2000.0) for scheme in DUFFING_RUN}
    rk = "significantly higher-order energy accuracy than the 6th-order symplectic Runge-Kutta method"
    return energy_result((*DUFFING_SETTING, "T = 2000."), runs, partial(_checks_of_energy, rk, 10.0))
