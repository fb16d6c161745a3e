"""Layout of the unknowns: one group of sites per coordinate, then one per component of other unknowns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from scvi_codegen.errors import MethodError
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["UnknownLayout", "layout_of"]


@dataclass(frozen=True, slots=True)
class UnknownLayout:
    """Groups of blocks of the same size, each at as many sites: first those with m components, at the coordinates.

    Attributes:
        first: the first site, by size.
        columns: the indices of the B blocks, by size.
        rows: the indices of the B rows, by size.
        count: number of sites.
    """

    first: dict[int, int]
    columns: dict[int, tuple[int, ...]]
    rows: dict[int, tuple[int, ...]]
    count: int


def layout_of(stages: StageSystem, dimension: int) -> UnknownLayout:
    """Return the sites of stage equations.

    Raises:
        MethodError: unless there are as many blocks as rows, and equally many, of every size.
    """
    blocks, rows = stages.block_sizes(dimension), stages.row_sizes(dimension)[:-1]
    sizes = [dimension, *sorted({*blocks, *rows} - {dimension})]
    columns, lines = ({size: _places(size, each) for size in sizes} for each in (blocks, rows))
    if len({len(places) for group in (columns, lines) for places in group.values()}) > 1:
        counts = ", ".join(f"{len(columns[size])} blocks and {len(lines[size])} rows of {size}" for size in sizes)
        raise MethodError(
            "stage equations must have as many blocks as rows of every size, and equally many of all "
            f"sizes; got {counts}"
        )
    first = {size: sum(sizes[:k]) for k, size in enumerate(sizes)}
    return UnknownLayout(first, columns, lines, sum(sizes))


def _places(size: int, sizes: Sequence[int]) -> tuple[int, ...]:
    return tuple(place for place, each in enumerate(sizes) if each == size)
