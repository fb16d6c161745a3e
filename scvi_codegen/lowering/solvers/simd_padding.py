"""Tables of fixed-point solvers, padded to whole vectors.

Lanes beyond the last real point repeat it (its row, its abscissa) and have weight 0: they are in the domain of the
Lagrangian whenever it is, and never delay convergence.
"""

from __future__ import annotations

from scvi_codegen.ir.iteration import PredictorTables
from scvi_codegen.ir.numbers import Number, NumberTable, lower_matrix, lower_vector
from scvi_codegen.tables.basis import continuation, extrapolation, legendre_functional, matrix_product
from scvi_codegen.tables.precision import Matrix, Vector, mp

__all__ = ["MOST_LANES", "lane_count", "pad_matrix", "pad_vector", "predictor_tables_of"]

MOST_LANES = 32
DEGREE_OF_ONE, DEGREE_OF_TWO = 8, 12
"""Degrees of the polynomials through the last step, or through the last two, that are extrapolated into the next.

Higher degrees are more accurate, but amplify rounding errors, by about 1e6 for these.
"""
INTERPOLATED = 5
"""Degree up to which the polynomial of two steps interpolates all points; above, least squares predict better."""


def lane_count(points: int) -> int:
    """Return the power of two, at least 2, that is not less than the number of points."""
    return max(2, 1 << (points - 1).bit_length())


def pad_matrix(entries: Matrix, lanes: int) -> NumberTable:
    """Return the padded table: rows beyond the last repeat it, columns beyond are zero."""
    return lower_matrix(_wide(entries, lanes))


def pad_vector(entries: Vector, lanes: int, *, repeat: bool = False) -> tuple[Number, ...]:
    """Return the padded vector; further entries are zero, or repeat the last."""
    return lower_vector(_longer(entries, lanes, repeat=repeat))


def predictor_tables_of(
    abscissae: Vector, lanes: int, *, through: Matrix | None = None, degree: int | None = None
) -> PredictorTables:
    """Return the predictor tables from values at the points in the last one or two steps to those in the next.

    ``through``: a matrix to apply to the prediction; ``degree``: of the leading coefficient that the method resolves,
    by default the highest that the points determine.
    """
    highest = len(abscissae) - 1 if degree is None else degree
    alone = extrapolation(abscissae, 1, min(len(abscissae) - 1, DEGREE_OF_ONE))
    places = len({*abscissae, *(x - 1 for x in abscissae)})  # one fewer if both ends of a step are points
    through_most = max(2 * len(abscissae) - 2, INTERPOLATED)
    tables: tuple[Matrix, ...] = (alone, *continuation(abscissae, min(places - 1, through_most, DEGREE_OF_TWO)))
    if through is not None:
        tables = tuple(matrix_product(through, table) for table in tables)
    last_alone, last, before = (pad_matrix(table, lanes) for table in tables)
    return PredictorTables(
        abscissae=lower_vector(abscissae),
        degree=highest,
        highest=pad_vector(legendre_functional(abscissae, highest), lanes),
        next=pad_vector(legendre_functional(abscissae, highest - 1), lanes),
        last_alone=last_alone,
        last=last,
        before=before,
    )


def _wide(entries: Matrix, lanes: int) -> Matrix:
    wide = tuple(_longer(line, lanes) for line in entries)
    return (*wide, *(wide[-1],) * (lanes - len(wide)))


def _longer(entries: Vector, lanes: int, *, repeat: bool = False) -> Vector:
    return (*entries, *((entries[-1] if repeat else mp.zero),) * (lanes - len(entries)))
