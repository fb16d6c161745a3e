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
from scvi_codegen.reproduce.figures import energy_errors, figure, over_time, plane
from scvi_codegen.reproduce.runs import SECTION_4, RunSetting, Scheme


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


def _energy_checks(better: str, factor: float) -> str:
    """Return the checks of Figs. 10 and 12, where SVI is to be ``factor`` times as accurate as Runge-Kutta."""
    return f"""
        SVI and the symplectic Runge-Kutta method preserve the energy very well over the whole time.
            energy: svi, srk, finer_svi; drift_share: svi < 0.33, srk < 0.33, finer_svi < 0.33 | long-time
        The energy error of SC drifts.
            energy: sc, finer_sc; drift_share: 0.33 < sc, 0.33 < finer_sc | long-time
        SVI is more accurate in energy than SC with the same points and step.
            energy: svi < sc, finer_svi < finer_sc | accuracy
        SVI achieves {better}.
            energy: {factor}*svi < srk
        """


SCHEMES = "SVI, SC and the {}th-order symplectic Runge-Kutta method"
EXPERIMENTS = (
    figure(
        "figure-3: Harmonic oscillator: phase trajectories of SVI and SC, every fifth step",
        OSCILLATOR,
        [plane("svi8", "sc", part=slice(None, None, 5))],
        """
        Plotted every five steps, the phase trajectories of SVI and SC show their differences.
            state: svi8, 2e-3 < sc || A line of the picture is 0.002 wide.
        SVI is more accurate in phase than SC with the same points and step.
            state: svi8 < sc | accuracy
        """,
    ),
    figure(
        "figure-4: Harmonic oscillator: position error of SVI and SC",
        OSCILLATOR,
        [over_time("position_error")],
        """
        The position error of SC is several orders of magnitude bigger than that of SVI.
            position: 100*svi7 < sc, 100*svi8 < sc, 100*svi9 < sc | accuracy
        The error of SC grows; that of SVI appears to be bounded and remains small.
            position_growth: svi7 < 2, svi8 < 2, svi9 < 2, sc | long-time | A factor of 5 is growth in proportion
            to t, the lag of a phase; it is 0 for errors below 1e-14.
        The axis of the panel of SVI is scaled by 1e-11; the number of quadrature points is not given.
            position: svi7, svi8, svi9 || Such an error belongs to 7 Gauss points, one fewer than the degree.
        """,
    ),
    figure(
        "figure-5: Harmonic oscillator: energy error of SVI and SC",
        replace(OSCILLATOR, span=500.0),
        [energy_errors()],
        """
        The energy error of SC is much bigger than that of SVI.
            energy: 100*svi7 < sc, 100*svi8 < sc, 100*svi9 < sc | accuracy
        The energy error of SC grows much faster than that of SVI.
            drift_share: 0.33 < sc, svi7 < 0.33, svi8 < 0.33, svi9 < 0.33 | long-time
        """,
    ),
    figure(
        f"figure-9: Pendulum: phase trajectories of {SCHEMES.format(4)}",
        PENDULUM,
        [plane("svi", "sc", "srk")],
        """
        SVI and the symplectic Runge-Kutta method preserve the phase area.
            area: svi < 1e-3, srk < 1e-3 | long-time
        A drift is observed in the phase trajectory of SC.
            area: 1e-2 < sc, finer_sc | long-time
        """,
    ),
    figure(
        f"figure-10: Pendulum: energy error of {SCHEMES.format(4)}",
        PENDULUM,
        [energy_errors()],
        _energy_checks("a higher accuracy than the 4th-order symplectic Runge-Kutta method", 1.0),
    ),
    figure(
        f"figure-11: Duffing oscillator: phase trajectories of {SCHEMES.format(6)}",
        DUFFING,
        [
            plane("svi", "sc", "srk"),
            plane("svi", "sc", "srk", window=(0.6, 1.1), more=", magnified"),
            *(energy_errors(key) for key in ("svi", "sc", "srk")),
        ],
        """
        Magnified, the phase trajectories of SVI and SRK are very regular, that of SC much less so.
            drift_share: svi < 0.33, srk < 0.33, 0.33 < sc | long-time | States on one curve have one energy.
        SVI is more accurate in phase than SC with the same points and step.
            energy: svi < sc, srk | accuracy
        """,
    ),
    figure(
        f"figure-12: Duffing oscillator: energy error of {SCHEMES.format(6)}",
        replace(DUFFING, span=2000.0),
        [energy_errors()],
        _energy_checks("significantly higher-order energy accuracy than the 6th-order Runge-Kutta method", 10.0),
    ),
    figure(
        "figure-21: Pendulum: phase trajectories of SCVI and SC with two points",
        TWO_POINTS,
        [plane()],
        """
        SCVI preserves the area in phase space, as a symplectic integrator does.
            area: scvi < 1e-3 | scvi-structure
        The trajectory of SC decays in phase space.
            area: 1e-2 < sc
        """,
    ),
    figure(
        "figure-22: Pendulum: energy error of SCVI and SC with two points",
        TWO_POINTS,
        [energy_errors()],
        """
        SCVI preserves the energy very well.
            energy: scvi < 1e-6; drift_share: scvi < 0.33 | scvi-structure
        SC performs much more poorly in preserving the energy.
            energy: 100*scvi < sc
        """,
    ),
)
"""Figures 3-5, 9-12, 21 and 22."""
