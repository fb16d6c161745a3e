"""Regularity of Hessians: of the mass matrix d2L/dv2 of a Lagrangian, and of d2H/dp2 of a Hamiltonian."""

from __future__ import annotations

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import tee

import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Matrix, Symbol

from scvi_codegen.formulas.expressions import Tape, hessian
from scvi_codegen.tables.precision import Number, mp

Entries = Mapping[tuple[int, int], Expr]

NEGLIGIBLE = mp.mpf(10) ** -40
DEPENDENT = 1e-10
"""Rank tolerance, relative to the largest singular value of the normalised rows."""
LARGEST_NULL_SPACE = 8


def row_rank(matrix: NDArray[np.float64]) -> int:
    """Return the rank of a matrix of shape (n, m) after its rows are scaled to unit length."""
    if not matrix.size:
        return 0
    sizes = np.linalg.norm(matrix, axis=1, keepdims=True)
    return int(np.linalg.matrix_rank(matrix / np.where(sizes > 0.0, sizes, 1.0), tol=DEPENDENT))


def singular_part(
    scalar: Expr, variables: Sequence[Symbol], others: Sequence[Symbol], constants: Mapping[Symbol, float]
) -> tuple[tuple[Symbol, ...], Entries] | None:
    """Return coupled variables whose block of the Hessian is singular at every sampled point, and the block.

    Args:
        scalar: L or H.
        variables: with respect to which it is differentiated twice.
        others: other variables that it may depend on.
        constants: values of parameters.

    Returns:
        ``None`` if every block is regular at one point at least, or could not be evaluated at any. An empty block means
        that the Hessian is structurally singular.
    """
    entries = hessian(scalar, variables)
    size = len(variables)
    if not all((index, index) in entries for index in range(size)) and _structural_rank(entries, size) < size:
        rows = {row for row, _ in entries}
        missing = tuple(variable for index, variable in enumerate(variables) if index not in rows)
        return missing, {}
    points = sample_points(variables, others, constants)
    for block in coupled_blocks(entries, size):
        local = {
            (i, j): entries[row, column]
            for i, row in enumerate(block)
            for j, column in enumerate(block)
            if (row, column) in entries
        }
        points, same = tee(points)  # points are drawn lazily, and shared by all blocks
        if _is_singular(local, len(block), same):
            return tuple(variables[index] for index in block), local
    return None


def _is_singular(entries: Entries, size: int, points: Iterable[dict[Symbol, Number]]) -> bool:
    """Return whether a block is singular at every point where it has values, of which there is at least one."""
    if size == 1 and entries[0, 0].is_Rational:
        return False
    evaluated, tape = False, None
    for point in points:
        tape = tape or Tape(list(entries.values()), list(point))
        try:
            matrix = dict(zip(entries, tape(list(point.values())), strict=True))
        except ArithmeticError:
            continue
        evaluated = True
        if _regular(matrix, size):
            return False
    return evaluated


def null_direction(entries: Entries, variables: Sequence[Symbol]) -> str:
    """Return a null vector of a singular block as text; empty for large blocks and irrational entries."""
    size = len(variables)
    if not entries or size > LARGEST_NULL_SPACE or not all(entry.is_Rational for entry in entries.values()):
        return ""
    vectors = Matrix(size, size, lambda row, column: entries.get((row, column), 0)).nullspace()
    return ", ".join(f"{variable} = {value}" for variable, value in zip(variables, vectors[0], strict=True))


def sample_points(
    variables: Sequence[Symbol], others: Sequence[Symbol], constants: Mapping[Symbol, float]
) -> Iterator[dict[Symbol, Number]]:
    """Yield reproducible random points: ``others`` of order 1/2, 1 and 10, ``variables`` from 1/1000 to 1."""
    generator = random.Random(20250101)
    fixed = {constant: mp.mpf(value) for constant, value in constants.items()}

    def spread(symbols: Sequence[Symbol], scale: float) -> dict[Symbol, Number]:
        return {symbol: mp.mpf(scale * generator.uniform(-1, 1)) for symbol in symbols}

    for own_scale in (0.1, 1e-3, 1.0):
        for scale in (1.0, 0.5, 10.0):
            yield fixed | spread(others, scale) | spread(variables, own_scale)


def _structural_rank(entries: Entries, size: int) -> int:
    # imported here because SciPy is slow to import and rarely needed
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import structural_rank

    rows, columns = np.array(list(entries), dtype=np.int64).reshape(-1, 2).T
    return int(structural_rank(csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size))))


def coupled_blocks(entries: Entries, size: int) -> list[list[int]]:
    """Return the connected components of the variables, coupled by non-zero entries, as lists of indices."""
    neighbours: list[list[int]] = [[] for _ in range(size)]
    for row, column in entries:
        neighbours[row].append(column)
    blocks, seen = [], [False] * size
    for start in range(size):
        block, pending = [], [start]
        while pending:
            index = pending.pop()
            if not seen[index]:
                seen[index] = True
                block.append(index)
                pending.extend(neighbours[index])
        if block:
            blocks.append(sorted(block))
    return blocks


def _regular(matrix: dict[tuple[int, int], Number], size: int) -> bool:
    """Return whether a matrix is regular, by elimination with complete pivoting in 60 digits on sparse, scaled rows."""
    rows: list[dict[int, Number]] = [{} for _ in range(size)]
    for (row, column), value in matrix.items():
        rows[row][column] = value
    rows = [{column: value / scale for column, value in row.items()} for row in rows if (scale := _largest(row))]
    if len(rows) < size:
        return False
    while rows:
        best = max(range(len(rows)), key=lambda index: _largest(rows[index]))
        pivot_row = rows.pop(best)
        if _largest(pivot_row) < NEGLIGIBLE:
            return False
        pivot = max(pivot_row, key=lambda column: abs(pivot_row[column]))
        rows = [_eliminated(row, pivot_row, pivot) if pivot in row else row for row in rows]
    return True


def _largest(row: Mapping[int, Number]) -> Number:
    return max(map(abs, row.values()), default=mp.zero)


def _eliminated(row: Mapping[int, Number], pivot_row: Mapping[int, Number], pivot: int) -> dict[int, Number]:
    factor = row[pivot] / pivot_row[pivot]
    result = dict(row)
    for column, value in pivot_row.items():
        result[column] = result.get(column, mp.zero) - factor * value
    del result[pivot]
    return result
