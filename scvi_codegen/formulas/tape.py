"""Evaluation of expressions in 60 digits by straight-line programs, each subexpression once."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sympy

from scvi_codegen.formulas.subexpressions import parts
from scvi_codegen.formulas.vocabulary import LARGEST, NAME_OF, shortened
from scvi_codegen.tables.precision import Number, mp

CONSTANTS = {sympy.S.Pi: mp.mpf(mp.pi), sympy.S.Exp1: mp.mpf(mp.e)}


class Tape:
    """Straight-line program of several expressions in the same symbols.

    Args:
        expressions: of the grammar of :mod:`~scvi_codegen.formulas.grammar`.
        symbols: all that occur in them.
    """

    def __init__(self, expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]) -> None:
        self.symbols = tuple(symbols)
        self._start: list[Number] = [mp.zero] * len(symbols)
        self._places: dict[sympy.Expr, int] = {symbol: register for register, symbol in enumerate(symbols)}
        self._steps: list[tuple[int, Callable[..., Number], tuple[int, ...]]] = []
        self._results = [self._place(expression) for expression in expressions]

    def __call__(self, numbers: Sequence[Number]) -> list[Number]:
        """Return the values at a point.

        Raises:
            ArithmeticError: if a value is not real or not within the range of a C double.
        """
        values = [*numbers, *self._start[len(numbers) :]]
        try:
            for register, operation, operands in self._steps:
                values[register] = operation(*[values[operand] for operand in operands])
        except (ValueError, TypeError, AttributeError) as error:
            raise ArithmeticError(f"no real value: {error}") from error
        results = [values[register] for register in self._results]
        if not all(isinstance(value, mp.mpf) and abs(value) <= LARGEST for value in results):
            raise ArithmeticError("a value is not a finite real number: the state is outside the domain of the formula")
        return results

    def _place(self, expression: sympy.Expr) -> int:
        """Return the index of an expression's value, appending the operations that compute it."""
        if expression in self._places:
            return self._places[expression]
        if expression.args:
            operands = tuple(self._place(argument) for argument in expression.args)
            operation, operands = _operation(expression, operands)
            self._steps.append((len(self._start), operation, operands))
            self._start.append(mp.zero)
        else:
            self._start.append(_constant(expression))
        self._places[expression] = len(self._start) - 1
        return self._places[expression]


def _operation(expression: sympy.Expr, operands: tuple[int, ...]) -> tuple[Callable[..., Number], tuple[int, ...]]:
    if expression.is_Add:
        return (operator.add if len(operands) == 2 else _sum), operands
    if expression.is_Mul:
        return (operator.mul if len(operands) == 2 else _product), operands
    if not expression.is_Pow:
        return getattr(mp, NAME_OF[expression.func]), operands
    exponent = expression.exp
    if exponent.is_Integer:
        power = int(exponent)
        return (lambda x: x**power), operands[:1]
    return mp.power, operands


def _sum(*terms: Number) -> Number:
    return mp.fsum(terms)


def _product(*factors: Number) -> Number:
    return mp.fprod(factors)


def _constant(expression: Any) -> Number:
    if expression.is_Rational:
        return mp.mpf(int(expression.p)) / int(expression.q)
    return CONSTANTS[expression]


def evaluate(expression: sympy.Expr, values: Mapping[sympy.Symbol, Number]) -> Number:
    """Return the value of an expression at one point, in 60 digits.

    Args:
        expression: of the grammar.
        values: a number for each of its symbols.

    Raises:
        ArithmeticError: if the value, or that of a subexpression, is not real or exceeds the range of a C double.
    """
    try:
        return Tape(list(parts(expression)), list(values))(list(map(mp.mpf, values.values())))[0]
    except ArithmeticError as error:
        raise ArithmeticError(f"'{shortened(expression)}' is not a finite real number") from error
