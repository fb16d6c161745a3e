"""Staggered finite differences of order 2 m: derivatives between two points, squared in the density.

They evaluate u, u_x and u_xx between two points from 2 m points (u_xx: 2 m + 2) (B. Fornberg, Math. Comp. 51 (1988),
699-706). At an end the rows Q = W D of u_x, the quadrature weights W between points and M at points satisfy

    sum_i Q_ci x_i^k = W_c k x_c^(k-1),    sum_c Q_ci x_c^k = -M_i k x_i^(k-1) - [i = 0] 0^k,    k = 0 .. m,

that is, D is exact for polynomials of degree m, and summation by parts holds for them (O. O'Reilly et al., J. Sci.
Comput. 2017, staggered operators). Of all solutions the one nearest to the interior coefficients is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.fields.axes import (
    Array,
    Axis,
    Cells,
    ClosedPoints,
    fixed_place,
    held_ends,
    lagrange,
    point_count_of,
    span,
)
from scvi_codegen.fields.density import Density
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.indices import Place, Size
from scvi_codegen.tables.precision import Number, Vector, mp


@dataclass(frozen=True, slots=True, kw_only=True)
class FiniteDifferences(Axis):
    """Equidistant points.

    Attributes:
        stencil: number of points for the interpolation of values between points.
    """

    stencil: int

    @classmethod
    def of(cls, system: Density, name: str, *, order: int, points: int) -> FiniteDifferences:
        """Return the axis of a density; for u_xx in its density two points more are used.

        Args:
            system, name: the density, and the axis.
            order: 2 m.
            points: their number, ends included.
        """
        second = any(
            orders.get(name) == 2 and symbol(each) in system.density.free_symbols
            for each, (_, orders) in system.derivatives.items()
        )
        bounds, fixed = system.space[name], held_ends(system.boundary[name])
        if isinstance(order, bool) or order not in (2, 4, 6, 8):
            raise SystemDefinitionError(f"order= of finite differences is 2, 4, 6 or 8, not {order!r}")
        if second and fixed is not None:
            raise SystemDefinitionError(
                f"'finite-differences' of second derivatives need a periodic axis, and '{name}' has ends: use "
                '"spectral-elements"'
            )
        count, index = point_count_of(name, points, least=(2 if fixed is None else 3) * order), f"e{name}"
        cell_count = count - (fixed is not None)
        m, h = order // 2 + second, (bounds[1] - bounds[0]) / cell_count
        nodes: Array = bounds[0] + h * np.arange(count, dtype=np.float64)
        rows = _coefficients([mp.mpf(2 * k + 1) / 2 for k in range(-m, m)], 2 + second)
        stiffness = [float(sum(map(abs, row))) ** 2 / h ** (2 * k) for k, row in enumerate(rows)]
        places = tuple(Place(index=index, base=Size("", k)) for k in range(1 - m, m + 1))
        cells = [Cells(span(index, f"N{name}", periodic=True), Place(index=index), places)]
        masses, inner, closed = np.full(count, h), slice(None), None
        if fixed is not None:
            end_rows, midpoints, ends, largest = _end_rows(np.array([float(x) for x in rows[1]]))
            masses[: len(ends)], masses[-len(ends) :] = h * ends, h * ends[::-1]
            left, right = map(int, fixed)
            within = span(index, f"N{name}", order - left, order + 1 - right)  # the unknown to the left of each cell
            inner_cells = Cells(within, Place(index=index, base=Size("", left)), places)
            cells = [inner_cells, *_end_cells(name, end_rows, midpoints, fixed)]
            inner = slice(left, count - right)
            closed = _closed(nodes, masses, order, inner)
            stiffness[1] = max(stiffness[1], largest / h**2)
        return cls(
            name=name,
            points=nodes[inner],
            weights=masses[inner],
            length=bounds[1] - bounds[0],
            stencil=order,
            periodic=fixed is None,
            quadrature=(mp.mpf(1),),
            operators=tuple((row,) for row in rows),
            cells=tuple(cells),
            jacobians=np.full(cell_count, h),
            cell_points=(nodes[:cell_count] + h / 2)[:, None],
            closed=closed,
            stiffness=tuple(stiffness[1:]),
        )

    def between(self, place: float, distance: Array) -> dict[int, float]:
        """See :meth:`Axis.between`: the polynomial through the nearest points."""
        near = np.sort(np.abs(distance).argsort(kind="stable")[: self.stencil]).tolist()
        return dict(zip(near, lagrange(distance[near]).tolist(), strict=True))

    def modes(self, values: Array) -> Array:
        """See :meth:`Axis.modes`."""
        if not self.periodic:  # sine series of what a straight line through the ends leaves
            steps = np.linspace(0, 1, values.shape[-1])
            values = values - values[..., :1] - steps * (values[..., -1:] - values[..., :1])
            values = np.concatenate([values, -values[..., -2:0:-1]], -1)
        return Axis.modes(self, values)


def _coefficients(offsets: Sequence[Number], count: int) -> list[Vector]:
    """Return the coefficients of derivatives of order 0, 1, .. at 0 of the interpolant of values at offsets."""
    powers = mp.matrix([[x**r for x in offsets] for r in range(len(offsets))])
    moments = ([mp.factorial(k) * (r == k) for r in range(len(offsets))] for k in range(count))
    return [tuple(mp.lu_solve(powers, mp.matrix(each))) for each in moments]


def _end_rows(row: Array) -> tuple[Array, Array, Array, float]:
    """Return, for h = 1, D of the first 2 m midpoints, the weights W and M, and a bound of D^T W D by M (one end)."""
    m = len(row) // 2
    size, width = 2 * m, 3 * m
    interior = np.zeros((4 * width, 4 * width + m))
    for c in range(m - 1, 4 * width):
        interior[c, c - m + 1 : c + m + 1] = row
    unknown, blocks, right = size * width, [], []
    x, y = np.arange(width + 0.0), np.arange(4 * width) + 0.5
    for k in range(m + 1):
        rates = k * x ** max(k - 1, 0), k * y[:size] ** max(k - 1, 0)
        blocks.append([np.kron(np.eye(size), x**k), -np.diag(rates[1]), np.zeros((size, width))])
        blocks.append([np.kron(y[:size] ** k, np.eye(width)), np.zeros((width, size)), np.diag(rates[0])])
        right += [np.zeros(size), -(k == 0) * (x == 0) - y[size:] ** k @ interior[size:, :width]]
    matrix, target = np.block(blocks), np.concatenate(right)
    solution = np.concatenate([interior[:size, :width].ravel(), np.ones(size), 1 - (x == 0) / 2])
    for _ in range(3):  # the first is the nearest solution, the others remove rounding
        solution += np.linalg.lstsq(matrix, target - matrix @ solution, rcond=1e-11)[0]
    weights, masses = solution[unknown : unknown + size], solution[unknown + size :]
    rows = solution[:unknown].reshape(size, width) / weights[:, None]
    interior[:size] = 0
    interior[:size, :width] = np.sqrt(weights)[:, None] * rows
    interior[:, :width] /= np.sqrt(masses)
    return rows, weights, masses, 1.01 * float(np.linalg.norm(interior, 2)) ** 2


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
                end
                if prescribed and i == 0
                else fixed_place(i - prescribed)
                if end == 0
                else fixed_place(prescribed - i - 1, f"N{name}")
                for i in range(rows.shape[1])
            ]
            operators = tuple((tuple(map(mp.mpf, each)),) for each in (value, -row if end else row))
            index = fixed_place(c) if end == 0 else fixed_place(-c - 1, f"E{name}")
            result.append(Cells(None, index, tuple(places), operators=operators, weight=float(weights[c])))
    return result


def _closed(points: Array, masses: Array, order: int, inner: slice) -> ClosedPoints:
    count = len(points)
    first = np.clip(np.arange(count) - order // 2, 0, count - order - 1)
    neighbours: NDArray[np.int64] = first[:, None] + np.arange(order + 1)
    rates = [
        np.array(_coefficients([mp.mpf(k - place) for k in range(order + 1)], 2)[1], float) / (points[1] - points[0])
        for place in range(order + 1)
    ]
    return ClosedPoints(
        points=points,
        weights=masses,
        positions=np.clip(np.arange(count) - inner.start, 0, inner.stop - inner.start - 1),
        inside=np.isin(np.arange(count), np.arange(count)[inner]),
        neighbours=neighbours,
        rates=np.array([rates[offset] for offset in np.arange(count) - first]),
    )
