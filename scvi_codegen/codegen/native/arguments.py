"""Checks of numbers that users pass to steppers; each raises :class:`StateError` with the name and the value."""

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.capacity import room_for_states
from scvi_codegen.common.errors import StateError

LONGEST_SHOWN = 60
FEW_NUMBERS = 2**24
"""Numbers that fit into the memory of any machine."""
BINARY64 = np.dtype(np.float64)
REAL_KINDS = "iufO"
"""Accepted kinds of numbers: not complex ones, whose imaginary part would be lost, dates, text or truth values."""


def real_array(value: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return a contiguous copy in binary64 of real numbers, possibly not finite; StateError for others and masks."""
    if type(value) is float or (type(value) is np.ndarray and value.dtype is BINARY64):  # the usual values
        return np.array(value, order="C")
    for word in ("unit", "units"):  # of astropy, of pint; not the label of a row or a column
        unit = getattr(value, word) if hasattr(type(value), word) else None
        if unit is not None and str(unit) not in ("", "dimensionless"):
            raise StateError(f"{name} has the unit {unit}: give plain numbers in the units of the parameters")
    try:
        converted = np.asanyarray(value)
        rows = value if isinstance(value, list | tuple) else ()
        if "numpy.ma" in sys.modules and (np.ma.is_masked(converted) or any(map(np.ma.is_masked, rows))):
            raise StateError(f"{name} has masked entries: fill or remove them")
        if converted.dtype.kind == "O" and any(entry is None for entry in converted.flat):
            raise StateError(f"{name} must be real numbers, not None")
        if converted.dtype.kind not in REAL_KINDS and converted.size:
            raise StateError(f"{name} must be real numbers, not {_shown(value, converted.dtype)}")
        return np.array(converted, dtype=np.float64, order="C", subok=False)
    except (TypeError, ValueError, OverflowError) as error:
        if isinstance(error, StateError):
            raise
        raise StateError(f"{name} must be real numbers, not {_shown(value)}: {error}") from error


def _shown(value: Any, kind: np.dtype[Any] | None = None) -> str:
    """Return a value, or its beginning, with the kind of its entries; for text with advice."""
    shown_value = repr(value)
    shown_value = shown_value if len(shown_value) <= LONGEST_SHOWN else f"{shown_value[:LONGEST_SHOWN]} .."
    if kind is None:
        return shown_value
    if kind.kind not in "US":
        return f"{kind.name}: {shown_value}"
    return f"text: {shown_value}, {_advice_for_text(np.asarray(value).ravel().tolist())}"


def _advice_for_text(entries: list[Any]) -> str:
    """Return the advice to remove the quotes of numbers, to read a file, or to give values."""
    try:
        for entry in entries:
            float(entry)
    except ValueError:
        if len(entries) == 1 and Path(str(entries[0])).suffix:
            return f"read the file first, as by numpy.loadtxt({entries[0]!r}, delimiter=',', skiprows=1)"
        return "give numbers"
    return "write it without quotes"


def empty_array(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return memory for states; raise StateError if there is not enough."""
    try:
        if (numbers := math.prod(shape)) > FEW_NUMBERS and 8 * numbers > room_for_states():
            raise MemoryError
        return np.empty(shape)
    except (MemoryError, ValueError) as error:
        raise StateError(f"{shape[0]} states do not fit into the memory: store fewer of them (save_every)") from error


def checked_number(value: Any, name: str) -> float:
    """Return a finite float."""
    array = real_array(value, name) if type(value) is not float else None
    if array is not None and array.shape != ():
        raise StateError(f"{name} must be a real number, not {value!r}")
    number = value if array is None else float(array)
    if not math.isfinite(number):
        raise StateError(f"{name} is {number}: it must be finite")
    return float(number)
