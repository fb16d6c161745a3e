"""Vectorised evaluation of formulas by NumPy, node by node, without generated code."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sympy import Expr

from scvi_codegen.formulas.vocabulary import NAME_OF

__all__ = ["on_arrays"]


def on_arrays(formula: Expr, known: Mapping[Expr, Any]) -> Any:
    """Return the values of a formula, with the broadcast shape of the arrays in ``known``.

    Args:
        formula: of :mod:`scvi_codegen.formulas.grammar`.
        known: a number or an array for each symbol.

    >>> from scvi_codegen.formulas.grammar import parse_expression
    >>> from sympy import Symbol
    >>> x = Symbol("x", real=True)
    >>> on_arrays(parse_expression("x**2 + 1", {"x": x}), {x: np.arange(3.0)}).tolist()
    [1.0, 2.0, 5.0]
    """
    if formula in known:
        return known[formula]
    if not formula.args:
        return float(formula)
    operands = [on_arrays(part, known) for part in formula.args]
    if formula.is_Pow:
        return np.power(*(np.asarray(operand, dtype=float) for operand in operands))
    if formula.is_Add or formula.is_Mul:
        total = operands[0]
        for operand in operands[1:]:
            total = total + operand if formula.is_Add else total * operand
        return total
    name = NAME_OF[formula.func]
    return getattr(np, name.replace("a", "arc", 1) if name.startswith("a") else name)(*operands)
