"""IR expressions to C text. Prints what it is given: no rewriting, only names, literals and parentheses."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from scvi_codegen.program import Constant, Expression, Kernel, Load, Operation, Sweep

__all__ = [
    "lane_functions",
    "print_expression",
    "print_lane_results",
    "print_lane_temporaries",
    "print_number",
    "scalar_functions",
]

Sources: TypeAlias = tuple[str, ...]
"""Loads that differ from lane to lane: ``("u", "t")`` where lanes are points, ``("u", "parameters")`` where they are
trajectories."""

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
        sign = f" {operator} " if level == 1 else operator
        text = f"{_print(left, level)}{sign}{_print(right, level + 1)}"
    return f"({text})" if level < context else text


def _load(load: Load) -> str:
    if load.source == "t":
        return "t"
    return f"w{load.index}" if load.source == "w" else f"{load.source}[{load.index}]"


def lane_functions(kernel: Kernel, sources: Sources) -> set[str]:
    """The functions a kernel applies to vectors; ``sources`` names the loads that are vectors."""
    vectors = _Vectors(kernel, sources)
    return _functions(kernel, vectors.has)


def scalar_functions(kernel: Kernel) -> set[str]:
    """All functions that occur in a kernel."""
    return _functions(kernel, lambda expression: True)


def _functions(kernel: Kernel, wanted: Callable[[Expression], bool]) -> set[str]:
    found: set[str] = set()
    pending: list[Expression] = [*kernel.temporaries, *kernel.results]
    while pending:
        expression = pending.pop()
        if isinstance(expression, Operation):
            pending.extend(expression.operands)
            if expression.operator not in PRECEDENCE and wanted(expression):
                found.add(expression.operator)
    return found


def print_lane_temporaries(kernel: Kernel, sources: Sources) -> list[tuple[str, str, str]]:
    """(type, name, text) of the temporaries as vectors; what is the same in every lane stays a number."""
    vectors = _Vectors(kernel, sources)
    return [
        ("lanes" if k in vectors.temporaries else "double", f"w{k}", _print_lanes(expression, vectors))
        for k, expression in enumerate(kernel.temporaries)
    ]


def print_lane_results(kernel: Kernel, sweep: Sweep, sources: Sources) -> list[str]:
    """Statements that store the results as vectors; slopes go to their places in the (lower) mass matrix."""
    vectors = _Vectors(kernel, sources)
    targets = [f"value[{k}]" for k in range(kernel.values)]
    targets += [f"slope[{i}]" if sweep.diagonal else f"slope[{i} * M + {j}]" for i, j in sweep.mass_entries]
    statements = []
    for target, expression in zip(targets, kernel.results, strict=False):
        text = _print_lanes(expression, vectors)
        statements.append(f"{target} = {text};" if vectors.has(expression) else f"{target} = lanes_of({text});")
    return statements


class _Vectors:
    """Which temporaries of a kernel differ from lane to lane."""

    def __init__(self, kernel: Kernel, sources: Sources) -> None:
        self.sources, self.temporaries = sources, set[int]()
        for k, expression in enumerate(kernel.temporaries):
            if self.has(expression):
                self.temporaries.add(k)

    def has(self, expression: Expression) -> bool:
        """Whether the expression is a vector."""
        if isinstance(expression, Load):
            return expression.source in self.sources or (
                expression.source == "w" and expression.index in self.temporaries
            )
        return isinstance(expression, Operation) and any(self.has(operand) for operand in expression.operands)


def _print_lanes(expression: Expression, vectors: _Vectors) -> str:
    return print_expression(_with_lane_calls(expression, vectors))


def _with_lane_calls(expression: Expression, vectors: _Vectors) -> Expression:
    """The same with ``f`` of a vector renamed ``lanes_f``, its plain arguments made vectors."""
    if not isinstance(expression, Operation):
        return expression
    operands = tuple(_with_lane_calls(operand, vectors) for operand in expression.operands)
    if expression.operator in PRECEDENCE or not vectors.has(expression):
        return Operation(expression.operator, operands)
    return Operation(
        f"lanes_{expression.operator}",
        tuple(
            new if vectors.has(old) else Operation("lanes_of", (new,))
            for old, new in zip(expression.operands, operands, strict=True)
        ),
    )
