"""Steps that choose their own length as C: the ladder's tables before ``support/control.h``."""

from __future__ import annotations

from collections.abc import Iterator

from scvi_codegen.ir.control import Control
from scvi_codegen.ir.sweeps import LaneTable
from scvi_codegen.rendering.layout import table
from scvi_codegen.rendering.printer import print_number

__all__ = ["ladder_tables"]


def ladder_tables(control: Control, lanes: int) -> Iterator[str]:
    """From what is kept of former steps to the next: of the last one, and of each of the last two."""
    changes = len(control.alone)
    yield table(f"static const lanes LADDER_ALONE[{changes}][{lanes}]", [_columns(each) for each in control.alone])
    for name, lines in (("LAST", control.last), ("BEFORE", control.before)):
        rows = [[f"{{{', '.join(_columns(each))}}}" for each in line] for line in lines]
        yield table(f"static const lanes LADDER_{name}[{changes}][{changes}][{lanes}]", rows)


def _columns(rows: LaneTable) -> list[str]:
    """Vectors, of which column j is what point j gives to all."""
    return [f"{{{', '.join(map(print_number, column))}}}" for column in zip(*rows, strict=True)]
