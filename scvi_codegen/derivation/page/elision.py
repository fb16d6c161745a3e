"""Elision of long formulas and functions, which are replaced by their size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache

import sympy

from scvi_codegen.display.page.blocks import Code, Content, Formula, Paragraph

MOST_FORMULAS = 12
"""Largest number of equations of one kind that are shown."""
MOST_OPERATIONS = 400
"""Largest number of operations of an equation that is shown."""
MOST_TOGETHER = 600
"""Largest number of operations of all equations of one kind that are shown."""
MOST_LINES = 70
"""Largest number of lines of a C function that are shown."""


@lru_cache(maxsize=4096)
def operations(expression: sympy.Basic) -> int:
    """Return the number of operations as SymPy counts them: functions, powers, products, quotients and sums."""
    return int(sympy.count_ops(expression))


def formulas(all_formulas: Sequence[Formula], what: str, *, together: int = MOST_TOGETHER) -> Iterator[Content]:
    """Yield the first formulas, and the number of the others.

    Args:
        all_formulas: all of them.
        what: the word for one of them.
        together: operations of those shown.
    """
    shown, large, total = 0, [], 0
    for formula in all_formulas[:MOST_FORMULAS]:
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
    if shown < len(all_formulas):
        yield Paragraph(f"The first {shown} of {_counted(len(all_formulas), what)}.")


def lines(text: str) -> Code:
    """Return C source, truncated if it is long."""
    all_formulas = text.splitlines()
    if len(all_formulas) <= MOST_LINES:
        return Code(text)
    shown = "\n".join(all_formulas[:MOST_LINES])
    return Code(f"{shown}\n/* .. {len(all_formulas) - MOST_LINES} more lines */")


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' * (count != 1)}"
