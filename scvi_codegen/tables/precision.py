"""The arithmetic in which every table is computed: 60 significant digits, in a context of its own.

Nodes, weights and cardinal functions are computed once, at generation time, and rounded once, when they are printed;
60 digits leave ten to spare over the 50 that are promised. The context is private: a user's ``mpmath.mp.dps`` neither
disturbs the tables nor is disturbed by them.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from mpmath import MPContext

__all__ = ["DIGITS", "Matrix", "Number", "Vector", "mp", "settled"]

DIGITS = 60
mp = MPContext()
mp.dps = DIGITS

ZERO = mp.mpf(10) ** -40
"""Entries of tables on a step of length 1 that are smaller are 0 but for the 60th digit of what they came from."""

Number: TypeAlias = Any
"""An ``mp.mpf`` of this context (mpmath ships no types)."""

Vector: TypeAlias = tuple[Number, ...]
Matrix: TypeAlias = tuple[Vector, ...]


def settled(value: Number) -> Number:
    """An entry of a table, rounded to the current precision; exactly 0 where it is 0 but for rounding."""
    return +value if abs(value) > ZERO else mp.zero
