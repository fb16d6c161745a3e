"""Subexpressions, and cache keys that contain every field of a system's description."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import sympy


def parts(*expressions: sympy.Basic) -> dict[sympy.Basic, None]:
    """Return all distinct subexpressions, beginning with the expressions themselves."""
    result = dict.fromkeys(expressions)
    waiting = list(expressions)
    while waiting:
        new = [argument for argument in waiting.pop().args if argument not in result]
        result.update(dict.fromkeys(new))
        waiting += new
    return result


def identity(expression: sympy.Basic) -> str:
    """Return text that identifies an expression uniquely.

    Each line is a subexpression that refers to its arguments by line numbers. Arguments are in SymPy's order, the same
    in all processes; ``sympy.srepr`` sorts them again, which takes longer than to differentiate a sum of thousands.

    >>> from sympy.abc import x
    >>> print(identity((x + 1)**2))
    Integer(1)
    Symbol('x')
    Add(0, 1)
    Integer(2)
    Pow(2, 3)
    """
    from sympy import srepr

    numbers: dict[sympy.Basic, int] = {}
    lines: list[str] = []

    def number_of(part: sympy.Basic) -> int:
        if part not in numbers:
            inner = ", ".join([str(number_of(argument)) for argument in part.args])
            lines.append(f"{type(part).__name__}({inner})" if part.args else srepr(part))
            numbers[part] = len(lines) - 1
        return numbers[part]

    number_of(expression)
    return "\n".join(lines)


def key_of(value: Any) -> str:
    """Return text that differs for different values: a dataclass by its type and all of its fields.

    Cache keys are made from it, so that a new field cannot be forgotten. Fields excluded from comparisons are
    included.

    Raises:
        TypeError: for a value that is no dataclass, expression, number, text, ``None``, sequence or mapping.

    >>> key_of((1, 1.0, "1", None))
    "(1, 1.0, '1', None)"
    """
    if is_dataclass(value) and not isinstance(value, type):
        named = ", ".join(f"{field.name}={key_of(getattr(value, field.name))}" for field in fields(value))
        return f"{type(value).__module__}.{type(value).__qualname__}({named})"
    if "sympy" in sys.modules and isinstance(value, sys.modules["sympy"].Basic):
        return repr(identity(value))
    if hasattr(value, "_mpf_"):
        return f"mpf{value._mpf_}"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key_of(name)}: {key_of(each)}' for name, each in value.items())}}}"
    if isinstance(value, tuple | list):
        return f"({', '.join(map(key_of, value))})"
    if isinstance(value, float):
        return repr(float(value))
    if value is None or isinstance(value, bool | int | str):
        return repr(value)
    raise TypeError(f"a cache key cannot be made from a {type(value).__name__}: {value!r}")
