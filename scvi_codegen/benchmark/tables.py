"""Results that are one plain table."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["ResultTable", "finite", "lines_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultTable:
    """Rows with named entries.

    Attributes:
        name: name of the section on the command line.
        title: one line that describes what is compared.
        columns: formats by name of entry, in order.
        rows: entries by name; one that is missing, None or NaN is shown as a dash.
        remarks: lines below the table.
    """

    name: str
    title: str
    columns: Mapping[str, str]
    rows: tuple[Mapping[str, Any], ...]
    remarks: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the table for the terminal."""
        header = [name.replace("_", " ") for name in self.columns]
        cells = [[_cell(row.get(name), form) for name, form in self.columns.items()] for row in self.rows]
        return "\n  ".join([f"{self.name}: {self.title}", *lines_of([header, *cells]), *self.remarks])

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> ResultTable:
        """Return the table that :meth:`data` describes."""
        return cls(**{**data, "rows": tuple(data["rows"]), "remarks": tuple(data["remarks"])})

    def data(self) -> dict[str, Any]:
        """Return the table as data for JSON."""
        rows = [finite(dict(row)) for row in self.rows]
        return {
            "name": self.name,
            "title": self.title,
            "columns": dict(self.columns),
            "rows": rows,
            "remarks": list(self.remarks),
        }


def lines_of(cells: list[list[str]]) -> list[str]:
    """Return cells as lines with aligned columns."""
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]


def finite(entries: dict[str, Any]) -> dict[str, Any]:
    """Return entries with numbers that are not finite replaced by None."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in entries.items()
    }


def _cell(value: Any, form: str) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "-"
    return format(value, form)
