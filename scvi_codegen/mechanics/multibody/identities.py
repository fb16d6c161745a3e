"""Probabilistic test of identities: expressions are evaluated at random points in 60 digits."""

from __future__ import annotations

import random
from collections.abc import Iterable

from sympy import Expr

from scvi_codegen.formulas.expressions import Tape, unsupported_part
from scvi_codegen.tables.precision import mp

NEGLIGIBLE = mp.mpf(10) ** -40
ATTEMPTS, POINTS = 24, 2
SEED = 20250101


def are_zero(expressions: Iterable[Expr]) -> bool:
    """Return whether all expressions are zero at two random points; false if fewer points of definition are found."""
    unlike = [expression for expression in expressions if expression != 0]
    if any(map(unsupported_part, unlike)):
        return False
    symbols = sorted(set().union(*(expression.free_symbols for expression in unlike)), key=str)
    tape, generator, tested = Tape(unlike, symbols), random.Random(SEED), 0
    for _ in range(ATTEMPTS):
        try:
            values = tape([mp.mpf(generator.uniform(0.1, 1.0)) for _ in symbols])
        except ArithmeticError:
            continue
        if any(abs(value) > NEGLIGIBLE for value in values):
            return False
        tested += 1
        if tested == POINTS:
            return True
    return not unlike
