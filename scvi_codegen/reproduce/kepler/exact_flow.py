"""Kepler's problem with mu = 1: exact flow, and quantities measured on an orbit.

The "analytic solution" in section 2.2 of the paper has the time in place of the eccentric anomaly; here Kepler's
equation is solved.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.models.systems import kepler

__all__ = [
    "SYSTEM",
    "angular_momentum",
    "ellipse",
    "exact_flow",
    "off_ellipse",
    "perihelion",
    "perihelion_turn",
    "revolutions",
]

Array = NDArray[np.float64]
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
