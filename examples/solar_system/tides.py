"""Tide raised by the Moon on the Earth, as forces: with a time lag it is not a term of L.

It has degree two, with a Love number and a lag for each order, as in DE421 (Williams, Boggs & Folkner, "DE421 Lunar
Orbit, Physical Librations, and Surface Coordinates", 2008). The tide at t was raised by the Moon at t - lag, and has
been carried on by the rotation of the Earth since.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from point_masses import AXES

TURNING = 2.0 * sympy.pi.evalf() * 1.00273781191135448  # radians a day


def tide(radius: float, love: Sequence[float], lag: Sequence[float]) -> dict[str, str]:
    """Return forces by coordinate, G times Newton's; radius in au, lags in days, for the orders 0, 1, 2."""
    moon, raising = sympy.symbols("x y z"), sympy.symbols("x_then y_then z_then")
    forces = [0, 0, 0]
    for order, (number, delay) in enumerate(zip(love, lag, strict=True)):
        potential = number * radius**5 * _harmonic(order, moon, raising)
        for i, x in enumerate(moon):
            forces[i] += potential.diff(x).subs(_place_then(moon, raising, delay), simultaneous=True)
    written = [_as_coordinates(sympy.factor_terms(force)) for force in forces]
    return {f"moon_{x}": f"gm_moon**2*({f})" for x, f in zip(AXES, written, strict=True)} | {
        f"earth_{x}": f"-gm_moon**2*({f})" for x, f in zip(AXES, written, strict=True)
    }


def _harmonic(order: int, r: Sequence[sympy.Symbol], s: Sequence[sympy.Symbol]) -> sympy.Expr:
    """Return the part of P_2(cos of the angle between r and s)/(|r| |s|)^3 of an order about the Earth's axis."""
    (x, y, z), (a, b, c) = r, s
    squared, then = x**2 + y**2 + z**2, a**2 + b**2 + c**2
    across = x * a + y * b
    parts = (
        (3 * z**2 - squared) * (3 * c**2 - then) / 4,
        3 * z * c * across,
        sympy.Rational(3, 4) * (2 * across**2 - (x**2 + y**2) * (a**2 + b**2)),
    )
    return parts[order] / (squared * then) ** sympy.Rational(5, 2)


def _place_then(r: Sequence[sympy.Symbol], s: Sequence[sympy.Symbol], delay: float) -> dict:
    """Return the position of the Moon ``delay`` days earlier, carried on by the rotation of the Earth."""
    x, y, z = (here - delay * sympy.Symbol(f"v_{here}") for here in r)
    turn = TURNING * delay
    carried = (sympy.cos(turn) * x - sympy.sin(turn) * y, sympy.sin(turn) * x + sympy.cos(turn) * y, z)
    return dict(zip(s, carried, strict=True))


def _as_coordinates(force: sympy.Expr) -> str:
    """Return the vector from the Earth to the Moon in the coordinates of both."""
    relative = {}
    for x in AXES:
        relative[sympy.Symbol(x)] = sympy.Symbol(f"moon_{x}") - sympy.Symbol(f"earth_{x}")
        relative[sympy.Symbol(f"v_{x}")] = sympy.Symbol(f"moon_{x}_dot") - sympy.Symbol(f"earth_{x}_dot")
    return str(force.subs(relative, simultaneous=True))
