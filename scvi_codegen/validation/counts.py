"""Validation of integers (degrees, points, steps, threads) and of the tolerance of adaptive steps."""

from __future__ import annotations

import operator
from typing import Any

from scvi_codegen.errors import ScviCodegenError, StateError

LARGEST_COUNT = 2**53 - 1
"""Largest integer below which binary64 represents every integer."""


def check_tolerance(value: float, error: type[ScviCodegenError] = StateError) -> None:
    """Raise an error unless the tolerance of adaptive steps is positive and below 1."""
    if not 0.0 < value < 1.0:
        raise error(
            "the tolerance must be positive and below 1 (relative error of each step), not "
            f"{value:g}: leave it out for errors at round-off level"
        )


def checked_count(
    value: Any, name: str, *, least: int, most: int = LARGEST_COUNT, error: type[ScviCodegenError] = StateError
) -> int:
    """Return the value as an int from ``least`` to ``most``, or raise an error that names it; booleans are rejected."""
    try:
        count = operator.index(value)
    except TypeError:
        count = None
    if count is None or isinstance(value, bool):
        raise error(f"{name} must be a whole number, not {value!r}")
    if count < least:
        raise error(f"{name} must be at least {least}, not {count}")
    if count > most:
        raise error(f"{name} must be at most {most}, not {count}")
    return count
