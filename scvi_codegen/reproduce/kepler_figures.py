"""Figures of runs of Kepler's problem: four methods (1), SVI and SC (13-15), SCVI (23-30).

With two points the printed and the variational equations of SCVI agree. With more, the printed (34d) and (34e) lack the
chain-rule term (experiment ``correction``): both forms are run.
"""

from __future__ import annotations

import math
from functools import partial

from scvi_codegen.methods import SCVI, SVI, ExplicitEuler, Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.figures import energy_errors, figure, momentum_errors, over_time, plane
from scvi_codegen.reproduce.runs import (
    KEPLER,
    PERIOD,
    SECTION_3,
    SECTION_4,
    RunSetting,
    Scheme,
    exact_kepler,
    perihelion,
)

GAUSS_POINTS = (5, 6, 7)
orbit = partial(plane, kind="orbit", window=(-1.65, 1.65))


def _kepler(
    numbers: tuple[float, float, float], schemes: dict[str, Scheme], *sentences: str, options: SolverOptions = SECTION_4
) -> RunSetting:
    """Return a setting that starts at the perihelion; the numbers are eccentricity, step size and span."""
    (_, h, span), (q, velocity) = numbers, perihelion(numbers[0])
    exact = partial(exact_kepler, q, velocity)
    return RunSetting(KEPLER, q, velocity, h, span, schemes, sentences, options, exact)


FOUR = _kepler(
    (0.6, 0.25, 100.0),
    {
        "euler": Scheme("explicit Euler", ExplicitEuler(), "Euler", 0.0025),
        "verlet": Scheme("Stoermer-Verlet", StoermerVerlet(), "Verlet", 0.1),
        "srk": Scheme("symplectic Runge-Kutta", Gauss(3), "SRK"),
        "sc": Scheme("Chebyshev collocation", SpectralCollocation(4), "SC"),
    },
    "e = 0.6, q(0) = (0.4, 0), p(0) = (0, 2), T = 100; steps as in the caption.",
    "The symplectic Runge-Kutta method is Gauss's of three stages; 5 collocation points are degree 4.",
    "Area: pi a b of the osculating ellipse, a mean over three periods at the end against three at the start.",
    options=SECTION_3,
)
LONG = _kepler(
    (0.5, 0.2, 2000.0),
    {
        **{f"svi{s or ''}": Scheme(f"SVI, degree {5 + s}", SVI(5 + s), "SVI") for s in (0, 1)},
        **{f"sc{s or ''}": Scheme(f"SC, degree {5 + s}", SpectralCollocation(5 + s), "SC") for s in (0, 1)},
    },
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.2, T = 2000 (10000 steps, 318 revolutions), six "
    "Chebyshev points: degree 5. The captions name no quadrature: SVI has as many Gauss points as the degree.",
    "Degree 6 is run, too, because the legends of section 3 count the degree in some figures.",
    options=SECTION_3,
)
TWO_POINTS = Scheme("SCVI", SCVI(1, "gauss-legendre:2"), "SCVI")
QUADRATURE = "Section 4.3 names two interpolation points and two Gauss points; printed and variational equations agree."
SEGMENTS = {"steps 1 to 2150": (1, 2151), "198925 to 201075": (198925, 201076), "397850 to 400000": (397850, 400001)}
AGES = _kepler(
    (0.5, math.pi / 20, 20000 * math.pi),
    {"scvi": TWO_POINTS},
    "Kepler's problem, e = 0.5, from the perihelion, h = pi/20, T = 20000 pi: 400000 steps.",
    QUADRATURE,
)
THREE = _kepler(
    (0.5, 0.1, 30 * PERIOD),
    {
        "scvi": TWO_POINTS,
        "sc": Scheme("SC", SpectralCollocation(2), "SC"),
        "sc2": Scheme("SC, two points", SpectralCollocation(1), "SC"),
    },
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.1, T = 60 pi (30 periods): SCVI with two points, SC with "
    "three.",
    QUADRATURE,
)
TWO_FORMS = "SCVI is run as printed, (34a)-(34e), and in variational form, with the chain-rule term in (34d), (34e)."


def shooting(points: int, gauss: int, *, printed: bool) -> SCVI:
    """Return SCVI with given numbers of Chebyshev and Gauss points."""
    return SCVI(points - 1, f"gauss-legendre:{gauss}", variational=not printed)


PHASES = _kepler(
    (0.5, 0.3, 30 * PERIOD),
    {
        "srk": Scheme("SRK4", Gauss(2), "SRK"),
        "printed": Scheme("SCVI (as printed)", shooting(4, 3, printed=True), "printed"),
        "scvi": Scheme("SCVI (variational)", shooting(4, 3, printed=False), "SCVI"),
        "verlet": Scheme("Stoermer-Verlet", StoermerVerlet(), "Verlet", 0.15),
        "sc": Scheme("SC", SpectralCollocation(3), "SC"),
    },
    "Kepler's problem. The caption names neither eccentricity nor time: e = 0.5 and T = 60 pi are those of Figs. 24 to "
    "26. SRK4 (Gauss, two stages), SCVI and SC with h = 0.3, Stoermer-Verlet with h = 0.15.",
    "SCVI and SC have four Chebyshev points; the caption names no quadrature: three Gauss points.",
    TWO_FORMS,
)
NINE = _kepler(
    (0.5, 0.3, 200 * PERIOD),
    {
        f"{key}{g}": Scheme(f"{g} Gauss points, {label}", shooting(9, g, printed=key == "printed"), color)
        for key, label, color in (("printed", "as printed", "printed"), ("full", "variational", "SCVI"))
        for g in GAUSS_POINTS
    },
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.3, T = 400 pi (200 periods): SCVI with nine Chebyshev "
    "points and 5, 6, 7 Gauss points.",
    TWO_FORMS,
)


EXPERIMENTS = (
    figure(
        "figure-1: Kepler's problem, e = 0.6: explicit Euler, Stoermer-Verlet, symplectic Runge-Kutta, collocation",
        FOUR,
        [plane(kind="orbit")],
        """
        Explicit Euler and Chebyshev collocation do not preserve the phase volume; their orbits spiral out.
            ellipse_area: 0.03 < euler, 0.03 < sc | long-time
        Stoermer-Verlet and the symplectic Runge-Kutta method preserve the area of the elliptical orbit.
            ellipse_area: verlet < 0.03, srk < 0.03 | long-time | 3 % counts as preserved.
        Chebyshev collocation is much more accurate than explicit Euler with steps 100 times smaller.
            energy: 5*sc < euler
        The analytic solution is q1 = cos t - e, q2 = sqrt(1 - e^2) sin t.
            printed_residual: srk < 1e-6 || The solution has the eccentric anomaly E, E - e sin E = t, in place of
            t: the same ellipse, so the drawn orbit is right.
        """,
    ),
    figure(
        "figure-13: Kepler, e = 0.5: orbits of SVI and SC over 318 revolutions",
        LONG,
        [orbit("svi", "sc"), over_time("position_error", "svi", "sc")],
        """
        SVI stays on the exact orbit, SC leaves it.
            energy: svi < 1e-4 < sc; momentum: svi < 1e-4 < sc; turn: svi < 1e-4 < sc | long-time | These
            determine the ellipse; changes below 0.01 are not visible.
        SVI is more accurate than SC in phase with the same points and step.
            position: svi < sc | accuracy
        """,
    ),
    figure(
        "figure-14: Kepler, e = 0.5: energy of SVI and SC over 318 revolutions",
        LONG,
        [over_time("energies", "svi", "sc", error=False), energy_errors("svi", "sc")],
        """
        SVI preserves the energy very well, while it drifts with SC.
            energy: svi < 1e-6 < sc; drift_share: 0.33 < sc; last_energy: sc | accuracy long-time
        """,
    ),
    figure(
        "figure-15: Kepler, e = 0.5: angular momentum of SVI and SC over 318 revolutions",
        LONG,
        [over_time("momenta", "svi", "sc", error=False), momentum_errors("svi", "sc")],
        """
        SVI preserves the momentum very well, while it drifts with SC.
            momentum: svi < 1e-12, 1e-6 < sc | accuracy long-time
        """,
    ),
    figure(
        "figure-23: Kepler: SCVI with two points over 10000 periods",
        AGES,
        [orbit(part=slice(*bounds), more=f", {name}") for name, bounds in SEGMENTS.items()],
        """
        After 10000 periods the orbit is what it was in the beginning.
            growth: scvi < 1.01; momentum: scvi < 1e-10 | scvi-structure
        """,
    ),
    figure(
        "figure-24: Kepler: orbits of SCVI with two points, SC with three",
        THREE,
        [orbit("scvi", "sc", more=", 30 periods"), orbit("scvi", "sc", part=slice(-63, None), more=", the last 2 pi")],
        """
        The orbital period shrinks by a factor of almost three with SC.
            first_revolution: sc; last_revolution: 2.094 < sc < 2.513 | sc-period | The exact period, 6.2832, is
            divided by 2.5 and 3.
        The period does not change with SCVI.
            first_revolution: scvi; period_change: scvi < 0.01; turn: scvi | sc-period scvi-structure
        SC with two points is not stable at h = 0.1.
            end: sc2 < 94; last_energy: sc2 | sc-unstable | The span is 188.5; a run ends where a step has no
            solution.
        """,
    ),
    figure(
        "figure-25: Kepler: momentum of SCVI with two points, SC with three",
        THREE,
        [over_time("momenta", "scvi", "sc", periods=True, error=False), momentum_errors("scvi", "sc", periods=True)],
        """
        SCVI preserves the momentum; that of SC falls.
            momentum: scvi < 1e-12, 0.0866 < sc; last_momentum: sc < 0.866 | scvi-structure
        """,
    ),
    figure(
        "figure-26: Kepler: energies of SCVI with two points, SC with three",
        THREE,
        [over_time(part, "scvi", "sc", periods=True, error=False) for part in ("energies", "kinetic", "potential")],
        """
        The energy error of SCVI stays bounded, while the energy of SC drifts.
            growth: scvi < 1.1; energy: scvi, 0.1 < sc; last_energy: sc | scvi-structure
        """,
    ),
    figure(
        "figure-27: Kepler: phase trajectories of four methods",
        PHASES,
        [plane(window=(-2.1, 2.1))],
        """
        The phase trajectories are preserved by SRK4, Stoermer-Verlet and SCVI (variational).
            energy: srk < 0.05, verlet < 0.05, scvi < 0.05; momentum: srk, verlet, scvi | scvi-structure | A tenth
            of the energy counts as lost.
        The phase trajectories are preserved by SCVI (as printed).
            energy: printed < 0.05; momentum: printed | scvi-structure
        SC does not preserve the phase trajectory.
            growth: 1.5 < sc; energy: sc; momentum: sc | long-time
        """,
    ),
    figure(
        "figure-28: Kepler: orbits of SCVI with nine points",
        NINE,
        [orbit()],
        """
        With 5 Gauss points the orbit precesses and fills an annulus; with 6 and 7 it does not visibly.
            turn: 1 < printed5, printed6 < 1, printed7 < 1, full5, full6, full7 || The verdict is on the printed
            form. Where the variational form does not turn, the annulus belongs to the printed equations, not to
            the five points.
        """,
    ),
    figure(
        "figure-29: Kepler: momentum of SCVI with nine points",
        NINE,
        [momentum_errors(f"printed{g}", f"full{g}", title=f"{g} Gauss points", periods=True) for g in GAUSS_POINTS],
        """
        SCVI preserves the momentum (as printed).
            momentum: printed5 < 1e-11, printed6 < 1e-11, printed7 < 1e-11 | scvi-structure
        SCVI preserves the momentum (variational).
            momentum: full5 < 1e-11, full6 < 1e-11, full7 < 1e-11 | scvi-structure
        More quadrature points make the momentum more accurate.
            momentum: 2*printed6 < printed5, 2*printed7 < printed6 | scvi-quadrature
        """,
    ),
    figure(
        "figure-30: Kepler: energy of SCVI with nine points",
        NINE,
        [energy_errors(f"printed{g}", f"full{g}", title=f"{g} Gauss points", periods=True) for g in GAUSS_POINTS],
        """
        The energy error of SCVI remains bounded (as printed).
            growth: printed5 < 1.2, printed6 < 1.2, printed7 < 1.2 | scvi-structure
        The energy error of SCVI remains bounded (variational).
            growth: full5 < 1.2, full6 < 1.2, full7 < 1.2 | scvi-structure
        More quadrature points make the energy more accurate.
            energy: 2*printed6 < printed5, 2*printed7 < printed6, 2*full6 < full5, 2*full7 < full6 |
            scvi-quadrature
        """,
    ),
)
"""Figures 1, 13-15 and 23-30."""
