"""Division of large kernels into parts: compile times grow faster than the length of a function.

gcc 12 spends 6 of 10 seconds for five post-Newtonian bodies on register allocation in one kernel of 20,000 operations,
and four minutes on a force of 190 pairs. Divided, the time is linear. Values that later parts read are stored in an
array, ``kept``; the compiler would have spilled most of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from scvi_codegen.ir.kernel import Expression, Kernel, Load, Operation, loads, operations

__all__ = ["LARGEST_PART", "Part", "Statement", "is_divided", "kept_length", "parts"]

LARGEST_PART = 1000
"""Largest number of operations of one C function."""

Statement: TypeAlias = tuple[str, int, Expression]
"""(kind, index, expression): ``w`` is a temporary of the part, ``kept``, ``value`` and ``derivative`` are arrays."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part:
    """Consecutive statements of a kernel; loads from ``kept`` are temporaries of earlier parts.

    Attributes:
        name: C identifier.
        statements: in order.
    """

    name: str
    statements: tuple[Statement, ...]

    def uses(self, array: str) -> bool:
        """Return whether it reads or writes ``u``, ``t``, ``parameters``, ``kept``, ``value`` or ``derivative``."""
        return any(
            kind == array or any(load.source == array for load in loads(expression))
            for kind, _, expression in self.statements
        )


def kept_length(cut: Sequence[Part]) -> int:
    """Return the length of ``kept``."""
    return 1 + max((index for part in cut for kind, index, _ in part.statements if kind == "kept"), default=-1)


@lru_cache(maxsize=32)
def parts(kernel: Kernel) -> tuple[Part, ...]:
    """Return the kernel in parts of about equal size; one, if it is short enough."""
    pieces = list(_parts_of_equal_size(tuple(kernel.statements())))
    if len(pieces) == 1:
        return (Part(name=kernel.name, statements=pieces[0]),)
    last_use = {load.index: n for n, piece in enumerate(pieces) for load in _temporaries(piece)}
    free: list[int] = []
    places: dict[int, int] = {}
    cut = []
    for n, piece in enumerate(pieces):
        arrived = dict(places)
        statements: list[Statement] = []
        for kind, index, expression in piece:
            statements.append((kind, index, _replaced(expression, arrived)))
            if kind == "w" and last_use.get(index, n) > n:
                places[index] = free.pop() if free else len(places)
                statements.append(("kept", places[index], Load("w", index)))
        done = [index for index in places if last_use[index] == n]
        free.extend(places[index] for index in done)
        cut.append(Part(name=f"{kernel.name}_{n + 1}", statements=tuple(statements)))
    return tuple(cut)


def is_divided(kernels: Iterable[Kernel]) -> bool:
    """Return whether one of the kernels, or a term of its loops, is divided into several functions."""
    return any(len(parts(each)) > 1 for kernel in kernels for each in kernel.functions)


def _parts_of_equal_size(statements: Sequence[Statement]) -> Iterator[tuple[Statement, ...]]:
    """Yield consecutive statements with about equal numbers of operations."""
    sizes = [operations(expression) for _, _, expression in statements]
    whole = sum(sizes)
    count = max(1, -(-whole // LARGEST_PART))
    n, total, begin = 1, 0, 0
    for end, size in enumerate(sizes, 1):
        total += size
        if n < count and total * count >= n * whole:
            yield tuple(statements[begin:end])
            n, begin = n + 1, end
    yield tuple(statements[begin:])


def _temporaries(piece: Sequence[Statement]) -> Iterator[Load]:
    """Return the loads of temporaries."""
    return (load for _, _, expression in piece for load in loads(expression) if load.source == "w")


def _replaced(expression: Expression, places: dict[int, int]) -> Expression:
    """Return the expression with temporaries of earlier parts loaded from ``kept``."""
    if isinstance(expression, Load):
        kept = expression.source == "w" and expression.index in places
        return Load("kept", places[expression.index]) if kept else expression
    if isinstance(expression, Operation):
        return Operation(expression.operator, tuple(_replaced(operand, places) for operand in expression.operands))
    return expression
