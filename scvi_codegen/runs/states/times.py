"""Double-double times t + n h of runs; numbers of steps that make up a span."""

from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import exact_product, exact_sum

WHOLE = 1e-9
"""Fraction of a step that rounding may leave of a span."""
MOST_STEPS = 10**9
"""Largest number of steps accepted; more indicate a mistyped step size."""


def times_after(t: float | Array, h: float | Array, steps: ArrayLike) -> tuple[Array, Array]:
    """Return t + n h after n < 2^53 steps as double-double numbers, correctly rounded but for near ties."""
    mantissa, exponent = np.frexp(h)
    numbers = np.asarray(steps, dtype=np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        high, low = (np.ldexp(piece, exponent) for piece in exact_product(numbers, mantissa))
        total, cut = exact_sum(t, high)
        rest = cut + low
        time = total + rest
        return time, rest - (time - total)


def number_until(t: ArrayLike, ends: ArrayLike, forward: float) -> NDArray[np.intp]:
    """Return the number of times t, in the order of a run, up to each end; ``forward``: -1 of a run back in time."""
    return np.searchsorted(forward * np.asarray(t), forward * np.asarray(ends), side="right")


def steps_within(spans: ArrayLike, h: float) -> NDArray[np.intp]:
    """Return the number of equal steps not longer than |h| in each span > 0; raise ``StateError`` if too large."""
    with np.errstate(over="ignore"):
        counts = np.maximum(1.0, np.ceil(np.asarray(spans) / abs(h) - WHOLE))
    if not counts.sum() <= MOST_STEPS:
        raise StateError(f"h = {h:g} requires {counts.sum():.0e} steps: give a larger h")
    return counts.astype(np.intp)


def steps_to(t: float | Fraction, t_end: float, h: float, *, exactly: bool = False) -> int | None:
    """Return the number of steps h from t to t_end, ``None`` if the last is shorter; StateError for an impossible h.

    ``exactly``: without an allowance for the rounding of h.
    """
    span = (checked_number(t_end, "t_end") - checked_number(t, "t")) / checked_step(h)
    if span < 0.0:
        raise StateError(f"h = {h:g} has the wrong sign for a run from t = {t:g} to t_end = {t_end:g}: use h = {-h:g}")
    if not span <= MOST_STEPS:
        raise StateError(f"h = {h:g} requires {span:.0e} steps from t = {t:g} to t_end = {t_end:g}: give a larger h")
    count = round(span)
    if exactly:
        return count if Fraction(t) + count * Fraction(h) == Fraction(t_end) else None
    return count if abs(span - count) <= WHOLE else None
