"""Figures of runs of Kepler's problem: four methods (1), SVI and SC (13-15), SCVI (23-30).

With two points the printed and the variational equations of SCVI agree. With more, the printed (34d) and (34e) lack the
chain-rule term (experiment ``correction``): both forms are run.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise
from types import SimpleNamespace

import numpy as np

from scvi_codegen.methods import SCVI, SVI, ExplicitEuler, Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.reproduce.figures import RunCheck, energy_errors, figure, momentum_errors, over_time, plane
from scvi_codegen.reproduce.runs import (
    KEPLER,
    NO_DRIFT,
    PERIOD,
    SECTION_3,
    SECTION_4,
    MeasuredRun,
    RunSetting,
    Scheme,
    exact_kepler,
    largest,
    perihelion,
)

SAME_AREA = 0.03
"""Largest relative change of the mean area over three revolutions that counts as constant."""
SHRUNK = 2.5, 3.0
"""Range of factors that counts as "almost three"."""
EXACT_MOMENTUM = 1e-11
"""Largest momentum error due to round-off over 4200 steps."""
GAUSS_POINTS = (5, 6, 7)
FORMS = {"printed": "as printed", "full": "variational"}
orbit = partial(plane, kind="orbit", window=(-1.65, 1.65))


def _kepler(e: float, h: float, span: float, schemes: dict[str, Scheme], *sentences: str) -> RunSetting:
    """Return a setting that starts at the perihelion, with the tolerance of section 4."""
    q, velocity = perihelion(e)
    exact = partial(exact_kepler, q, velocity)
    return RunSetting(KEPLER, q, velocity, h, span, schemes, sentences, SECTION_4, exact)


FOUR = replace(
    _kepler(
        0.6,
        0.25,
        100.0,
        {
            "euler": Scheme("explicit Euler", ExplicitEuler(), "Euler", 0.0025),
            "verlet": Scheme("Stoermer-Verlet", StoermerVerlet(), "Verlet", 0.1),
            "srk": Scheme("symplectic Runge-Kutta", Gauss(3), "SRK"),
            "sc": Scheme("Chebyshev collocation", SpectralCollocation(4), "SC"),
        },
        "e = 0.6, q(0) = (0.4, 0), p(0) = (0, 2), T = 100; steps as in the caption.",
        "The symplectic Runge-Kutta method is Gauss's of three stages; 5 collocation points are degree 4.",
        "Area: pi a b of the osculating ellipse, a mean over three periods at the end against three at the start.",
    ),
    options=SECTION_3,
)
LONG = replace(
    _kepler(
        0.5,
        0.2,
        2000.0,
        {
            **{f"svi{s or ''}": Scheme(f"SVI, degree {5 + s}", SVI(5 + s), "SVI") for s in (0, 1)},
            **{f"sc{s or ''}": Scheme(f"SC, degree {5 + s}", SpectralCollocation(5 + s), "SC") for s in (0, 1)},
        },
        "Kepler's problem, e = 0.5, from the perihelion, h = 0.2, T = 2000 (10000 steps, 318 revolutions), six "
        "Chebyshev points: degree 5. The captions name no quadrature: SVI has as many Gauss points as the degree.",
        "Degree 6 is run, too, because the legends of section 3 count the degree in some figures.",
    ),
    options=SECTION_3,
)
TWO_POINTS = Scheme("SCVI", SCVI(1, "gauss-legendre:2"), "SCVI")
QUADRATURE = "Section 4.3 names two interpolation points and two Gauss points; printed and variational equations agree."
SEGMENTS = {"steps 1 to 2150": (1, 2151), "198925 to 201075": (198925, 201076), "397850 to 400000": (397850, 400001)}
AGES = _kepler(
    0.5,
    math.pi / 20,
    20000 * math.pi,
    {"scvi": TWO_POINTS},
    "Kepler's problem, e = 0.5, from the perihelion, h = pi/20, T = 20000 pi: 400000 steps.",
    QUADRATURE,
)
THREE = _kepler(
    0.5,
    0.1,
    30 * PERIOD,
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
    0.5,
    0.3,
    30 * PERIOD,
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
    0.5,
    0.3,
    200 * PERIOD,
    {
        f"{key}{g}": Scheme(f"{g} Gauss points, {label}", shooting(9, g, printed=key == "printed"), color)
        for key, label, color in (("printed", "as printed", "printed"), ("full", "variational", "SCVI"))
        for g in GAUSS_POINTS
    },
    "Kepler's problem, e = 0.5, from the perihelion, h = 0.3, T = 400 pi (200 periods): SCVI with nine Chebyshev "
    "points and 5, 6, 7 Gauss points.",
    TWO_FORMS,
)


def _nine(r: SimpleNamespace, form: str) -> list[MeasuredRun]:
    return [getattr(r, f"{form}{gauss}") for gauss in GAUSS_POINTS]


def _preserved(form: str, r: SimpleNamespace) -> list[object]:
    return [max(run.momentum for run in _nine(r, form)) < EXACT_MOMENTUM]


def _bounded(form: str, r: SimpleNamespace) -> list[object]:
    return [run.growth < 1.2 for run in _nine(r, form)]


def _falling(runs: list[MeasuredRun], quantity: str) -> bool:
    values = [getattr(run, quantity) for run in runs]
    return all(later < earlier / 2 for earlier, later in pairwise(values))


def _change(run: MeasuredRun) -> float:
    """Return the change of the ends of the range of energies between the first and the last segment, over the range."""
    first, *_, last = (run.energies[slice(*bounds)] for bounds in SEGMENTS.values())
    return largest(np.subtract((last.min(), last.max()), (first.min(), first.max()))) / float(np.ptp(first))


def printed_solution(e: float) -> tuple[float, float]:
    """Return the residual of q'' = -q/|q|^3 for (cos t - e, sqrt(1 - e^2) sin t), and the error of its q2."""
    minor, t = math.sqrt(1.0 - e**2), np.linspace(0.0, PERIOD, 400)
    q = np.array([np.cos(t) - e, minor * np.sin(t)])
    residual = -np.array([np.cos(t), minor * np.sin(t)]) + q / np.hypot(*q) ** 3
    return largest(residual), largest(q[1] - exact_kepler(*perihelion(e), t)[0][:, 1])


RESIDUAL, OFF = printed_solution(0.6)

EXPERIMENTS = (
    figure(
        "figure-1",
        "Kepler's problem, e = 0.6: explicit Euler, Stoermer-Verlet, symplectic Runge-Kutta, collocation",
        FOUR,
        [plane(kind="orbit")],
        {
            "Explicit Euler and Chebyshev collocation do not preserve the phase volume; orbits spiral out.": RunCheck(
                "ellipse_area: euler sc",
                lambda r: [run.ellipse_area > SAME_AREA for run in (r.euler, r.sc)],
                "long-time",
            ),
            "Stoermer-Verlet and the symplectic Runge-Kutta method preserve the area of the orbit.": RunCheck(
                "ellipse_area: verlet srk",
                lambda r: [abs(run.ellipse_area) < SAME_AREA for run in (r.verlet, r.srk)],
                "long-time",
                f"{SAME_AREA:.0%} counts as preserved.",
            ),
            "Chebyshev collocation is much more accurate than explicit Euler with steps 100 times smaller.": RunCheck(
                "energy: euler sc", lambda r: [r.euler.energy > 5.0 * r.sc.energy]
            ),
            "The analytic solution is q1 = cos t - e, q2 = sqrt(1 - e^2) sin t.": RunCheck(
                "",
                lambda r: [RESIDUAL < 1e-6],
                note=f"These start with the velocity 0.8, not 2.0, and miss q'' = -q/|q|^3 by up to {RESIDUAL:.1f}. "
                "The solution has the eccentric anomaly E, E - e sin E = t, in place of t: the same ellipse, so the "
                f"drawn orbit is right; q2 differs by up to {OFF:.2f}.",
            ),
        },
    ),
    figure(
        "figure-13",
        "Kepler, e = 0.5: orbits of SVI and SC over 318 revolutions",
        LONG,
        [orbit("svi", "sc"), over_time("position_error", "svi", "sc")],
        {
            "SVI stays on the exact orbit, SC leaves it.": RunCheck(
                "off_ellipse turn: svi sc",
                lambda r: [r.svi.off_ellipse < 1e-4 < r.sc.off_ellipse],
                "long-time",
                "Below 0.01 semi-major axes a picture of the orbit shows nothing.",
            ),
            "SVI is more accurate than SC in phase with the same points and step.": RunCheck(
                "last_position: svi sc", lambda r: [r.svi.last_position < r.sc.last_position], "accuracy"
            ),
        },
    ),
    figure(
        "figure-14",
        "Kepler, e = 0.5: energy of SVI and SC over 318 revolutions",
        LONG,
        [over_time("energies", "svi", "sc", error=False), energy_errors("svi", "sc")],
        {
            "SVI preserves the energy very well, while it drifts with SC.": RunCheck(
                "energy drift last_energy: svi sc",
                lambda r: [r.svi.energy < 1e-6 < r.sc.energy and abs(r.sc.energy_error[-1]) > 0.9 * r.sc.energy],
                "accuracy long-time",
            ),
        },
    ),
    figure(
        "figure-15",
        "Kepler, e = 0.5: angular momentum of SVI and SC over 318 revolutions",
        LONG,
        [over_time("momenta", "svi", "sc", error=False), momentum_errors("svi", "sc")],
        {
            "SVI preserves the momentum very well, while it drifts with SC.": RunCheck(
                "momentum: svi sc", lambda r: [r.svi.momentum < NO_DRIFT and r.sc.momentum > 1e-6], "accuracy long-time"
            ),
        },
    ),
    figure(
        "figure-23",
        "Kepler: SCVI with two points over 10000 periods",
        AGES,
        [orbit(part=slice(*bounds), more=f", {name}") for name, bounds in SEGMENTS.items()],
        {
            "After 10000 periods the orbit is what it was in the beginning.": RunCheck(
                "energy growth momentum",
                lambda r: [_change(r.scvi) < 0.01 and r.scvi.momentum < 1e-10],
                "scvi-structure",
                "The range of energies of the first 2150 steps and that of the last must agree to 1 %.",
            ),
        },
    ),
    figure(
        "figure-24",
        "Kepler: orbits of SCVI with two points, SC with three",
        THREE,
        [orbit("scvi", "sc", more=", 30 periods"), orbit("scvi", "sc", part=slice(-63, None), more=", the last 2 pi")],
        {
            "The orbital period shrinks by a factor of almost three with SC.": RunCheck(
                "first_revolution last_revolution: sc",
                lambda r: [SHRUNK[0] < PERIOD / r.sc.last_revolution < SHRUNK[1]],
                "sc-period",
                f"The exact period is {PERIOD:.4f}.",
            ),
            "The period does not change with SCVI.": RunCheck(
                "first_revolution last_revolution turn: scvi",
                lambda r: [abs(r.scvi.last_revolution / r.scvi.first_revolution - 1) < 0.01],
                "sc-period scvi-structure",
            ),
            "SC with two points is not stable at h = 0.1.": RunCheck(
                "end last_energy: sc2",
                lambda r: [r.sc2.end < r.sc2.setting.span / 2],
                "sc-unstable",
                f"The span is {30 * PERIOD:.1f}; a run ends where a step has no solution.",
            ),
        },
    ),
    figure(
        "figure-25",
        "Kepler: momentum of SCVI with two points, SC with three",
        THREE,
        [over_time("momenta", "scvi", "sc", periods=True, error=False), momentum_errors("scvi", "sc", periods=True)],
        {
            "SCVI preserves the momentum; that of SC falls.": RunCheck(
                "momentum last_momentum: scvi sc",
                lambda r: [r.scvi.momentum < NO_DRIFT and r.sc.last_momentum < 0.9 * r.sc.momenta[0]],
                "scvi-structure",
            ),
        },
    ),
    figure(
        "figure-26",
        "Kepler: energies of SCVI with two points, SC with three",
        THREE,
        [over_time(part, "scvi", "sc", periods=True, error=False) for part in ("energies", "kinetic", "potential")],
        {
            "The energy error of SCVI stays bounded, while the energy of SC drifts.": RunCheck(
                "energy growth last_energy: scvi sc",
                lambda r: [r.scvi.growth < 1.1 and abs(r.sc.energy_error[-1]) > 0.1],
                "scvi-structure",
            ),
        },
    ),
    figure(
        "figure-27",
        "Kepler: phase trajectories of four methods",
        PHASES,
        [plane(window=(-2.1, 2.1))],
        {
            "The phase trajectories are preserved by SRK4, Stoermer-Verlet and SCVI (variational).": RunCheck(
                "energy momentum lost: srk verlet scvi",
                lambda r: [not run.failed and run.lost is None for run in (r.srk, r.verlet, r.scvi)],
                "scvi-structure",
            ),
            "The phase trajectories are preserved by SCVI (as printed).": RunCheck(
                "energy momentum lost: printed",
                lambda r: [not r.printed.failed and r.printed.lost is None],
                "scvi-structure",
            ),
            "SC does not preserve the phase trajectory.": RunCheck(
                "energy growth momentum: sc", lambda r: [r.sc.growth > 1.5], "long-time"
            ),
        },
    ),
    figure(
        "figure-28",
        "Kepler: orbits of SCVI with nine points",
        NINE,
        [orbit()],
        {
            "With 5 Gauss points the orbit precesses and fills an annulus; with 6 and 7 it does not visibly.": RunCheck(
                "turn",
                lambda r: [abs(r.printed5.turn) > 1.0 and max(abs(r.printed6.turn), abs(r.printed7.turn)) < 1.0],
                note="The verdict is on the printed form. Where the variational form turns by less than 1 rad in 200 "
                "revolutions, the annulus belongs to the printed equations, not to the five points.",
            ),
        },
    ),
    figure(
        "figure-29",
        "Kepler: momentum of SCVI with nine points",
        NINE,
        [momentum_errors(f"printed{g}", f"full{g}", title=f"{g} Gauss points", periods=True) for g in GAUSS_POINTS],
        {
            **{
                f"SCVI preserves the momentum ({label}).": RunCheck(
                    f"momentum: {form}5 {form}6 {form}7",
                    partial(_preserved, form),
                    "scvi-structure",
                )
                for form, label in FORMS.items()
            },
            "More quadrature points make the momentum more accurate.": RunCheck(
                "momentum", lambda r: [_falling(_nine(r, "printed"), "momentum")], "scvi-quadrature"
            ),
        },
    ),
    figure(
        "figure-30",
        "Kepler: energy of SCVI with nine points",
        NINE,
        [energy_errors(f"printed{g}", f"full{g}", title=f"{g} Gauss points", periods=True) for g in GAUSS_POINTS],
        {
            **{
                f"The energy error of SCVI remains bounded ({label}).": RunCheck(
                    f"growth: {form}5 {form}6 {form}7",
                    partial(_bounded, form),
                    "scvi-structure",
                )
                for form, label in FORMS.items()
            },
            "More quadrature points make the energy more accurate.": RunCheck(
                "energy", lambda r: [all(_falling(_nine(r, form), "energy") for form in FORMS)], "scvi-quadrature"
            ),
        },
    ),
)
"""Figures 1, 13-15 and 23-30."""
