"""Temperature, pressure and radial distribution function of particles in a periodic box.

Each is a function of a trajectory or, as an observer of ``integrate(.., observe=)``, of a run.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from scvi_codegen.common.errors import ArgumentError, StateError
from scvi_codegen.common.validation import checked_count, checks_arguments
from scvi_codegen.runs.states.validation import Array

RELATIVE_STRAIN = 1e-5
"""Relative change of lengths for the derivative of the energy: errors of 1e-9 by truncation and 1e-11 by rounding."""

SPARSE = 0.04
"""Fraction of all pairs below which a tree finds the near ones faster than all are compared."""
PAIRS_TOGETHER = 30_000
"""Number of pairs compared at once, which fit into the cache of the processor."""


def temperature(states: Any) -> Any:
    """Return the temperature in units of energy, twice the kinetic energy per degree of freedom.

    The degrees of freedom are the coordinates less the conserved linear momenta and the constraints.

    Args:
        states: a trajectory, for the temperature of each state, or a run, for that of its present state.

    Raises:
        StateError: if the system is no Lagrangian of arrays with sizes known at run time.
    """
    stepper, maps = states.stepper, states.stepper.interface.layout.maps
    momenta = sum(quantity.other is None and not quantity.phase for quantity in maps)
    return 2 * _kinetic(states) / (stepper.dimension - momenta - len(stepper.constraints))


def pressure(states: Any, box: str | Sequence[str]) -> Any:
    """Return the pressure, minus the derivative of the energy by the volume, where positions scale with the box.

    In d dimensions p = (2 T - dU/ds) / (d V), with the potential energy U of all lengths times s; pair forces
    contribute -dU/ds = sum r . F over pairs, the virial.

    Args:
        states: a trajectory or a run.
        box: parameter that is the length of the period, or one per component.

    Raises:
        StateError: as :func:`temperature`, or if there are several arrays of coordinates.
        ArgumentError: if there is no such parameter.
    """
    kinetic, (places, lengths) = _kinetic(states), _periods(states, box)
    q, p, t = np.atleast_2d(states.q), np.atleast_2d(states.p), np.atleast_1d(states.t)
    potential = []
    for scale in (1 + RELATIVE_STRAIN, 1 - RELATIVE_STRAIN):
        scaled = np.array(states.parameters)
        scaled[places] *= scale
        potential.append(states.stepper._energy_parts(q * scale, p, t, scaled)[:, 1])
    derivative = (potential[0] - potential[1]).reshape(np.shape(kinetic)) / (2 * RELATIVE_STRAIN)
    return (2 * kinetic - derivative) / (len(lengths) * lengths.prod())


@checks_arguments()
def radial_distribution(
    states: Any, box: str | Sequence[str], *, largest: float | None = None, bins: int = 100
) -> tuple[Array, Array]:
    """Return distances and the radial distribution function, the density of pairs relative to that of an ideal gas.

    Args:
        states: a trajectory, whose states are averaged, or a run, for its present state.
        box: parameter that is the length of the period, or one per component.
        largest: end of the distances, at most and by default half of the shortest period.
        bins: number of intervals, at whose midpoints the distances are.

    Raises:
        StateError: if there are several arrays of coordinates.
        ArgumentError: if there is no such parameter, or a distance is too large.
    """
    _, lengths = _periods(states, box)
    dimension, half = len(lengths), lengths.min() / 2
    if not 0 < (end := half if largest is None else largest) <= half:
        raise ArgumentError(f"largest must be positive and at most half of the shortest period, {half:g}, not {end:g}")
    edges = np.linspace(0, end, checked_count(bins, "bins", least=1) + 1)
    (positions,) = states.q.values()
    positions = positions.reshape(-1, positions.size // len(np.atleast_2d(states.q)) // dimension, dimension)
    inside = positions % lengths
    inside[inside >= lengths] = 0.0  # by rounding
    ball, count = math.pi ** (dimension / 2) / math.gamma(dimension / 2 + 1), positions.shape[1]
    sparse = ball * end**dimension < SPARSE * lengths.prod()
    pairs = (_histogram_of_near_pairs if sparse else _histogram_of_pairs)(inside, lengths, end, len(edges) - 1)
    uniform = len(positions) * count * (count - 1) / 2 / lengths.prod() * ball * np.diff(edges**dimension)
    return (edges[1:] + edges[:-1]) / 2, pairs / uniform


def _histogram_of_pairs(inside: Array, lengths: Array, end: float, bins: int) -> Any:
    """Return the numbers of pairs by distance, from all pairs: those of particles i and i + s, for each shift s."""
    count, histogram = inside.shape[1], np.zeros(bins + 1, np.int64)
    for first in range(0, len(inside), max(1, PAIRS_TOGETHER // count)):
        some = np.moveaxis(inside[first : first + max(1, PAIRS_TOGETHER // count)] / lengths, -1, 0)
        twice = np.concatenate([some, some], axis=2)
        apart, nearest, squares = np.empty((3, *some.shape[1:]))
        for shift in range(1, count // 2 + 1):
            squares[:] = 0.0
            for x, shifted, length in zip(some, twice[:, :, shift : shift + count], lengths, strict=True):
                np.subtract(x, shifted, out=apart)
                np.subtract(apart, np.rint(apart, out=nearest), out=apart)  # nearest image
                np.multiply(apart, length * bins / end, out=apart)
                np.add(squares, np.multiply(apart, apart, out=apart), out=squares)
            rows = np.minimum(np.sqrt(squares, out=squares), bins, out=squares).astype(np.intp)
            once = count // 2 if 2 * shift == count else count
            histogram += np.bincount(rows[:, :once].ravel(), minlength=bins + 1)
    return histogram[:-1]


def _histogram_of_near_pairs(inside: Array, lengths: Array, end: float, bins: int) -> Any:
    """Return the numbers of pairs by distance, from a tree of the particles."""
    from scipy.spatial import cKDTree

    histogram = np.zeros(bins, np.int64)
    for points in inside:
        i, j = cKDTree(points, boxsize=lengths).query_pairs(end, output_type="ndarray").T
        apart = points[i] - points[j]
        apart -= lengths * np.rint(apart / lengths)
        histogram += np.histogram(np.sqrt((apart**2).sum(axis=1)), bins, (0.0, end))[0]
    return histogram


def _kinetic(states: Any) -> Any:
    kinetic = np.asarray(states.energies)[..., 0]
    if states.stepper.interface.layout.momenta or not np.isfinite(kinetic).all():
        raise StateError(
            f"the kinetic energy is unknown for {states.stepper!r}: use a Lagrangian of arrays whose sizes are known "
            "at run time"
        )
    return kinetic


def _periods(states: Any, box: str | Sequence[str]) -> tuple[list[int], Array]:
    """Return the indices of the parameters of a box, and the length of a period of each component of a position."""
    stepper, names = states.stepper, [box] if isinstance(box, str) else list(box)
    arrays = stepper.interface.layout.coordinates
    if len(arrays) != 1:
        raise StateError(f"{stepper!r} must have one array of coordinates, the positions, not {len(arrays)}")
    dimension = arrays[0].axes[-1].number or 1
    if len(names) not in (1, dimension):
        raise ArgumentError(f"box must be one name or {dimension}, one per component, not {len(names)}")
    for name in names:
        if name not in stepper.parameters:
            raise ArgumentError(f"'{name}' is not a parameter of {stepper!r}: give the name of the length of the box")
    places = [stepper.interface.parameters.index(name) for name in names]
    return places, np.resize(np.array(states.parameters)[places], dimension)
