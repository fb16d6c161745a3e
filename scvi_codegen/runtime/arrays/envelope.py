"""Order of coupled coordinates in which the factors of the linear part of a step have few entries.

The rows of the factors L D L^T of a matrix have entries from the first column in which the matrix has one (envelope:
A. Jennings, Comput. J. 9 (1966), 281). Coordinates of parallel arrays are interleaved; those that are coupled across a
periodic boundary are last.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.rendering.source import ArrayLayout
from scvi_codegen.runtime.arrays.interface import RunSizes

MOST_COUPLINGS, MOST_ENTRIES = 2**24, 2**24
"""Largest numbers of couplings, and of entries of the factors."""
MOST_PER_ROW, MOST_WITHOUT_TABLES = 400, 24
"""Largest number of entries per row on average; without tables there is the circulant preconditioner for others."""
FAR = 0.5
"""Fraction of all coordinates that a coupling across a periodic boundary spans."""


class Envelope(NamedTuple):
    """Pattern for templates/support/arrays/envelope.h, and the number of entries of the factors."""

    pattern: NDArray[np.int32]
    entries: int


def envelope_of(layout: ArrayLayout, arrays: RunSizes) -> Envelope | None:
    """Return the envelope of the coordinates of a run; ``None`` without couplings or with too many."""
    if not layout.couplings:
        return None
    pairs = _coupled_pairs(layout, arrays)
    if pairs is None:
        return None
    shapes = [array.shape(arrays.sizes) for array in layout.coordinates]
    order, apart = _order(shapes, pairs)
    n, position = len(order), np.empty(len(order), np.int64)
    position[order] = np.arange(n)
    ends = np.sort(position[pairs], axis=0)
    codes = np.unique(np.concatenate([ends[0] * n + ends[1], np.arange(n) * (n + 1)]))
    column, row = codes // n, codes % n
    first = np.arange(n)
    np.minimum.at(first, row, column)
    lengths = np.arange(n) - first + 1
    entries = int(lengths.sum())
    if entries > min(MOST_ENTRIES, (MOST_PER_ROW if layout.tables else MOST_WITHOUT_TABLES) * n):
        return None
    near = row < n - apart
    width = 2 * int((row - column)[near].max(initial=0)) + 1
    across = ~near & (column < n - apart)
    while len(np.unique(row[across] * n + column[across] % width)) < across.sum():
        width += 1  # columns of one colour have no row in common, not one of the last either
    parts = (
        *([min(width, max(1, n - apart)), apart], order, first, np.cumsum(lengths) - lengths),
        *(np.searchsorted(column, np.arange(n + 1)), row),
    )
    return Envelope(np.concatenate(parts).astype(np.int32), entries)


def _coupled_pairs(layout: ArrayLayout, arrays: RunSizes) -> NDArray[np.int64] | None:
    """Return the indices of pairs of coordinates that occur in the same element of a term, (2, n)."""
    from scvi_codegen.formulas.numpy_values import Elements  # here, because it imports SymPy

    shapes = {array.name: array.shape(arrays.sizes) for array in layout.coordinates}
    firsts = dict(zip(shapes, np.cumsum([0, *(int(np.prod(shape)) for shape in shapes.values())]), strict=False))
    found: list[NDArray[np.int64]] = []
    count = 0
    for term in layout.couplings:
        accesses = [access for _, access in term.slots if access.array.name in shapes]
        size = np.prod([float(loop.end.at(arrays.sizes) - loop.first.at(arrays.sizes)) for loop in term.loops])
        count += int(size) * len(accesses) ** 2
        if count > MOST_COUPLINGS:
            return None
        elements = Elements(term.loops, arrays.sizes, arrays.places)
        rows = next((len(index) for index in elements.index.values()), 1)
        places = [_flat(elements.of(access), shapes[access.array.name], rows) for access in accesses]
        indices = [place + firsts[access.array.name] for place, access in zip(places, accesses, strict=True)]
        found += [np.stack([a, b]) for k, a in enumerate(indices) for b in indices[k + 1 :]]
    return np.concatenate([np.zeros((2, 0), np.int64), *found], axis=1)


def _flat(index: tuple[Any, ...], shape: tuple[int, ...], count: int) -> NDArray[np.int64]:
    """Return positions in an array of elements, one for each element of the loops."""
    flat: Any = np.ravel_multi_index(index, shape) if shape else 0
    return np.array(np.broadcast_to(flat, (count,)), np.int64)


def _order(shapes: list[tuple[int, ...]], pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the order of all coordinates, and the number of the last ones that are coupled to all parts."""
    along = np.concatenate([(np.arange(max(1, int(np.prod(s)))) + 0.5) / max(1, int(np.prod(s))) for s in shapes])
    single = np.concatenate([np.full(max(1, int(np.prod(shape))), not shape) for shape in shapes])
    order = np.argsort(along + single, kind="stable")
    n, position = len(order), np.empty(len(order), np.int64)
    position[order] = np.arange(n)
    ends = np.sort(position[pairs], axis=0)
    last = single[order]
    last[ends[0][ends[1] - ends[0] > FAR * n]] = True
    return np.concatenate([order[~last], order[last]]), int(last.sum())
