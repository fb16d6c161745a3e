"""Lines C K^N through errors that decrease geometrically: fits, and distances from the lines of a legend."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Line: TypeAlias = tuple[float, float]
"""Constants (C, K)."""

WINDOW = 1e-13, 1e-1
"""Range of errors that count: smaller ones are round-off, larger ones are not resolved."""
LEAST = 3
"""Least number of errors for a fit."""
AGREEMENT_FACTOR = 30.0
"""Largest typical factor between errors and a line that counts as agreement."""
STRAIGHT = 0.9
"""Least squared correlation of N and the logarithms of errors that decrease geometrically."""


def within(errors: Array) -> NDArray[np.bool_]:
    """Return a mask of the errors inside :data:`WINDOW`."""
    return (errors > WINDOW[0]) & (errors < WINDOW[1])


def fitted_line(n: Array, errors: Array) -> Line | None:
    """Return the line through the errors inside the window; ``None`` with fewer than three of them."""
    used = within(errors)
    if np.count_nonzero(used) < LEAST:
        return None
    derivative, offset = np.polyfit(n[used], np.log(errors[used]), 1)
    return float(np.exp(offset)), float(np.exp(derivative))


def is_straight(n: Array, errors: Array) -> bool:
    """Return True if errors inside the window decrease, along a line."""
    used = within(errors)
    correlation = np.corrcoef(n[used], np.log(errors[used]))[0, 1]
    return bool(correlation < 0 and correlation**2 > STRAIGHT)


def factors(n: Array, errors: Array, line: Line) -> Array:
    """Return the factor, at least 1, between each error inside the window and a line."""
    used = within(errors)
    result: Array = np.exp(np.abs(np.log(errors[used]) - np.log(line[0]) - n[used] * np.log(line[1])))
    return result


def typical(all_factors: Iterable[Array]) -> float:
    """Return the median of :func:`factors` of several curves."""
    return float(np.median(np.concatenate([*all_factors])))
