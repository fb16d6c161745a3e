"""Discretisations of one axis of space: points, quadrature weights, and values and derivatives within a cell.

A density T(u, u_x, x) is integrated cell by cell with the quadrature of the cell,

    int T dx = sum_e J_e sum_a w_a T(sum_b I_ab u_b, (1/J_e) sum_b D_ab u_b, x_ea),

where b runs over the points that the cell uses. Spectral elements of degree p have the Gauss-Lobatto-Legendre points as
points and quadrature, so that I is the identity and the mass matrix is diagonal (C. Canuto et al., Spectral Methods:
Fundamentals in Single Domains, Springer 2006, section 5.4). Differences: :mod:`scvi_codegen.fields.axes`.

Staggered finite differences of order 2 m: derivatives between two points, squared in the density.

They evaluate u, u_x and u_xx between two points from 2 m points (u_xx: 2 m + 2) (B. Fornberg, Math. Comp. 51 (1988),
699-706). At an end the rows Q = W D of u_x, the quadrature weights W between points and M at points satisfy

    sum_i Q_ci x_i^k = W_c k x_c^(k-1),    sum_c Q_ci x_c^k = -M_i k x_i^(k-1) - [i = 0] 0^k,    k = 0 .. m,

that is, D is exact for polynomials of degree m, and summation by parts holds for them (O. O'Reilly et al., J. Sci.
Comput. 2017, staggered operators). Of all solutions the one nearest to the interior coefficients is taken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.tables.basis import differentiation_matrix, identity_matrix, matrix_product
from scvi_codegen.tables.nodes import point_count
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.tables.quadrature import gauss_lobatto
from scvi_codegen.validation import checked_count

Array = NDArray[np.float64]

LEAST_TRANSFORMED = 32
"""Smallest even number of Fourier points that are transformed, half of the smallest odd one (measured)."""
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
        operators: in place of those of the axis.
        weight: factor of its quadrature weight.
    """

    loop: str
    index: str
    places: tuple[CellPoint, ...]
    rule: str | None = None
    interior: bool = False
    edge: bool = False
    operators: tuple[Matrix, ...] = ()
    weight: float = 1.0


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
class ClosedPoints:
    """All points of an axis, those with prescribed values included; of elements those of each in turn.

    Attributes:
        points, weights: (P,) coordinates and quadrature weights.
        positions, inside: (P,) positions among the unknown values, and whether the value is unknown.
        neighbours, rates: (P, s) points and coefficients of the derivative at each.
    """

    points: Array
    weights: Array
    positions: NDArray[np.int64]
    inside: NDArray[np.bool_]
    neighbours: NDArray[np.int64]
    rates: Array


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
        closed: all points of an axis with ends, those of each element in turn; ``None`` for equidistant periodic ones.
        reference: of elements, the points on [-1, 1].
        edges: of elements, their ends.
        stencil: number of points for the interpolation of values between equidistant points (differences).
        periodic: whether it has no ends.
        pairs: coefficients of the quadratic forms sum_(i<j) K_ij (u_i - u_j)^2/2 of int u_x^2/2 dx and int u_xx^2/2 dx
            (Fourier): (N, N) matrices K, or (N,) values c of K_ij = c[j-i] for fast Fourier transforms.
        rates: (N,) coefficients c of the derivative sum_j c[j-i] u_j (Fourier).
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
    closed: ClosedPoints | None = None
    reference: Vector = ()
    edges: Edges | None = None
    stencil: int = 0
    periodic: bool = True
    pairs: tuple[Array, ...] = ()
    rates: Array = field(default_factory=lambda: np.zeros(0))
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
        return dict(zip(near, lagrange(distance[near]).tolist(), strict=True))

    def differentiated(self, values: Array, along: int) -> Array:
        """Return the derivative at the points of values along one of their axes; see :meth:`MeshSystem.derivative`."""
        return self.from_elements(self.derivative(self.in_elements(values, along), along), along)

    def in_elements(self, values: Array, along: int, ends: Sequence[Array | None] = (None, None)) -> Array:
        """Return values at all points of elements, those at ends are ``ends`` if prescribed, or 0."""
        if self.closed is None:
            return values
        local = np.where(self.closed.inside, np.moveaxis(values, along, -1)[..., self.closed.positions], 0.0)
        for end, prescribed in enumerate(ends):
            if prescribed is not None:
                local[..., -end] = prescribed
        return np.moveaxis(local, -1, along)

    def derivative(self, values: Array, along: int) -> Array:
        """Return the derivative of values at all points of elements, there."""
        array = np.moveaxis(values, along, -1)
        if self.closed is None:
            k = 2j * np.pi * np.fft.rfftfreq(len(self.points), self.length / len(self.points))
            result = np.fft.irfft(k * np.fft.rfft(array), len(self.points))
        else:
            result = np.einsum("...ab,ab->...a", array[..., self.closed.neighbours], self.closed.rates)
        return np.moveaxis(result, -1, along)

    def from_elements(self, values: Array, along: int) -> Array:
        """Return values at the points, of values at those of all elements: at shared ones means weighted by length."""
        if self.closed is None:
            return values
        array, inside = np.moveaxis(values, along, -1) * self.closed.weights, self.closed.inside
        result = np.zeros((len(self.points), *array.shape[:-1]))
        np.add.at(result, self.closed.positions[inside], np.moveaxis(array[..., inside], -1, 0))
        return np.moveaxis(np.moveaxis(result, 0, -1) / self.weights, -1, along)

    def modes(self, values: Array) -> Array:
        """Return the squared amplitudes of all modes but the constant, (.., E, p), or (.., 1, N//2) of Fourier modes.

        Args:
            values: at the points along the last axis.
        """
        if self.table is None:
            if not self.periodic:  # sine series of what a straight line through the ends leaves
                steps = np.linspace(0, 1, values.shape[-1])
                values = values - values[..., :1] - steps * (values[..., -1:] - values[..., :1])
                values = np.concatenate([values, -values[..., -2:0:-1]], -1)
            return np.asarray(np.abs(np.fft.rfft(values)[..., None, 1:]) ** 2)
        points = np.array([float(x) for x in self.reference])
        to_modes = np.linalg.inv(np.polynomial.legendre.legvander(points, len(points) - 1))
        local = self.in_elements(values, -1).reshape(*values.shape[:-1], *self.table.shape)
        modes = np.einsum("ab,...eb->...ea", to_modes, local)[..., 1:] ** 2
        return np.asarray(modes / (np.arange(1, len(points)) + 0.5))


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
    nodes = f"nodes_{name}"
    kinds = []
    if elements > left + right:
        loop = f"{index} in {size}" if not (left or right) else f"{index} in {int(left)}..{size}-{1 + int(right)}"
        kinds.append(
            Cells(loop, index, tuple(CellPoint(f"{nodes}[{index}, {b}]") for b in range(p + 1)), f"{nodes}[{index}")
        )
    if elements == 1 and left and right:
        kinds = [Cells("", "0", (CellPoint(None, 0), *(CellPoint(str(b)) for b in range(p - 1)), CellPoint(None, 1)))]
    else:
        if left:
            kinds.append(Cells("", "0", (CellPoint(None, 0), *(CellPoint(str(b)) for b in range(p)))))
        if right:
            last = tuple(CellPoint(f"N{name}-{p - b}") for b in range(p))
            kinds.append(Cells("", f"{size}-1", (*last, CellPoint(None, 1))))
    table = np.clip(places - int(left), 0, count - int(left) - int(right) - 1)
    matrix = np.array([[float(x) for x in row] for row in derivative])
    roots = np.sqrt(np.array([float(each) for each in rule.weights]))
    largest = float(np.linalg.norm(roots[:, None] * matrix / roots, 2)) ** 2 / float(half.min()) ** 2
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
        table=table,
        closed=ClosedPoints(
            points=at.ravel(),
            weights=np.outer(half, [float(each) for each in rule.weights]).ravel(),
            positions=table.ravel(),
            inside=((places >= int(left)) & (places < count - int(right))).ravel(),
            neighbours=np.arange(places.size).reshape(places.shape).repeat(p + 1, axis=0),
            rates=np.vstack([matrix / length for length in half]),
        ),
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


def fourier(name: str, start: float, end: float, points: int, derivative: str | None = None) -> Axis:
    """Return a periodic axis of equidistant points with the derivatives of the trigonometric interpolant.

    int u_x^2 dx = sum_k L k^2 |c_k|^2 over the discrete Fourier coefficients c_k is the quadratic form u . K u with a
    circulant K whose rows have the sum 0, so that it is -sum_(i<j) K_ij (u_i - u_j)^2; likewise u_xx with k^4.

    Args:
        name, start, end: of the axis.
        points: their number.
        derivative: ``"fft"``, ``"dense"``, or ``None`` for fast Fourier transforms of many points.
    """
    if derivative not in (None, "fft", "dense"):
        raise SystemDefinitionError(f'derivative= of \'{name}\' is "fft" or "dense", not {derivative!r}')
    count = point_count_of(name, points, least=3, most=4096 if derivative == "dense" else 16384)
    transformed = count >= LEAST_TRANSFORMED * (1 + count % 2) if derivative is None else derivative == "fft"
    h = (end - start) / count
    k = 2 * np.pi * np.fft.fftfreq(count, h)
    distance = np.abs(np.arange(1 if transformed else count)[:, None] - np.arange(count))
    angle = np.pi * np.arange(1, (count + 1) // 2) / count
    signs = np.where(np.arange(1, (count + 1) // 2) % 2, np.pi, -np.pi) / (end - start)
    half = signs / (np.sin(angle) if count % 2 else np.tan(angle))  # Trefethen, Spectral Methods in MATLAB, chapter 3
    spectra = (np.fft.ifft(k.astype(np.longdouble) ** (2 * power)).real * h for power in (1, 2))
    rows = [each.astype(np.float64) for each in spectra]
    matrices = (-row[np.minimum(distance, count - distance)] for row in rows)
    return Axis(
        name=name,
        points=start + h * np.arange(count, dtype=np.float64),
        weights=np.full(count, h),
        length=end - start,
        pairs=tuple(each[0] if transformed else each for each in matrices),
        rates=np.concatenate([[0.0], half, np.zeros(1 - count % 2), -half[::-1]]),
        stiffness=tuple(float(np.abs(k).max()) ** (2 * power) for power in (1, 2)),
    )


def held_ends(boundary: Any) -> tuple[bool, bool] | None:
    """Return whether values are prescribed at the ends of an axis with this boundary; ``None`` if it is periodic."""
    return None if boundary == PERIODIC else (boundary[0] != NATURAL, boundary[1] != NATURAL)


def clamped_ends(boundary: Any, derivative: str) -> tuple[bool, bool]:
    """Return whether a derivative of this name is prescribed at the ends of an axis with this boundary."""
    held = held_ends(boundary) or (False, False)
    return held[0] and derivative in boundary[0], held[1] and derivative in boundary[1]


def point_count_of(axis: str, points: int, *, least: int, most: int = 10**9) -> int:
    """Return the validated number of points of an axis."""
    return checked_count(
        points, f"the number of points of '{axis}'", least=least, most=most, error=SystemDefinitionError
    )


def lagrange(distance: Array) -> Array:
    """Return the coefficients of the polynomial interpolant at a place with these distances from the points."""
    others = [(x, np.delete(distance, k)) for k, x in enumerate(distance)]
    return np.array([np.prod(each / (each - x)) for x, each in others])


def same(values: Sequence[float] | Array) -> float | None:
    """Return the value that all entries have to 1e-14, or ``None``."""
    array = np.asarray(values, float)
    return float(array.flat[0]) if np.ptp(array) <= 1e-14 * np.abs(array).max() else None


def digits(value: Number) -> str:
    """Return a number with 25 digits, as text of a formula."""
    return str(mp.nstr(mp.mpf(value), 25)).removesuffix(".0")


def differences(
    name: str, bounds: tuple[float, float], points: int, order: int, fixed: tuple[bool, bool] | None, *, second: bool
) -> Axis:
    """Return an axis of equidistant points with staggered differences of order 2 m.

    Args:
        name, bounds: of the axis.
        points: their number, ends included.
        order: 2 m.
        fixed: whether the values at the left and right ends are prescribed; ``None`` for a periodic axis.
        second: whether the density contains u_xx, for which two points more are used.
    """
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
    at: Array = bounds[0] + h * np.arange(count, dtype=np.float64)
    rows = _coefficients([mp.mpf(2 * k + 1) / 2 for k in range(-m, m)], 2 + second)
    stiffness = [float(sum(map(abs, row))) ** 2 / h ** (2 * k) for k, row in enumerate(rows)]
    places = tuple(CellPoint(index if k == 0 else f"{index}{k:+d}") for k in range(1 - m, m + 1))
    cells = [Cells(f"{index} in N{name} periodic", index, places)]
    masses, inner, closed = np.full(count, h), slice(None), None
    if fixed is not None:
        end_rows, midpoints, ends, largest = _end_rows(np.array([float(x) for x in rows[1]]))
        masses[: len(ends)], masses[-len(ends) :] = h * ends, h * ends[::-1]
        left, right = map(int, fixed)
        within = f"{index} in {order - left}..N{name}-{order + 2 - right}"  # the unknown to the left of each cell
        cells = [Cells(within, f"{index}+1" if left else index, places), *_end_cells(name, end_rows, midpoints, fixed)]
        inner = slice(left, count - right)
        closed = _closed(at, masses, order, inner)
        stiffness[1] = max(stiffness[1], largest / h**2)
    return Axis(
        name=name,
        points=at[inner],
        weights=masses[inner],
        length=bounds[1] - bounds[0],
        stencil=order,
        periodic=fixed is None,
        quadrature=(mp.mpf(1),),
        operators=tuple((row,) for row in rows),
        cells=tuple(cells),
        jacobians=np.full(cell_count, h),
        cell_points=(at[:cell_count] + h / 2)[:, None],
        closed=closed,
        stiffness=tuple(stiffness[1:]),
    )


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
                CellPoint(None, end)
                if prescribed and i == 0
                else CellPoint(str(i - prescribed) if end == 0 else f"N{name}-{i + 1 - prescribed}")
                for i in range(rows.shape[1])
            ]
            operators = tuple((tuple(map(mp.mpf, each)),) for each in (value, -row if end else row))
            index = str(c) if end == 0 else f"E{name}-{c + 1}"
            result.append(Cells("", index, tuple(places), operators=operators, weight=float(weights[c])))
    return result


def _closed(points: Array, masses: Array, order: int, inner: slice) -> ClosedPoints:
    count = len(points)
    first = np.clip(np.arange(count) - order // 2, 0, count - order - 1)
    neighbours: NDArray[np.int64] = first[:, None] + np.arange(order + 1)
    rates = [
        np.array(_coefficients([mp.mpf(k - at) for k in range(order + 1)], 2)[1], float) / (points[1] - points[0])
        for at in range(order + 1)
    ]
    return ClosedPoints(
        points=points,
        weights=masses,
        positions=np.clip(np.arange(count) - inner.start, 0, inner.stop - inner.start - 1),
        inside=np.isin(np.arange(count), np.arange(count)[inner]),
        neighbours=neighbours,
        rates=np.array([rates[offset] for offset in np.arange(count) - first]),
    )
