"""Arrays, indices and loops: what sums over many like terms are written with.

    array    = name "[" size ("," size)* "]"                      declared, as q[N], r[N, 3], bonds[B, 2]
    loop     = name "in" (bound ".." bound | size) ["periodic"]   i in N, i in 0..N-2, i in N periodic
             | name "<" name "in" size                            i < j in N: every pair once
    place    = whole number | size (+|-) whole number             0, N-1
             | index (+|-) whole number                           i, i+1
             | table "[" index "," whole number "]"               bonds[b, 0]

Sizes are names, whose values the arrays of a run have, or whole numbers. SymPy never sees an index: every *access* of
an array (``q[i+1]``, ``m[bonds[b, 0]]``) is a symbol of its own in the formula of a term, a *slot*, of which
derivatives are taken as of any other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

__all__ = ["Access", "Array", "Loop", "Place", "Size"]


@dataclass(frozen=True, slots=True)
class Size:
    """``name + number``; a whole number alone where there is no name."""

    name: str
    number: int = 0

    def at(self, sizes: Mapping[str, int]) -> int:
        """Its value."""
        return (sizes[self.name] if self.name else 0) + self.number

    def __add__(self, number: int) -> Size:
        return replace(self, number=self.number + number)

    def __str__(self) -> str:
        return offset_text(self.name, self.number)


def offset_text(name: str, number: int) -> str:
    """``name + number`` as short as it can be written."""
    if not name:
        return str(number)
    return f"{name}{number:+d}" if number else name


@dataclass(frozen=True, slots=True)
class Array:
    """A name with the size of each of its axes; of a table of places the last is a whole number of columns."""

    name: str
    axes: tuple[Size, ...]

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Its shape where the sizes have values."""
        return tuple(axis.at(sizes) for axis in self.axes)

    @property
    def names(self) -> tuple[str, ...]:
        """Of its axes that are no whole numbers."""
        return tuple(axis.name for axis in self.axes if axis.name)

    def __str__(self) -> str:
        return f"{self.name}[{', '.join(map(str, self.axes))}]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """An index from ``first`` to the one before ``end``, or from behind another index on.

    Attributes:
        index: its name.
        first, end: bounds; first is 0 where it begins behind another index.
        periodic: whether the index ``end`` is ``first`` again.
        behind: the other index of a pair.
    """

    index: str
    first: Size
    end: Size
    periodic: bool = False
    behind: str = ""

    @property
    def is_whole(self) -> bool:
        """Whether it begins at 0."""
        return self.first == Size("", 0)

    def __str__(self) -> str:
        if self.behind:
            return f"{self.behind} < {self.index} in {self.end}"
        span = str(self.end) if self.is_whole and not self.end.number else f"{self.first}..{self.end + -1}"
        return f"{self.index} in {span}{' periodic' if self.periodic else ''}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Where an axis is accessed: an index, a size or nothing, plus a whole number; or an entry of a table.

    Attributes:
        index: the loop that it moves with, or "".
        base: the size and the whole number that it stands at, if it does not move; else what is added to the index.
        table, column: the table whose row is that of the index, or "".
    """

    index: str = ""
    base: Size = Size("")
    table: str = ""
    column: int = 0

    def __str__(self) -> str:
        if self.table:
            return f"{self.table}[{self.index}, {self.column}]"
        return offset_text(self.index, self.base.number) if self.index else str(self.base)


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """An entry of an array, ``q[i+1, 0]``."""

    array: Array
    places: tuple[Place, ...]

    @property
    def indices(self) -> frozenset[str]:
        """The loops that it moves with."""
        return frozenset(place.index for place in self.places if place.index)

    def __str__(self) -> str:
        return f"{self.array.name}[{', '.join(map(str, self.places))}]"
