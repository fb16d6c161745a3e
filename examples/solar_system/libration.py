"""Libration of the Moon in longitude in DE421: its rotation angle relative to Cassini's laws."""

from __future__ import annotations

import ephemeris
import figures
import numpy as np
import sympy

OFFSET = np.radians(67.92 / 3600.0)
"""Angle from the axis towards the mean Earth to the principal axis: Williams, Boggs & Folkner (2008)."""
DRIFT = 1e-3
"""Constant rate added to the angle, in radians a day, so that the velocity is never near zero: step-size control
compares changes with velocities. The equations of motion do not change."""


def axes(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the pole of the Moon's figure and its principal axis nearest to the Earth, by DE421: (3, times)."""
    phi, theta, psi = ephemeris.tables.position("librations", ephemeris.EPOCH, t)
    s, c = np.sin, np.cos
    pole = np.array([s(theta) * s(phi), -s(theta) * c(phi), c(theta)])
    x, y = c(phi) * c(psi) - s(phi) * c(theta) * s(psi), s(phi) * c(psi) + c(phi) * c(theta) * s(psi)
    return pole, np.array([x, y, s(theta) * s(psi)])


def turn(t: np.ndarray) -> np.ndarray:
    """Return the angle in radians."""
    pole, near = axes(t)
    towards = sympy.lambdify("century", figures.of_the_moon("century")[1])((t - ephemeris.YEAR_2000) / 36525.0)
    across = np.cross(pole, near, axis=0)
    return -np.arcsin(np.sum(np.array(towards) * across, axis=0)) - OFFSET


def state(t: float) -> tuple[float, float]:
    """Return the coordinate at a time, the angle with its drift, and its rate in radians a day."""
    before, now, after = turn(t + np.array([-0.1, 0.0, 0.1]))
    return float(now) + DRIFT * t, float((after - before) / 0.2) + DRIFT
