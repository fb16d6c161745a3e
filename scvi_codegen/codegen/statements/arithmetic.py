"""Arithmetic of statements in C: numbers of one or two words, the same for all SIMD lanes or one for each."""

from __future__ import annotations

from dataclasses import dataclass

PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2}
ATOM = 3
NAMES = {"+": "add", "-": "subtract", "*": "multiply", "/": "divide"}
"""Functions of two words, behind ``dd_`` or, of lanes, ``ddl_``."""


@dataclass(frozen=True, slots=True)
class Value:
    """A value in C.

    Attributes:
        text: its expression.
        words: 1, or 2 for double-double.
        uniform: whether it is one number for all lanes.
        precedence: of the last operation of the expression, by which operands are put in parentheses.
    """

    text: str
    words: int = 1
    uniform: bool = False
    precedence: int = ATOM

    @property
    def prefix(self) -> str:
        """Type of two words, and prefix of its functions."""
        return "dd" if self.uniform else "ddl"

    def operand(self, least: int) -> str:
        """Return the expression as an operand of an operation of a precedence."""
        return self.text if self.precedence >= least else f"({self.text})"

    def widened(self, uniform: bool) -> Value:
        """Return the value in two words, one number or one for each lane."""
        two = self if self.words == 2 else Value(f"{self.prefix}_word({self.text})", 2, self.uniform)
        return two if two.uniform == uniform else Value(f"ddl_of({two.text})", 2, False)


def combine(operator: str, left: Value, right: Value) -> Value:
    """Return the sum, difference, product or quotient of two values."""
    uniform = left.uniform and right.uniform
    if left.words == right.words == 1:
        precedence = PRECEDENCE[operator]
        text = f"{left.operand(precedence)} {operator} {right.operand(precedence + 1)}"
        return Value(text, 1, uniform, precedence)
    prefix = "dd" if uniform else "ddl"
    if operator == "*" and left.words != right.words:
        pair, number = (left, right) if left.words == 2 else (right, left)
        factor = f"lanes_of({number.text})" if number.uniform and not uniform else number.text
        return Value(f"{prefix}_scale({pair.widened(uniform).text}, {factor})", 2, uniform)
    operands = f"{left.widened(uniform).text}, {right.widened(uniform).text}"
    return Value(f"{prefix}_{NAMES[operator]}({operands})", 2, uniform)


def negated(value: Value) -> Value:
    """Return the negative of a value."""
    if value.words == 1:
        return Value(f"-{value.operand(ATOM)}", 1, value.uniform, PRECEDENCE["*"])
    return Value(f"{value.prefix}_negative({value.text})", 2, value.uniform)


def high_word(value: Value) -> Value:
    """Return the high word of a value."""
    return Value(f"({value.text}).high", 1, value.uniform) if value.words == 2 else value
