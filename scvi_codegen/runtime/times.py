"""Times in two pieces, as runs carry them: t + n h, rounded, and what rounding cut off; steps that make up a span."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.runtime.inputs import Array

__all__ = ["WHOLE", "steps_to", "steps_within", "times_after"]

SPLITTER = 2.0**27 + 1.0
"""Times a number of 53 bits, it splits off the upper 26 (Dekker 1971)."""
WHOLE = 1e-9
"""Of a step: what rounding may leave of a span."""
MOST_STEPS = 10**9
"""More are a slip of the pen."""


def times_after(t: float, h: float, steps: ArrayLike) -> tuple[Array, Array]:
    """T + n h after each number n < 2^53 of steps: rounded correctly but for near ties, and the rest."""
    mantissa, exponent = math.frexp(h)
    numbers = np.asarray(steps, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        high, low = (np.ldexp(piece, exponent) for piece in _product(numbers, mantissa))
        total = t + high
        part = total - t
        rest = ((t - (total - part)) + (high - part)) + low
        time = total + rest
        return time, rest - (time - total)


def steps_within(spans: ArrayLike, h: float) -> NDArray[np.intp]:
    """How many equal steps, none longer than |h|, make up each span > 0; StateError where they are too many to take."""
    with np.errstate(over="ignore"):
        counts = np.maximum(1.0, np.ceil(np.asarray(spans) / abs(h) - WHOLE))
    if not counts.sum() <= MOST_STEPS:
        raise StateError(f"steps of h = {h:g} would be {counts.sum():.0e} of them: give a longer one")
    return counts.astype(np.intp)


def steps_to(t: float, t_end: float, h: float) -> int | None:
    """Return how many steps of h lead from t to t_end, or ``None`` if the last of them has to be shorter.

    Raises:
        StateError: where they lead away from t_end.
    """
    span = (checked_number(t_end, "t_end") - checked_number(t, "the time t")) / checked_step(h)
    if span < 0.0:
        raise StateError(f"steps of h = {h:g} do not lead from t = {t:g} to t_end = {t_end:g}: give h the other sign")
    if not span <= MOST_STEPS:
        raise StateError(f"steps of h = {h:g} from t = {t:g} to t_end = {t_end:g} are {span:.0e}: give a larger h")
    return round(span) if abs(span - round(span)) <= WHOLE else None


def _product(x: Array, y: float) -> tuple[Array, Array]:
    """X y in two pieces, without error (Dekker's product)."""
    product = x * y
    x_high, y_high = SPLITTER * x - (SPLITTER * x - x), SPLITTER * y - (SPLITTER * y - y)
    x_low, y_low = x - x_high, y - y_high
    return product, ((x_high * y_high - product) + x_high * y_low + x_low * y_high) + x_low * y_low
