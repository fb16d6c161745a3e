"""Unrolling of the loops of a kernel: the same arithmetic in the same order, without loops."""

from __future__ import annotations

from dataclasses import replace

from scvi_codegen.ir.kernel import Expression, IndexedSum, Kernel, Load, Operation

__all__ = ["unrolled"]


def unrolled(kernel: Kernel) -> Kernel:
    """Return the kernel without loops; without contraction of operations by the compiler, both round alike."""
    temporaries, results = list(kernel.temporaries), list(kernel.results)
    for each in kernel.sums:
        for number, aims in enumerate(each.aims):
            terms = _placed(each, number, temporaries)
            for place, term in zip(aims, terms, strict=True):
                temporaries.append(Operation("+", (results[place], term)))
                results[place] = Load("w", len(temporaries) - 1)
    return replace(kernel, temporaries=tuple(temporaries), results=tuple(results), sums=())


def _placed(each: IndexedSum, number: int, temporaries: list[Expression]) -> list[Expression]:
    """Return the values of a row of the table; append the temporaries that they need."""
    first = len(temporaries)
    arguments = (*(Load("u", place) for place in each.table[number]), *(column[number] for column in each.given))

    def placed(expression: Expression) -> Expression:
        if isinstance(expression, Operation):
            return Operation(expression.operator, tuple(map(placed, expression.operands)))
        if isinstance(expression, Load) and expression.source == "u":
            return arguments[expression.index]
        if isinstance(expression, Load) and expression.source == "w":
            return Load("w", first + expression.index)
        return expression

    temporaries.extend(map(placed, each.term.temporaries))
    return [placed(result) for result in each.term.results]
