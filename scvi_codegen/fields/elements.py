"""Spectral elements of degree p.

They have the Gauss-Lobatto-Legendre points as points and quadrature, so that I is the identity and the mass matrix is
diagonal (C. Canuto et al., Spectral Methods: Fundamentals in Single Domains, Springer 2006, section 5.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.fields.axes import Array, Axis, Cells, ClosedPoints, Edges, clamped_ends, fixed_place, held_ends, span
from scvi_codegen.fields.density import Density
from scvi_codegen.indices import Place
from scvi_codegen.tables.basis import differentiation_matrix, identity_matrix, matrix_product
from scvi_codegen.tables.nodes import point_count
from scvi_codegen.tables.precision import Matrix, Vector
from scvi_codegen.tables.quadrature import Quadrature, gauss_lobatto
from scvi_codegen.validation import checked_count


@dataclass(frozen=True, slots=True, kw_only=True)
class SpectralElements(Axis):
    """Elements between ascending ends.

    Attributes:
        reference: the points on [-1, 1].
    """

    reference: Vector

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
        p = point_count(degree, "the degree of the elements", least=1)
        rule = cls.rule(p + 1)
        derivative = differentiation_matrix(rule.points)
        half = np.diff(breaks) / 2
        elements = len(half)
        offsets = np.array([float(1 + each) for each in rule.points])
        local = breaks[:-1, None] + half[:, None] * offsets
        places = np.arange(elements)[:, None] * p + np.arange(p + 1)
        count = elements * p + (fixed is not None)
        places %= count
        points, masses = np.zeros(count), np.zeros(count)
        points[places[:, ::-1]] = local[:, ::-1]
        points[places[0, 0]] = breaks[0]  # not the end of a periodic axis
        np.add.at(masses, places.ravel(), np.outer(half, np.array([float(each) for each in rule.weights])).ravel())
        left, right = fixed or (False, False)
        if count <= left + right:
            raise SystemDefinitionError(f"'{name}' has no points between its prescribed ends: use more elements")
        inside = slice(int(left), count - int(right))
        size, index, nodes = f"E{name}", f"e{name}", f"nodes_{name}"
        kinds = []
        if elements > left + right:
            every = tuple(Place(index=index, table=nodes, column=b) for b in range(p + 1))
            kinds.append(Cells(span(index, size, int(left), int(right)), Place(index=index), every, nodes))
        if elements == 1 and left and right:
            kinds = [Cells(None, fixed_place(0), (0, *(fixed_place(b) for b in range(p - 1)), 1))]
        else:
            if left:
                kinds.append(Cells(None, fixed_place(0), (0, *(fixed_place(b) for b in range(p)))))
            if right:
                last = tuple(fixed_place(b - p, f"N{name}") for b in range(p))
                kinds.append(Cells(None, fixed_place(-1, size), (*last, 1)))
        table = np.clip(places - int(left), 0, count - int(left) - int(right) - 1)
        matrix = np.array([[float(x) for x in row] for row in derivative])
        roots = np.sqrt(np.array([float(each) for each in rule.weights]))
        largest = float(np.linalg.norm(roots[:, None] * matrix / roots, 2)) ** 2 / float(half.min()) ** 2
        return cls(
            name=name,
            points=points[inside],
            weights=masses[inside],
            length=float(breaks[-1] - breaks[0]),
            periodic=fixed is None,
            quadrature=rule.weights,
            operators=(identity_matrix(p + 1), derivative, matrix_product(derivative, derivative)),
            stiffness=(largest, largest**2),
            edges=_edges(name, places, local, (rule.weights, derivative), fixed, clamped),
            cells=tuple(kinds),
            jacobians=half,
            cell_points=local,
            table=table,
            closed=ClosedPoints(
                points=local.ravel(),
                weights=np.outer(half, [float(each) for each in rule.weights]).ravel(),
                positions=table.ravel(),
                inside=((places >= int(left)) & (places < count - int(right))).ravel(),
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
        points = np.array([float(x) for x in self.reference])
        to_modes = np.linalg.inv(np.polynomial.legendre.legvander(points, len(points) - 1))
        local = self.in_elements(values, -1).reshape(*values.shape[:-1], *self.table.shape)
        modes = np.einsum("ab,...eb->...ea", to_modes, local)[..., 1:] ** 2
        return np.asarray(modes / (np.arange(1, len(points)) + 0.5))


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
    if (
        breaks.ndim != 1
        or len(breaks) < 2
        or not (np.diff(breaks) > 0).all()
        or breaks[0] != start
        or breaks[-1] != end
    ):
        raise SystemDefinitionError(f"the ends of the elements of '{axis}' must ascend from {start:g} to {end:g}")
    return np.union1d(breaks, places)


def _edges(
    name: str,
    places: NDArray[np.int64],
    local: Array,
    rule: tuple[Vector, Matrix],
    fixed: tuple[bool, bool] | None,
    clamped: tuple[bool, bool],
) -> Edges:
    """Return the ends of elements; ``places`` and ``local``, (E, p + 1), are positions and coordinates of points."""
    weights = np.array([float(each) for each in rule[0]])
    derivative = np.array([[float(x) for x in row] for row in rule[1]])
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
    prescribed, (lower, upper) = by_end[0] | by_end[1], (int(each.any(1).sum()) for each in by_end)
    index = f"f{name}"
    slots = tuple(Place(index=index, table=f"edges_{name}", column=b) for b in range(2 * size))
    loop = span(index, f"F{name}", lower, upper)
    kinds = [] if prescribed.any(1).all() else [Cells(loop, Place(index=index), slots, edge=True)]
    for f in np.flatnonzero(prescribed.any(1)):
        single = zip(table[f].tolist(), prescribed[f].tolist(), strict=True)
        points = tuple(int(n > 0) if end else fixed_place(n - left) for n, end in single)
        kinds.append(Cells(None, fixed_place(int(f)), points, edge=True))
    stiffness = derivative.T @ (weights[:, None] * derivative)
    return Edges(
        cells=tuple(kinds),
        table=np.clip(table - left, 0, last - left - right),
        weights=whole[:, 0],
        points=np.where(present[:, 1], local[sides[:, 1], 0], local[sides[:, 0], -1]),
        rows={order: matrix[[-1, 0]] for order, matrix in ((1, derivative), (2, stiffness))},
        scales={1: shares / half[sides] / whole, 2: np.where(present, -1, 0) / half[sides] / whole},
    )
