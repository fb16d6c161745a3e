"""Sizes of arrays and loops in C, as numbers of the problem."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from scvi_codegen.indices import Array, Loop, Size
from scvi_codegen.ir.program import Program

__all__ = ["count_text", "product_text", "size_text", "sizes_text"]


def product_text(array: Array) -> str:
    """Return the number of entries of an array, in C."""
    return " * ".join(map(size_text, array.axes)) or "1"


def count_text(loops: Sequence[Loop]) -> str:
    """Return the number of elements of loops, in C."""
    behind = {loop.behind: loop for loop in loops if loop.behind}
    return " * ".join(_span_text(loop, loop.index in behind) for loop in loops if not loop.behind) or "1"


def _span_text(loop: Loop, paired: bool) -> str:
    size = f"({size_text(loop.end)} - {size_text(loop.first)})"
    return f"(({size_text(loop.end)}) * ({size_text(loop.end)} - 1) / 2)" if paired else size


def size_text(size: Size) -> str:
    """Return a size in C."""
    number = f"{size.number:+d}"
    return f"size_{size.name}{f' {number[0]} {number[1:]}' if size.number else ''}" if size.name else str(size.number)


def sizes_text(program: Program, text: str) -> Iterator[str]:
    """Yield declarations of the sizes that occur in a source."""
    for k, name in enumerate(program.layout.sizes):
        if re.search(rf"\bsize_{name}\b", text):
            yield f"const long long size_{name} = given->size[{k}];"
