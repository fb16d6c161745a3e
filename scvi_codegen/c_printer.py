"""IR expressions to C text. Prints what it is given: no rewriting, only names, literals and parentheses."""

from __future__ import annotations

from scvi_codegen.program import Constant, Expression, Load

__all__ = ["print_expression", "print_number"]

PRECEDENCE = {"+": 1, "-": 1, "*": 2, "/": 2, "neg": 3}


def print_number(value: float) -> str:
    """A C double literal that reads back as the same binary64 number."""
    return repr(float(value))


def print_expression(expression: Expression) -> str:
    """C text of an expression over ``u``, ``t``, ``parameters`` and temporaries ``w<k>``."""
    return _print(expression, 0)


def _print(expression: Expression, context: int) -> str:
    if isinstance(expression, Constant):
        text = print_number(expression.value)
        return f"({text})" if text.startswith("-") and context else text
    if isinstance(expression, Load):
        return _load(expression)
    operator, operands = expression.operator, expression.operands
    if operator not in PRECEDENCE:
        return f"{operator}({', '.join(_print(operand, 0) for operand in operands)})"
    level = PRECEDENCE[operator]
    if operator == "neg":
        text = f"-{_print(operands[0], level + 1)}"
    else:
        left, right = operands
        text = f"{_print(left, level)} {operator} {_print(right, level + 1)}"
        if level == 2:
            text = text.replace(f" {operator} ", operator) if _flat(left) and _flat(right) else text
    return f"({text})" if level < context else text


def _flat(expression: Expression) -> bool:
    return isinstance(expression, Constant | Load)


def _load(load: Load) -> str:
    if load.source == "t":
        return "t"
    return f"w{load.index}" if load.source == "w" else f"{load.source}[{load.index}]"
