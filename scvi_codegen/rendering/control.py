"""Adaptive steps as C: the header with the predictor tables."""

from __future__ import annotations

from collections.abc import Iterator

from scvi_codegen.ir.control import AdaptivePredictor
from scvi_codegen.ir.numbers import NumberTable
from scvi_codegen.rendering.layout import table
from scvi_codegen.rendering.printer import print_number

__all__ = ["predictor_text"]

HEAD = "/* Predictor tables from former steps to the next, by changes of the step-size level. Requires: points.h. */\n"


def predictor_text(predictor: AdaptivePredictor) -> str:
    """Return the header."""
    return HEAD + "".join(f"{table}\n" for table in _tables(predictor))


def _tables(predictor: AdaptivePredictor) -> Iterator[str]:
    """Yield the tables from stored values to predicted ones: of the last step, and of each of the last two."""
    changes, size = len(predictor.alone), "[POINTS * GROUPS]"
    yield table(f"static const lanes PREDICTOR_ALONE[{changes}]{size}", [_columns(each) for each in predictor.alone])
    for name, lines in (("LAST", predictor.last), ("BEFORE", predictor.before)):
        rows = [[f"{{{', '.join(_columns(each))}}}" for each in line] for line in lines]
        yield table(f"static const lanes PREDICTOR_{name}[{changes}][{changes}]{size}", rows)


def _columns(rows: NumberTable) -> list[str]:
    """Return the table by columns: the contributions of point j to all points."""
    return [print_number(number) for column in zip(*rows, strict=True) for number in column]
