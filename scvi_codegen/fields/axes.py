"""Axes of space: points, quadrature weights, and values and derivatives within a cell or between pairs of points.

A density T(u, u_x, x) is integrated cell by cell with the quadrature of the cell,

    int T dx = sum_e J_e sum_a w_a T(sum_b I_ab u_b, (1/J_e) sum_b D_ab u_b, x_ea),

where b runs over the points that the cell uses. Discretisations are subclasses of :class:`Axis`:
:mod:`~scvi_codegen.fields.elements`, :mod:`~scvi_codegen.fields.differences`, :mod:`~scvi_codegen.fields.fourier`.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Rational

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.indices import Loop, Place, Size
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.validation import checked_count

Array = NDArray[np.float64]
PERIODIC = "periodic"
NATURAL = "natural"


@dataclass(frozen=True, slots=True)
class Cells:
    """Cells of one kind.

    Attributes:
        loop: over them; ``None`` for a single cell.
        index: index of the cell.
        places: of the points that a cell uses; a whole number is the end, 0 or 1, whose value is prescribed.
        table: name of the table whose row contains all of these points, else "".
        interior: whether the ends of elements have no weight, because they are edges.
        edge: whether it is an end of two elements, whose points follow each other.
        operators: in place of those of the axis.
        weight: factor of its quadrature weight.
    """

    loop: Loop | None
    index: Place
    places: tuple[Place | int, ...]
    table: str = ""
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
    quadrature: Vector = ()
    operators: tuple[Matrix, ...] = ()
    cells: tuple[Cells, ...] = ()
    jacobians: Array = field(default_factory=lambda: np.zeros(0))
    cell_points: Array = field(default_factory=lambda: np.zeros((0, 0)))
    table: NDArray[np.int64] | None = None
    closed: ClosedPoints | None = None
    edges: Edges | None = None
    periodic: bool = True
    pairs: tuple[Array, ...] = ()
    rates: Array = field(default_factory=lambda: np.zeros(0))
    stiffness: tuple[float, ...] = ()

    @abstractmethod
    def between(self, place: float, distance: Array) -> dict[int, float]:
        """Return the coefficients of :meth:`interpolation` at a coordinate with these distances from all points."""

    def modes(self, values: Array) -> Array:
        """Return the squared amplitudes of all modes but the constant, (.., E, p), or (.., 1, N//2) of Fourier modes.

        Args:
            values: at the points along the last axis.
        """
        return np.asarray(np.abs(np.fft.rfft(values)[..., None, 1:]) ** 2)

    def interpolation(self, place: float) -> dict[int, float]:
        """Return the coefficients of the values at points in the value at a coordinate, by the index of the point."""
        distance = self.points - place
        if self.periodic:
            distance -= self.length * np.round(distance / self.length)
        if np.abs(distance).min() <= 1e-12 * self.length:
            return {int(np.abs(distance).argmin()): 1.0}
        return self.between(place, distance)

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


def span(index: str, size: str, first: int = 0, last: int = 0, *, periodic: bool = False) -> Loop:
    """Return the loop of an index from ``first`` to ``size - 1 - last``."""
    return Loop(index=index, first=Size("", first), end=Size(size, -last), periodic=periodic)


def fixed_place(number: int, size: str = "") -> Place:
    """Return the index ``number`` or ``size + number``."""
    return Place(base=Size(size, number))


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


def rational(value: Number) -> Expr:
    """Return a number rounded to 25 digits."""
    return Rational(mp.nstr(mp.mpf(value), 25))
