"""Checks of numbers that users pass to steppers; each raises :class:`StateError` with the name and the value."""

from __future__ import annotations

import math

import numpy as np

from scvi_codegen.errors import StateError

__all__ = ["checked_count", "checked_number", "checked_step"]


def checked_number(value: float, name: str) -> float:
    """A finite float."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise StateError(f"{name} must be a real number, not {value!r}") from error
    if not math.isfinite(number):
        raise StateError(f"{name} is {number}")
    return number


def checked_step(h: float) -> float:
    """A finite step other than 0."""
    number = checked_number(h, "the step h")
    if number == 0.0:
        raise StateError("the step h is 0")
    return number


def checked_count(value: int, name: str, *, least: int) -> int:
    """An integer of at least ``least``."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise StateError(f"{name} must be a whole number, not {value!r}")
    if value < least:
        raise StateError(f"{name} must be at least {least}, not {value}")
    return int(value)
