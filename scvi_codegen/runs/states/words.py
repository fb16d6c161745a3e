"""Arrays of states: entries by name, and double-double numbers as arrays of high words that carry the low words.

Numbers go in as floats, text (``"0.1"`` is one tenth), fractions, mpmath numbers or ``numpy.longdouble``. In C a vector
is its high words, followed by its low words.
"""

import math
from collections.abc import Hashable, Iterable, KeysView, Mapping, Sequence
from fractions import Fraction
from numbers import Rational
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import StateError
from scvi_codegen.common.validation import ExactNumber

Array = NDArray[np.float64]
Shapes = Sequence[tuple[str, tuple[int, ...]]]
Key = TypeVar("Key", bound=Hashable)
DIGITS, SHOWN_DIGITS = 40, 32
"""Digits of mpmath numbers, more than two words have; of numbers in reports."""


class NamedState(np.ndarray[Any, Any]):
    """Numbers (.., m) of states with arrays of coordinates, also by name: ``q["u"]`` has the shape (.., *shape of u).

    Slices of states have names as well; results of arithmetic are ordinary arrays.
    """

    shapes: Shapes | None = None

    def __array_finalize__(self, other: Any) -> None:
        self.shapes = getattr(other, "shapes", None)

    def __array_wrap__(self, array: Any, context: Any = None, return_scalar: bool = False) -> Any:
        plain = np.asarray(array)
        return plain if plain.ndim else plain[()]

    def __getitem__(self, key: Any) -> Any:
        if not isinstance(key, str):
            return super().__getitem__(key)
        arrays = by_name(np.asarray(self), self.shapes or ())
        if key not in arrays:
            raise KeyError(f"there is no array '{key}' among {', '.join(arrays) or 'no names'}")
        return arrays[key]

    def keys(self) -> KeysView[str]:
        """Return the names of the arrays."""
        return dict(self.shapes or ()).keys()

    def values(self) -> list[Array]:
        """Return the arrays in order."""
        return list(by_name(unnamed(self), self.shapes or ()).values())

    def items(self) -> list[tuple[str, Array]]:
        """Return the names and the arrays in order."""
        return list(by_name(unnamed(self), self.shapes or ()).items())

    def __reduce__(self) -> tuple[Any, ...]:
        return named, (np.asarray(self), self.shapes)


def named(values: Array, shapes: Shapes | None) -> Array:
    """Return states that have the arrays of these names and shapes; shares memory."""
    state = values if isinstance(values, NamedState) else values.view(NamedState)  # or with low words
    state.shapes = shapes
    return state


def by_name(values: Array, shapes: Iterable[tuple[Key, tuple[int, ...]]]) -> dict[Key, Array]:
    """Return (.., m) numbers as arrays of these names and shapes; shares memory."""
    arrays, first = {}, 0
    for name, shape in shapes:
        end = first + math.prod(shape)
        arrays[name], first = values[..., first:end].reshape((*values.shape[:-1], *shape)), end
    return arrays


class Word(np.float64):
    """High word of a double-double number; ``low`` is the low word. Differences are computed with both."""

    low: float = 0.0

    def mp(self) -> Any:
        """Return the number as an mpmath number of 40 digits."""
        return as_mpmath(self)

    def __sub__(self, other: Any) -> Any:
        return NotImplemented if isinstance(other, np.ndarray) else float(self) - other + (self.low - low_words(other))

    def __reduce__(self) -> tuple[Any, ...]:
        return word, (float(self), self.low)


def word(high: float, low: float) -> Word:
    """Return a double-double number."""
    result = Word(high)
    result.low = float(low)
    return result


def word_of(value: Fraction) -> Word:
    """Return the double-double number nearest to a fraction."""
    high = float(value)
    return word(high, float(value - Fraction(high)))


class Words(NamedState):
    """High words of double-double numbers; ``low`` has the low words.

    Entries (``Word``), rows, slices, copies and concatenations keep both words, and differences are computed with both;
    other arithmetic uses the high words alone and returns ordinary arrays.
    """

    _low: Array | None = None

    def __array_finalize__(self, other: Any) -> None:
        super().__array_finalize__(other)
        self._low = None

    @property
    def low(self) -> Array:
        """Low words, of the same shape."""
        if self._low is None:
            self._low = np.zeros(self.shape)
        return self._low

    def mp(self) -> Any:
        """Return the numbers as mpmath numbers of 40 digits in an object array."""
        return as_mpmath(self)

    def __getitem__(self, key: Any) -> Any:
        high, low = super().__getitem__(key), NamedState.__getitem__(_named_as(self.low, self), key)
        return with_low(high, low) if isinstance(high, np.ndarray) else word(high, low)

    def __setitem__(self, key: Any, value: Any) -> None:
        low = self.low
        super().__setitem__(key, np.asarray(value))
        low[key] = low_words(value)

    def __sub__(self, other: Any) -> Any:
        return (np.asarray(self) - np.asarray(other)) + (self.low - low_words(other))

    def __array_function__(self, function: Any, types: Any, arguments: Any, keywords: Any) -> Any:
        result = super().__array_function__(function, types, arguments, keywords)
        if function is np.concatenate:
            return with_low(
                np.asarray(result), np.concatenate([*map(low_words, arguments[0])], *arguments[1:], **keywords)
            )
        if function is np.broadcast_to:
            return with_low(result, np.broadcast_to(self.low, *arguments[1:], **keywords))
        return result

    def copy(self, order: Any = "C") -> Self:
        """Return a copy of both words."""
        result: Self = with_low(_named_as(np.array(self, order=order, subok=False), self), self.low.copy())
        return result

    def reshape(self, *shape: Any, **order: Any) -> Any:
        """Return the numbers in another shape."""
        return with_low(np.asarray(self).reshape(*shape, **order), self.low.reshape(*shape, **order))

    def __reduce__(self) -> tuple[Any, ...]:
        return with_low, (np.asarray(self), self.low, self.shapes)


def _named_as(array: Array, other: Any) -> NamedState:
    state = array.view(NamedState)
    state.shapes = other.shapes
    return state


def with_low(high: Any, low: Array, shapes: Any = None) -> Any:
    """Return high words with these low words, in the same memory."""
    result = high.view(Words)
    result.shapes = getattr(high, "shapes", None) if shapes is None else shapes
    result._low = np.asarray(low)
    return result


def unnamed(values: Any) -> Array:
    """Return numbers as an array without names, with both words if they have two; shares memory."""
    high: Array = np.asarray(values)
    return with_low(high, values.low) if isinstance(values, Words) else high


def scalar(value: Any) -> float:
    """Return an entry of an array as a number, with both words if it has two."""
    return value if isinstance(value, Word) else float(value)


def low_words(values: Any) -> Array:
    """Return the low words of numbers, 0 of doubles."""
    if isinstance(values, list | tuple):
        return np.array([*map(low_words, values)])
    return np.asarray(values.low) if isinstance(values, Words | Word) else np.zeros(np.shape(values))


def stacked(rows: Sequence[Any]) -> Array:
    """Return numbers or vectors as one array, with both words if they have two."""
    high: Array = np.array(rows)
    return with_low(high, low_words([*rows])) if isinstance(rows[0], Words | Word) else high


def from_block(block: Array) -> Words:
    """Return numbers (.., m) from (.., 2m) high words and low words, in the same memory."""
    m = block.shape[-1] // 2
    words: Words = with_low(block[..., :m], block[..., m:])
    return words


def block_of(values: Any) -> Array:
    """Return (.., 2m) high words and low words of (.., m) numbers; of doubles the array itself."""
    if not isinstance(values, Words):
        return np.asarray(values)
    return np.concatenate([np.asarray(values), values.low], axis=-1)


def check_keeps_words(words: int, path: Any) -> None:
    """Raise :class:`StateError` for a file, or another format, that has no low words."""
    if words > 1 and Path(path).suffix.lower() != ".npz":
        raise StateError(
            f"{path} would lose the low words of double-double arithmetic: save a file NAME.npz, or use mp"
        )


def as_mpmath(values: Any) -> Any:
    """Return numbers as mpmath numbers in an object array, or one number."""
    from mpmath import mp

    with mp.workdps(DIGITS), np.errstate(invalid="ignore"):  # NaN: states that were not reached
        return np.frompyfunc(lambda a, b: mp.mpf(float(a)) + mp.mpf(float(b)), 2, 1)(
            np.asarray(values, dtype=float), low_words(values)
        )


def fraction_of(value: Any) -> Fraction:
    """Return a number of one or two words exactly."""
    return value if isinstance(value, Fraction) else Fraction(float(value)) + Fraction(float(low_words(value)))


def as_text(values: Any) -> list[str]:
    """Return numbers as text of 32 digits."""
    from mpmath import mp

    with mp.workdps(DIGITS):
        return [mp.nstr(value, SHOWN_DIGITS) for value in as_mpmath(values)]


def two_words(value: Any, name: str) -> tuple[float, float]:
    """Return the nearest double to a number, and that to the rest; StateError for anything but a finite real number."""
    if type(value) is float and np.isfinite(value):
        return value, 0.0
    if isinstance(value, ExactNumber | Word) and np.isfinite(value):
        return float(value), value.low
    from mpmath import mp

    try:
        if isinstance(value, bool | np.bool_ | complex) or value is None:
            raise TypeError("not a real number")
        with mp.workdps(DIGITS + 20):
            if isinstance(value, np.ndarray) and value.ndim == 0:
                value = value[()]
            if hasattr(value, "evalf"):  # of SymPy
                value = value.evalf(DIGITS + 20)
            if isinstance(value, Rational):  # integers of NumPy, too
                exact: Any = mp.mpf(int(value.numerator)) / mp.mpf(int(value.denominator))
            else:
                exact = mp.mpf(value) if isinstance(value, str) else value
            high = float(exact)
            rest = exact - type(exact)(high) if np.isfinite(high) else 0.0  # exact for longdouble, 60 digits of mpf
            low = float(rest)
    except OverflowError:
        high = low = np.inf
    except (TypeError, ValueError, ZeroDivisionError) as error:
        raise StateError(f"{name} must be a real number, not {repr(value)[:60]}: {error}") from error
    if not (np.isfinite(high) and np.isfinite(low)):
        raise StateError(f"{name} is {value}: it must be finite")
    return high, low


def hashed(t: float) -> float | Fraction:
    """Return a time as a number whose hash depends on both words."""
    return fraction_of(t) if isinstance(t, Word) else t


def check_doubles(words: int, **times: Any) -> None:
    """Raise ``StateError`` if a time of a run of two words is not a double, which rounding would change."""
    for name, time in times.items():
        if words > 1 and type(time) is not float and time is not None:
            low = split(time, name)[1]
            if np.any(low):
                raise StateError(f"{name} must be doubles, such as 0.125 or float({name}): it has digits beyond those")


def split(values: Any, name: str) -> tuple[Any, Any]:
    """Return high and low words of numbers, also by name, or ``None``; StateError unless finite and real."""
    if isinstance(values, Mapping):
        parts = {key: split(value, f"{name}: '{key}'") for key, value in values.items()}
        return {key: part[0] for key, part in parts.items()}, {key: part[1] for key, part in parts.items()}
    if values is None or isinstance(values, Words):
        return (None, None) if values is None else (np.asarray(values), values.low)
    if isinstance(values, list | tuple) and any(isinstance(entry, Words) for entry in values):
        rows = [split(entry, f"{name}[{k}]") for k, entry in enumerate(values)]
        return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    array = np.asarray(values) if isinstance(values, np.ndarray) else np.array(values, dtype=object)
    if array.dtype == np.float64:
        return array, np.zeros(array.shape)
    words = [two_words(entry, f"{name}{list(k) if k else ''}") for k, entry in np.ndenumerate(array)]
    high, low = np.array(words, dtype=float).reshape(array.size, 2).T.reshape(2, *array.shape)
    return high, low


class TwoWords:
    """Mixin of trajectories and ensembles: low words, and quantities as mpmath numbers."""

    __slots__ = ()
    q: Array
    p: Array

    @property
    def q_low(self) -> Array:
        """Low words of the positions, of the shape of ``q``; 0 in double precision."""
        return low_words(self.q)

    @property
    def p_low(self) -> Array:
        """Low words of the momenta, of the shape of ``p``; 0 in double precision."""
        return low_words(self.p)

    def mp(self, name: str) -> Any:
        """Return a quantity as mpmath numbers of 40 digits in an object array of its shape.

        Args:
            name: ``"t"``, ``"q"``, ``"p"``, ``"parameters"``, ``"energy"``, ``"momentum_maps"``, or a coordinate.

        Raises:
            StateError: for an unknown name, or a quantity that is computed in one word of two: rotations, angular
                velocities and other coordinates than those of the states.
        """
        if name in ("energy", "momentum_maps"):
            return as_mpmath(getattr(self, name)())
        if name in ("t", "q", "p", "parameters"):
            return as_mpmath(getattr(self, name))
        values = self[name]  # type: ignore[index]
        if isinstance(self.q, Words) and not isinstance(values, Words):
            raise StateError(f"'{name}' has one word of double-double arithmetic: compute it from mp('q') and mp('p')")
        return as_mpmath(values)


SPLITTER = 2.0**27 + 1.0
"""Factor that splits a double into two halves of 26 bits (Dekker 1971)."""


def exact_product(x: Array, y: Array | float) -> tuple[Array, Array]:
    """Return x y without rounding error as a double-double number (Dekker's product)."""
    product = x * y
    x_high, y_high = SPLITTER * x - (SPLITTER * x - x), SPLITTER * y - (SPLITTER * y - y)
    x_low, y_low = x - x_high, y - y_high
    return product, ((x_high * y_high - product) + x_high * y_low + x_low * y_high) + x_low * y_low


def exact_sum(x: Array | float, y: Any) -> tuple[Any, Any]:
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
