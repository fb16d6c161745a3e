"""Axes of space: points, quadrature weights, and values and derivatives within a cell or between pairs of points.

A density T(u, u_x, x) is integrated cell by cell with the quadrature of the cell,

    int T dx = sum_e J_e sum_a w_a T(sum_b I_ab u_b, (1/J_e) sum_b D_ab u_b, x_ea),

where b runs over the points that the cell uses. Discretisations are subclasses of :class:`Axis`.

**Spectral elements** of degree p have the Gauss-Lobatto-Legendre points as points and quadrature, so that I is the
identity and the mass matrix is diagonal (C. Canuto et al., Spectral Methods: Fundamentals in Single Domains, Springer
2006, section 5.4).

**Staggered finite differences** of order 2 m, which are squared in the density, evaluate u, u_x and u_xx between two
points from 2 m points (u_xx: 2 m + 2) (B. Fornberg, Math. Comp. 51 (1988), 699-706). At an end
the rows Q = W D of u_x, the quadrature weights W between points and M at points satisfy

    sum_i Q_ci x_i^k = W_c k x_c^(k-1),    sum_c Q_ci x_c^k = -M_i k x_i^(k-1) - [i = 0] 0^k,    k = 0 .. m,

that is, D is exact for polynomials of degree m, and summation by parts holds for them (O. O'Reilly et al., J. Sci.
Comput. 2017, staggered operators). Of all solutions the one nearest to the interior coefficients is taken.

**Fourier modes**: on a periodic axis of equidistant points, with the derivatives of the trigonometric interpolant,
int u_x^2 dx = sum_k L k^2 |c_k|^2 over the discrete Fourier coefficients c_k is the quadratic form u . K u with a
circulant K whose rows have the sum 0, so that it is -sum_(i<j) K_ij (u_i - u_j)^2; likewise u_xx with k^4.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Rational

from scvi_codegen.api.checks import checked_count
from scvi_codegen.api.formulas import Array as Indexed
from scvi_codegen.api.formulas import Number, mp, symbol
from scvi_codegen.common.errors import MethodError, SystemDefinitionError
from scvi_codegen.extras.fields.density import Density
from scvi_codegen.methods.tables.quadrature import Quadrature, gauss_lobatto

Array = NDArray[np.float64]
INWARD = 1e-6
"""Distance of coordinates slightly inside of an element from its ends, relative to half of its length."""
PERIODIC = "periodic"
NATURAL = "natural"


@dataclass(frozen=True, slots=True)
class Cells:
    """Cells of one kind.

    Attributes:
        loop: over them; ``None`` for a single cell.
        index: index of the cell.
        places: of the points that a cell uses; a whole number is the end, 0 or 1, whose value is prescribed.
        table: name of the table whose row contains all of these points, if there is one.
        interior: whether the ends of elements have no weight, because they are edges.
        edge: whether it is an end of two elements, whose points follow each other.
        operators: in place of those of the axis.
        weight: factor of its quadrature weight.
    """

    loop: Any
    index: Any
    places: tuple[Any, ...]
    table: str | None = None
    interior: bool = False
    edge: bool = False
    operators: tuple[tuple[tuple[Number, ...], ...], ...] = ()
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
        sides, shares: (2, F) coordinates slightly inside of the elements to the left and to the right, and the parts of
            the weights that belong to these.
        rows: by order of the derivative, (2, p + 1) coefficients to the left and to the right.
        scales: by order, (F, 2) factors of both sides.
    """

    cells: tuple[Cells, ...]
    table: NDArray[np.int64]
    weights: Array
    points: Array
    sides: Array
    shares: Array
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
class OneSided:
    """Coordinates slightly inside of elements, at which functions that jump at ends of elements are evaluated.

    Attributes:
        cells: (E, p + 1) of the points of each element.
        points: (2, N) of the points within the element to the left and to the right; equal inside of elements.
        weights: (2, N) quadrature weights of both elements at the points; that to the right is 0 inside of elements.
    """

    cells: Array
    points: Array
    weights: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis(ABC):
    """Discretised axis. Derivatives in densities are those of its cells or, without cells, those of its pairs.

    Attributes:
        name: its name.
        points, weights: (N,) of the points with unknown values, and the quadrature weights there.
        length: of the axis.
        quadrature: weights w_a on the cell, whose half length (differences: length) is J.
        operators: matrices I, D and, for differences, that of the second derivative, by order of the derivative.
        cells: kinds of cells.
        jacobians, cell_points: (E,) and (E, a): J_e and x_ea.
        table: (E, b) positions of the points, which are those of the quadrature, or ``None`` if cells name their
            points without a table.
        closed: all points of an axis with ends, those of each element in turn; ``None`` for equidistant periodic ones.
        edges: of elements, their ends.
        one_sided: of elements, coordinates within each; ``None`` without elements.
        periodic: whether it has no ends.
        pairs: coefficients of the quadratic forms sum_(i<j) K_ij (u_i - u_j)^2/2 of int u_x^2/2 dx and int u_xx^2/2 dx:
            (N, N) matrices K, or (N,) values c of K_ij = c[j-i] for fast Fourier transforms.
        rates: (N,) coefficients c of the derivative sum_j c[j-i] u_j, with ``pairs``.
        stiffness: upper bounds of int u_x^2 dx and int u_xx^2 dx by sum_i weights_i u_i^2.
    """

    name: str
    points: Array
    weights: Array
    length: float
    quadrature: tuple[Number, ...] = ()
    operators: tuple[tuple[tuple[Number, ...], ...], ...] = ()
    cells: tuple[Cells, ...] = ()
    jacobians: Array = field(default_factory=lambda: np.zeros(0))
    cell_points: Array = field(default_factory=lambda: np.zeros((0, 0)))
    table: NDArray[np.int64] | None = None
    closed: ClosedPoints | None = None
    edges: Edges | None = None
    one_sided: OneSided | None = None
    periodic: bool = True
    pairs: tuple[Array, ...] = ()
    rates: Array = field(default_factory=lambda: np.zeros(0))
    stiffness: tuple[float, ...] = ()

    @abstractmethod
    def between(self, place: float, distance: Array) -> dict[int, float]:
        """Return the coefficients of :meth:`interpolation` at a coordinate with these distances from all points."""

    def modes(self, values: Array) -> Array:
        """Return the squared amplitudes of all modes but the constant, (.., E, p), or (.., 1, N//2) of Fourier."""
        return np.asarray(np.abs(np.fft.rfft(values)[..., None, 1:]) ** 2)

    def interpolation(self, place: float) -> dict[int, float]:
        """Return the coefficients of the values at points in the value at a coordinate, by the index of the point."""
        distance = self.points - place
        if self.periodic:
            distance -= self.length * np.round(distance / self.length)
        if np.abs(distance).min() <= 1e-12 * self.length:
            return {int(np.abs(distance).argmin()): 1.0}
        return self.between(place, distance)

    def differentiated(self, values: Array, along: int, ends: Sequence[Array | None] = (None, None)) -> Array:
        """Return the derivative at the points of values along one of their axes; see :meth:`MeshSystem.derivative`."""
        return self.from_elements(self.derivative(self.in_elements(values, along, ends), along), along)

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


def span(index: str, size: str, first: int = 0, last: int = 0, *, periodic: bool = False) -> Any:
    """Return the loop of an index from ``first`` to ``size - 1 - last``."""
    return Indexed.loop(index=index, first=Indexed.size("", first), end=Indexed.size(size, -last), periodic=periodic)


def fixed_place(number: int, size: str = "") -> Any:
    """Return the index ``number`` or ``size + number``."""
    return Indexed.place(base=Indexed.size(size, number))


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
    # l_k = prod_(j != k) (x - x_j)/(x_k - x_j) (Lagrange).
    others = [(x, np.delete(distance, k)) for k, x in enumerate(distance)]
    return np.array([np.prod(rest / (rest - x)) for x, rest in others])


def same(values: Sequence[float] | Array) -> float | None:
    """Return the value that all entries have to 1e-14, or ``None``."""
    array = np.asarray(values, float)
    return float(array.flat[0]) if np.ptp(array) <= 1e-14 * np.abs(array).max() else None


def rational(value: Number) -> Expr:
    """Return a number rounded to 25 digits."""
    return Rational(mp.nstr(mp.mpf(value), 25))


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralElements(Axis):
    """Elements between ascending ends, with the points ``reference`` on [-1, 1]."""

    reference: tuple[Number, ...]

    @staticmethod
    def rule(count: int) -> Quadrature:
        """Return the points of an element, with both ends, and the quadrature."""
        return gauss_lobatto(count)

    @classmethod
    def of(cls, system: Density, name: str, *, degree: int, elements: Any) -> SpectralElements:
        """Return the axis of a density.

        Args:
            system, name: the density, and the axis.
            degree: p.
            elements: number of equal elements, which are divided at places of point Lagrangians, or their ends.
        """
        places = [place[name] for place, _ in system.point_lagrangians]
        return cls.between_ends(system, name, _breaks(name, *system.space[name], elements, places), degree)

    @classmethod
    def one(cls, system: Density, name: str, *, degree: int) -> SpectralElements:
        """Return the axis of a density as one element of this degree."""
        return cls.between_ends(system, name, np.array(system.space[name]), degree)

    @classmethod
    def between_ends(cls, system: Density, name: str, breaks: Array, degree: int) -> SpectralElements:
        """Return the axis of a density with (E + 1,) ascending ends of the elements."""
        fixed = held_ends(system.boundary[name])
        clamped = clamped_ends(system.boundary[name], f"{system.fields[0]}_{name}")
        p = checked_count(degree, "the degree of the elements", least=1, error=MethodError)
        rule = cls.rule(p + 1)
        derivative = differentiation(rule.points)
        identity = tuple(tuple(mp.mpf(int(i == j)) for j in range(p + 1)) for i in range(p + 1))
        twice = tuple(tuple(mp.fdot(row, column) for column in zip(*derivative, strict=True)) for row in derivative)
        half = np.diff(breaks) / 2
        elements = len(half)
        offsets = np.array([float(1 + point) for point in rule.points])
        local = breaks[:-1, None] + half[:, None] * offsets
        inner = breaks[:-1, None] + half[:, None] * (1.0 + (1.0 - INWARD) * (offsets - 1.0))
        count = elements * p + (fixed is not None)
        left, right = map(int, fixed or (False, False))
        if count <= left + right:
            raise SystemDefinitionError(f"'{name}' has no points between its prescribed ends: use more elements")
        # The last point of an element is the first of the next, on a periodic axis that of the first element.
        places = (np.arange(elements)[:, None] * p + np.arange(p + 1)) % count
        unknown = slice(left, count - right)
        table = np.clip(places - left, 0, count - left - right - 1)
        points, masses = np.zeros(count), np.zeros(count)
        points[places[:, ::-1]] = local[:, ::-1]
        points[places[0, 0]] = breaks[0]  # not the end of a periodic axis
        weights = np.array([float(weight) for weight in rule.weights])
        quadrature = np.outer(half, weights)
        np.add.at(masses, places.ravel(), quadrature.ravel())
        matrix = np.array([[float(x) for x in row] for row in derivative])
        largest = _largest_stiffness(matrix, weights) / float(half.min()) ** 2
        return cls(
            name=name,
            points=points[unknown],
            weights=masses[unknown],
            length=float(breaks[-1] - breaks[0]),
            periodic=fixed is None,
            quadrature=rule.weights,
            operators=(identity, derivative, twice),
            stiffness=(largest, largest**2),
            edges=_edges(name, places, (local, inner), (weights, matrix), fixed, clamped),
            one_sided=_one_sided(inner, quadrature, places, unknown),
            cells=_element_cells(name, elements, p, left=left, right=right),
            jacobians=half,
            cell_points=local,
            table=table,
            closed=ClosedPoints(
                points=local.ravel(),
                weights=quadrature.ravel(),
                positions=table.ravel(),
                inside=((places >= left) & (places < count - right)).ravel(),
                neighbours=np.arange(places.size).reshape(places.shape).repeat(p + 1, axis=0),
                rates=np.vstack([matrix / length for length in half]),
            ),
            reference=rule.points,
        )

    def between(self, place: float, distance: Array) -> dict[int, float]:
        """See :meth:`Axis.between`: none within elements, which end at the places of point Lagrangians."""
        raise SystemDefinitionError(
            f"the point Lagrangian at {self.name} = {place:g} is not at an unknown value of the mesh, but inside of "
            'an element or at an end with a prescribed value: use "spectral-elements", and a place off that end'
        )

    def modes(self, values: Array) -> Array:
        """See :meth:`Axis.modes`: Legendre polynomials on each element."""
        assert self.table is not None
        # u = sum_k c_k P_k on an element, and the integral of P_k^2 is 2/(2 k + 1) = 1/(k + 1/2).
        points = np.array([float(x) for x in self.reference])
        to_modes = np.linalg.inv(np.polynomial.legendre.legvander(points, len(points) - 1))
        local = self.in_elements(values, -1).reshape(*values.shape[:-1], *self.table.shape)
        modes = np.einsum("ab,...eb->...ea", to_modes, local)[..., 1:] ** 2
        return np.asarray(modes / (np.arange(1, len(points)) + 0.5))


def _largest_stiffness(derivative: Array, weights: Array) -> float:
    """Return the largest eigenvalue of D^T W D relative to W, the squared norm of W^(1/2) D W^(-1/2)."""
    roots = np.sqrt(weights)
    return float(np.linalg.norm(roots[:, None] * derivative / roots, 2)) ** 2


def _element_cells(name: str, elements: int, degree: int, *, left: int, right: int) -> tuple[Cells, ...]:
    """Return the kinds of elements: those whose values are all unknown, and those at prescribed ends, 0 or 1 each."""
    size, index, nodes = f"E{name}", f"e{name}", f"nodes_{name}"
    if elements == 1 and left and right:
        inside = (fixed_place(b) for b in range(degree - 1))
        return (Cells(None, fixed_place(0), (0, *inside, 1)),)
    kinds = []
    if elements > left + right:
        unknown = tuple(Indexed.place(index=index, table=nodes, column=b) for b in range(degree + 1))
        kinds.append(Cells(span(index, size, left, right), Indexed.place(index=index), unknown, nodes))
    if left:
        kinds.append(Cells(None, fixed_place(0), (0, *(fixed_place(b) for b in range(degree)))))
    if right:
        last = (fixed_place(b - degree, f"N{name}") for b in range(degree))
        kinds.append(Cells(None, fixed_place(-1, size), (*last, 1)))
    return tuple(kinds)


def _one_sided(inner: Array, quadrature: Array, places: NDArray[np.int64], inside: slice) -> OneSided:
    """Return the coordinates ``inner`` (E, p + 1) and weights of elements by point, on both sides of ends."""
    points, weights = np.zeros((2, 2, places.max() + 1))
    points[:, places[:, :-1]], points[0, places[:, -1]] = inner[:, :-1], inner[:, -1]
    weights[0, places[:, 1:]], weights[1, places[:, 0]] = quadrature[:, 1:], quadrature[:, 0]
    return OneSided(cells=inner, points=points[:, inside], weights=weights[:, inside])


def _breaks(axis: str, start: float, end: float, elements: Any, places: Sequence[float]) -> Any:
    """Return the ends of the elements, including the places, at which equal elements are divided."""
    if np.ndim(elements) == 0:
        argument = f"elements= of '{axis}' (a number of elements or their ends)"
        count = checked_count(elements, argument, least=1, error=SystemDefinitionError)
        ends = np.unique([start, *places, end])
        numbers = np.ceil(np.diff(ends) / (end - start) * count - 1e-9).astype(int)
        parts = [np.linspace(a, b, n + 1) for a, b, n in zip(ends[:-1], ends[1:], numbers, strict=True)]
        return np.unique(np.concatenate(parts))
    breaks = np.asarray(elements, float)
    ascend = breaks.ndim == 1 and len(breaks) > 1 and (np.diff(breaks) > 0).all()
    if not ascend or (breaks[0], breaks[-1]) != (start, end):
        raise SystemDefinitionError(f"the ends of the elements of '{axis}' must ascend from {start:g} to {end:g}")
    return np.union1d(breaks, places)


def _edges(
    name: str,
    places: NDArray[np.int64],
    coordinates: tuple[Array, Array],
    rule: tuple[Array, Array],
    fixed: tuple[bool, bool] | None,
    clamped: tuple[bool, bool],
) -> Edges:
    """Return the ends of elements.

    ``places`` and ``coordinates``, (E, p + 1), are those of the points, and coordinates slightly inside of elements;
    ``rule`` are the weights of an element of half length 1 and its derivative.
    """
    (local, inner), (weights, derivative) = coordinates, rule
    elements, size, half = len(places), places.shape[1], np.ptp(local, axis=1) / 2
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
    prescribed = by_end[0] | by_end[1]
    lower, upper = (int(at_end.any(1).sum()) for at_end in by_end)
    index = f"f{name}"
    slots = tuple(Indexed.place(index=index, table=f"edges_{name}", column=b) for b in range(2 * size))
    loop = span(index, f"F{name}", lower, upper)
    kinds = [] if prescribed.any(1).all() else [Cells(loop, Indexed.place(index=index), slots, edge=True)]
    for f in np.flatnonzero(prescribed.any(1)):
        single = zip(table[f].tolist(), prescribed[f].tolist(), strict=True)
        points = tuple(int(n > 0) if end else fixed_place(n - left) for n, end in single)
        kinds.append(Cells(None, fixed_place(int(f)), points, edge=True))
    stiffness = derivative.T @ (weights[:, None] * derivative)
    left_of, right_of = inner[sides[:, 0], -1], inner[sides[:, 1], 0]
    return Edges(
        cells=tuple(kinds),
        table=np.clip(table - left, 0, last - left - right),
        weights=whole[:, 0],
        points=np.where(present[:, 1], local[sides[:, 1], 0], local[sides[:, 0], -1]),
        sides=np.stack([np.where(present[:, 0], left_of, right_of), np.where(present[:, 1], right_of, left_of)]),
        shares=(shares / whole).T,
        rows={order: matrix[[-1, 0]] for order, matrix in ((1, derivative), (2, stiffness))},
        scales={1: shares / half[sides] / whole, 2: np.where(present, -1, 0) / half[sides] / whole},
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class FiniteDifferences(Axis):
    """Equidistant points, ``stencil`` of them for the interpolation of values between points."""

    stencil: int

    @classmethod
    def of(cls, system: Density, name: str, *, order: int, points: int) -> FiniteDifferences:
        """Return the axis of a density, differences of order 2 m at points with both ends; two more for u_xx."""
        second = any(
            orders.get(name) == 2 and symbol(derivative) in system.density.free_symbols
            for derivative, (_, orders) in system.derivatives.items()
        )
        bounds, fixed = system.space[name], held_ends(system.boundary[name])
        if isinstance(order, bool) or order not in (2, 4, 6, 8):
            raise SystemDefinitionError(f"order= of finite differences is 2, 4, 6 or 8, not {order!r}")
        if second and fixed is not None:
            raise SystemDefinitionError(
                f"'finite-differences' of second derivatives need a periodic axis, and '{name}' has ends: use "
                '"spectral-elements"'
            )
        count = point_count_of(name, points, least=(2 if fixed is None else 3) * order)
        index = f"e{name}"
        cell_count = count - (fixed is not None)
        # u, u_x and u_xx at midpoints of cells from 2 m points, by Taylor's formula.
        m, h = order // 2 + second, (bounds[1] - bounds[0]) / cell_count
        nodes: Array = bounds[0] + h * np.arange(count, dtype=np.float64)
        rows = _coefficients([mp.mpf(2 * k + 1) / 2 for k in range(-m, m)], 2 + second)
        stiffness = [float(sum(map(abs, row))) ** 2 / h ** (2 * k) for k, row in enumerate(rows)]
        places = tuple(Indexed.place(index=index, base=Indexed.size("", k)) for k in range(1 - m, m + 1))
        cells = [Cells(span(index, f"N{name}", periodic=True), Indexed.place(index=index), places)]
        masses, inner, closed = np.full(count, h), slice(None), None
        if fixed is not None:
            end_rows, midpoints, ends, largest = _end_rows(np.array([float(x) for x in rows[1]]))
            masses[: len(ends)], masses[-len(ends) :] = h * ends, h * ends[::-1]
            left, right = map(int, fixed)
            within = span(index, f"N{name}", order - left, order + 1 - right)  # the unknown to the left of each cell
            inner_cells = Cells(within, Indexed.place(index=index, base=Indexed.size("", left)), places)
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


def differentiation(points: Sequence[Number]) -> tuple[tuple[Number, ...], ...]:
    """Return the derivatives l_j'(x_i) of the cardinal functions on points, in 60 digits."""
    with mp.workdps(mp.dps + 20 + len(points)):
        rows = [_coefficients([x - point for x in points], 2)[1] for point in points]
    return tuple(tuple(+x for x in row) for row in rows)


def _coefficients(offsets: Sequence[Number], count: int) -> list[tuple[Number, ...]]:
    """Return the coefficients of derivatives of order 0, 1, .. at 0 of the interpolant of values at offsets."""
    # sum_i c_i x_i^r = k! [r = k]: exact for all polynomials up to the degree of the interpolant.
    powers = mp.matrix([[x**r for x in offsets] for r in range(len(offsets))])
    moments = ([mp.factorial(k) * (r == k) for r in range(len(offsets))] for k in range(count))
    return [tuple(mp.lu_solve(powers, mp.matrix(moment))) for moment in moments]


def _end_rows(row: Array) -> tuple[Array, Array, Array, float]:
    """Return, for h = 1, D of the first 2 m midpoints, the weights W and M, and a bound of D^T W D by M (one end)."""
    m = len(row) // 2
    size, width = 2 * m, 3 * m
    interior = np.zeros((4 * width, 4 * width + m))
    for c in range(m - 1, 4 * width):
        interior[c, c - m + 1 : c + m + 1] = row
    unknown, blocks, right = size * width, [], []
    x, y = np.arange(width + 0.0), np.arange(4 * width) + 0.5
    # The equations of Q = W D, W and M for k = 0 .. m of the module's docstring.
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
            at_left = [fixed_place(i - prescribed) for i in range(rows.shape[1])]
            at_right = [fixed_place(prescribed - i - 1, f"N{name}") for i in range(rows.shape[1])]
            places: list[Any] = [*(at_right if end else at_left)]
            if prescribed:
                places[0] = end
            operators = tuple((tuple(map(mp.mpf, coefficients)),) for coefficients in (value, -row if end else row))
            index = fixed_place(c) if end == 0 else fixed_place(-c - 1, f"E{name}")
            result.append(Cells(None, index, tuple(places), operators=operators, weight=float(weights[c])))
    return result


def _closed(points: Array, masses: Array, order: int, inner: slice) -> ClosedPoints:
    """Return all points of equidistant ones with ends; derivatives by the nearest ``order`` + 1 points."""
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


LEAST_TRANSFORMED = 32
"""Smallest even number of Fourier points that are transformed, half of the smallest odd one (measured)."""


class Fourier(Axis):
    """Periodic axis of equidistant points."""

    __slots__ = ()

    @classmethod
    def of(cls, system: Density, name: str, *, points: int, derivative: str | None = None) -> Fourier:
        """Return the axis of a density; ``derivative``: ``"fft"``, ``"dense"``, or ``None`` for the faster of both."""
        if system.boundary[name] != PERIODIC:
            raise SystemDefinitionError(
                f"'fourier' needs a periodic axis, and '{name}' has ends: use \"spectral-elements\" or "
                '"finite-differences"'
            )
        start, end = system.space[name]
        if derivative not in (None, "fft", "dense"):
            raise SystemDefinitionError(f'derivative= of \'{name}\' is "fft" or "dense", not {derivative!r}')
        count = point_count_of(name, points, least=3, most=4096 if derivative == "dense" else 16384)
        transformed = count >= LEAST_TRANSFORMED * (1 + count % 2) if derivative is None else derivative == "fft"
        h = (end - start) / count
        k = 2 * np.pi * np.fft.fftfreq(count, h)
        distance = np.abs(np.arange(1 if transformed else count)[:, None] - np.arange(count))
        angle = np.pi * np.arange(1, (count + 1) // 2) / count
        signs = np.where(np.arange(1, (count + 1) // 2) % 2, np.pi, -np.pi) / (end - start)
        # (-1)^j pi/L / sin(pi j/n), of even n / tan(..) (L. N. Trefethen, Spectral Methods in MATLAB, 2000, chapter 3).
        half = signs / (np.sin(angle) if count % 2 else np.tan(angle))
        spectra = (np.fft.ifft(k.astype(np.longdouble) ** (2 * power)).real * h for power in (1, 2))
        rows = [spectrum.astype(np.float64) for spectrum in spectra]
        matrices = (-row[np.minimum(distance, count - distance)] for row in rows)
        return cls(
            name=name,
            points=start + h * np.arange(count, dtype=np.float64),
            weights=np.full(count, h),
            length=end - start,
            pairs=tuple(matrix[0] if transformed else matrix for matrix in matrices),
            rates=np.concatenate([[0.0], half, np.zeros(1 - count % 2), -half[::-1]]),
            stiffness=tuple(float(np.abs(k).max()) ** (2 * power) for power in (1, 2)),
        )

    def between(self, place: float, distance: Array) -> dict[int, float]:
        """See :meth:`Axis.between`: trigonometric interpolation."""
        angle, n = np.pi * distance / self.length, len(self.points)
        values = np.sin(n * angle) / (n * (np.sin(angle) if n % 2 else np.tan(angle)))
        return dict(enumerate(values.tolist()))
