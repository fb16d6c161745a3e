"""Linear equations of a path: the block-tridiagonal Hessian of its action, and its inertia.

With r_k = p1_(k-1) - p0_k the Hessian has the blocks dp1/dq1 - dp0/dq0 on its diagonal, -dp0/dq1 above and dp1/dq0
below it. The negative pivots of its block LDL^T factorisation up to node k count the negative directions of the action
on [t_0, t_(k+1)]: the Morse index, which increases at conjugate points (Milnor, Morse Theory, sec. 15).
"""

from typing import Any

import numpy as np

from scvi_codegen.analysis.paths.intervals import Intervals, Linearised
from scvi_codegen.common.errors import PathError
from scvi_codegen.runs.states.validation import Array

NULL_EIGENVALUE = 1e-7
"""Fraction of the largest eigenvalue below which others belong to symmetries of a closed path, which is not unique."""


def hessian_blocks(at: Linearised) -> tuple[Array, Array, Array]:
    """Return the diagonal (N - 1, d, d) and the upper and lower blocks (N - 2, d, d)."""
    a, b, c, e = at.blocks
    return e[:-1] - a[1:], -b[1:-1], c[1:-1]


class Band:
    """LU factors of the Hessian in band storage, with partial pivoting."""

    def __init__(self, at: Linearised, shift: float = 0.0) -> None:
        from scipy.linalg import lapack  # here, because stepping does not need SciPy

        self.lapack = lapack
        diagonal, upper, lower = hessian_blocks(at)
        self.positive: bool | None = None
        if shift:
            diagonal = diagonal + shift * np.eye(diagonal.shape[1])
            self.positive = not _negative_pivots(diagonal, upper, lower)[-1]
        count, d, _ = diagonal.shape
        self.shape, self.reach = (count, d), 2 * d - 1
        matrix = np.zeros((3 * self.reach + 1, count * d))
        i, j = np.indices((d, d))
        for blocks, row, column in ((diagonal, 0, 0), (upper, 0, d), (lower, d, 0)):
            for k, block in enumerate(blocks):
                matrix[2 * self.reach + (row + i) - (column + j), k * d + column + j] = block
        self.factors, self.pivots, status = lapack.dgbtrf(matrix, self.reach, self.reach)
        if status or not np.isfinite(self.factors).all():
            raise PathError("the Hessian of the action is singular: an end is a conjugate point of the other")

    def solve(self, r: Array) -> Array:
        """Return the solution for (N - 1, d) right-hand sides."""
        x, _ = self.lapack.dgbtrs(self.factors, self.reach, self.reach, r.reshape(-1, 1), self.pivots)
        return np.asarray(x.reshape(self.shape))


class Sparse:
    """LU factors of the Hessian of many coordinates, of which the entries ``rows``, ``columns`` of blocks are known."""

    def __init__(self, at: Linearised, intervals: Any, shift: float = 0.0) -> None:
        from scipy.sparse import csc_matrix, identity
        from scipy.sparse.linalg import splu

        a, b, c, e = at.blocks
        count, d = a.shape[0] - 1, intervals.dimension
        rows, columns, data = [], [], []
        for first, i, j, blocks in ((0, 0, 0, e[:-1] - a[1:]), (0, 0, 1, -b[1:-1]), (0, 1, 0, c[1:-1])):
            k = np.arange(first, first + len(blocks))[:, np.newaxis]
            rows.append(((k + i) * d + intervals.rows).ravel())
            columns.append(((k + j) * d + intervals.columns).ravel())
            data.append(blocks.ravel())
        matrix = csc_matrix(
            (np.concatenate(data), (np.concatenate(rows), np.concatenate(columns))), shape=(count * d,) * 2
        )
        matrix = matrix + shift * identity(count * d, format="csc")
        order = np.arange(count * d).reshape(count, d).T.ravel()  # a site at all times, then the next
        self.order, self.shape = order, (count, d)
        try:
            self.factors = splu(
                matrix[order][:, order], permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
            )
        except RuntimeError as error:
            raise PathError("the Hessian of the action is singular") from error

    def solve(self, r: Array) -> Array:
        """See :meth:`Band.solve`."""
        result = np.empty(r.size)
        result[self.order] = self.factors.solve(r.ravel()[self.order])
        return result.reshape(self.shape)

    @property
    def negative(self) -> int:
        """Number of negative pivots."""
        return int((self.factors.U.diagonal() < 0).sum())

    @property
    def positive(self) -> bool:
        """True if the matrix is positive definite."""
        return not self.negative


def factors_of(at: Linearised, intervals: Intervals, shift: float = 0.0) -> Band | Sparse:
    """Return the factors of the Hessian plus ``shift`` times the identity."""
    return Sparse(at, intervals, shift) if intervals.sparse else Band(at, shift)


def negative_directions(at: Linearised) -> list[int]:
    """Return the Morse index of [t_0, t_k], k = 1 to N, by the inertia of the pivots."""
    return _negative_pivots(*hessian_blocks(at))


def _negative_pivots(diagonal: Array, upper: Array, lower: Array) -> list[int]:
    index, inverse = [0], np.zeros_like(diagonal[0])
    for k, block in enumerate(diagonal):
        pivot = block - (lower[k - 1] @ inverse @ upper[k - 1] if k else 0.0)
        pivot = (pivot + pivot.T) / 2.0
        index.append(index[-1] + int((np.linalg.eigvalsh(pivot) < 0).sum()))
        inverse = np.linalg.pinv(pivot, hermitian=True)
    return index


def condensed_hessian(at: Linearised, factors: Band) -> Array:
    """Return the (2d, 2d) Hessian of the action of a path as a function of both ends."""
    a, b, c, e = at.blocks
    count, d = factors.shape
    result = np.zeros((2 * d, 2 * d))
    result[:d, :d], result[d:, d:] = -a[0], e[-1]
    if not count:
        result[:d, d:], result[d:, :d] = -b[0], c[0]
        return result
    for column in range(2 * d):
        r = np.zeros((count, d))
        if column < d:
            r[0] = c[0][:, column]
        else:
            r[-1] = -b[-1][:, column - d]
        x = factors.solve(r)
        result[:d, column] += b[0] @ x[0]
        result[d:, column] -= c[-1] @ x[-1]
    return result


class Closed:
    """Residual and Hessian of a closed path, q_N = M q_0, with the unknown nodes 0 to N - 1.

    Directions of eigenvalues near 0, of rotations and shifts along the path, are left out of Newton's step.
    """

    def __init__(self, at: Linearised, M: Array, *, symmetric: bool) -> None:
        self.shape = count, d = at.p0.shape[0], len(M)
        a, b, c, e = at.blocks
        matrix = np.zeros((count * d,) * 2)
        for k in range(count):
            here, after = slice(k * d, k * d + d), slice((k + 1) % count * d, (k + 1) % count * d + d)
            T = M if k == count - 1 else np.eye(d)
            matrix[here, here] -= a[k]
            matrix[after, after] += T.T @ e[k] @ T
            matrix[here, after] -= b[k] @ T
            matrix[after, here] += T.T @ c[k]
        self.symmetric, self.matrix = symmetric, matrix
        if symmetric:
            self.matrix = (matrix + matrix.T) / 2.0
            self.factorise()
        else:
            self.inverse = np.linalg.pinv(matrix, rcond=NULL_EIGENVALUE)

    def factorise(self) -> None:
        """Compute the eigenvalues of the matrix."""
        self.values, self.vectors = np.linalg.eigh(self.matrix)
        self.kept = np.abs(self.values) > NULL_EIGENVALUE * np.abs(self.values).max()

    def solve(self, r: Array) -> Array:
        """Return the solution of least norm."""
        if not self.symmetric:
            return np.asarray((self.inverse @ r.ravel()).reshape(self.shape))
        kept = self.vectors[:, self.kept]
        return np.asarray((kept @ ((kept.T @ r.ravel()) / self.values[self.kept])).reshape(self.shape))

    @property
    def negative(self) -> int:
        """Number of negative eigenvalues."""
        return int((self.values[self.kept] < 0).sum())


class Bordered:
    """Factors of [H, border; row, corner] by those of H, with one more unknown and equation."""

    def __init__(self, factors: Band | Sparse, border: Array, row: Array, corner: float) -> None:
        self.factors, self.row, self.along = factors, row, factors.solve(border)
        self.pivot = corner - float(row @ self.along[0])

    def solve(self, r: Array) -> Array:
        """Return the solution; the row is that of the first inner node."""
        own = self.factors.solve(r[:-1])
        last = (r[-1] - self.row @ own[0]) / self.pivot
        return np.append(own - last * self.along, last)


class BorderedClosed(Closed):
    """Hessian of a closed path with the duration as a further unknown, which is scaled to the size of the others."""

    def __init__(self, at: Linearised, M: Array, border: Array, corner: float) -> None:
        self.border, self.corner = border.reshape(-1, 1), corner
        super().__init__(at, M, symmetric=True)

    def factorise(self) -> None:
        """See :meth:`Closed.factorise`."""
        self.scale = np.sqrt(np.abs(self.matrix).max() / abs(self.corner)) if self.corner else 1.0
        side, corner = self.scale * self.border, np.array([[self.scale**2 * self.corner]])
        self.matrix = np.block([[self.matrix, side], [side.T, corner]])
        super().factorise()

    def solve(self, r: Array) -> Array:
        """See :meth:`Closed.solve`."""
        kept, scales = self.vectors[:, self.kept], np.append(np.ones(r.size - 1), self.scale)
        return np.asarray(scales * (kept @ ((kept.T @ (scales * r)) / self.values[self.kept])))


def closed_residual(at: Linearised, M: Array, intervals: Intervals) -> Array:
    """Return the (N, d) residuals of the nodes of a closed path."""
    return np.concatenate([intervals.tangent(0, M.T @ at.p1[-1] - at.p0[0])[np.newaxis], at.residual])
