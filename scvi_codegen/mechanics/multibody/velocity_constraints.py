"""Selection of velocity constraints that are independent of other linear equations between velocities."""

from __future__ import annotations

import random
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import Tape, jacobian, unsupported_part
from scvi_codegen.mechanics.derived_expressions import row_rank
from scvi_codegen.tables.precision import mp

ATTEMPTS = 24
SEED = 20250101


def independent_of(known: Sequence[Expr], asked: Sequence[Expr], rates: Sequence[Symbol]) -> tuple[int, ...]:
    """Return the indices of ``asked`` expressions that are independent of earlier ones, by ranks at a point.

    Args:
        known, asked: linear in the rates.
        rates: velocities and speeds.

    Raises:
        SystemDefinitionError: if they have no value at any of the sampled points.
    """
    rows = _values((*known, *asked), rates)
    basis, independent = rows[: len(known)], []
    for k, row in enumerate(rows[len(known) :]):
        more = np.vstack([basis, row])
        if row_rank(more) > row_rank(basis):
            independent.append(k)
            basis = more
    return tuple(independent)


def _values(expressions: Sequence[Expr], rates: Sequence[Symbol]) -> NDArray[np.float64]:
    """Return the coefficients of the rates and the remainder without rates, row by row, at a random point."""
    entries = dict(jacobian(expressions, rates))
    resting = dict.fromkeys(rates, 0)
    entries |= {(k, len(rates)): expression.xreplace(resting) for k, expression in enumerate(expressions)}
    if problem := next(filter(None, map(unsupported_part, entries.values())), None):
        raise SystemDefinitionError(f"in the constraints: {problem}")
    symbols = sorted(set().union(*(entry.free_symbols for entry in entries.values())), key=str)
    tape, generator = Tape(list(entries.values()), symbols), random.Random(SEED)
    for _ in range(ATTEMPTS):
        try:
            values = tape([mp.mpf(generator.uniform(0.1, 1.0)) for _ in symbols])
        except ArithmeticError:
            continue
        matrix = np.zeros((len(expressions), len(rates) + 1))
        for position, value in zip(entries, values, strict=True):
            matrix[position] = float(value)
        return matrix
    raise SystemDefinitionError(
        "the constraints have no finite value at any of the sampled points: check their domains"
    )
