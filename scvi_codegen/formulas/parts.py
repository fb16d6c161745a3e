"""Expressions as what they share: each part once, where a walk through trees would meet it again and again."""

from __future__ import annotations

import sympy

__all__ = ["identity", "parts"]


def parts(*expressions: sympy.Basic) -> dict[sympy.Basic, None]:
    """All that occurs in expressions, themselves first."""
    found = dict.fromkeys(expressions)
    waiting = list(expressions)
    while waiting:
        new = [argument for argument in waiting.pop().args if argument not in found]
        found.update(dict.fromkeys(new))
        waiting += new
    return found


def identity(expression: sympy.Basic) -> str:
    """An expression as text that tells it from every other.

    A part stands behind its own parts, which it names by their lines. They stand as SymPy keeps them, the same in
    every process; ``sympy.srepr`` sorts them anew, which takes longer than to differentiate a sum of thousands.

    >>> from sympy.abc import x
    >>> print(identity((x + 1)**2))
    Integer(1)
    Symbol('x')
    Add(0, 1)
    Integer(2)
    Pow(2, 3)
    """
    places: dict[sympy.Basic, int] = {}
    lines: list[str] = []

    def place(part: sympy.Basic) -> int:
        if part not in places:
            inner = ", ".join([str(place(argument)) for argument in part.args])
            lines.append(f"{type(part).__name__}({inner})" if part.args else sympy.srepr(part))
            places[part] = len(lines) - 1
        return places[part]

    place(expression)
    return "\n".join(lines)
