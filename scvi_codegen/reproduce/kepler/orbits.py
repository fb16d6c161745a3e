"""Kepler's problem with mu = 1: exact flow, and quantities measured on an orbit.

The "analytic solution" in section 2.2 of the paper has the time in place of the eccentric anomaly; here Kepler's
equation is solved.

Runs with their errors over time, and pictures of orbits and invariants.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods import SCVI
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import kepler
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.laboratory.drawing import COLORS, Array, Axes, Figure, draw_error, panels, thinned
from scvi_codegen.reproduce.laboratory.experiment import TableBlock, series_table
from scvi_codegen.reproduce.laboratory.running import SECTION_4, trajectory
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

Pair = tuple[float, float]

SYSTEM = kepler()
"""System q'' = -q / |q|^3, built once."""

NEWTON_STEPS = 60


def perihelion(e: float) -> tuple[Pair, Pair]:
    """Return (q, v) at perihelion for semi-major axis 1 (energy -1/2, period 2 pi) and eccentricity e."""
    return (1.0 - e, 0.0), (0.0, math.sqrt((1.0 + e) / (1.0 - e)))


def exact_flow(q: ArrayLike, p: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
    """Return (q, p) after times t, one row each, from Kepler's equation for the change x of the eccentric anomaly."""
    start, velocity = np.asarray(q, dtype=float), np.asarray(p, dtype=float)
    times = np.atleast_1d(np.asarray(t, dtype=float))
    r0 = float(np.hypot(*start))
    a = 1.0 / (2.0 / r0 - float(velocity @ velocity))
    inward, sigma = 1.0 - r0 / a, float(start @ velocity) / math.sqrt(a)
    mean = times / a**1.5
    x = mean.copy()
    for _ in range(NEWTON_STEPS):
        x -= (x - inward * np.sin(x) + sigma * (1 - np.cos(x)) - mean) / (1 - inward * np.cos(x) + sigma * np.sin(x))
    r = a * (1 - inward * np.cos(x) + sigma * np.sin(x))
    f, g = 1 - a / r0 * (1 - np.cos(x)), times - a**1.5 * (x - np.sin(x))
    f_dot, g_dot = -math.sqrt(a) / (r * r0) * np.sin(x), 1 - a / r * (1 - np.cos(x))
    return np.outer(f, start) + np.outer(g, velocity), np.outer(f_dot, start) + np.outer(g_dot, velocity)


def ellipse(e: float) -> tuple[Array, Array]:
    """Return points of the exact orbit from :func:`perihelion`."""
    anomaly = np.linspace(0.0, 2 * np.pi, 361)
    return np.cos(anomaly) - e, math.sqrt(1 - e * e) * np.sin(anomaly)


def angular_momentum(q: Array, p: Array) -> Array:
    """Return M = q1 p2 - q2 p1, along the last axis."""
    result: Array = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    return result


def off_ellipse(q: Array, e: float) -> Array:
    """Return the distance of positions outside the exact orbit: half the sum of the distances to its foci, less 1."""
    result: Array = (np.hypot(q[:, 0], q[:, 1]) + np.hypot(q[:, 0] + 2 * e, q[:, 1])) / 2 - 1
    return result


def perihelion_turn(q: Array, p: Array) -> float:
    """Return the angle in radians by which the perihelion has rotated, whole turns included.

    It is the direction of the Laplace-Runge-Lenz vector p x M - q / |q|, which is constant on exact orbits.
    """
    m, r = angular_momentum(q, p), np.hypot(q[:, 0], q[:, 1])
    angle = np.unwrap(np.arctan2(-p[:, 0] * m - q[:, 1] / r, p[:, 1] * m - q[:, 0] / r))
    return float(angle[-1] - angle[0])


def revolutions(t: Array, q: Array, p: Array) -> Array:
    """Return the duration of each revolution, from apocentre to apocentre, where q . p changes sign."""
    outward = (q * p).sum(axis=1)
    before = np.flatnonzero((outward[:-1] > 0) & (outward[1:] <= 0))
    share = outward[before] / (outward[before] - outward[before + 1])
    return np.diff(t[before] + share * (t[before + 1] - t[before]))


PRESERVED = 0.05
"""Largest energy error at which a phase trajectory counts as preserved: a tenth of the semi-major axis."""


@dataclass(frozen=True, slots=True)
class Orbit:
    """Run from the perihelion and its errors over time.

    Attributes:
        run: states.
        energy, momentum: errors over time.
        failed: True if a step had no solution before the end.
    """

    run: Trajectory
    energy: Array
    momentum: Array
    failed: bool

    @property
    def largest(self) -> tuple[float, float]:
        """Largest errors of energy and momentum."""
        return float(np.abs(self.energy).max()), float(np.abs(self.momentum).max())

    @property
    def turn(self) -> float:
        """Rotation of the perihelion over the whole run, in radians."""
        return perihelion_turn(self.run.q, self.run.p)

    @property
    def lost(self) -> float:
        """First time at which the energy is off by a tenth, or the last time."""
        off = np.flatnonzero(np.abs(self.energy) > PRESERVED)
        return float(self.run.t[off[0]]) if len(off) else self.end

    @property
    def end(self) -> float:
        """Time of the last state."""
        return float(self.run.t[-1])

    def halves(self) -> tuple[float, float]:
        """Return the largest energy errors of the first and of the second half."""
        half = len(self.energy) // 2
        return float(np.abs(self.energy[:half]).max()), float(np.abs(self.energy[half:]).max())


@lru_cache(maxsize=32)
def orbit_of(method: Method, h: float, span: float, e: float = 0.5, options: SolverOptions = SECTION_4) -> Orbit:
    """Return the orbit from the perihelion, by default with the tolerance of section 4."""
    failed = False
    try:
        solver = "newton" if isinstance(method, SCVI) and method.degree > 1 else "auto"
        run = trajectory(SYSTEM, method, *perihelion(e), h=h, span=span, options=options, solver=solver)
    except StepFailedError as failure:
        run, failed = Trajectory.before(failure), True
    energy, momentum = run.energy(), angular_momentum(run.q, run.p)
    return Orbit(run, energy - energy[0], momentum - momentum[0], failed)


def time_series(t: Array, columns: Mapping[str, Array]) -> TableBlock:
    """Return a table of quantities over time; those of runs that ended before are empty from then on."""
    padded = {name: [*values.tolist(), *[None] * (len(t) - len(values))] for name, values in columns.items()}
    return series_table({"t": t.tolist()} | padded)


def draw_states(axes: Axes, q: Array, scheme: str, label: str | None = None) -> None:
    """Draw positions of a long run as dots, rasterised also in SVG."""
    style: dict[str, Any] = {"color": COLORS[scheme], "markersize": 1.2, "rasterized": True}
    axes.plot(q[:, 0], q[:, 1], ".", label=label or scheme, **style)


def draw_ellipse(axes: Axes, e: float) -> None:
    """Draw the exact orbit."""
    axes.plot(*ellipse(e), color="black", linewidth=0.8, label="exact")


def draw_orbits(figure: Figure, runs: Mapping[str, tuple[Array, str]], *, rows: int, e: float) -> None:
    """Draw the states of runs, each (q, scheme) by title, over the exact ellipse."""
    for axes, (title, (q, scheme)) in zip(panels(figure, rows, len(runs) // rows), runs.items(), strict=True):
        draw_states(axes, q, scheme)
        draw_ellipse(axes, e)
        axes.set(title=title, xlabel="$q_1$", ylabel="$q_2$", aspect="equal", xlim=(-1.65, 1.65), ylim=(-1.65, 1.65))
        axes.legend(loc="upper right")


def draw_invariant(figure: Figure, t: Array, values: Mapping[str, Array], name: str, unit: str = "") -> None:
    """Draw an invariant by scheme as in the paper, and its error on a logarithmic axis."""
    left, right = panels(figure, 1, 2)
    for scheme, series in reversed([*values.items()]):
        left.plot(*thinned(t, series, most=3000), color=COLORS[scheme], label=scheme, linewidth=0.8)
        draw_error(right, t, series - series[0], scheme)
    time = ", ".join(filter(None, ("t", unit)))
    left.set(title=name, xlabel=time, ylabel=name)
    right.set(title=f"error of the {name}", xlabel=time, ylabel="|error|, largest in each bin")
    left.ticklabel_format(useOffset=False)
    left.legend(loc="lower left")
    right.legend(loc="center right")
