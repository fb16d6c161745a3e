"""Directions that linear conditions leave free: the one decision on which rows depend on each other."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
DEPENDENT = 1e-9
"""Singular value of rows of length 1 below which they depend on each other.

Rows that are differences of rates at unit velocities have errors of 1e-16 times these, with room for rates that are
1e6 times as large as their differences.
"""


@dataclass(frozen=True, eq=False)
class TangentSpace:
    """The vectors x with A x = 0, by the singular values of A (Golub & Van Loan, Matrix Computations, sec. 5.5.4).

    Attributes:
        rows: (c, m) of A, of length 1 or 0.
    """

    rows: Array

    @cached_property
    def _decomposition(self) -> tuple[Array, Array, Array]:
        left, values, right = np.linalg.svd(self.rows)
        return left, values, right

    @property
    def singular_values(self) -> Array:
        """(min(c, m),) singular values of the rows, the largest first."""
        return self._decomposition[1]

    @property
    def rank(self) -> int:
        """Number of independent rows."""
        return int(np.count_nonzero(self.singular_values > DEPENDENT))

    @property
    def basis(self) -> Array:
        """(m, m - rank) orthonormal columns that span the space."""
        return self._decomposition[2][self.rank :].T

    @property
    def conditions(self) -> Array:
        """(c, c - rank) orthonormal combinations of the rows that are 0, as columns."""
        return self._decomposition[0][:, self.rank :]

    @property
    def determined(self) -> NDArray[np.intp]:
        """(rank,) indices of the coordinates that the rows determine from the others, by elimination with pivots.

        The first has the largest column, the next ones the largest rest across the columns before.
        """
        rest, pivots = self.rows.copy(), list[int]()
        while len(pivots) < min(rest.shape) and (sizes := np.linalg.norm(rest, axis=0)).max() > DEPENDENT:
            pivots.append(int(np.argmax(sizes)))
            unit = rest[:, pivots[-1]] / sizes[pivots[-1]]
            rest -= np.outer(unit, unit @ rest)
        return np.array(pivots, np.intp)


def tangent_space(rows: Array) -> TangentSpace:
    """Return the space that (c, m) rows leave free, whatever their lengths; rows of zeros are no conditions."""
    return TangentSpace(unit_rows(rows))


def unit_rows(rows: Array) -> Array:
    """Return a matrix with its rows scaled to length 1, unless they are 0."""
    largest = np.abs(rows).max(axis=1, keepdims=True, initial=0.0)  # squares of entries overflow and underflow
    scaled = rows / np.where(largest > 0.0, largest, 1.0)
    lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
    return np.asarray(scaled / np.where(lengths > 0.0, lengths, 1.0))
