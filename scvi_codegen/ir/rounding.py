"""Tables of 60 digits rounded to binary64, once."""

from __future__ import annotations

from scvi_codegen.tables.precision import Matrix, Vector

__all__ = ["lower_matrix", "lower_vector"]


def lower_vector(numbers: Vector) -> tuple[float, ...]:
    """Each number rounded to the nearest double."""
    return tuple(float(x) for x in numbers)


def lower_matrix(entries: Matrix) -> tuple[tuple[float, ...], ...]:
    """The same for the rows of a table."""
    return tuple(lower_vector(line) for line in entries)
