"""Adaptive steps as C: the header with the predictor tables."""

from __future__ import annotations

from collections.abc import Iterator

from scvi_codegen.ir.control import Ladder
from scvi_codegen.ir.numbers import NumberTable
from scvi_codegen.rendering.layout import table
from scvi_codegen.rendering.printer import print_number

__all__ = ["ladder_text"]

HEAD = "/* Predictor tables from former steps to the next, by changes of the step-size level. Requires: points.h. */\n"


def ladder_text(ladder: Ladder) -> str:
    """Return the header."""
    return HEAD + "".join(f"{table}\n" for table in _tables(ladder))


def _tables(ladder: Ladder) -> Iterator[str]:
    """Yield the tables from stored values to predicted ones: of the last step, and of each of the last two."""
    changes, size = len(ladder.alone), "[POINTS * GROUPS]"
    yield table(f"static const lanes LADDER_ALONE[{changes}]{size}", [_columns(each) for each in ladder.alone])
    for name, lines in (("LAST", ladder.last), ("BEFORE", ladder.before)):
        rows = [[f"{{{', '.join(_columns(each))}}}" for each in line] for line in lines]
        yield table(f"static const lanes LADDER_{name}[{changes}][{changes}]{size}", rows)


def _columns(rows: NumberTable) -> list[str]:
    """Return the table by columns: the contributions of point j to all points."""
    return [print_number(number) for column in zip(*rows, strict=True) for number in column]
