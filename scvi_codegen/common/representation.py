"""Representations of objects for ``repr``: constructor-like or a summary, at most ``LONGEST`` characters."""

import math
import numbers
from collections.abc import Callable, Mapping
from decimal import ROUND_CEILING, Decimal
from typing import Any

LONGEST = 100
LONGEST_VALUE = 40


def summary(*names: str) -> Callable[[Any], str]:
    """Return a ``__repr__`` that shows these attributes as ``Name(a=1, b=<61 x 4>)``; what does not fit becomes "..".

    A value with the attribute ``name`` is shown by that.
    """

    def shown(self: Any) -> str:
        head, parts = f"{type(self).__name__}(", list[str]()
        for name in names:
            parts.append(f"{name}={_short(getattr(self, name))}")
            if len(head) + len(", ".join(parts)) > LONGEST - len(", ..)") * (name != names[-1]) - 1:
                parts[-1] = ".."
                break
        return f"{head}{', '.join(parts)})"

    return shown


def one_line(value: Any, title: str, facts: str) -> str:
    """Return ``<Run of TITLE; FACTS>``, the title shortened to fit."""
    head, tail = f"<{type(value).__name__} of ", f"; {facts}>"
    return f"{head}{clipped(title, LONGEST - len(head) - len(tail))}{tail}"


def clipped(text: str, length: int = LONGEST) -> str:
    """Return the text, or its beginning and "..", in at most ``length`` characters."""
    return text if len(text) <= length else f"{text[: max(length - 2, 0)]}.."


def with_uncertainty(value: float, error: float) -> str:
    """Return a value with the uncertain digits of its error in parentheses: ``0.512345(12)`` is 0.512345 +- 0.000012.

    The error has two digits, rounded up, also where it exceeds the value, as ``0.0(33)e+78``.
    """
    if not (math.isfinite(value) and math.isfinite(error)):
        return f"{value:.3g}(lost)"
    if error == 0.0:
        return repr(float(value))
    number, size = Decimal(float(value)), Decimal(max(float(error), math.ulp(value)))
    last = size.adjusted() - 1  # power of ten of the last digit
    digits = int((size.scaleb(-last) - Decimal("1e-9")).to_integral_value(ROUND_CEILING))
    if digits >= 100:
        digits, last = 10, last + 1
    exponent = max(size.adjusted(), number.adjusted() if value else last)
    if -5 < exponent < 16 and last <= 0:
        return f"{number:.{-last}f}({digits})"
    return f"{number.scaleb(-exponent):.{max(0, exponent - last)}f}({digits})e{exponent:+03d}"


def _short(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype") and value.shape:
        return f"[{', '.join(f'{x:.6g}' for x in value)}]" if value.shape in ((1,), (2,)) else _size(value.shape)
    if isinstance(value, numbers.Real) and not isinstance(value, numbers.Integral):
        return f"{float(value):.6g}"
    if isinstance(getattr(value, "name", None), str):
        return repr(value.name)
    text = str(value) if hasattr(value, "_mpf_") else repr(value)
    if len(text) > LONGEST_VALUE and isinstance(value, tuple | list | Mapping):
        return _size((len(value),))
    return clipped(text.replace("\n", " "), LONGEST_VALUE)


def _size(shape: tuple[int, ...]) -> str:
    return f"<{' x '.join(map(str, shape))}>"


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, in the plural unless the number is 1."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"
