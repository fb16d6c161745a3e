"""Order of coupled coordinates in which the factors of the linear part of a step have few entries.

The rows of L and the columns of U in the factors L D U of a matrix have entries from the first column in which the
matrix has one (envelope: A. Jennings, Comput. J. 9 (1966), 281). Coordinates of parallel arrays, and those of a
Hamiltonian with their momenta, are interleaved; those that are coupled across a periodic boundary are last.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.rendering.source import ArrayLayout
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.stepping.array_interface import RunSizes

MOST_COUPLINGS, MOST_ENTRIES = 2**24, 2**24
"""Largest numbers of couplings, and of entries of the factors."""
MOST_PER_ROW, MOST_WITHOUT_TABLES = 400, 24
"""Largest number of entries per row on average; without tables there is the circulant preconditioner for others."""
FAR = 0.5
"""Fraction of all coordinates that a coupling across a periodic boundary spans."""


class Envelope(NamedTuple):
    """Pattern for templates/support/arrays/envelope.h, and the number of complex vectors of the factors."""

    pattern: NDArray[np.int32]
    numbers: int


def envelope_of(layout: ArrayLayout, arrays: RunSizes) -> Envelope | None:
    """Return the envelope of the unknowns of a run, also of momenta of a Hamiltonian; ``None`` without couplings.

    StateError for a linear part that is not symmetric and too large, since there is no other preconditioner.
    """
    if not layout.couplings or (layout.momenta and _has_modes(layout)):
        return None
    envelope = _envelope(layout, arrays)
    if envelope is None and not layout.symmetric:
        raise StateError(
            "solver='newton' factorises the linear part of a Hamiltonian or with forces of velocities, with at most "
            f"{MOST_PER_ROW} entries per row and {MOST_ENTRIES} in all, which this system exceeds: use "
            "solver='fixed-point', finite differences or spectral elements, or fewer points across"
        )
    return envelope


def _has_modes(layout: ArrayLayout) -> bool:
    """Return whether circulant matrices couple no array of the state to another: the linear part has Fourier modes."""
    names, has_terms = {array.name for array in (*layout.coordinates, *layout.momenta)}, False
    for term in layout.couplings:
        if any(access.sums or any(place.minus for place in access.places) for _, access in term.slots):
            has_terms, moving = True, [(slot, x.array.name) for slot, x in term.slots if x.array.name in names]
            pairs = ((a, b) for a, array in moving for b, other in moving if array < other)
            if any(term.formula.diff(a, b) != 0 for a, b in pairs):
                return False
    return has_terms and not layout.tables


def _envelope(layout: ArrayLayout, arrays: RunSizes) -> Envelope | None:
    """Return the envelope; ``None`` with too many couplings."""
    shapes = [array.shape(arrays.sizes) for array in (*layout.coordinates, *layout.momenta)]
    per_row = MOST_PER_ROW if layout.tables or not layout.symmetric else MOST_WITHOUT_TABLES
    most = min(MOST_ENTRIES, per_row * sum(int(np.prod(shape)) for shape in shapes))
    pairs = _coupled_pairs(layout, arrays, most)
    if pairs is None:
        return None
    order, apart = _order(shapes, pairs)
    n, ends = len(order), _places(order, pairs)
    codes = np.unique(np.concatenate([ends[0] * n + ends[1], np.arange(n) * (n + 1)]))
    column, row = codes // n, codes % n
    first = np.arange(n)
    np.minimum.at(first, row, column)
    lengths = np.arange(n) - first + 1
    entries = int(lengths.sum())
    if entries > most:
        return None
    near = row < n - apart
    width = 2 * int((row - column)[near].max(initial=0)) + 1
    across = ~near & (column < n - apart)
    while len(np.unique(row[across] * n + column[across] % width)) < across.sum():
        width += 1  # columns of one colour have no row in common, not one of the last either
    if not layout.symmetric:
        both = np.unique(np.concatenate([codes, row * n + column]))
        column, row = both // n, both % n
    parts = (
        *([min(width, max(1, n - apart)), apart], order, first, np.cumsum(lengths) - lengths),
        *(np.searchsorted(column, np.arange(n + 1)), row),
    )
    return Envelope(np.concatenate(parts).astype(np.int32), n + (1 if layout.symmetric else 2) * entries)


def _coupled_pairs(layout: ArrayLayout, arrays: RunSizes, most: int) -> NDArray[np.int64] | None:
    """Return the indices of pairs of coordinates that occur in the same element of a term, (2, n).

    ``None`` if a term has too many, or if a sum over pairs or convolutions couple more than ``most``.
    """
    from scvi_codegen.systems.formulas.arrays import ArrayTerm  # here, because it imports SymPy
    from scvi_codegen.systems.formulas.numpy_values import Elements
    from scvi_codegen.systems.formulas.symbols import DOT

    shapes = {array.name: array.shape(arrays.sizes) for array in (*layout.coordinates, *layout.momenta)}
    starts = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes.values())])
    firsts = dict(zip(shapes, starts, strict=False))
    firsts |= {name + DOT: first for name, first in firsts.items()}
    shapes |= {name + DOT: shape for name, shape in shapes.items()}
    groups, count = list[NDArray[np.int64]](), 0
    for term in layout.couplings:
        targets = () if isinstance(term, ArrayTerm) else term.targets
        slots = [*(access for _, access in term.slots), *(access for access, _ in targets)]
        accesses = [access for access in slots if access.array.name in firsts]
        if any(access.sums for access in accesses):  # all entries of these arrays are taken as coupled
            names = sorted({access.array.name for access in accesses})
            entries = np.concatenate([firsts[name] + np.arange(int(np.prod(shapes[name]))) for name in names])
            count += len(entries) ** 2
            if count > MOST_COUPLINGS or len(entries) * (len(entries) - 1) > 2 * most:
                return None
            groups.append(entries[np.stack(np.triu_indices(len(entries), 1))])
            continue
        size = np.prod([float(loop.end.at(arrays.sizes) - loop.first.at(arrays.sizes)) for loop in term.loops])
        count += int(size) * len(accesses) ** 2
        all_pairs = any(loop.behind for loop in term.loops) and len(accesses) > 1
        if count > MOST_COUPLINGS or (all_pairs and size > 4 * most):
            return None
        groups += _pairs_in_loops(Elements(term.loops, arrays.sizes, arrays.places), accesses, firsts, shapes)
    pairs = np.concatenate([np.zeros((2, 0), np.int64), *groups], axis=1)
    return _with_conjugates(pairs, int(starts[-1]) // 2) if layout.momenta else pairs


def _pairs_in_loops(
    elements: Any, accesses: Sequence[Any], firsts: Mapping[str, int], shapes: Mapping[str, tuple[int, ...]]
) -> list[NDArray[np.int64]]:
    """Return the pairs of coordinates that occur in the same element of loops, (2, n) for each pair of accesses."""
    rows = next((len(index) for index in elements.index.values()), 1)
    names = [access.array.name for access in accesses]
    places = [_flat(elements.of(access), shapes[name], rows) for access, name in zip(accesses, names, strict=True)]
    indices = [place + firsts[name] for place, name in zip(places, names, strict=True)]
    return [np.stack([a, b]) for k, a in enumerate(indices) for b in indices[k + 1 :]]


def _with_conjugates(pairs: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Return pairs of positions and momenta: rates are derivatives by the conjugates, which are n places apart."""
    pairs = np.concatenate([pairs, [range(n), range(n, 2 * n)]], axis=1) % n
    return np.concatenate([pairs + np.array([[a], [b]]) for a in (0, n) for b in (0, n)], axis=1)


def _flat(index: tuple[Any, ...], shape: tuple[int, ...], count: int) -> NDArray[np.int64]:
    """Return positions in an array of elements, one for each element of the loops."""
    flat: Any = np.ravel_multi_index(index, shape) if shape else 0
    return np.array(np.broadcast_to(flat, (count,)), np.int64)


def _order(shapes: list[tuple[int, ...]], pairs: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Return the order of all coordinates, and the number of the last ones that are coupled to all parts."""
    along = np.concatenate([(np.arange(max(1, int(np.prod(s)))) + 0.5) / max(1, int(np.prod(s))) for s in shapes])
    single = np.concatenate([np.full(max(1, int(np.prod(shape))), not shape) for shape in shapes])
    order = np.argsort(along + single, kind="stable")
    ends, last = _places(order, pairs), single[order]
    last[ends[0][ends[1] - ends[0] > FAR * len(order)]] = True
    return np.concatenate([order[~last], order[last]]), int(last.sum())


def _places(order: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the positions of pairs of coordinates in an order, the smaller ones first."""
    return np.sort(np.argsort(order)[pairs], axis=0)
