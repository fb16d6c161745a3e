"""Arrays, indices and loops of Lagrangians in index notation.

    array    = name "[" size ("," size)* "]"                      declared, as q[N], r[N, 3], bonds[B, 2]
    loop     = name "in" (bound ".." bound | size) ["periodic"]   i in N, i in 0..N-2, i in N periodic
             | name "<" name "in" size                            i < j in N: every pair once
             | name "<" name "in" list                            i < j in near: pairs of a list of neighbours
    place    = whole number | size (+|-) whole number             0, N-1
             | index (+|-) whole number                           i, i+1
             | index "-" index                                    j-i, of a pair i < j or of a convolution
             | table "[" index "," whole number "]"               bonds[b, 0]

A convolution within a sum is ``sum(j in N, c[j-i]*q[j])``, in which differences of indices are modulo N.

A size is a name, whose value follows from the arrays of a run, or a whole number. SymPy never sees an index: every
*access* of an array (``q[i+1]``, ``m[bonds[b, 0]]``) is replaced by a separate symbol in the formula of a term, and
derivatives are taken with respect to these symbols.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import SystemDefinitionError

SIZES_REQUIRED = (
    "the sizes of its arrays are known at run time only. Give them when compiling, "
    "compile_stepper(system, method, sizes={'N': 8}), or use unroll_sums(system, {'N': 8})"
)
"""Reason why arrays of run-time sizes lack a feature, with the remedy."""
MOST_ELEMENTS = 10**6
"""Largest number of entries of an array of known sizes, each of which has a name."""
MOST_THREADS = 64
"""Largest number of threads that share a step: the largest number of blocks of coordinates."""


@dataclass(frozen=True, slots=True)
class Size:
    """Array size ``name + number``; a whole number if ``name`` is empty."""

    name: str
    number: int = 0

    def at(self, sizes: Mapping[str, int]) -> int:
        """Return the numerical value for the sizes of a run."""
        return (sizes[self.name] if self.name else 0) + self.number

    def __add__(self, number: int) -> Size:
        return replace(self, number=self.number + number)

    def __str__(self) -> str:
        return offset_text(self.name, self.number)


def offset_text(name: str, number: int) -> str:
    """Return ``name + number`` in its shortest form."""
    if not name:
        return str(number)
    return f"{name}{number:+d}" if number else name


@dataclass(frozen=True, slots=True)
class Array:
    """Declaration of an array: name and size of each axis; the last axis of an index table is a whole number.

    A single coordinate is an array without axes.

    Attributes:
        name, axes: name of the array, size of each axis.
        letters: names of the entries along the last axis, ``"wxyz"`` of quaternions; by default their indices.
        is_field: of an array of known sizes, whether forces couple neighbouring elements (:func:`couples_elements`).
    """

    name: str
    axes: tuple[Size, ...]
    letters: str = ""
    is_field: bool = field(default=False, compare=False)

    @staticmethod
    def size(name: str, number: int = 0) -> Size:
        """Return the size ``name + number``; a whole number if ``name`` is empty."""
        return Size(name, number)

    @staticmethod
    def loop(index: str, first: Size, end: Size, *, periodic: bool = False) -> Loop:
        """Return the loop over an index from ``first`` to ``end`` - 1, which a periodic one wraps."""
        return Loop(index=index, first=first, end=end, periodic=periodic)

    @staticmethod
    def place(index: str = "", **further: Any) -> Place:
        """Return the place of an index; ``base``, ``table``, ``column``, ``minus`` as of :class:`Place`."""
        return Place(index=index, **further)

    def at(self, *places: Place, sums: Sequence[Convolution] = ()) -> Access:
        """Return an entry of the array, or of convolutions of it along axes."""
        return Access(array=self, places=places, sums=tuple(sums))

    def convolution(self, axis: int, index: str) -> Convolution:
        """Return the sum over an axis with coefficients c[j - i] of this array; ``index`` is shown."""
        return Convolution(axis, self, index)

    @classmethod
    def of_shape(cls, name: str, shape: Sequence[int]) -> Array:
        """Return the array with these sizes."""
        return cls(name, tuple(Size("", n) for n in shape))

    def shape(self, sizes: Mapping[str, int]) -> tuple[int, ...]:
        """Return the numerical shape for the sizes of a run."""
        return tuple(axis.at(sizes) for axis in self.axes)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the symbolic axis sizes."""
        return tuple(axis.name for axis in self.axes if axis.name)

    @property
    def is_lattice(self) -> bool:
        """True if there are axes with names, all before those of integer size."""
        named = [bool(axis.name) for axis in self.axes]
        return bool(named) and named[0] and named == sorted(named, reverse=True)

    def __str__(self) -> str:
        return f"{self.name}[{', '.join(map(str, self.axes))}]" if self.axes else self.name

    @property
    def entry(self) -> str:
        """An entry with one index per axis, ``q[i, j]``, for messages."""
        return f"{self.name}[{', '.join('ijklmn'[: len(self.axes)])}]"

    @property
    def elements(self) -> tuple[str, ...]:
        """Names of the entries of an array of known sizes, ``q_0``, .., the last axis running fastest."""
        if (count := math.prod(self.shape({}))) > MOST_ELEMENTS:
            raise SystemDefinitionError(
                f"{self} has {count} entries, more than the {MOST_ELEMENTS} that are supported as named coordinates: "
                f"declare it with a name for the size, {self.name}[N], and give the size to runs"
            )
        ranges: list[Iterable[Any]] = [*map(range, self.shape({}))]
        if self.letters:
            ranges[-1] = self.letters
        return tuple("_".join([self.name, *map(str, index)]) for index in product(*ranges))


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayDeclarations:
    """Arrays of a system: declarations and sizes.

    Attributes:
        coordinates: arrays of coordinates.
        momenta: of a Hamiltonian, after the coordinates in the state.
        fields, tables: arrays of parameters and of indices.
        sizes: names of the sizes, in the order of the C struct.
    """

    coordinates: tuple[Array, ...] = ()
    momenta: tuple[Array, ...] = ()
    fields: tuple[Array, ...] = ()
    tables: tuple[Array, ...] = ()
    sizes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Loop:
    """Loop over an index from ``first`` to ``end`` - 1, or over the values greater than another index.

    Attributes:
        index: name of the index.
        first, end: bounds; ``first`` is 0 in a pair loop.
        periodic: periodic boundary: index ``end`` wraps to ``first``.
        behind: the smaller index of a pair loop, or "".
        near: list of neighbours that contains the pairs, or "".
    """

    index: str
    first: Size
    end: Size
    periodic: bool = False
    behind: str = ""
    near: str = ""

    @property
    def is_whole(self) -> bool:
        """Return whether the loop begins at 0."""
        return self.first == Size("", 0)

    def __str__(self) -> str:
        if self.behind:
            return f"{self.behind} < {self.index} in {self.near or self.end}"
        span = str(self.end) if self.is_whole and not self.end.number else f"{self.first}..{self.end + -1}"
        return f"{self.index} in {span}{' periodic' if self.periodic else ''}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """Index expression of one axis: an index, a size or nothing, plus a whole number; or an entry of an index table.

    Attributes:
        index: the loop index, or "".
        base: the constant position if there is no index; otherwise the offset added to the index.
        minus: the smaller index of a pair, which is subtracted, or "".
        table, column: the index table whose row is the index, and its column; or "".
    """

    index: str = ""
    base: Size = Size("")
    table: str = ""
    column: int = 0
    minus: str = ""

    def at(
        self,
        index: Mapping[str, Any],
        sizes: Mapping[str, int],
        tables: Mapping[str, NDArray[np.int64]],
        periods: Mapping[str, int],
    ) -> Any:
        """Return the position at values of the indices, numbers or arrays; ``periods`` are those of periodic loops."""
        if self.table:
            return tables[self.table][index[self.index], self.column]
        if not self.index:
            return self.base.at(sizes)
        position = index[self.index] + self.base.number
        if self.minus:
            position = position - index[self.minus]
        return position % periods[self.index] if self.index in periods else position

    def __str__(self) -> str:
        if self.table:
            return f"{self.table}[{self.index}, {self.column}]"
        if self.minus:
            return f"{self.index}-{self.minus}"
        return offset_text(self.index, self.base.number) if self.index else str(self.base)


@dataclass(frozen=True, slots=True)
class Convolution:
    """Sum along an axis of an array at each place i, sum_j c[j - i] x_j, with differences of indices modulo N.

    Attributes:
        axis: position of the axis.
        coefficients: the array ``c[N]``.
        index: name of j, for display.
    """

    axis: int
    coefficients: Array
    index: str = field(compare=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class Access:
    """Array access such as ``q[i+1, 0]``, or an entry of convolutions of the array, the first one applied first."""

    array: Array
    places: tuple[Place, ...]
    sums: tuple[Convolution, ...] = ()

    @property
    def indices(self) -> frozenset[str]:
        """Loop indices that occur in the access."""
        return frozenset(index for place in self.places for index in (place.index, place.minus) if index)

    def __str__(self) -> str:
        places, before = [*map(str, self.places)], ""
        for convolution in reversed(self.sums):
            (size,) = convolution.coefficients.axes
            place = places[convolution.axis]
            j = convolution.index
            before += f"sum({j} in {size}, {convolution.coefficients.name}[{j}-{place}]*"
            places[convolution.axis] = j
        entry = f"{self.array.name}[{', '.join(places)}]" if places else self.array.name
        return before + entry + ")" * len(self.sums)


def periods_of(loops: Iterable[Loop], sizes: Mapping[str, int]) -> dict[str, int]:
    """Return the period of each index of a periodic loop."""
    return {loop.index: loop.end.at(sizes) for loop in loops if loop.periodic}


def elements(loops: Sequence[Loop], sizes: Mapping[str, int]) -> Iterator[dict[str, int]]:
    """Yield the values of the indices of loops, the last one running fastest."""
    if not loops:
        yield {}
        return
    last = loops[-1]
    for outer in elements(loops[:-1], sizes):
        first = outer[last.behind] + 1 if last.behind else last.first.at(sizes)
        for k in range(first, last.end.at(sizes)):
            yield {**outer, last.index: k}


def couples_elements(array: Array, reads: Iterable[Access], coefficients: Iterable[Access]) -> bool:
    """Return whether a term couples elements of an array: at offsets, by rows of a table, or by a matrix c[i, j]."""
    coefficients = [*coefficients]
    return any(
        all(_are_coupled(a, b, coefficients) for a, b in zip(first.places, other.places, strict=True))
        and any(a != b and a.index for a, b in zip(first.places, other.places, strict=True))
        for first, other in combinations([read for read in reads if read.array == array], 2)
    )


def _are_coupled(a: Place, b: Place, coefficients: Iterable[Access]) -> bool:
    if a.index == b.index:
        return not (a.minus or b.minus)
    return any({a.index, b.index} <= coefficient.indices for coefficient in coefficients)


@dataclass(frozen=True, slots=True)
class ArrayMap:
    """Momentum map of a translation of an array component (all components if ``None``) or of a rotation of two.

    Attributes:
        array: name of the coordinate array.
        component, other: indices on its last axis.
        phase: phase rotation of positions into momenta; the conserved quantity is sum (q^2 + p^2)/2, the norm of a
            field.
    """

    array: str
    component: int | None
    other: int | None = None
    phase: bool = False

    @property
    def name(self) -> str:
        """Descriptive name."""
        if self.phase:
            return f"norm of {self.array}"
        if self.component is None:
            return f"momentum of {self.array}"
        if self.other is None:
            return f"momentum of {self.array}[.., {self.component}]"
        return f"angular momentum of {self.array}[.., {self.component}], {self.array}[.., {self.other}]"
