"""Which sums over indices couple places of lattices at constant distances, and how far."""

from __future__ import annotations

from collections.abc import Iterable

from scvi_codegen.indices import Access, Array
from scvi_codegen.ir.indexed import LoopedKernel

__all__ = ["reach_of"]


def reach_of(arrays: Iterable[Array], families: Iterable[LoopedKernel]) -> int:
    """How far on an axis forces depend on other places.

    Args:
        arrays: of coordinates: lattices are those whose first axes are named sizes, and whose last whole numbers.
        families: of forces, with the coordinates that each depends on.

    Returns:
        0 where no place depends on another, where an array is no lattice, or where a family couples places by a table
        or all pairs.
    """
    if not all(is_lattice(array) for array in arrays):
        return 0
    pairs = [
        (target, slot)
        for looped in families
        if looped.loops
        for target in looped.targets
        for slot in looped.slots
        if target != slot
    ]
    if not all(_same_loops(*pair) for pair in pairs):
        return 0
    if not any(_distance(*pair) for pair in pairs if pair[0].array == pair[1].array):
        return 0
    return max(_distance(*pair) for pair in pairs)


def is_lattice(array: Array) -> bool:
    """Whether it has named axes, all before those of whole numbers."""
    named = [bool(axis.name) for axis in array.axes]
    return named[0] and named == sorted(named, reverse=True)


def _same_loops(one: Access, other: Access) -> bool:
    """Whether two entries move together on every axis that both have."""
    pairs = list(zip(one.places, other.places, strict=False))
    return not any(a.table or b.table or a.index != b.index for a, b in pairs)


def _distance(one: Access, other: Access) -> int:
    pairs = zip(one.places, other.places, strict=False)
    return max((abs(a.base.number - b.base.number) for a, b in pairs if a.index), default=0)
