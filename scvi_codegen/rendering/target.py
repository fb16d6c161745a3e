"""Scalar types of C, their rounding, literals and libm functions.

The numbers of a program are exact; a target determines how they are rounded and printed, and which functions of libm
take them. The support headers use the header of its name.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from scvi_codegen.errors import MethodError
from scvi_codegen.ir.kernel import Number
from scvi_codegen.rendering.convergence import TOLERANCE
from scvi_codegen.tables.precision import mp, nearest_float, settled


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A scalar type of C.

    Attributes:
        name: as in :data:`~scvi_codegen.rendering.program_source.EMBEDDED`.
        scalar: the type, and the name of its support header.
        suffix: of the functions of libm and of literals.
        digits: of a literal that reads back as the same number; 0: the shortest that does.
        tolerance: see :data:`scvi_codegen.rendering.convergence.TOLERANCE`.
        halvings: from 1 to the round-off unit.
        smallest, largest: numbers with full precision.
    """

    name: str
    scalar: str
    suffix: str
    digits: int
    tolerance: float
    halvings: int
    smallest: float
    largest: float

    def rounded(self, value: Number) -> float:
        """Return the number of the target nearest to ``value``; 0 below its smallest, as for low words of tables."""
        nearest = nearest_float(value, self.halvings + 1)
        return 0.0 if abs(nearest) <= self.smallest and abs(mp.convert(value)) < self.smallest else nearest

    def rest(self, value: Number) -> Number:
        """Return the rounding error: the low word of a double-double number."""
        return settled(mp.convert(value) - self.rounded(value))

    def number(self, value: Number) -> str:
        """Return a literal that reads back as the number of the target nearest to ``value``."""
        nearest = self.rounded(value)
        if not self.digits:
            return repr(nearest)
        text = f"{nearest:.{self.digits}g}"
        return f"{text}{self.suffix}" if "." in text or "e" in text else f"{text}.0{self.suffix}"

    def function(self, name: str) -> str:
        """Return the name of a function of libm."""
        return f"{name}{self.suffix}"

    def check(self, values: Iterable[Number]) -> None:
        """Raise :class:`MethodError` for numbers of a model outside the range of the target."""
        for value in values:
            if value != 0.0 and not self.smallest <= abs(value) <= self.largest:
                raise MethodError(
                    f"the number {float(value)!r} is outside the range of {self.name} precision: choose "
                    "other units, or 'double'"
                )


DOUBLE = Target(
    name="double",
    scalar="double",
    suffix="",
    digits=0,
    tolerance=TOLERANCE,
    halvings=52,
    smallest=5e-324,
    largest=(2.0 - 2.0**-52) * 2.0**1023,
)

SINGLE = Target(
    name="single",
    scalar="float",
    suffix="f",
    digits=9,
    tolerance=2.0**-23,
    halvings=23,
    smallest=2.0**-126,
    largest=(2.0 - 2.0**-23) * 2.0**127,
)
