"""Tables of numbers, of reports and of displays."""

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
