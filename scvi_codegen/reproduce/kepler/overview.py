"""Figures 1 and 2: four methods on Kepler's problem; nodes of a step, and why they are not equispaced."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SVI, ExplicitEuler, Gauss, SpectralCollocation, StoermerVerlet
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import planar_pendulum
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, angular_momentum, perihelion
from scvi_codegen.reproduce.laboratory.drawing import COLORS, Array, Axes, Figure, draw_orbit, panels
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
from scvi_codegen.reproduce.laboratory.running import stepper_of, trajectory
from scvi_codegen.reproduce.oscillators.one_degree import drift, largest
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.tables.basis import cardinal_values
from scvi_codegen.tables.nodes import chebyshev_lobatto, equispaced, legendre_lobatto
from scvi_codegen.tables.precision import Vector
from scvi_codegen.tables.quadrature import gauss_legendre, gauss_lobatto

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


CURVE = SVI(4, gauss_legendre(5), chebyshev_lobatto(4))
START, MOMENTUM, CURVE_STEP = 1.0, 1.0, 2.5
NODE_TYPES = {"Legendre": legendre_lobatto, "Chebyshev": chebyshev_lobatto, "equispaced": equispaced}
COUNTS = (2, 4, 7)
RUNGE_COUNTS = range(3, 32, 4)
FAMILY_STYLES = {"Legendre": ("SVI", "o"), "Chebyshev": ("SC", "s"), "equispaced": ("exact", "^")}


@experiment("figure-2", "The trial curve of a step, its nodes and its quadrature points")
def _points_of_a_step(_: Mapping[str, Result]) -> Result:
    solved = derived_step(planar_pendulum(), CURVE)([START], [MOMENTUM], CURVE_STEP)
    values = np.array([START, *map(float, solved.unknowns)])
    nodes, points = (_numbers(family) for family in (CURVE.node_set.points, CURVE.rule.points))
    compiled = stepper_of(planar_pendulum(), CURVE).step([START], [MOMENTUM], h=CURVE_STEP)[0][0]
    common = int(np.sum(np.min(np.abs(points[:, None] - nodes), axis=1) < 1e-12))
    at_lobatto = sum(any(abs(x - y) < 1e-30 for y in legendre_lobatto(4).points) for x in gauss_lobatto(5).points)
    counts = RUNGE_COUNTS
    errors = {name: np.array([_interpolation_error(name, n) for n in counts]) for name in NODE_TYPES}
    rows = tuple(zip(counts, *(error.tolist() for error in errors.values()), strict=True))
    end = {name: float(error[-1]) for name, error in errors.items()}
    return Result(
        setting=(
            "The paper's drawing is a sketch. Here: one step of SVI for the pendulum, degree 4, five Chebyshev nodes, "
            f"five Gauss points, q = {START:g}, p = {MOMENTUM:g}, h = {CURVE_STEP:g}.",
            "The second panel is the unnumbered picture of section 2.1, with equispaced points, too; Legendre points "
            "are the Legendre-Gauss-Lobatto points, which contain the ends.",
            "Third panel: the interpolation of 1/(1 + 16 x^2), Runge's function, with n points.",
        ),
        checks=(
            Comparison(
                claim="The quadrature points may or may not be the interpolation points.",
                measured=f"{common} of 5 Gauss points is a Chebyshev node (the middle), {at_lobatto} of 5 "
                "Gauss-Lobatto points are Legendre-Gauss-Lobatto nodes.",
                verdict=judged(common < len(points), at_lobatto == len(points)),
            ),
            Comparison(
                claim="The trajectory on a step is the polynomial through Q^0 = q_k, .., Q^s = q_{k+1}.",
                measured=f"Its end and the compiled step differ by {abs(values[-1] - compiled):.0e}.",
                verdict=holds(abs(values[-1] - compiled) < 1e-14),
            ),
            Comparison(
                claim="Interpolation at Chebyshev and Legendre points converges faster than at equispaced points.",
                measured=f"Largest error with {RUNGE_COUNTS[-1]} points: "
                + ", ".join(f"{name} {error:.1e}" for name, error in end.items())
                + ".",
                verdict=judged(*(end[name] < 0.01 * end["equispaced"] for name in ("Legendre", "Chebyshev"))),
            ),
        ),
        tables=(
            TableBlock(columns=("n", *NODE_TYPES), rows=rows, formats=dict.fromkeys(NODE_TYPES, ".1e"), shown=False),
            TableBlock(
                name="curve",
                columns=("node", "Q"),
                rows=tuple(zip(nodes.tolist(), values.tolist(), strict=True)),
                formats={"node": ".4f", "Q": ".6f"},
            ),
        ),
        picture=Picture(draw=partial(_draw_points, values, errors), width=11.0, height=3.8),
    )


def _numbers(points: Vector) -> Array:
    return np.array([float(point) for point in points])


def _interpolated(points: Vector, values: Array, at: Array) -> Array:
    """Return the values at ``at`` of the polynomial through ``values`` at ``points``."""
    table = np.array([_numbers(row) for row in cardinal_values(points, [float(x) for x in at])])
    result: Array = table @ values
    return result


def _interpolation_error(family: str, count: int) -> float:
    """Return the largest interpolation error of Runge's function on [-1, 1] at 101 points."""
    points, at = NODE_TYPES[family](count - 1).points, np.linspace(-1.0, 1.0, 101)
    return largest(_interpolated(points, _runge(_numbers(points)), at) - _runge(at))


def _runge(x: Array) -> Array:
    return 1.0 / (1.0 + 16.0 * x**2)


def _draw_points(values: Array, errors: Mapping[str, Array], figure: Figure) -> None:
    curve, families, convergence = panels(figure, 1, 3)
    _draw_curve(curve, values)
    for row, (name, family) in enumerate(NODE_TYPES.items()):
        color, mark = FAMILY_STYLES[name]
        for block, count in enumerate(COUNTS):
            height = -(row + 4.0 * block)
            families.axhline(height, color="#cccccc", linewidth=0.8, zorder=0)
            families.plot(_numbers(family(count - 1).points), [height] * count, mark, color=COLORS[color], markersize=4)
        convergence.semilogy(RUNGE_COUNTS, errors[name], f"{mark}-", color=COLORS[color], markersize=3, label=name)
    ticks = [-(1.0 + 4.0 * block) for block in range(len(COUNTS))]
    families.set(yticks=ticks, yticklabels=[f"{count} points" for count in COUNTS], title="families of points")
    convergence.set(xlabel="points n", title="error of interpolation, 1/(1 + 16 x$^2$)")
    convergence.legend(loc="upper left")


def _draw_curve(axes: Axes, values: Array) -> None:
    nodes, points, t = CURVE.node_set.points, CURVE.rule.points, np.linspace(-1.0, 1.0, 200)
    at_points = _interpolated(nodes, values, _numbers(points))
    axes.plot(t, _interpolated(nodes, values, t), color=COLORS["exact"], linewidth=1.2)
    axes.plot(_numbers(nodes), values, "o", color="black", markersize=5, label="nodes $c_v$, values $Q^v$")
    axes.plot(_numbers(points), at_points, "o", color="red", markersize=4, label="quadrature points $d_n$")
    axes.vlines(_numbers(points), 0.0, at_points, color="red", linestyle=":", linewidth=0.7)
    axes.vlines(_numbers(nodes), 0.0, values, color="black", linestyle=":", linewidth=0.7)
    axes.set(
        xticks=(-1.0, 1.0), xticklabels=("kh", "(k+1)h"), ylabel="q", title="trial curve of one step", ylim=(0.0, 2.1)
    )
    axes.legend(loc="upper left")
