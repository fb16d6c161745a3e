"""Blocks of a page: prose, formulas, tables, fixed-width text, drawings, and blocks side by side.

Long formulas and functions are replaced by their size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

import sympy

Cell: TypeAlias = float | int | str | sympy.Basic | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TableBlock:
    """Table of numbers, written as CSV in full precision.

    Attributes:
        name: ``""`` for the main table of a result, else what is appended to the file's name.
        columns: headings.
        rows: as many cells as columns; ``None`` for a missing number.
        formats: format specification by column, for the report; default ``".3g"``.
        shown: whether the report prints it; long series of a curve are only drawn.
    """

    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    name: str = ""
    formats: Mapping[str, str] = field(default_factory=dict)
    shown: bool = True


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Prose."""

    text: str


@dataclass(frozen=True, slots=True)
class Formula:
    """A typeset equation, ``left = right``, or an expression alone.

    Attributes:
        right: SymPy; symbols called ``Q__2_x`` are set as Q with superscript 2 and subscript x.
        left: SymPy or ``None``.
        number: the paper's, or ``""``.
    """

    right: sympy.Basic
    left: sympy.Basic | None = None
    number: str = ""


@dataclass(frozen=True, slots=True)
class Listing:
    """Text in a fixed-width font: C, an outline, output."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """C source, with its comments in a lighter colour; long lines scroll."""

    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture.

    Attributes:
        svg: an ``<svg>`` element with colours of the page (``currentColor``, its variables).
        caption: description.
    """

    svg: str
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SideBySide:
    """Contents side by side on a wide screen, one above the other on a narrow one.

    Attributes:
        title: of both, in a fixed-width font.
        left, right: contents.
        folded: whether only the title is visible until the reader unfolds it.
    """

    title: str
    left: tuple[Content, ...]
    right: tuple[Content, ...]
    folded: bool = False


Block: TypeAlias = Paragraph | Formula | Listing
Content: TypeAlias = Block | TableBlock | Code | Drawing | SideBySide


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of a page.

    Attributes:
        name: anchor of links.
        title: its heading.
        contents: in order.
    """

    name: str
    title: str
    contents: tuple[Content, ...]


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
