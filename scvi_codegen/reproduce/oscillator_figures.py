"""Figures of systems with one degree of freedom: oscillator (3-5), pendulum (9, 10, 21, 22), Duffing (11, 12)."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import numpy as np

from scvi_codegen.errors import MethodWarning
from scvi_codegen.methods import SCVI, SVI, Gauss, SpectralCollocation
from scvi_codegen.models.systems import duffing, harmonic_oscillator, planar_pendulum
from scvi_codegen.reproduce.drawing import Array
from scvi_codegen.reproduce.experiment import Experiment
from scvi_codegen.reproduce.figures import RunCheck, energy_errors, figure, over_time, plane
from scvi_codegen.reproduce.runs import SECTION_4, RunSetting, Scheme

SMALL_AREA = 1e-3
"""Relative change of an area that its polygon does not resolve."""
VISIBLE = 2e-3
"""Width of a line relative to the picture."""
REST = 1.0 - math.cos(0.5)
"""Energy of the pendulum above its equilibrium."""


def _galerkin(degree: int, points: int) -> SVI:
    """Return an SVI with any number of Gauss points, without the warning for fewer than the degree."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MethodWarning)
        return SVI(degree, f"gauss-legendre:{points}")


def _harmonic(t: Array) -> tuple[Array, Array]:
    return np.sin(t)[:, None], np.cos(t)[:, None]


OSCILLATOR = RunSetting(
    system=harmonic_oscillator(),
    q=(0.0,),
    velocity=(1.0,),
    h=1.0,
    span=100.0,
    schemes={
        **{f"svi{n}": Scheme(f"SVI, {n} Gauss points", _galerkin(8, n), "SVI") for n in (7, 8, 9)},
        "sc": Scheme("SC", SpectralCollocation(8), "SC"),
    },
    sentences=(
        "m = k = 1, q(0) = 0, p(0) = 1, h = 1; the exact solution is q = sin t, p = cos t.",
        "9 Chebyshev points: degree 8. The caption gives no quadrature; SVI is run with 7, 8 and 9 Gauss points. The "
        "nonlinear iteration ends at 1e-14, the paper's rule.",
    ),
    exact=_harmonic,
)


def _schemes(degree: int, order: int) -> dict[str, Scheme]:
    return {
        "svi": Scheme(f"SVI, degree {degree}", SVI(degree), "SVI"),
        "sc": Scheme(f"SC, degree {degree}", SpectralCollocation(degree), "SC"),
        "srk": Scheme(f"SRK{order}", Gauss(order // 2), "SRK"),
        "finer_svi": Scheme(f"SVI, degree {degree + 1}", SVI(degree + 1), "SVI"),
        "finer_sc": Scheme(f"SC, degree {degree + 1}", SpectralCollocation(degree + 1), "SC"),
    }


def _points(degree: int, order: int) -> str:
    return (
        f"{degree + 1} Chebyshev points: degree {degree}. Degree {degree + 1} is run, too, as the paper's N is the "
        "degree elsewhere. The caption gives no quadrature: SVI has as many Gauss points as the degree. The symplectic "
        f"Runge-Kutta method of order {order} is Gauss's with {order // 2} stages. The iteration ends at 1e-14."
    )


PENDULUM = RunSetting(
    system=planar_pendulum(),
    q=(0.5,),
    velocity=(0.0,),
    h=0.5,
    span=1000.0,
    schemes=_schemes(3, 4),
    sentences=("m = l = g = 1, q(0) = 0.5, p(0) = 0, h = 0.5, T = 1000.", _points(3, 4)),
)
TWO_POINTS = replace(
    PENDULUM,
    h=0.005,
    span=60.0 * math.pi,
    options=SECTION_4,
    schemes={
        "scvi": Scheme("SCVI", SCVI(1, "gauss-legendre:2"), "SCVI"),
        "sc": Scheme("SC", SpectralCollocation(1), "SC"),
    },
    sentences=(
        "m = l = g = 1, q(0) = 0.5, p(0) = 0, h = 0.005, T = 60 pi; the iteration ends at 1e-12, the rule of "
        "section 4.",
        "SCVI: degree 1, two Gauss points, (36)-(37); the variational form and the printed one are the same map there. "
        "SC: degree 1, one equation at the end of the step; this is the implicit Euler method.",
    ),
)
DUFFING = RunSetting(
    system=duffing(),
    q=(0.0,),
    velocity=(1.0,),
    h=0.6,
    span=500.0,
    schemes=_schemes(5, 6),
    sentences=(
        "L = v^2/2 + q^2/2 - 2 q^4/3 (alpha = -1, beta = 8/3, undriven, undamped), q(0) = 0, p(0) = 1, h = 0.6.",
        _points(5, 6),
    ),
)


def _energy_checks(better: str, factor: float) -> dict[str, RunCheck]:
    """Return the checks of Figs. 10 and 12, where SVI is to be ``factor`` times as accurate as Runge-Kutta."""
    return {
        "SVI and the symplectic Runge-Kutta method preserve the energy very well over the whole time.": RunCheck(
            "energy drift: svi srk finer_svi",
            lambda r: [not run.drifts for run in (r.svi, r.srk, r.finer_svi)],
            "long-time",
        ),
        "The energy error of SC drifts.": RunCheck(
            "energy drift: sc finer_sc", lambda r: [r.sc.drifts, r.finer_sc.drifts], "long-time"
        ),
        "SVI is more accurate in energy than SC with the same points and step.": RunCheck(
            "energy: svi sc finer_svi finer_sc",
            lambda r: [r.svi.energy < r.sc.energy, r.finer_svi.energy < r.finer_sc.energy],
            "accuracy",
        ),
        f"SVI achieves {better}.": RunCheck(
            "energy: svi srk", lambda r: [r.srk.energy > factor * r.svi.energy], "efficiency"
        ),
    }


def _costs(name: str, setting: RunSetting, ratio: float) -> Experiment:
    """Return the experiment of a table of costs, with the printed time of SVI over that of Runge-Kutta."""
    checks = {
        f"SVI costs less than SRK at the same step (the paper: {ratio:.2f} of its time).": RunCheck(
            "evaluations: svi srk",
            lambda r: [r.svi.evaluations < r.srk.evaluations],
            "svi-cheaper efficiency",
            "The cost is counted in evaluations of the force; `scvi-codegen bench` measures times.",
        ),
        "SVI is more accurate than SRK at the same step.": RunCheck(
            "relative: svi srk", lambda r: [r.svi.relative < r.srk.relative], "svi-cheaper efficiency"
        ),
        "SVI is much more accurate than SC over the long run.": RunCheck(
            "relative evaluations: svi sc", lambda r: [r.svi.relative < r.sc.relative / 10.0], "accuracy efficiency"
        ),
    }
    return figure(name, f"Computational cost, {setting.system.name}", setting, (), checks)


EXPERIMENTS = (
    _costs("table-6", PENDULUM, 4.94 / 13.73),
    _costs("table-7", replace(DUFFING, span=2000.0), 39.18 / 86.98),
    figure(
        "figure-3",
        "Harmonic oscillator: phase trajectories of SVI and SC, every fifth step",
        OSCILLATOR,
        [plane("svi8", "sc", part=slice(None, None, 5))],
        {
            "Plotted every five steps, the phase trajectories of SVI and SC show their differences.": RunCheck(
                "state: svi8 sc",
                lambda r: [r.sc.state > VISIBLE],
                note=f"A line of the picture is {VISIBLE:g} wide.",
            ),
            "SVI is more accurate in phase than SC with the same points and step.": RunCheck(
                "state: svi8 sc", lambda r: [r.svi8.state < r.sc.state], "accuracy"
            ),
        },
    ),
    figure(
        "figure-4",
        "Harmonic oscillator: position error of SVI and SC",
        OSCILLATOR,
        [over_time("position_error")],
        {
            "The position error of SC is several orders of magnitude bigger than that of SVI.": RunCheck(
                "position",
                lambda r: [r.sc.position > 100.0 * svi.position for svi in (r.svi7, r.svi8, r.svi9)],
                "accuracy",
            ),
            "The error of SC grows; that of SVI appears to be bounded and remains small.": RunCheck(
                "position early_position",
                lambda r: [
                    svi.position < 1e-14 or svi.position < 2.0 * svi.early_position for svi in (r.svi7, r.svi8, r.svi9)
                ],
                "long-time",
                "A factor of 5 is growth in proportion to t, the lag of a phase. Errors below 1e-14 count as bounded.",
            ),
            "The axis of the panel of SVI is scaled by 1e-11; the number of quadrature points is not given.": RunCheck(
                "position: svi7 svi8 svi9", note="Such an error belongs to 7 Gauss points, one fewer than the degree."
            ),
        },
    ),
    figure(
        "figure-5",
        "Harmonic oscillator: energy error of SVI and SC",
        replace(OSCILLATOR, span=500.0),
        [energy_errors()],
        {
            "The energy error of SC is much bigger than that of SVI.": RunCheck(
                "energy", lambda r: [r.sc.energy > 100.0 * svi.energy for svi in (r.svi7, r.svi8, r.svi9)], "accuracy"
            ),
            "The energy error of SC grows much faster than that of SVI.": RunCheck(
                "drift",
                lambda r: [r.sc.drifts and not any(svi.drifts for svi in (r.svi7, r.svi8, r.svi9))],
                "long-time",
            ),
        },
    ),
    figure(
        "figure-9",
        "Pendulum: phase trajectories of SVI, SC and the 4th-order symplectic Runge-Kutta method",
        PENDULUM,
        [plane("svi", "sc", "srk")],
        {
            "SVI and the symplectic Runge-Kutta method preserve the phase area.": RunCheck(
                "area: svi srk", lambda r: [max(abs(r.svi.area), abs(r.srk.area)) < SMALL_AREA], "long-time"
            ),
            "A drift is observed in the phase trajectory of SC.": RunCheck(
                "area: sc finer_sc", lambda r: [abs(r.sc.area) > 10.0 * SMALL_AREA], "long-time"
            ),
        },
    ),
    figure(
        "figure-10",
        "Pendulum: energy error of SVI, SC and the 4th-order symplectic Runge-Kutta method",
        PENDULUM,
        [energy_errors()],
        _energy_checks("a higher accuracy than the 4th-order symplectic Runge-Kutta method", 1.0),
    ),
    figure(
        "figure-11",
        "Duffing oscillator: phase trajectories of SVI, SC and the 6th-order symplectic Runge-Kutta method",
        DUFFING,
        [
            plane("svi", "sc", "srk"),
            plane("svi", "sc", "srk", window=(0.6, 1.1), more=", magnified"),
            *(over_time("offset", key) for key in ("svi", "sc", "srk")),
        ],
        {
            "Magnified, the phase trajectories of SVI and SRK are very regular, that of SC much less so.": RunCheck(
                "roughness: svi srk sc",
                lambda r: [r.sc.roughness > 3.0 * run.roughness for run in (r.svi, r.srk)],
                "long-time",
                "The distance is that from the exact curve.",
            ),
            "SVI is more accurate in phase than SC with the same points and step.": RunCheck(
                "away: svi sc srk", lambda r: [r.svi.away < r.sc.away], "accuracy"
            ),
        },
    ),
    figure(
        "figure-12",
        "Duffing oscillator: energy error of SVI, SC and the 6th-order symplectic Runge-Kutta method",
        replace(DUFFING, span=2000.0),
        [energy_errors()],
        _energy_checks("significantly higher-order energy accuracy than the 6th-order Runge-Kutta method", 10.0),
    ),
    figure(
        "figure-21",
        "Pendulum: phase trajectories of SCVI and SC with two points",
        TWO_POINTS,
        [plane()],
        {
            "SCVI preserves the area in phase space, as a symplectic integrator does.": RunCheck(
                "determinant area: scvi",
                lambda r: [abs(r.scvi.determinant) < 1e-10, abs(r.scvi.area) < SMALL_AREA],
                "scvi-structure",
            ),
            "The trajectory of SC decays in phase space.": RunCheck(
                "determinant area: sc", lambda r: [r.sc.area < -10.0 * SMALL_AREA]
            ),
        },
    ),
    figure(
        "figure-22",
        "Pendulum: energy error of SCVI and SC with two points",
        TWO_POINTS,
        [energy_errors()],
        {
            "SCVI preserves the energy very well.": RunCheck(
                "energy drift: scvi",
                lambda r: [r.scvi.energy < 1e-5 * REST, not r.scvi.drifts],
                "scvi-structure",
                f"The energy above the equilibrium is {REST:.2f}.",
            ),
            "SC performs much more poorly in preserving the energy.": RunCheck(
                "energy", lambda r: [r.sc.energy > 100.0 * r.scvi.energy]
            ),
        },
    ),
)
"""Figures 3-5, 9-12, 21 and 22, Tables 6 and 7."""
