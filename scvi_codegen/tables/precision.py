"""The arithmetic in which every table is computed: 60 significant digits, in a context of its own.

Nodes, weights and cardinal functions are computed once, at generation time, and rounded once, when they are printed;
60 digits leave ten to spare over the 50 that are promised. The context is private: a user's ``mpmath.mp.dps`` neither
disturbs the tables nor is disturbed by them. Its precision is each thread's own: mpmath keeps one for all, and a thread
would round to the digits that another works with.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, TypeAlias

from mpmath import MPContext
from mpmath.libmp import dps_to_prec, prec_to_dps, round_nearest

__all__ = ["DIGITS", "Matrix", "Number", "Vector", "mp", "settled"]

DIGITS = 60


class _Precision(threading.local):
    """The pair [bits, rounding] of mpmath's contexts; a thread begins with that of :data:`DIGITS`."""

    def __init__(self) -> None:
        self.held = [dps_to_prec(DIGITS), round_nearest]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.held)

    def __getitem__(self, which: int) -> Any:
        return self.held[which]

    def __setitem__(self, which: int, value: Any) -> None:
        self.held[which] = value


class _Context(MPContext):  # type: ignore[misc]
    """With numbers that look up the precision of the thread."""

    def __init__(self) -> None:
        super().__init__()
        self._prec_rounding = own = _Precision()
        for kind in (self.mpf, self.mpc, self.constant):
            kind._ctxdata = [*kind._ctxdata[:2], own]

    @property
    def _prec(self) -> int:
        return int(self._prec_rounding[0])

    @_prec.setter
    def _prec(self, bits: int) -> None:
        self._prec_rounding[0] = bits

    @property
    def _dps(self) -> int:
        return int(prec_to_dps(self._prec))

    @_dps.setter
    def _dps(self, digits: int) -> None:
        """What the bits say."""


mp: Any = _Context()

ZERO = mp.mpf(10) ** -40
"""Entries of tables on a step of length 1 that are smaller are 0 but for the 60th digit of what they came from."""

Number: TypeAlias = Any
"""An ``mp.mpf`` of this context (mpmath ships no types)."""

Vector: TypeAlias = tuple[Number, ...]
Matrix: TypeAlias = tuple[Vector, ...]


def settled(value: Number) -> Number:
    """An entry of a table, rounded to the current precision; exactly 0 where it is 0 but for rounding."""
    return +value if abs(value) > ZERO else mp.zero
