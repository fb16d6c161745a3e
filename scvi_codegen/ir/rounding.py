"""Tables of 60 digits rounded to binary64, once."""

from __future__ import annotations

from scvi_codegen.tables.precision import Matrix, Vector, settled

__all__ = ["lower_matrix", "lower_vector"]


def lower_vector(numbers: Vector) -> tuple[float, ...]:
    """Each number rounded to the nearest double; what is 0 but for rounding is 0."""
    return tuple(float(settled(x)) for x in numbers)


def lower_matrix(entries: Matrix) -> tuple[tuple[float, ...], ...]:
    """The same for the rows of a table."""
    return tuple(lower_vector(line) for line in entries)
