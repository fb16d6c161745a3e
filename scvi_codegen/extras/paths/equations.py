"""Linear equations of a path: the block-tridiagonal Hessian of its action, and its inertia.

With r_k = p1_(k-1) - p0_k the Hessian has the blocks dp1/dq1 - dp0/dq0 on its diagonal, -dp0/dq1 above and dp1/dq0
below it. The negative pivots of its block LDL^T factorisation up to node k count the negative directions of the action
on [t_0, t_(k+1)]: the Morse index, which increases at conjugate points (Milnor, Morse Theory, sec. 15).
"""

from typing import Any

import numpy as np

from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import PathError
from scvi_codegen.extras.paths.intervals import Intervals, Linearised

NULL_EIGENVALUE = 1e-7
"""Fraction of the largest eigenvalue below which others belong to symmetries of a closed path, which is not unique."""


def hessian_blocks(at: Linearised) -> tuple[Array, Array, Array]:
    """Return the diagonal (N - 1, d, d) and the upper and lower blocks (N - 2, d, d)."""
    # H_(k, k) = dp1_(k-1)/dq1 - dp0_k/dq0,  H_(k, k+1) = -dp0_k/dq1,  H_(k+1, k) = dp1_k/dq0,  k = 1 to N - 1
    p0_by_q0, p0_by_q1, p1_by_q0, p1_by_q1 = at.blocks
    return p1_by_q1[:-1] - p0_by_q0[1:], -p0_by_q1[1:-1], p1_by_q0[1:-1]


class Band:
    """LU factors of the Hessian in band storage, with partial pivoting."""

    def __init__(self, at: Linearised, shift: float = 0.0) -> None:
        from scipy.linalg import lapack  # here, because stepping does not need SciPy

        self.lapack = lapack
        diagonal, upper, lower = hessian_blocks(at)
        self.positive: bool | None = None
        if shift:
            diagonal = diagonal + shift * np.eye(diagonal.shape[1])
            self.positive = not negative_pivots(diagonal, upper, lower)[-1]
        count, d, _ = diagonal.shape
        self.shape, self.reach = (count, d), 2 * d - 1
        # LAPACK's band storage for dgbtrf: the entry (I, J) is in row 2 reach + I - J and column J
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
        # blocks (k + i, k + j) of the matrix, k = 0 to N - 2, as in hessian_blocks
        for i, j, blocks in ((0, 0, e[:-1] - a[1:]), (0, 1, -b[1:-1]), (1, 0, c[1:-1])):
            k = np.arange(len(blocks))[:, np.newaxis]
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


def negative_pivots(diagonal: Array, upper: Array, lower: Array) -> list[int]:
    """Return the numbers of negative eigenvalues of the leading 0, 1, .., N - 1 blocks of a Hessian.

    Block LDL^T factorisation of a symmetric block-tridiagonal matrix: the pivots are D_1 = H_11 and
    D_k = H_kk - H_(k, k-1) D_(k-1)^-1 H_(k-1, k); by Sylvester's law of inertia their negative eigenvalues add up.
    They are the Morse indices of [t_0, t_k], k = 1 to N.
    """
    indices = [0]
    inverse_pivot = np.zeros_like(diagonal[0])
    for k, block in enumerate(diagonal):
        pivot = block
        if k > 0:
            pivot = block - lower[k - 1] @ inverse_pivot @ upper[k - 1]
        pivot = (pivot + pivot.T) / 2.0
        negative = int((np.linalg.eigvalsh(pivot) < 0).sum())
        indices.append(indices[-1] + negative)
        inverse_pivot = np.linalg.pinv(pivot, hermitian=True)
    return indices


def condensed_hessian(at: Linearised, factors: Band) -> Array:
    """Return the (2d, 2d) Hessian of the action of a path as a function of both ends.

    The inner nodes x follow the ends E = (q_0, q_N) so that the action stays stationary in them: the Hessian is the
    Schur complement S_EE - S_Ex S_xx^-1 S_xE. Its blocks are derivatives of the gradient of the action,
    S_q0 = -p0_0 and S_qN = p1_(N-1) (generating function of the first kind), S_xk = p1_(k-1) - p0_k.
    """
    p0_by_q0, p0_by_q1, p1_by_q0, p1_by_q1 = at.blocks
    inner_nodes, d = factors.shape
    start, end = slice(0, d), slice(d, 2 * d)
    hessian = np.zeros((2 * d, 2 * d))
    hessian[start, start] = -p0_by_q0[0]
    hessian[end, end] = p1_by_q1[-1]
    if inner_nodes == 0:
        hessian[start, end] = -p0_by_q1[0]
        hessian[end, start] = p1_by_q0[0]
        return hessian
    for j in range(2 * d):
        # column j of S_xE: q_0 acts on the first inner node, q_N on the last
        by_end = np.zeros((inner_nodes, d))
        if j < d:
            by_end[0] = p1_by_q0[0][:, j]
        else:
            by_end[-1] = -p0_by_q1[-1][:, j - d]
        x = factors.solve(by_end)
        # S_Ex has the rows -dp0_0/dq1 (first inner node) and dp1_(N-1)/dq0 (last)
        hessian[start, j] += p0_by_q1[0] @ x[0]
        hessian[end, j] -= p1_by_q0[-1] @ x[-1]
    return hessian


class Closed:
    """Residual and Hessian of a closed path, q_N = M q_0, with the unknown nodes 0 to N - 1.

    Directions of eigenvalues near 0, of rotations and shifts along the path, are left out of Newton's step.
    """

    def __init__(self, at: Linearised, M: Array, *, symmetric: bool) -> None:
        self.shape = count, d = at.p0.shape[0], len(M)
        p0_by_q0, p0_by_q1, p1_by_q0, p1_by_q1 = at.blocks
        matrix = np.zeros((count * d,) * 2)
        # Step k goes from q_k to T q_j, j = k + 1 and T = 1, but j = 0 and T = M for the last one. Its action has the
        # gradient (-p0_k, T^T p1_k) with respect to (q_k, q_j); the matrix is the sum of the derivatives of all steps.
        for k in range(count):
            next_node, T = (0, M) if k == count - 1 else (k + 1, np.eye(d))
            here = slice(k * d, k * d + d)
            after = slice(next_node * d, next_node * d + d)
            matrix[here, here] -= p0_by_q0[k]
            matrix[after, after] += T.T @ p1_by_q1[k] @ T
            matrix[here, after] -= p0_by_q1[k] @ T
            matrix[after, here] += T.T @ p1_by_q0[k]
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
    """Factors of [H, border; row, corner] by those of H, with one more unknown and equation.

    Block elimination of H x + border s = r, row . x_1 + corner s = rho, x_1 the first inner node:
    s = (rho - row . (H^-1 r)_1) / (corner - row . (H^-1 border)_1) and x = H^-1 r - s H^-1 border.
    """

    def __init__(self, factors: Band | Sparse, border: Array, row: Array, corner: float) -> None:
        self.factors, self.row = factors, row
        self.solved_border = factors.solve(border)
        self.pivot = corner - float(row @ self.solved_border[0])

    def solve(self, r: Array) -> Array:
        """Return x and s, flat, for the right-hand sides r and rho, flat."""
        unbordered = self.factors.solve(r[:-1])
        s = (r[-1] - self.row @ unbordered[0]) / self.pivot
        return np.append(unbordered - s * self.solved_border, s)


class BorderedClosed(Closed):
    """Hessian of a closed path with the duration as a further unknown, which is scaled to the size of the others."""

    def __init__(self, at: Linearised, M: Array, border: Array, corner: float) -> None:
        self.border, self.corner = border.reshape(-1, 1), corner
        super().__init__(at, M, symmetric=True)

    def factorise(self) -> None:
        """See :meth:`Closed.factorise`; of D A D with D = diag(1, .., 1, scale), which also replaces ``matrix``."""
        self.scale = np.sqrt(np.abs(self.matrix).max() / abs(self.corner)) if self.corner else 1.0
        side, corner = self.scale * self.border, np.array([[self.scale**2 * self.corner]])
        self.matrix = np.block([[self.matrix, side], [side.T, corner]])
        super().factorise()

    def solve(self, r: Array) -> Array:
        """See :meth:`Closed.solve`: A x = r by x = D (D A D)^+ D r."""
        kept = self.vectors[:, self.kept]
        scales = np.append(np.ones(r.size - 1), self.scale)
        return np.asarray(scales * (kept @ ((kept.T @ (scales * r)) / self.values[self.kept])))


def closed_residual(at: Linearised, M: Array, intervals: Intervals) -> Array:
    """Return the (N, d) residuals of the nodes of a closed path."""
    return np.concatenate([intervals.tangent(0, M.T @ at.p1[-1] - at.p0[0])[np.newaxis], at.residual])
