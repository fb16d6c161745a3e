"""Staggered finite differences of order 2 m: derivatives between two points, squared in the density.

They evaluate u, u_x and u_xx between two points from 2 m points (u_xx: 2 m + 2) (B. Fornberg, Math. Comp. 51 (1988),
699-706). At an end the rows Q = W D of u_x, the quadrature weights W between points and M at points satisfy

    sum_i Q_ci x_i^k = W_c k x_c^(k-1),    sum_c Q_ci x_c^k = -M_i k x_i^(k-1) - [i = 0] 0^k,    k = 0 .. m,

that is, D is exact for polynomials of degree m, and summation by parts holds for them (O. O'Reilly et al., J. Sci.
Comput. 2017, staggered operators). Of all solutions the one nearest to the interior coefficients is taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.fields.axes import Array, Axis, CellPoint, Cells, ClosedPoints, lagrange, point_count_of
from scvi_codegen.tables.precision import Vector, mp


def differences(
    name: str, bounds: tuple[float, float], points: int, order: int, fixed: tuple[bool, bool] | None, *, second: bool
) -> Axis:
    """Return an axis of equidistant points with staggered differences of order 2 m.

    By symmetry the coefficients of u and h^2 u_xx at the midpoint are even and exact for even polynomials of degree up
    to 2 m - 2, those of h u_x odd and exact for odd ones of degree up to 2 m - 1. ``second`` adds u_xx, with two points
    more.

    Args:
        name, bounds: of the axis.
        points: their number, ends included.
        order: 2 m.
        fixed: whether the values at the left and right ends are prescribed; ``None`` for a periodic axis.
        second: whether the density contains u_xx.
    """
    if isinstance(order, bool) or order not in (2, 4, 6, 8):
        raise SystemDefinitionError(f"order= of finite differences is 2, 4, 6 or 8, not {order!r}")
    count = point_count_of(name, points, least=(2 if fixed is None else 3) * order)
    m = order // 2 + second
    halves = [mp.mpf(2 * k + 1) / 2 for k in range(m)]

    def solved(moments: Sequence[float], parity: int) -> Vector:
        matrix = mp.matrix([[2 * x ** (2 * r + parity) for x in halves] for r in range(m)])
        return tuple(mp.lu_solve(matrix, mp.matrix(list(moments))))

    value, odd = solved([1] + [0] * (m - 1), 0), solved([1] + [0] * (m - 1), 1)
    rows = [(*reversed(value), *value), (*(-each for each in reversed(odd)), *odd)]
    if second:
        curvature = solved([0, 2] + [0] * (m - 2), 0)
        rows.append((*reversed(curvature), *curvature))
    (start, end), index = bounds, f"e{name}"
    h = (end - start) / (count if fixed is None else count - 1)
    at: Array = start + h * np.arange(count, dtype=np.float64)
    masses, stiffness = np.full(count, h), [float(sum(map(abs, row))) ** 2 for row in rows]
    places = tuple(CellPoint(index if k == 0 else f"{index}{k:+d}") for k in range(1 - m, m + 1))
    cells = [Cells(f"{index} in N{name} periodic", index, places)]
    inner, closed = slice(None), None
    if fixed is not None:
        if second:
            raise SystemDefinitionError(
                f"'finite-differences' of second derivatives need a periodic axis, and '{name}' has ends: use "
                '"spectral-elements"'
            )
        end_rows, midpoints, ends, largest = _end_rows(np.array([float(x) for x in rows[1]]))
        masses[: len(ends)], masses[-len(ends) :] = h * ends, h * ends[::-1]
        left, right = map(int, fixed)
        within = (
            f"{index} in {2 * m - left}..N{name}-{2 * m + 2 - right}"  # that of the unknown to the left of the cell
        )
        cells = [Cells(within, f"{index}+1" if left else index, places), *_end_cells(name, end_rows, midpoints, fixed)]
        inner = slice(left, count - right)
        closed = _closed(at, masses, order, inner)
        stiffness[1] = max(stiffness[1], largest)
    return Axis(
        name=name,
        points=at[inner],
        weights=masses[inner],
        length=end - start,
        stencil=order,
        periodic=fixed is None,
        quadrature=(mp.mpf(1),),
        operators=tuple((row,) for row in rows),
        cells=tuple(cells),
        jacobians=np.full(count - (fixed is not None), h),
        cell_points=(at[: count - (fixed is not None)] + h / 2)[:, None],
        closed=closed,
        stiffness=tuple(size / h ** (2 * k) for k, size in enumerate(stiffness) if k),
    )


def _end_rows(row: Array) -> tuple[Array, Array, Array, float]:
    """Return D of the first R = 2 m midpoints from R + m points, the weights W and M, and the largest D^T W D by M.

    All for h = 1. The eigenvalue is that of a line with one end, with one percent added for its length.
    """
    m = len(row) // 2
    size, width = 2 * m, 3 * m
    interior = np.zeros((4 * width, 4 * width + m))
    for c in range(m - 1, 4 * width):
        interior[c, c - m + 1 : c + m + 1] = row
    unknown = size * width
    matrix, right = [], []
    for k in range(m + 1):
        at, between = np.arange(width + 0.0) ** k, (np.arange(4 * width) + 0.5) ** k
        slope = k * np.arange(width + 0.0) ** max(k - 1, 0), k * (np.arange(size) + 0.5) ** max(k - 1, 0)
        for c in range(size):
            entry = np.zeros(unknown + size + width)
            entry[c * width : (c + 1) * width], entry[unknown + c] = at, -slope[1][c]
            matrix.append(entry)
            right.append(0.0)
        for i in range(width):
            entry = np.zeros(unknown + size + width)
            entry[i:unknown:width], entry[unknown + size + i] = between[:size], slope[0][i]
            matrix.append(entry)
            right.append(float(-(i == 0 and k == 0) - between[size:] @ interior[size:, i]))
    solution = np.concatenate([interior[:size, :width].ravel(), np.ones(size + width)])
    solution[unknown + size] = 0.5
    for _ in range(3):  # the first is the nearest solution, the others remove rounding
        solution += np.linalg.lstsq(np.array(matrix), np.array(right) - matrix @ solution, rcond=1e-11)[0]
    weights, masses = solution[unknown : unknown + size], solution[unknown + size :]
    rows = solution[:unknown].reshape(size, width) / weights[:, None]
    interior[:size] = 0
    interior[:size, :width] = rows
    interior[:size] *= np.sqrt(weights)[:, None]
    interior[:, :width] /= np.sqrt(masses)
    largest = np.linalg.norm(interior, 2) ** 2
    return rows, weights, masses, 1.01 * float(largest)


def _end_cells(name: str, rows: Array, weights: Array, fixed: tuple[bool, bool]) -> list[Cells]:
    """Return the cells at both ends; those of the right are mirror images of the left."""
    result = []
    for c, row in enumerate(rows):
        distance = c + 0.5 - np.arange(rows.shape[1], dtype=np.float64)
        near = np.argsort(np.abs(distance), kind="stable")[: len(weights)]
        value = np.zeros(rows.shape[1])
        value[near] = lagrange(distance[near])
        for end, prescribed in enumerate(fixed):
            places = [
                CellPoint(None, end)
                if prescribed and i == 0
                else CellPoint(str(i - prescribed) if end == 0 else f"N{name}-{i + 1 - prescribed}")
                for i in range(rows.shape[1])
            ]
            operators = tuple((tuple(map(mp.mpf, each)),) for each in (value, -row if end else row))
            index = str(c) if end == 0 else f"E{name}-{c + 1}"
            result.append(Cells("", index, tuple(places), operators=operators, weight=float(weights[c])))
    return result


def _closed(at: Array, masses: Array, order: int, inner: slice) -> ClosedPoints:
    """Return all points, with derivatives from the nearest order + 1 points."""
    count = len(at)
    first = np.clip(np.arange(count) - order // 2, 0, count - order - 1)
    neighbours: NDArray[np.int64] = first[:, None] + np.arange(order + 1)
    moment = np.eye(order + 1)[1] / (at[1] - at[0])
    rates = [
        np.linalg.solve(np.vander(np.arange(order + 1.0) - offset, increasing=True).T, moment)
        for offset in range(order + 1)
    ]
    return ClosedPoints(
        points=at,
        weights=masses,
        positions=np.clip(np.arange(count) - inner.start, 0, inner.stop - inner.start - 1),
        inside=np.isin(np.arange(count), np.arange(count)[inner]),
        neighbours=neighbours,
        rates=np.array([rates[offset] for offset in np.arange(count) - first]),
    )
