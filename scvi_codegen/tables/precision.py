"""The arithmetic in which every table is computed: 60 significant digits, in a context of its own.

Nodes, weights and cardinal functions are computed once, at generation time, and rounded once, when they are printed;
60 digits leave ten to spare over the 50 that are promised. The context is private: a user's ``mpmath.mp.dps`` neither
disturbs the tables nor is disturbed by them.
"""

from __future__ import annotations

from typing import Any, TypeAlias

from mpmath import MPContext

__all__ = ["DIGITS", "Matrix", "Number", "Vector", "mp"]

DIGITS = 60
mp = MPContext()
mp.dps = DIGITS

Number: TypeAlias = Any
"""An ``mp.mpf`` of this context (mpmath ships no types)."""

Vector: TypeAlias = tuple[Number, ...]
Matrix: TypeAlias = tuple[Vector, ...]
