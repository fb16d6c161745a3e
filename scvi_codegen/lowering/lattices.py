"""Lattices: array systems whose forces couple places at constant distances."""

from __future__ import annotations

from collections.abc import Iterable

from scvi_codegen.indices import Access, Array
from scvi_codegen.ir.kernel import LoopedKernel

__all__ = ["reach_of"]


def reach_of(arrays: Iterable[Array], term_groups: Iterable[LoopedKernel]) -> int:
    """Return the largest distance on an axis of places that forces couple.

    Args:
        arrays: of coordinates; in a lattice the first axes are named sizes, the last ones integers.
        term_groups: term groups of forces, with the coordinates that each depends on.

    Returns:
        0 if no places are coupled, if an array is no lattice, or if a term group couples places by a table or all
        pairs.
    """
    if not all(is_lattice(array) for array in arrays):
        return 0
    pairs = [
        (target, slot)
        for looped in term_groups
        if looped.loops
        for target in looped.writes
        for slot in looped.reads
        if target != slot
    ]
    if not all(_same_loops(*pair) for pair in pairs):
        return 0
    if not any(_distance(*pair) for pair in pairs if pair[0].array == pair[1].array):
        return 0
    return max(_distance(*pair) for pair in pairs)


def is_lattice(array: Array) -> bool:
    """Return whether an array has named axes, all before those of integer size."""
    named = [bool(axis.name) for axis in array.axes]
    return bool(named) and named[0] and named == sorted(named, reverse=True)


def _same_loops(one: Access, other: Access) -> bool:
    """Return whether two entries have the same index on every axis that both have."""
    pairs = list(zip(one.places, other.places, strict=False))
    return not any(a.table or b.table or a.index != b.index for a, b in pairs)


def _distance(one: Access, other: Access) -> int:
    pairs = zip(one.places, other.places, strict=False)
    return max((abs(a.base.number - b.base.number) for a, b in pairs if a.index), default=0)
