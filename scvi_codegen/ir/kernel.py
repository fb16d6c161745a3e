"""Kernels: straight-line arithmetic of arguments, time and parameters, and loops that add to their values.

``u[i]`` are its arguments, ``t`` the time and ``parameters[i]`` the parameters: temporaries, each used more than once,
then results. Operations are ``+ - * / neg sqrt``, ``inverse_root_k`` (x^(-k/2)) and calls of elementary functions on
numbers of the target's scalar type; there are no branches. Terms that differ only in the elements of ``u`` that they
read may be a loop over a table of indices (:class:`IndexedSum`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeAlias

from scvi_codegen.ir.numbers import Number

if TYPE_CHECKING:
    import sympy

__all__ = ["Constant", "Expression", "IndexedSum", "Kernel", "Load", "Operation", "loads", "operations"]


@dataclass(frozen=True, slots=True)
class Constant:
    """An exact number, or 60 digits of one."""

    value: Number


@dataclass(frozen=True, slots=True)
class Load:
    """``u[index]``, ``parameters[index]``, ``t`` (index -1) or temporary ``w[index]``, by ``source``."""

    source: str
    index: int


@dataclass(frozen=True, slots=True)
class Operation:
    """``operator`` applied to operands; anything but ``+ - * / neg`` is a call of that C function."""

    operator: str
    operands: tuple[Expression, ...]


Expression: TypeAlias = Constant | Load | Operation


@dataclass(frozen=True, slots=True, kw_only=True)
class Kernel:
    """Straight-line code: ``temporaries[k]`` defines ``w[k]``; ``results`` are stored as soon as they can be.

    Attributes:
        name: C identifier.
        arguments: length of ``u``.
        temporaries, results: expressions.
        values: number of results that are values; the rest are derivatives.
        symbols: of the elements of ``u``, as in the formulas.
        formulas: the results as expressions.
        purpose: one sentence on what it computes.
        sums: loops that add to the values once all results are stored, in order.
    """

    name: str
    arguments: int
    temporaries: tuple[Expression, ...]
    results: tuple[Expression, ...]
    values: int
    symbols: tuple[sympy.Symbol, ...] = field(default=(), repr=False, compare=False)
    formulas: tuple[sympy.Expr, ...] = field(default=(), repr=False, compare=False)
    purpose: str = field(default="", repr=False, compare=False)
    sums: tuple[IndexedSum, ...] = ()

    def __post_init__(self) -> None:
        for each in self.sums:
            each.check(self)

    def with_sums(self, sums: tuple[IndexedSum, ...]) -> Kernel:
        """Return the kernel with further loops, whose terms are called after it."""
        named = (replace(each, term=replace(each.term, name=f"{self.name}_{each.term.name}")) for each in sums)
        return replace(self, sums=(*self.sums, *named))

    @property
    def functions(self) -> tuple[Kernel, ...]:
        """The kernel and the terms of its loops."""
        return (self, *(each.term for each in self.sums))

    @property
    def uses_arguments(self) -> bool:
        """True if any ``u[i]`` occurs."""
        return self.uses("u")

    @property
    def uses_time(self) -> bool:
        """True if ``t`` occurs."""
        return self.uses("t")

    @property
    def uses_parameters(self) -> bool:
        """True if any ``parameters[i]`` occurs."""
        return self.uses("parameters")

    def uses(self, array: str) -> bool:
        """Return whether it reads or writes ``u``, ``t``, ``parameters``, ``value`` or ``derivative``."""
        if array == "value" or (self.sums and array == "u"):
            return True
        if array == "derivative":
            return len(self.results) > self.values
        if any(each.term.uses(array) for each in self.sums):
            return True
        return any(load.source == array for each in (*self.temporaries, *self.results) for load in loads(each))

    def operation_counts(self) -> dict[str, int]:
        """Return the number of operations by name, in alphabetical order."""
        counts: dict[str, int] = {}
        for expression in (*self.temporaries, *self.results):
            _count(expression, counts)
        for each in self.sums:
            added = {"+": each.term.values}
            for operator, count in (*each.term.operation_counts().items(), *added.items()):
                counts[operator] = counts.get(operator, 0) + count * len(each.table)
        return dict(sorted(counts.items()))

    def statements(self) -> Iterator[tuple[str, int, Expression]]:
        """Yield ("w", "value" or "derivative", index, expression): each result right after its last temporary."""
        due: list[list[int]] = [[] for _ in range(len(self.temporaries) + 1)]
        for k, expression in enumerate(self.results):
            due[1 + _last_temporary(expression)].append(k)
        for k, ready in enumerate(due):
            if k > 0:
                yield "w", k - 1, self.temporaries[k - 1]
            for number in ready:
                derivative = number >= self.values
                yield "derivative" if derivative else "value", number - derivative * self.values, self.results[number]

    def __str__(self) -> str:
        """Return the kernel as readable text, one assignment per line."""
        lines = [f"kernel {self.name}(u[{self.arguments}], t, parameters)"]
        for kind, k, expression in self.statements():
            target = f"w{k}" if kind == "w" else f"{kind}[{k}]"
            lines.append(f"  {target} = {_text(expression)}")
        lines += [f"  {each}" for each in self.sums]
        return "\n".join([*lines, *(str(each.term) for each in self.sums)])


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedSum:
    """A kernel in a loop over an index table: for every row e, value[targets[e][a]] += term_a(u[table[e][..]], ...).

    Rows and the targets a of a row are processed in order, so that a loop and its unrolled form
    (:func:`scvi_codegen.ir.unrolled.unrolled`) round alike. An index may occur in a row twice. The length of the code
    depends on the term, not on the number of rows; time and parameters are those of the kernel.

    Attributes:
        term: a kernel with as many arguments as slots and constants, as many values as targets, no derivatives and no
            loops.
        table: (rows, slots) indices of ``u``.
        given: (constants, rows) values of the arguments after the slots: numbers, or parameters.
        targets: (rows, values) indices of the values; by default those of ``u``.
    """

    term: Kernel
    table: tuple[tuple[int, ...], ...]
    given: tuple[tuple[Constant | Load, ...], ...] = ()
    targets: tuple[tuple[int, ...], ...] = ()

    @property
    def aims(self) -> tuple[tuple[int, ...], ...]:
        """The targets, also if they are those of the table."""
        return self.targets or self.table

    def check(self, kernel: Kernel) -> None:
        """Raise ``ValueError`` for a term or tables that do not fit a kernel."""
        term, slots = self.term, self.term.arguments - len(self.given)
        if term.sums or term.values != len(term.results) or not (self.targets or slots == term.values):
            raise ValueError(f"the term '{term.name}' must have one value per target, no derivatives and no loops")
        for rows, width, most in ((self.table, slots, kernel.arguments), (self.aims, term.values, kernel.values)):
            for row in rows:
                if len(row) != width or not all(0 <= place < most for place in row):
                    raise ValueError(
                        f"a row of '{term.name}' must have {width} indices from 0 to {most - 1}; got {row}"
                    )
        if len({len(self.table), len(self.aims), *map(len, self.given)}) > 1:
            raise ValueError(f"the tables of '{term.name}' must have the same number of rows")

    def __str__(self) -> str:
        """Return the loop as one line."""
        given, aims = ", given[..][e]" * bool(self.given), "targets" if self.targets else "table"
        return f"value[{aims}[e][a]] += {self.term.name}(u[table[e]]{given})[a], e < {len(self.table)}"


def loads(expression: Expression) -> Iterator[Load]:
    """Yield the loads of an expression."""
    pending = [expression]
    while pending:
        each = pending.pop()
        if isinstance(each, Load):
            yield each
        elif isinstance(each, Operation):
            pending.extend(each.operands)


def operations(expression: Expression) -> int:
    """Return the number of operations of an expression."""
    return 1 + sum(map(operations, expression.operands)) if isinstance(expression, Operation) else 0


def _last_temporary(expression: Expression) -> int:
    """Return the largest index of a temporary in an expression, -1 if there is none."""
    return max((load.index for load in loads(expression) if load.source == "w"), default=-1)


def _count(expression: Expression, counts: dict[str, int]) -> None:
    if isinstance(expression, Operation):
        counts[expression.operator] = counts.get(expression.operator, 0) + 1
        for operand in expression.operands:
            _count(operand, counts)


def _text(expression: Expression) -> str:
    if isinstance(expression, Constant):
        return str(expression.value)
    if isinstance(expression, Load):
        return "t" if expression.source == "t" else f"{expression.source}{expression.index}"
    return f"({expression.operator} {' '.join(_text(operand) for operand in expression.operands)})"
