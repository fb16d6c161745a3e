"""The arithmetic in which every table is computed: 60 significant digits, in a context of its own.

Nodes, weights and cardinal functions are computed once, at generation time, and rounded once, when they are printed;
60 digits leave ten to spare over the 50 that are promised. The context is private: a user's ``mpmath.mp.dps`` neither
disturbs the tables nor is disturbed by them. Its precision is that of each thread: where one rounds to the 53 bits of a
double, tables that another computes keep their digits.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, TypeAlias

from mpmath import MPContext
from mpmath.libmp import dps_to_prec, prec_to_dps

__all__ = ["DIGITS", "Matrix", "Number", "Vector", "mp", "settled"]

DIGITS = 60


class _OfThread(threading.local):
    """A pair, bits and rounding, as mpmath's numbers ask for it; of 60 digits where a thread begins."""

    def __init__(self) -> None:
        self.pair = [dps_to_prec(DIGITS), "n"]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.pair)

    def __getitem__(self, place: int) -> Any:
        return self.pair[place]

    def __setitem__(self, place: int, value: Any) -> None:
        self.pair[place] = value


class _ThreadedContext(MPContext):  # type: ignore[misc]
    """mpmath's arithmetic; where it keeps one precision for all threads, each has its own."""

    _own = _OfThread()
    _prec_rounding = property(lambda self: self._own, lambda self, given: None)
    _prec = property(lambda self: self._own.pair[0], lambda self, bits: None)  # mpmath sets the pair as well
    _dps = property(lambda self: prec_to_dps(self._own.pair[0]), lambda self, digits: None)


mp = _ThreadedContext()
mp.dps = DIGITS
for constant in (mp.pi, mp.e, mp.ln2, mp.ln10):  # mpmath keeps their digits, but not safely while threads extend them
    constant(dps=10 * DIGITS)

ZERO = mp.mpf(10) ** -40
"""Entries of tables on a step of length 1 that are smaller are 0 but for the 60th digit of what they came from."""

Number: TypeAlias = Any
"""An ``mp.mpf`` of this context (mpmath ships no types)."""

Vector: TypeAlias = tuple[Number, ...]
Matrix: TypeAlias = tuple[Vector, ...]


def settled(value: Number) -> Number:
    """An entry of a table, rounded to the current precision; exactly 0 where it is 0 but for rounding."""
    return +value if abs(value) > ZERO else mp.zero
