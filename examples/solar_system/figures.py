"""Figures of the Sun, the Earth and the Moon: terms of L, as text, for their potentials at point masses.

Axes are functions of t, days from the epoch of the ephemeris, in its frame, the mean equator and equinox of 2000: the
Sun's is fixed, the Earth's precesses (IAU 2006, Capitaine, Wallace & Chapront 2003), the Moon's pole follows Cassini's
laws, inclined by 1.543 degrees, with the mean elements of Simon et al. (1994). The rotation angle of the Moon is a
coordinate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import cos, radians, sin

from point_masses import AXES, attraction, distance, total

LEGENDRE = {2: "(3*{s}**2 - 1)/2", 3: "(5*{s}**3 - 3*{s})/2", 4: "(35*{s}**4 - 30*{s}**2 + 3)/8"}
OBLIQUITY = radians(84381.448 / 3600.0)
Vector = Sequence[str]


def zonal(a: str, bodies: Sequence[str], axis: Vector, radius: float, j: Mapping[int, float]) -> str:
    """Return the zonal harmonics J_n of a body of that equatorial radius (au), at other bodies."""
    terms = []
    for b in bodies:
        s = _along(axis, a, b)
        harmonics = total(
            f"{value!r}*({radius!r}/{distance(a, b)})**{n}*{LEGENDRE[n].format(s=s)}" for n, value in j.items()
        )
        terms.append(f"-{attraction(a, b)}*({harmonics})")
    return total(terms)


def of_the_sun() -> Vector:
    """Return the Sun's axis, by the IAU's right ascension and declination."""
    ascension, declination = radians(286.13), radians(63.87)
    return [repr(cos(declination) * cos(ascension)), repr(cos(declination) * sin(ascension)), repr(sin(declination))]


def of_the_earth(century: str) -> Vector:
    """Return the Earth's mean axis, with the centuries from 2000 as text."""
    arcsecond = radians(1.0 / 3600.0)
    x = f"({2004.191898 * arcsecond!r}*{century} - {0.4297829 * arcsecond!r}*{century}**2)"
    y = f"(-{22.4072747 * arcsecond!r}*{century}**2)"
    return [x, y, f"(1 - ({x}**2 + {y}**2)/2)"]


def of_the_moon(century: str, turn: str = "0") -> tuple[Vector, Vector]:
    """Return the Moon's pole, and its axis towards the mean Earth by Cassini's laws, rotated by an angle."""
    inclination = radians(1.543)
    node = f"({radians(125.044555)!r} - {radians(6967919.3622 / 3600.0)!r}*{century})"  # on the ecliptic of 2000
    latitude = f"({radians(93.27209906)!r} + {radians(1739527263.2179 / 3600.0)!r}*{century} + {turn})"  # from there
    up, across = repr(cos(inclination)), repr(sin(inclination))
    pole = [f"-{across}*sin{node}", f"{across}*cos{node}", up]
    towards = [
        f"(-cos{node}*cos{latitude} + {up}*sin{node}*sin{latitude})",
        f"(-sin{node}*cos{latitude} - {up}*cos{node}*sin{latitude})",
        f"({across}*sin{latitude})",
    ]
    return _equatorial(pole), _equatorial(towards)


def moon(pole: Vector, towards: Vector, radius: float, j2: float, c22: float) -> str:
    """Return the term of the Moon's figure, of degree two, at the Earth."""
    up, near = _along(pole, "moon", "earth"), _along(towards, "moon", "earth")
    # along the third axis: 1 - up^2 - near^2; cos^2(latitude) cos(2 longitude) is near^2 less that
    degree_two = f"{-j2!r}*(3*{up}**2 - 1)/2 + {3.0 * c22!r}*(2*{near}**2 + {up}**2 - 1)"
    return f"{attraction('moon', 'earth')}*({radius!r}/{distance('moon', 'earth')})**2*({degree_two})"


def turning_moon(radius: float, inertia: float) -> str:
    """Return the energy of `moon_turn`, the libration angle of the Moon; the moment of inertia is in m radius^2."""
    return f"gm_moon*{inertia * radius**2!r}*moon_turn_dot**2/2"


def _along(axis: Vector, a: str, b: str) -> str:
    """Return the cosine of the angle between an axis and the direction from one body to another."""
    return f"(({total(f'{k}*({b}_{x} - {a}_{x})' for k, x in zip(axis, AXES, strict=True))})/{distance(a, b)})"


def _equatorial(ecliptic: Vector) -> Vector:
    x, y, z = ecliptic
    return [
        x,
        f"({cos(OBLIQUITY)!r}*{y} - {sin(OBLIQUITY)!r}*{z})",
        f"({sin(OBLIQUITY)!r}*{y} + {cos(OBLIQUITY)!r}*{z})",
    ]
