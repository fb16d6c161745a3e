"""Figures 11 and 12: the undriven Duffing oscillator."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.methods import SVI, Gauss, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import duffing
from scvi_codegen.reproduce.laboratory.drawing import COLORS, draw_error, panels, thinned
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Experiment,
    Picture,
    Result,
    TableBlock,
    holds,
    judged,
)
from scvi_codegen.reproduce.laboratory.running import trajectory
from scvi_codegen.reproduce.oscillators.one_degree import (
    area_change,
    curves_table,
    drift,
    drifts,
    energy_error,
    energy_table,
    largest,
    offset_from_curve,
)
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS"]

Array = NDArray[np.float64]

TITLES = {
    "figure-11": "Duffing oscillator: phase trajectories of SVI, SC and the 6th-order symplectic Runge-Kutta method",
    "figure-12": "Duffing oscillator: energy error of SVI, SC and the 6th-order symplectic Runge-Kutta method",
}

OSCILLATOR = duffing()
POSITION, VELOCITY = (0.0,), (1.0,)
METHODS: dict[str, Method] = {
    "SVI, degree 5": SVI(5),
    "SC, degree 5": SpectralCollocation(5),
    "SRK6": Gauss(3),
    "SVI, degree 6": SVI(6),
    "SC, degree 6": SpectralCollocation(6),
}
DRAWN = ("SVI, degree 5", "SC, degree 5", "SRK6")
MOST_DOTS = 450
WINDOW = (0.6, 1.1)
"""Range of both coordinates in the paper's magnified part."""

SETTING = (
    "L = v^2/2 + q^2/2 - 2 q^4/3 (alpha = -1, beta = 8/3, undriven, undamped), q(0) = 0, p(0) = 1.",
    "h = 0.6; nonlinear iteration to 1e-14, the paper's rule.",
    "6 Chebyshev points: degree 5. Degree 6 is run, too, as the paper's N is the degree elsewhere.",
    "The caption gives no quadrature: SVI has as many Gauss points as the degree.",
    "The symplectic Runge-Kutta method of order 6 is Gauss's of three stages.",
)


@lru_cache
def _run(scheme: str, span: float) -> Trajectory:
    return trajectory(OSCILLATOR, METHODS[scheme], POSITION, VELOCITY, h=0.6, span=span)


def _energy_curve() -> tuple[Array, Array]:
    """Return the exact orbit in the phase plane, p^2 = 1 + q^2 - 4 q^4/3."""
    end = np.sqrt((3.0 + np.sqrt(57.0)) / 8.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 600)
    q = end * np.cos(angle)
    return q, np.sign(np.sin(angle)) * np.sqrt(np.maximum(0.0, 1.0 + q**2 - 4.0 / 3.0 * q**4))


def _roughness(run: Trajectory) -> float:
    """Return the largest jump of the distance from the exact curve between neighbours along it."""
    offset = offset_from_curve(run)[np.argsort(np.arctan2(run.p[:, 0], run.q[:, 0]))]
    return float(np.abs(np.diff(offset)).max())


def _phase(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _run(scheme, 500.0) for scheme in METHODS}
    rough = {scheme: _roughness(run) for scheme, run in runs.items()}
    away = {scheme: largest(offset_from_curve(run)) for scheme, run in runs.items()}
    svi, sc, srk, *_finer = METHODS
    orbits = {scheme: (runs[scheme].q[:, 0], runs[scheme].p[:, 0], offset_from_curve(runs[scheme])) for scheme in DRAWN}
    rows: list[tuple[Cell, ...]] = [
        (scheme, away[scheme], rough[scheme], area_change(runs[scheme])) for scheme in METHODS
    ]
    columns = (
        "scheme",
        "largest distance from the exact curve",
        "largest jump between neighbours",
        "change of the area",
    )
    return Result(
        name="figure-11",
        title=TITLES["figure-11"],
        setting=(*SETTING, "T = 500."),
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
        picture=Picture(draw=partial(_draw_phase, orbits, _energy_curve()), width=10.0, height=8.6),
    )


def _draw_phase(orbits: Mapping[str, tuple[Array, ...]], exact: tuple[Array, Array], figure: Figure) -> None:
    rows = np.reshape(np.array(panels(figure, 3, len(orbits)), dtype=object), (3, -1))
    for (whole, part, distance), (scheme, (q, p, offset)) in zip(rows.T, orbits.items(), strict=True):
        color = COLORS[_scheme_name(scheme)]
        near = (q > WINDOW[0]) & (q < WINDOW[1]) & (p > WINDOW[0]) & (p < WINDOW[1])
        whole.plot(*thinned(q, p, most=MOST_DOTS), ".", color=color, markersize=2)
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


def _scheme_name(scheme: str) -> str:
    """Return the name of a scheme without its degree or order."""
    return scheme.partition(",")[0].removesuffix("6")


def _energy(_: Mapping[str, Result]) -> Result:
    runs = {scheme: _run(scheme, 2000.0) for scheme in METHODS}
    errors = {scheme: energy_error(run) for scheme, run in runs.items()}
    return Result(
        name="figure-12",
        title=TITLES["figure-12"],
        setting=(*SETTING, "T = 2000."),
        checks=_checks_of_energy(errors),
        tables=(energy_table(runs), curves_table("curves", runs["SRK6"].t, errors)),
        picture=Picture(draw=partial(_draw_energy, runs["SRK6"].t, errors), width=7.0),
    )


def _checks_of_energy(errors: Mapping[str, Array]) -> tuple[Comparison, ...]:
    size = {scheme: largest(error) for scheme, error in errors.items()}
    svi, sc, srk, finer_svi, finer_sc = errors
    return (
        Comparison(
            claim="SVI achieves significantly higher-order energy accuracy than the 6th-order symplectic Runge-Kutta "
            "method.",
            measured=f"Largest energy error: SVI {size[svi]:.1e}, SRK6 {size[srk]:.1e}, "
            f"{size[srk] / size[svi]:.0f} times larger; SVI of degree 6 {size[finer_svi]:.1e}.",
            verdict=holds(size[srk] > 10.0 * size[svi]),
            bears_on=("efficiency",),
        ),
        Comparison(
            claim="SVI is more accurate in energy than SC with the same points and step.",
            measured=f"SVI {size[svi]:.1e}, SC {size[sc]:.1e}; degree 6: {size[finer_svi]:.1e}, {size[finer_sc]:.1e}.",
            verdict=judged(size[svi] < size[sc], size[finer_svi] < size[finer_sc]),
            bears_on=("accuracy",),
        ),
        Comparison(
            claim="SVI and SRK exhibit good long-term energy stability, SC drifts.",
            measured=f"Drift from the first to the last fifth: SVI {drift(errors[svi]):.0e}, SRK6 "
            f"{drift(errors[srk]):.0e}, SC {drift(errors[sc]):.0e}.",
            verdict=judged(not drifts(errors[svi]), not drifts(errors[srk]), drifts(errors[sc])),
            bears_on=("long-time",),
        ),
    )


def _draw_energy(t: Array, errors: Mapping[str, Array], figure: Figure) -> None:
    (axes,) = panels(figure, 1, 1)
    for scheme, error in errors.items():
        style = ":" if scheme.endswith("degree 6") else "-"
        draw_error(axes, t, error, _scheme_name(scheme), scheme, linestyle=style)
    axes.set(xlabel="t", ylabel="|H - H(0)|")
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))


RUNS = {"figure-11": _phase, "figure-12": _energy}
EXPERIMENTS = tuple(Experiment(name=name, title=TITLES[name], run=run) for name, run in RUNS.items())
