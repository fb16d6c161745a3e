"""Discretisations of one axis of space: points, quadrature weights, and values and derivatives within a cell.

A density T(u, u_x, x) is integrated cell by cell with the quadrature of the cell,

    int T dx = sum_e J_e sum_a w_a T(sum_b I_ab u_b, (1/J_e) sum_b D_ab u_b, x_ea),

where b runs over the points that the cell uses. Spectral elements of degree p have the Gauss-Lobatto-Legendre points as
points and quadrature, so that I is the identity and the mass matrix is diagonal (C. Canuto et al., Spectral Methods:
Fundamentals in Single Domains, Springer 2006, section 5.4). Staggered differences of order 2 m evaluate u, u_x
and u_xx between two points from 2 m points (u_xx: 2 m + 2) (B. Fornberg, Math. Comp. 51 (1988), 699-706).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.tables.basis import differentiation_matrix, identity_matrix, matrix_product
from scvi_codegen.tables.nodes import point_count
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.tables.quadrature import gauss_lobatto
from scvi_codegen.validation import checked_count

Array = NDArray[np.float64]

PERIODIC = "periodic"
NATURAL = "natural"


@dataclass(frozen=True, slots=True)
class CellPoint:
    """Value that a cell uses: that at a point, or a prescribed one at an end.

    Attributes:
        index: index of the point as text, ``nodes_x[ex, 2]``; ``None`` for a prescribed value.
        end: 0 for the left end, 1 for the right end, where ``index`` is ``None``.
    """

    index: str | None
    end: int = 0


@dataclass(frozen=True, slots=True)
class Cells:
    """Cells of one kind.

    Attributes:
        loop: text of the loop over them, ``ex in 1..Ex-1``; empty for a single cell.
        index: index of the cell.
        places: of the points that a cell uses.
        rule: beginning of the text of the index of point b, ``nodes_x[ex``, if a table has all of them.
        interior: whether the ends of elements have no weight, because they are edges.
        edge: whether it is an end of two elements, whose points follow each other.
    """

    loop: str
    index: str
    places: tuple[CellPoint, ...]
    rule: str | None = None
    interior: bool = False
    edge: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Edges:
    """Ends of elements with derivatives from both sides, for densities of the second derivative.

    The second derivative is k = -M^-1 K u with the mass and stiffness matrices: within elements that of the
    polynomials, at their ends a mean of both sides and the jump of the first derivative. Ends of the axis belong to
    them only if they are clamped; at others k vanishes.

    Attributes:
        cells: kinds of edges.
        table: (F, 2 p + 2) positions of the points of the elements to the left and to the right.
        weights, points: (F,) quadrature weights and coordinates.
        rows: by order of the derivative, (2, p + 1) coefficients to the left and to the right.
        scales: by order, (F, 2) factors of both sides.
    """

    cells: tuple[Cells, ...]
    table: NDArray[np.int64]
    weights: Array
    points: Array
    rows: dict[int, Array]
    scales: dict[int, Array]


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """Discretised axis.

    Attributes:
        name: its name.
        points, weights: (N,) of the points with unknown values, and the quadrature weights there.
        length: of the axis.
        quadrature: weights w_a on the cell, whose half length (differences: length) is J.
        operators: matrices I, D and, for differences, that of the second derivative, by order of the derivative.
        cells: kinds of cells.
        jacobians, cell_points: (E,) and (E, a): J_e and x_ea.
        table: (E, b) positions of the points, or ``None`` if cells name their points without a table.
        inside: (E, b) whether a point is unknown; the value at the others is prescribed.
        reference: of elements, the points on [-1, 1].
        edges: of elements, their ends.
        stencil: number of points for the interpolation of values between equidistant points (differences).
        periodic: whether it has no ends.
        pairs: (N, N) matrices K of the quadratic forms sum_(i<j) K_ij (u_i - u_j)^2/2 of int u_x^2/2 dx and int
            u_xx^2/2 dx (Fourier).
        stiffness: upper bounds of int u_x^2 dx and int u_xx^2 dx by sum_i weights_i u_i^2.
    """

    name: str
    points: Array
    weights: Array
    length: float
    quadrature: Vector = ()
    operators: tuple[Matrix, ...] = ()
    cells: tuple[Cells, ...] = ()
    jacobians: Array = field(default_factory=lambda: np.zeros(0))
    cell_points: Array = field(default_factory=lambda: np.zeros((0, 0)))
    table: NDArray[np.int64] | None = None
    inside: NDArray[np.bool_] = field(default_factory=lambda: np.ones((0, 0), bool))
    reference: Vector = ()
    edges: Edges | None = None
    stencil: int = 0
    periodic: bool = True
    pairs: tuple[Array, ...] = ()
    stiffness: tuple[float, ...] = ()

    def interpolation(self, at: float) -> dict[int, float]:
        """Return the coefficients of the values at points in the value at a coordinate, by the index of the point."""
        distance = self.points - at
        if self.periodic:
            distance -= self.length * np.round(distance / self.length)
        if np.abs(distance).min() <= 1e-12 * self.length:
            return {int(np.abs(distance).argmin()): 1.0}
        if self.table is not None:
            raise SystemDefinitionError(
                f"the point Lagrangian at {self.name} = {at:g} is not at an unknown value of the mesh, but inside of "
                'an element or at an end with a prescribed value: use "spectral-elements", and a place off that end'
            )
        if self.pairs:
            angle, n = np.pi * distance / self.length, len(self.points)
            values = np.sin(n * angle) / (n * (np.sin(angle) if n % 2 else np.tan(angle)))
            return dict(enumerate(values.tolist()))
        near = np.sort(np.abs(distance).argsort(kind="stable")[: self.stencil]).tolist()
        return {k: float(np.prod([distance[j] / (distance[j] - distance[k]) for j in near if j != k])) for k in near}

    def differentiated(self, values: Array, along: int) -> Array:
        """Return the derivative at the points of values along one of their axes; see :meth:`MeshSystem.derivative`."""
        return self.from_elements(self.derivative(self.in_elements(values, along), along), along)

    @property
    def element_points(self) -> Array:
        """Coordinates of the points of all elements, (E (p + 1),), or of the points."""
        return self.points if self.table is None else self.cell_points.ravel()

    @property
    def element_weights(self) -> Array:
        """Quadrature weights at ``element_points``."""
        if self.table is None:
            return self.weights
        return np.outer(self.jacobians, [float(w) for w in self.quadrature]).ravel()

    def in_elements(self, values: Array, along: int, ends: Sequence[Array | None] = (None, None)) -> Array:
        """Return values at ``element_points``, those at ends are ``ends`` if prescribed, or 0."""
        if self.table is None:
            return values
        local = self._in_elements(np.moveaxis(values, along, -1))
        for end, prescribed in enumerate(ends):
            if prescribed is not None:
                local[..., -end, -end] = prescribed
        return np.moveaxis(local.reshape(*local.shape[:-2], -1), -1, along)

    def derivative(self, values: Array, along: int) -> Array:
        """Return the derivative at ``element_points`` of values there."""
        array = np.moveaxis(values, along, -1)
        if self.table is None:
            k = 2j * np.pi * np.fft.rfftfreq(len(self.points), self.length / len(self.points))
            result = np.fft.irfft(k * np.fft.rfft(array), len(self.points))
        else:
            matrix = np.array([[float(x) for x in row] for row in self.operators[1]])
            local = array.reshape(*array.shape[:-1], *self.table.shape) @ matrix.T
            result = (local / self.jacobians[:, None]).reshape(array.shape)
        return np.moveaxis(result, -1, along)

    def from_elements(self, values: Array, along: int) -> Array:
        """Return values at the points, of values at ``element_points``: at shared points means weighted by length."""
        if self.table is None:
            return values
        array = np.moveaxis(values, along, -1) * self.element_weights
        local = array.reshape(*array.shape[:-1], *self.table.shape)
        result = np.zeros((*array.shape[:-1], len(self.points)))
        for entry in range(self.table.shape[1]):  # a point occurs once in each column of the table
            elements = self.inside[:, entry]
            result[..., self.table[elements, entry]] += local[..., elements, entry]
        return np.moveaxis(result / self.weights, -1, along)

    def modes(self, values: Array) -> Array:
        """Return the squared amplitudes of all modes but the constant, (.., E, p), or (.., 1, N//2) of Fourier modes.

        Args:
            values: at the points along the last axis.
        """
        if self.table is None:
            return np.asarray(np.abs(np.fft.rfft(values)[..., None, 1:]) ** 2)
        points = np.array([float(x) for x in self.reference])
        to_modes = np.linalg.inv(np.polynomial.legendre.legvander(points, len(points) - 1))
        modes = np.einsum("ab,...eb->...ea", to_modes, self._in_elements(values))[..., 1:] ** 2
        return np.asarray(modes / (np.arange(1, len(points)) + 0.5))

    def _in_elements(self, array: Array) -> Array:
        """Return values at the points of each element, (..., E, p + 1); prescribed ones are 0."""
        assert self.table is not None
        return np.where(self.inside, array[..., self.table], 0.0)


def spectral_elements(
    name: str, breaks: Array, degree: int, fixed: tuple[bool, bool] | None, clamped: tuple[bool, bool]
) -> Axis:
    """Return an axis of elements of degree p on Gauss-Lobatto-Legendre points.

    Args:
        name: of the axis.
        breaks: (E + 1,) ascending ends of the elements.
        degree: p.
        fixed: whether the values at the left and right ends are prescribed; ``None`` for a periodic axis.
        clamped: whether the first derivatives vanish there.
    """
    p = point_count(degree, "the degree of the elements", least=1)
    rule = gauss_lobatto(p + 1)
    derivative = differentiation_matrix(rule.points)
    half = np.diff(breaks) / 2
    elements = len(half)
    offsets = np.array([float(1 + each) for each in rule.points])
    at = breaks[:-1, None] + half[:, None] * offsets
    places = np.arange(elements)[:, None] * p + np.arange(p + 1)
    count = elements * p + (fixed is not None)
    places %= count
    points, masses = np.zeros(count), np.zeros(count)
    points[places[:, ::-1]] = at[:, ::-1]
    points[places[0, 0]] = breaks[0]  # not the end of a periodic axis
    np.add.at(masses, places.ravel(), np.outer(half, np.array([float(each) for each in rule.weights])).ravel())
    left, right = fixed or (False, False)
    if count <= left + right:
        raise SystemDefinitionError(f"'{name}' has no points between its prescribed ends: use more elements")
    inside = slice(int(left), count - int(right))
    size, index = f"E{name}", f"e{name}"
    table = f"nodes_{name}"
    kinds = []
    if elements > left + right:
        loop = f"{index} in {size}" if not (left or right) else f"{index} in {int(left)}..{size}-{1 + int(right)}"
        kinds.append(
            Cells(loop, index, tuple(CellPoint(f"{table}[{index}, {b}]") for b in range(p + 1)), f"{table}[{index}")
        )
    if elements == 1 and left and right:
        kinds = [Cells("", "0", (CellPoint(None, 0), *(CellPoint(str(b)) for b in range(p - 1)), CellPoint(None, 1)))]
    else:
        if left:
            kinds.append(Cells("", "0", (CellPoint(None, 0), *(CellPoint(str(b)) for b in range(p)))))
        if right:
            last = tuple(CellPoint(f"N{name}-{p - b}") for b in range(p))
            kinds.append(Cells("", f"{size}-1", (*last, CellPoint(None, 1))))
    largest = _largest_quotient(rule.weights, derivative) / float(half.min()) ** 2
    return Axis(
        name=name,
        points=points[inside],
        weights=masses[inside],
        length=float(breaks[-1] - breaks[0]),
        periodic=fixed is None,
        quadrature=rule.weights,
        operators=(identity_matrix(p + 1), derivative, matrix_product(derivative, derivative)),
        stiffness=(largest, largest**2),
        edges=_edges(name, places, at, (rule.weights, derivative), fixed, clamped),
        cells=tuple(kinds),
        jacobians=half,
        cell_points=at,
        table=np.clip(places - int(left), 0, count - int(left) - int(right) - 1),
        inside=(places >= int(left)) & (places < count - int(right)),
        reference=rule.points,
    )


def _edges(
    name: str,
    places: NDArray[np.int64],
    at: Array,
    rule: tuple[Vector, Matrix],
    fixed: tuple[bool, bool] | None,
    clamped: tuple[bool, bool],
) -> Edges:
    """Return the ends of elements whose points have the positions ``places`` and the coordinates ``at``, (E, p + 1)."""
    weights = np.array([float(each) for each in rule[0]])
    derivative = np.array([[float(x) for x in row] for row in rule[1]])
    elements, size, half = len(places), places.shape[1], np.ptp(at, axis=1) / 2
    last, (left, right) = int(places.max()), fixed or (False, False)
    ends = np.arange(1 - clamped[0], elements + (fixed is None or clamped[1]))
    sides = np.stack([ends - 1, ends], axis=1)
    present = (sides >= 0) & ((sides < elements) | (fixed is None))
    sides = np.where(present, sides % elements, (sides % elements)[:, ::-1])
    table = places[sides]
    table[~present[:, 0], 0] = table[~present[:, 0], 0, ::-1]  # so that entry p is the edge in all rows
    table = table.reshape(-1, 2 * size)
    shares = np.where(present, half[sides] * weights[0], 0.0)
    whole = shares.sum(1, keepdims=True)
    by_end = ((table == 0) & left, (table == last) & right)
    prescribed, (lower, upper) = by_end[0] | by_end[1], (int(each.any(1).sum()) for each in by_end)
    loop = f"f{name} in {lower}..F{name}-{upper + 1}" if lower or upper else f"f{name} in F{name}"
    slots = tuple(CellPoint(f"edges_{name}[f{name}, {b}]") for b in range(2 * size))
    kinds = [] if prescribed.any(1).all() else [Cells(loop, f"f{name}", slots, edge=True)]
    for f in np.flatnonzero(prescribed.any(1)):
        single = zip(table[f].tolist(), prescribed[f].tolist(), strict=True)
        given = tuple(CellPoint(None, int(n > 0)) if end else CellPoint(str(n - left)) for n, end in single)
        kinds.append(Cells("", str(f), given, edge=True))
    stiffness = derivative.T @ (weights[:, None] * derivative)
    return Edges(
        cells=tuple(kinds),
        table=np.clip(table - left, 0, last - left - right),
        weights=whole[:, 0],
        points=np.where(present[:, 1], at[sides[:, 1], 0], at[sides[:, 0], -1]),
        rows={order: matrix[[-1, 0]] for order, matrix in ((1, derivative), (2, stiffness))},
        scales={1: shares / half[sides] / whole, 2: np.where(present, -1, 0) / half[sides] / whole},
    )


def differences(name: str, start: float, end: float, points: int, order: int, *, second: bool) -> Axis:
    """Return a periodic axis of equidistant points with staggered differences of order 2 m.

    By symmetry the coefficients of u and h^2 u_xx at the midpoint are even and exact for even polynomials of degree up
    to 2 m - 2, those of h u_x odd and exact for odd ones of degree up to 2 m - 1. ``second`` adds u_xx, with two points
    more.
    """
    if isinstance(order, bool) or order not in (2, 4, 6, 8):
        raise SystemDefinitionError(f"order= of finite differences is 2, 4, 6 or 8, not {order!r}")
    count = point_count_of(name, points, least=2 * order)
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
    h = (end - start) / count
    index = f"e{name}"
    places = tuple(CellPoint(index if k == 0 else f"{index}{k:+d}") for k in range(1 - m, m + 1))
    at: Array = start + h * np.arange(count, dtype=np.float64)
    return Axis(
        name=name,
        points=at,
        weights=np.full(count, h),
        length=end - start,
        stencil=order,
        quadrature=(mp.mpf(1),),
        operators=tuple((row,) for row in rows),
        cells=(Cells(f"{index} in N{name} periodic", index, places),),
        jacobians=np.full(count, h),
        cell_points=(at + h / 2)[:, None],
        stiffness=tuple(float(sum(map(abs, row))) ** 2 / h ** (2 * k) for k, row in enumerate(rows) if k),
    )


def fourier(name: str, start: float, end: float, points: int) -> Axis:
    """Return a periodic axis of equidistant points with the derivatives of the trigonometric interpolant.

    int u_x^2 dx = sum_k L k^2 |c_k|^2 over the discrete Fourier coefficients c_k is the quadratic form u . K u with a
    circulant K whose rows have the sum 0, so that it is -sum_(i<j) K_ij (u_i - u_j)^2; likewise u_xx with k^4.
    """
    count = point_count_of(name, points, least=3, most=4096)
    h = (end - start) / count
    k = 2 * np.pi * np.fft.fftfreq(count, h)
    distance = np.abs(np.arange(count)[:, None] - np.arange(count))
    rows = [np.fft.ifft(k ** (2 * power)).real * h for power in (1, 2)]
    return Axis(
        name=name,
        points=start + h * np.arange(count, dtype=np.float64),
        weights=np.full(count, h),
        length=end - start,
        pairs=tuple(-row[np.minimum(distance, count - distance)] for row in rows),
        stiffness=tuple(float(np.abs(k).max()) ** (2 * power) for power in (1, 2)),
    )


def point_count_of(axis: str, points: int, *, least: int, most: int = 10**9) -> int:
    """Return the validated number of points of an axis."""
    return checked_count(
        points, f"the number of points of '{axis}'", least=least, most=most, error=SystemDefinitionError
    )


def _largest_quotient(weights: Vector, derivative: Matrix) -> float:
    """Return the largest eigenvalue of D^T W D by W, for one element of half length 1."""
    roots = np.sqrt(np.array([float(each) for each in weights]))
    scaled = roots[:, None] * np.array([[float(x) for x in row] for row in derivative]) / roots
    return float(np.linalg.norm(scaled, 2)) ** 2


def same(values: Sequence[float] | Array) -> float | None:
    """Return the value that all entries have to 1e-14, or ``None``."""
    array = np.asarray(values, float)
    return float(array.flat[0]) if np.ptp(array) <= 1e-14 * np.abs(array).max() else None


def digits(value: Number) -> str:
    """Return a number with 25 digits, as text of a formula."""
    return str(mp.nstr(mp.mpf(value), 25)).removesuffix(".0")
