"""Division of a term group among threads, in rounds of tasks that add to different elements.

Terms of a lattice add to neighbours of the outermost index: even blocks of it are done first, then odd ones. Pairs i <
j are done in tiles, a block of i by a block of j, in the rounds of a round-robin tournament. All other terms, such as
rows of tables, may add to any element: each thread evaluates all terms and adds to its own elements. The choice depends
on the indices alone, and the order of additions on sizes, never on the number of threads.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum, auto

from scvi_codegen.indices import Access
from scvi_codegen.ir.kernel import LoopedKernel
from scvi_codegen.rendering.sizes import count_text, size_text

__all__ = ["MOST_THREADS", "Sharing", "sharing_of", "sharing_text"]

MOST_THREADS = 64
"""Largest number of threads that share a step: the largest number of blocks of coordinates."""


class Sharing(Enum):
    """Kinds of tasks (``window`` of templates/support/arrays.h)."""

    ALONE = auto()
    IN_TURN = auto()
    IN_TILES = auto()
    BY_PLACES = auto()


def sharing_of(looped: LoopedKernel) -> Sharing:
    """Return the kind of tasks for a term group."""
    loops, targets = looped.loops, looped.writes
    if not loops:
        return Sharing.ALONE
    if _axes(targets, {loops[0].index}):
        return Sharing.IN_TURN
    if len(loops) > 1 and loops[1].behind == loops[0].index and loops[1].end == loops[0].end and loops[0].is_whole:
        pair = {loops[0].index, loops[1].index}
        if _axes(targets, pair) and _width(targets, pair) == 0:
            return Sharing.IN_TILES
    return Sharing.BY_PLACES


def sharing_text(looped: LoopedKernel) -> str:
    """Return the C expression of the rounds."""
    found, loops = sharing_of(looped), looped.loops
    if found is Sharing.IN_TURN:
        span = f"{size_text(loops[0].first)}, {size_text(loops[0].end)}"
        return f"alternating_blocks({span}, {_width(looped.writes, {loops[0].index})}, {count_text(loops[1:])})"
    if found is Sharing.IN_TILES:
        return f"pairs_of_blocks({size_text(loops[0].end)})"
    return "by_elements(run, n)" if found is Sharing.BY_PLACES else "alternating_blocks(0, 1, 0, 1)"


def _axes(targets: Sequence[Access], indices: Collection[str]) -> dict[str, int]:
    """Return the axis of each array on which all its targets depend on one of the indices; empty if one has none."""
    common: dict[str, set[int]] = {}
    for target in targets:
        moved = {k for k, place in enumerate(target.places) if place.index in indices and not place.table}
        common[target.array.name] = common.get(target.array.name, moved) & moved
    return {name: min(axes) for name, axes in common.items()} if all(common.values()) else {}


def _width(targets: Sequence[Access], indices: Collection[str]) -> int:
    """Return the largest distance, on these axes, of elements that one term adds to."""
    offsets: dict[str, list[int]] = {}
    for target in targets:
        place = target.places[_axes(targets, indices)[target.array.name]]
        offsets.setdefault(target.array.name, []).append(place.base.number)
    return max((max(each) - min(each) for each in offsets.values()), default=0)
