"""Functions and constants of the grammar by name, and quotation of subexpressions in messages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import sympy
from sympy import Expr, S

LARGEST = 1.7976931348623157e308
"""Largest finite C double."""

FUNCTIONS: Mapping[str, Callable[..., Expr]] = {
    function.__name__: function
    for function in (
        *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
        *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh),
        *(sympy.exp, sympy.log, sympy.sqrt),
    )
}
"""Functions of the grammar by name; all take one argument, ``atan2`` two."""

NAME_OF = {function: name for name, function in FUNCTIONS.items() if isinstance(function, type)}
CONSTANTS = {"pi": S.Pi}


def shortened(node: Any) -> str:
    """Return the text of an expression, cut to 60 characters."""
    text = str(node)
    return text if len(text) <= 60 else text[:57] + "..."
