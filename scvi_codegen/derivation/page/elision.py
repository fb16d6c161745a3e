"""What is too long to be read is left out, and how much that is stands in its place."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import sympy

from scvi_codegen.display.page.blocks import Code, Content, Formula, Paragraph

__all__ = ["MOST_FORMULAS", "formulas", "lines", "operations"]

MOST_FORMULAS = 12
"""Equations of one kind that are written out."""
MOST_OPERATIONS = 400
"""Of an equation that is written out."""
MOST_TOGETHER = 600
"""Of equations of one kind that are written out."""
MOST_LINES = 70
"""Of a C function that are shown."""


@lru_cache(maxsize=4096)
def operations(expression: sympy.Basic) -> int:
    """As SymPy counts them: every function, power, product, quotient and sum of the formula as it stands."""
    return int(sympy.count_ops(expression))


def formulas(given: Sequence[Formula], what: str, *, together: int = MOST_TOGETHER) -> Iterator[Content]:
    """The first of them, and of the others how many they are.

    Args:
        given: all of them.
        what: the word for one of them.
        together: operations of those shown.
    """
    shown, large, total = 0, [], 0
    for formula in given[:MOST_FORMULAS]:
        size = operations(formula.right)
        total += min(size, MOST_OPERATIONS)
        if shown and total > together:
            break
        shown += 1
        if size <= MOST_OPERATIONS:
            yield formula
        else:
            large.append(size)
    if large:
        count = _counted(len(large), what)
        yield Paragraph(f"{count} of more than {MOST_OPERATIONS} operations left out, the longest of {max(large)}.")
    if shown < len(given):
        yield Paragraph(f"The first {shown} of {_counted(len(given), what)}.")


def lines(text: str) -> Code:
    """C text, its end left out where it is long."""
    given = text.splitlines()
    if len(given) <= MOST_LINES:
        return Code(text)
    kept = "\n".join(given[:MOST_LINES])
    return Code(f"{kept}\n/* .. {len(given) - MOST_LINES} more lines */")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
