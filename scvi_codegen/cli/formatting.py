"""Formatting of numbers, durations and tables for people."""

from __future__ import annotations

import math
from collections.abc import Sequence


def counted(count: int, what: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def duration(seconds: float) -> str:
    """Return a duration with a suitable unit."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= scale:
            return f"{seconds / scale:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"


def in_known_digits(x: float, error: float) -> str:
    """Return a number rounded to the digits that an error leaves right; 17 digits if the error is 0 or not finite."""
    if error == 0.0 or not math.isfinite(error):
        return f"{x: .17g}"
    decimals = math.floor(-math.log10(2.0 * error))
    digits = math.floor(math.log10(abs(x))) + 1 + decimals if x else 0
    return f"{x: .{min(digits, 17)}g}" if digits > 0 else f"{x: .1g} within {error:.1g}"


def table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows as lines with aligned columns."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
