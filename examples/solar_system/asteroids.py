"""Fifteen asteroids: elements of the Small-Body Database of JPL, and masses from DE421, which has 343 of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import ephemeris
import numpy as np
from point_masses import attraction, square, total
from scipy.optimize import newton

EPOCH = 2457200.5 - ephemeris.EPOCH  # 27 June 2015
ELEMENTS = {  # number, osculating a in au, e, and in degrees inclination, argument of perihelion, node, mean anomaly
    "ceres": (1, 2.7679724, 0.07578254, 10.59230, 72.65415, 80.32720, 138.6621747),
    "pallas": (2, 2.7720036, 0.23115767, 34.84026, 309.96556, 173.09215, 120.9190263),
    "vesta": (4, 2.3619132, 0.08883383, 7.14010, 151.18850, 103.84964, 75.1726759),
    "juno": (3, 2.6710735, 0.25583020, 12.98662, 248.39924, 169.86010, 78.2157434),
    "hebe": (6, 2.4260396, 0.20150658, 14.74819, 239.48589, 138.70347, 81.3179389),
    "iris": (7, 2.3858038, 0.23111629, 5.52245, 145.41010, 259.58587, 125.6920559),
    "flora": (8, 2.2015844, 0.15668778, 5.88687, 285.43109, 110.91382, 132.1859850),
    "metis": (9, 2.3865738, 0.12217763, 5.57406, 5.87362, 68.93971, 263.1426340),
    "hygiea": (10, 3.1421159, 0.11469175, 3.83777, 312.10431, 283.41231, 264.4639730),
    "eunomia": (15, 2.6439231, 0.18737574, 11.73822, 97.53941, 293.18555, 323.3872658),
    "psyche": (16, 2.9221666, 0.13617091, 3.09904, 227.11245, 150.27584, 14.1157196),
    "melpomene": (18, 2.2950431, 0.21894920, 10.13370, 227.90601, 150.47116, 230.5164283),
    "fortuna": (19, 2.4414347, 0.15885487, 1.57374, 182.23242, 211.15556, 195.5179904),
    "amphitrite": (29, 2.5549604, 0.07200974, 6.08968, 61.96096, 356.41987, 307.7532204),
    "euphrosyne": (31, 3.1556843, 0.22179830, 26.30346, 61.45203, 31.13400, 201.0559803),
}
OBLIQUITY = np.radians(84381.448 / 3600.0)


def masses(names: Sequence[str]) -> dict[str, float]:
    return {name: ephemeris.constant(f"MA{ELEMENTS[name][0]:04d}") for name in names}


def lagrangian(names: Sequence[str]) -> str:
    """Return Newton's Lagrangian, with the attraction of the bodies of the ephemeris, but not of each other."""
    pairs = (attraction(a, b) for a, b in product(names, ephemeris.BODIES))
    return total([*(f"gm_{a}*{square(a)}/2" for a in names), *pairs])


def heliocentric(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return position (au) and velocity (au/day) at :data:`EPOCH`, in the frame of the ephemeris."""
    _, a, e, *angles = ELEMENTS[name]
    inclination, argument, node, mean = np.radians(angles)
    E = newton(lambda E: E - e * np.sin(E) - mean, mean)
    flat = np.sqrt(1.0 - e**2)
    rate = np.sqrt(ephemeris.constant("GMS") / a**3) / (1.0 - e * np.cos(E))
    axes = _turned(0, OBLIQUITY) @ _turned(2, node) @ _turned(0, inclination) @ _turned(2, argument)
    position = axes @ [np.cos(E) - e, flat * np.sin(E), 0.0]
    return a * position, a * rate * (axes @ [-np.sin(E), flat * np.cos(E), 0.0])


def _turned(axis: int, angle: float) -> np.ndarray:
    """Return the matrix that rotates vectors about a coordinate axis."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
    return matrix
