"""Figure 1: four methods on Kepler's problem."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from scvi_codegen.methods import ExplicitEuler, Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, angular_momentum, perihelion
from scvi_codegen.reproduce.laboratory.drawing import Array, Figure, draw_orbit, panels
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
from scvi_codegen.reproduce.laboratory.running import trajectory
from scvi_codegen.reproduce.oscillators.one_degree import drift, largest
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

ECCENTRICITY = 0.6
POSITION, VELOCITY = perihelion(ECCENTRICITY)
PERIOD = 2.0 * math.pi


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Method with its step size, and the name of its colour."""

    method: Method
    h: float
    color: str


RUNS = {
    "explicit Euler": PaperRun(ExplicitEuler(), 0.0025, "Euler"),
    "Stoermer-Verlet": PaperRun(StoermerVerlet(), 0.1, "Verlet"),
    "symplectic Runge-Kutta": PaperRun(Gauss(3), 0.25, "SRK"),
    "Chebyshev collocation": PaperRun(SpectralCollocation(4), 0.25, "SC"),
}
SAME_AREA = 0.03
"""Largest relative change of the mean area over three revolutions that counts as constant."""


@lru_cache
def _orbit(name: str) -> Trajectory:
    run = RUNS[name]
    return trajectory(SYSTEM, run.method, POSITION, VELOCITY, h=run.h, span=100.0)


def _ellipse_area(run: Trajectory) -> Array:
    """Return the area pi a b of the osculating ellipse of each state: a = -1/(2 E), b = M sqrt(a)."""
    area: Array = np.pi * np.abs(angular_momentum(run.q, run.p)) * (-2.0 * run.energy()) ** -1.5
    return area


def _area_change(run: Trajectory) -> float:
    """Return the mean area over the last three periods relative to the first three, less 1."""
    area, count = _ellipse_area(run), round(3.0 * PERIOD / run.h)
    return float(area[-count:].mean() / area[:count].mean()) - 1.0


@experiment(
    "figure-1", "Kepler's problem, e = 0.6: explicit Euler, Stoermer-Verlet, symplectic Runge-Kutta, collocation"
)
def _four_methods(_: Mapping[str, Result]) -> Result:
    runs = {name: _orbit(name) for name in RUNS}
    errors = {name: run.energy() - run.energy()[0] for name, run in runs.items()}
    area = {name: _area_change(run) for name, run in runs.items()}
    rows: list[tuple[Cell, ...]] = [
        (name, RUNS[name].h, len(run) - 1, largest(errors[name]), drift(errors[name]), area[name])
        for name, run in runs.items()
    ]
    columns = (
        "method",
        "h",
        "steps",
        "largest energy error",
        "drift of the energy",
        "change of the area of the ellipse",
    )
    return Result(
        setting=(
            "e = 0.6, q(0) = (0.4, 0), p(0) = (0, 2), T = 100; steps as in the caption.",
            "The symplectic Runge-Kutta method is Gauss's of three stages; 5 collocation points are degree 4.",
            "Area: pi a b of the osculating ellipse, a mean over three periods at the end against three at the start.",
            "The black ellipse is the exact orbit.",
        ),
        checks=(*_checks_of_areas(area), _accuracy(errors), _printed_solution()),
        tables=(TableBlock(columns=columns, rows=tuple(rows), formats=dict.fromkeys(columns[3:], ".1e") | {"h": "g"}),),
        picture=Picture(
            draw=partial(_draw_orbits, {name: (run.q[:, 0], run.q[:, 1]) for name, run in runs.items()}), height=8.0
        ),
    )


def _checks_of_areas(area: Mapping[str, float]) -> tuple[Comparison, Comparison]:
    euler, verlet, srk, sc = (area[name] for name in RUNS)
    return (
        Comparison(
            claim="Explicit Euler and Chebyshev collocation do not preserve the phase volume; their orbits spiral out.",
            measured=f"The area of the ellipse changes by {euler:+.0%} (Euler) and {sc:+.1%} (collocation).",
            verdict=judged(euler > SAME_AREA, sc > SAME_AREA),
            bears_on=("long-time",),
        ),
        Comparison(
            claim="Stoermer-Verlet and the symplectic Runge-Kutta method preserve the area of the elliptical orbit.",
            measured=f"It changes by {verlet:+.2%} and {srk:+.2%}; {SAME_AREA:.0%} counts as preserved.",
            verdict=judged(abs(verlet) < SAME_AREA, abs(srk) < SAME_AREA),
            bears_on=("long-time",),
        ),
    )


def _accuracy(errors: Mapping[str, Array]) -> Comparison:
    euler, sc = (largest(errors[name]) for name in ("explicit Euler", "Chebyshev collocation"))
    return Comparison(
        claim="Chebyshev collocation is much more accurate than explicit Euler with steps 100 times smaller.",
        measured=f"Largest energy error: collocation {sc:.1e}, Euler {euler:.1e}, {euler / sc:.0f} times as much.",
        verdict=holds(euler > 5.0 * sc),
    )


def _printed_solution() -> Comparison:
    """Return the check that (cos t - e, sqrt(1 - e^2) sin t) is a solution with the initial velocity."""
    minor = math.sqrt(1.0 - ECCENTRICITY**2)
    t = np.linspace(0.0, PERIOD, 400)
    q = np.array([np.cos(t) - ECCENTRICITY, minor * np.sin(t)])
    residual = -np.array([np.cos(t), minor * np.sin(t)]) + q / np.hypot(*q) ** 3
    time = t - ECCENTRICITY * np.sin(t)
    q2 = largest(q[1] - np.interp(t, time, q[1]))
    return Comparison(
        claim="The analytic solution is q1 = cos t - e, q2 = sqrt(1 - e^2) sin t.",
        measured=f"These start with the velocity {minor:.1f} instead of {VELOCITY[1]:.1f} and miss q'' = -q/|q|^3 by "
        f"up to {largest(residual):.1f}. The solution has the eccentric anomaly E, E - e sin E = t, in place of t: the "
        f"same ellipse, so the drawn orbit is right; q2 differs by up to {q2:.2f}.",
        verdict=holds(largest(residual) < 1e-6),
    )


def _draw_orbits(orbits: Mapping[str, tuple[Array, Array]], figure: Figure) -> None:
    angle = np.linspace(0.0, 2.0 * np.pi, 400)
    minor = math.sqrt(1.0 - ECCENTRICITY**2)
    for axes, (name, (x, y)), letter in zip(panels(figure, 2, 2), orbits.items(), "abcd", strict=True):
        style = {"marker": ".", "markersize": 3, "linestyle": ""} if RUNS[name].h > 0.2 else {}
        draw_orbit(axes, x, y, RUNS[name].color, name, **style)
        axes.plot(np.cos(angle) - ECCENTRICITY, minor * np.sin(angle), color="black", linewidth=1.2, label="exact")
        axes.plot(0.0, 0.0, "+", color="black", markersize=6)
        axes.set(xlabel="q1", ylabel="q2", title=f"({letter}) {name}, h = {RUNS[name].h:g}")
        axes.set_aspect("equal", adjustable="datalim")
