"""Lagrangians of point masses, as text: Newton's, and the first relativistic terms of Einstein, Infeld and Hoffmann.

A body `a` has coordinates `a_x`, `a_y`, `a_z` and the parameter `gm_a`, G times its mass; L is G times the Lagrangian.
Relativistic terms: Landau & Lifshitz, *The Classical Theory of Fields*, section 106, in harmonic coordinates.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

AXES = "xyz"


def coordinates(bodies: Sequence[str]) -> list[str]:
    return [f"{a}_{x}" for a in bodies for x in AXES]


def newton(bodies: Sequence[str]) -> str:
    """Return L = sum m v^2/2 + sum over pairs of G m m'/r."""
    kinetic = (f"gm_{a}*{square(a)}/2" for a in bodies)
    return total([*kinetic, *(f"{attraction(a, b)}" for a, b in combinations(bodies, 2))])


def relativity(bodies: Sequence[str]) -> str:
    """Return the terms of order 1/c^2 by Einstein, Infeld and Hoffmann.

    c^2 L = sum m v^4/8 + sum over pairs of G m m'/(2 r) [3 v^2 + 3 v'^2 - 7 v.v' - (v.n)(v'.n)]
            - sum over bodies a of m_a/2 (sum over other bodies b of G m_b/r_ab)^2
    """
    kinetic = (f"gm_{a}*{square(a)}**2/8" for a in bodies)
    pairs = (f"{attraction(a, b)}*({_of_speeds(a, b)})/2" for a, b in combinations(bodies, 2))
    triples = (f"-gm_{a}*({total(f'gm_{b}/{distance(a, b)}' for b in bodies if b != a)})**2/2" for a in bodies)
    return f"({total([*kinetic, *pairs, *triples])})/c**2"


def _of_speeds(a: str, b: str) -> str:
    product = total(f"{a}_{x}_dot*{b}_{x}_dot" for x in AXES)
    along = [total(f"({a}_{x} - {b}_{x})*{c}_{x}_dot" for x in AXES) for c in (a, b)]
    return f"3*{square(a)} + 3*{square(b)} - 7*({product}) - ({along[0]})*({along[1]})/{distance(a, b)}**2"


def attraction(a: str, b: str) -> str:
    return f"gm_{a}*gm_{b}/{distance(a, b)}"


def distance(a: str, b: str) -> str:
    return "sqrt(" + total(f"({a}_{x} - {b}_{x})**2" for x in AXES) + ")"


def square(a: str) -> str:
    """Return the square of a speed."""
    return "(" + total(f"{a}_{x}_dot**2" for x in AXES) + ")"


def total(terms: Iterable[str]) -> str:
    return " + ".join(terms)
