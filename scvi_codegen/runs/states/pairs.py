"""Arithmetic of arrays of double-double numbers; of doubles it is ordinary arithmetic."""

import numpy as np

from scvi_codegen.runs.states.words import Array, Words, low_words, with_low

SPLITTER = 2.0**27 + 1.0
"""Factor that splits a double into two halves of 26 bits (Dekker 1971)."""


def exact_product(x: Array, y: Array | float) -> tuple[Array, Array]:
    """Return x y without rounding error as a double-double number (Dekker's product)."""
    product = x * y
    x_high, y_high = SPLITTER * x - (SPLITTER * x - x), SPLITTER * y - (SPLITTER * y - y)
    x_low, y_low = x - x_high, y - y_high
    return product, ((x_high * y_high - product) + x_high * y_low + x_low * y_high) + x_low * y_low


def exact_sum(x: Array | float, y: Array) -> tuple[Array, Array]:
    """Return x + y without rounding error as a double-double number (Knuth's sum)."""
    total = x + y
    part = total - x
    return total, (x - (total - part)) + (y - part)


def sum_of(x: Array, y: Array) -> Array:
    """Return x + y, in two words if one of them has two."""
    if not (isinstance(x, Words) or isinstance(y, Words)):
        return x + y
    high, rest = exact_sum(np.asarray(x), np.asarray(y))
    return _normalised(high, rest + (low_words(x) + low_words(y)))


def product_of(x: Array, y: Array) -> Array:
    """Return x y, in two words if one of them has two."""
    if not (isinstance(x, Words) or isinstance(y, Words)):
        return x * y
    first, second = np.asarray(x), np.asarray(y)
    high, rest = exact_product(first, second)
    return _normalised(high, rest + (first * low_words(y) + low_words(x) * second))


def quotient_of(x: Array, y: Array) -> Array:
    """Return x / y, in two words if one of them has two."""
    if not (isinstance(x, Words) or isinstance(y, Words)):
        return x / y
    first, second = np.asarray(x), np.asarray(y)
    high = first / second
    product, cut = exact_product(high, second)
    rest = ((first - product) - cut) + (low_words(x) - high * low_words(y))
    return _normalised(high, rest / second)


def _normalised(high: Array, rest: Array) -> Array:
    result: Array = with_low(*map(np.asarray, exact_sum(high, rest)))
    return result
