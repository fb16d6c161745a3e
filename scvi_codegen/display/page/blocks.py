"""Blocks of a page: prose, formulas, tables, fixed-width text, drawings, and blocks side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
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
