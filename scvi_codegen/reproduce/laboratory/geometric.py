"""Lines C K^N along errors that fall geometrically: those that fit, and how far errors are from those of a legend."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

__all__ = ["ALONG", "STRAIGHT", "WINDOW", "Line", "factors", "fitted_line", "is_straight", "typical", "within"]

Array = NDArray[np.float64]
Line: TypeAlias = tuple[float, float]
"""(C, K)."""

WINDOW = 1e-13, 1e-1
"""Errors that count: below is round-off, above the solution is not resolved."""
LEAST = 3
"""Errors that make a line."""
ALONG = 30.0
"""A line of a legend runs along errors that are typically off it by a smaller factor."""
STRAIGHT = 0.9
"""Least square of the correlation of N and the logarithms of errors that fall geometrically."""


def within(errors: Array) -> NDArray[np.bool_]:
    """Which errors are inside :data:`WINDOW`."""
    return (errors > WINDOW[0]) & (errors < WINDOW[1])


def fitted_line(n: Array, errors: Array) -> Line | None:
    """The line through the errors inside the window; ``None`` with fewer than three of them."""
    used = within(errors)
    if np.count_nonzero(used) < LEAST:
        return None
    slope, offset = np.polyfit(n[used], np.log(errors[used]), 1)
    return float(np.exp(offset)), float(np.exp(slope))


def is_straight(n: Array, errors: Array) -> bool:
    """Whether errors inside the window fall, and along a line."""
    used = within(errors)
    correlation = np.corrcoef(n[used], np.log(errors[used]))[0, 1]
    return bool(correlation < 0 and correlation**2 > STRAIGHT)


def factors(n: Array, errors: Array, line: Line) -> Array:
    """By how much each error inside the window is above or below a line, at least 1."""
    used = within(errors)
    found: Array = np.exp(np.abs(np.log(errors[used]) - np.log(line[0]) - n[used] * np.log(line[1])))
    return found


def typical(all_factors: Iterable[Array]) -> float:
    """The median of :func:`factors` of several curves."""
    return float(np.median(np.concatenate([*all_factors])))
