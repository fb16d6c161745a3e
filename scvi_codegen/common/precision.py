"""Multiprecision arithmetic of all tables: 60 significant digits, in a private context.

Nodes, weights and cardinal functions are computed once, at generation time, and rounded once, when they are printed;
50 digits are guaranteed, ten are reserve. The context is independent of a user's ``mpmath.mp.dps``. Its precision is
thread-local: functions of mpmath that raise it meanwhile do not affect tables computed by other threads.
"""

import copyreg
import threading
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, TypeAlias

from mpmath import MPContext
from mpmath.libmp import MPZ, dps_to_prec, mpf_pos, prec_to_dps, round_nearest, to_float

DIGITS = 60


class _ThreadLocalPrecision(threading.local):
    """Thread-local pair of precision in bits and rounding mode, as mpmath's numbers access it; initially 60 digits."""

    def __init__(self) -> None:
        self.pair = [dps_to_prec(DIGITS), "n"]

    def __iter__(self) -> Iterator[Any]:
        return iter(self.pair)

    def __getitem__(self, index: int) -> Any:
        return self.pair[index]

    def __setitem__(self, index: int, value: Any) -> None:
        self.pair[index] = value


class _ThreadedContext(MPContext):  # type: ignore[misc]
    """Context of mpmath whose precision is thread-local instead of global."""

    _own = _ThreadLocalPrecision()
    _prec_rounding = property(lambda self: self._own, lambda self, pair: None)
    _prec = property(lambda self: self._own.pair[0], lambda self, bits: None)  # mpmath sets the pair as well
    _dps = property(lambda self: prec_to_dps(self._own.pair[0]), lambda self, digits: None)


mp = _ThreadedContext()
mp.dps = DIGITS
for constant in (mp.pi, mp.e, mp.ln2, mp.ln10):  # cached by mpmath, but extended in a way that is not thread-safe
    constant(dps=10 * DIGITS)

ZERO = mp.mpf(10) ** -40
"""Bound below which table entries on a step of length 1 are set to 0: round-off in the 60th digit of their terms."""

VANISHING = Fraction(1, 2**120 + 1)
"""Added to bases of roots that may be 0, so that these and their derivatives are finite; 2^-60 in single precision.

No number of a model is equal to it.
"""

Number: TypeAlias = Any
"""An ``mp.mpf`` of this context (mpmath has no type annotations)."""

Vector: TypeAlias = tuple[Number, ...]
Matrix: TypeAlias = tuple[Vector, ...]


def _made(sign: int, mantissa: int, exponent: int, bits: int) -> Number:
    """Return a number of the context from the parts of :mod:`mpmath.libmp`."""
    return mp.make_mpf((sign, MPZ(mantissa), exponent, bits))


# pickle does not find the class of numbers, which belongs to the context, by its name
copyreg.pickle(mp.mpf, lambda number: (_made, (number._mpf_[0], int(number._mpf_[1]), *number._mpf_[2:])))


def nearest_float(value: Number, bits: int) -> float:
    """Return a number of any type rounded once to ``bits`` bits, without a change of the working precision."""
    return float(to_float(mpf_pos(mp.convert(value)._mpf_, bits, round_nearest)))


def settled(value: Number) -> Number:
    """Return a table entry rounded to the current precision; exactly 0 if it is round-off."""
    return +value if abs(value) > ZERO else mp.zero
