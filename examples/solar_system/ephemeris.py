"""DE421 of the Jet Propulsion Laboratory: masses, constants and states, in au and days, from 1899 to 2200.

Folkner, Williams & Boggs, "The Planetary and Lunar Ephemeris DE 421", IPN Progress Report 42-178 (2009), made for the
years up to 2053. Its series are the package `de421`, read by `jplephem` (the extra `ephemeris`). Axes are those of the
International Celestial Reference Frame, time is barycentric dynamical time, counted from :data:`EPOCH`.
"""

from __future__ import annotations

import de421
import numpy as np
from jplephem.ephem import Ephemeris

BODIES = ("sun", "mercury", "venus", "earth", "moon", "mars", "jupiter", "saturn", "uranus", "neptune", "pluto")
GM = {"mercury": "GM1", "venus": "GM2", "mars": "GM4", "jupiter": "GM5", "saturn": "GM6", "uranus": "GM7"} | {
    "neptune": "GM8", "pluto": "GM9", "sun": "GMS"
}  # fmt: skip

tables = Ephemeris(de421)


def constant(name: str) -> float:
    """Return a number from the header of DE421."""
    return float(getattr(tables, name))


EPOCH = constant("JDEPOC")  # Julian date, 28 June 1969: where the integration of DE421 began, in both directions
FIRST, LAST = constant("jalpha") - EPOCH, constant("jomega") - EPOCH
END_OF_FIT = 2471184.5 - EPOCH  # 9 October 2053
YEAR_2000 = 2451545.0 - EPOCH
AU = constant("AU")  # km
LIGHT = constant("CLIGHT") * 86400.0 / AU  # au/day
EARTH_RADIUS, MOON_RADIUS, SUN_RADIUS = (constant(name) / AU for name in ("AE", "AM", "ASUN"))


def masses() -> dict[str, float]:
    """Return G m in au^3/day^2; planets include their moons, except the Earth."""
    moon = constant("GMB") / (1.0 + constant("EMRAT"))
    known = {body: constant(name) for body, name in GM.items()} | {"moon": moon, "earth": constant("GMB") - moon}
    return {body: known[body] for body in BODIES}


def states(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return barycentric positions and velocities at some days, each (times, bodies, 3), in au and au/day."""
    found = {name: _state(name, t) for name in {*BODIES, "earthmoon"} - {"earth"}}
    geocentric = found["moon"]
    found["earth"] = found["earthmoon"] - geocentric / (1.0 + constant("EMRAT"))
    found["moon"] = found["earth"] + geocentric
    together = np.stack([found[body] for body in BODIES], axis=1)
    return together[..., :3], together[..., 3:]


def _state(name: str, t: np.ndarray) -> np.ndarray:
    position, velocity = tables.position_and_velocity(name, EPOCH, np.asarray(t, dtype=float))
    return np.vstack([position, velocity]).T / AU


def relative(x: np.ndarray) -> np.ndarray:
    """Return planets relative to the Sun and the Moon relative to the Earth, without the Sun: (..., bodies - 1, 3)."""
    sun, earth, moon = (BODIES.index(body) for body in ("sun", "earth", "moon"))
    seen = x - x[..., sun : sun + 1, :]
    seen[..., moon, :] = x[..., moon, :] - x[..., earth, :]
    return seen[..., 1 : len(BODIES), :]
