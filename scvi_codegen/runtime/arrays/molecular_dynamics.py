"""Temperature, pressure and radial distribution function of particles in a periodic box.

Each is a function of a trajectory or, as an observer of ``integrate(.., observe=)``, of a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.errors import ArgumentError, StateError
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.validation import checked_count, checks_arguments

if TYPE_CHECKING:
    from scvi_codegen.runtime.run.run import Run
    from scvi_codegen.runtime.trajectory.trajectory import Trajectory

RELATIVE_STRAIN = 1e-5
"""Relative change of lengths for the derivative of the energy: errors of 1e-9 by truncation and 1e-11 by rounding."""


def temperature(states: Run | Trajectory) -> Any:
    """Return the temperature in units of energy, twice the kinetic energy per degree of freedom.

    The degrees of freedom are the coordinates less the conserved linear momenta and the constraints.

    Args:
        states: a trajectory, for the temperature of each state, or a run, for that of its present state.

    Raises:
        StateError: if the system is no Lagrangian of arrays with sizes known at run time.
    """
    stepper, maps = states.stepper, states.stepper.interface.layout.maps
    momenta = sum(each.other is None and not each.phase for each in maps)
    return 2 * _kinetic(states) / (stepper.dimension - momenta - len(stepper.constraints))


def pressure(states: Run | Trajectory, box: str | Sequence[str]) -> Any:
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
    kinetic, stepper = _kinetic(states), states.stepper
    lengths, parameters = _lengths(states, box), np.asarray(states.parameters)
    states_of = (np.atleast_2d(np.asarray(each)) for each in (states.q, states.p))
    (q, p), t = states_of, np.atleast_1d(np.asarray(states.t, dtype=float))
    potential = []
    for scale in (1 + RELATIVE_STRAIN, 1 - RELATIVE_STRAIN):
        scaled = parameters.copy()
        scaled[[stepper.parameters.index(name) for name in _names(box)]] *= scale
        potential.append(stepper._energy_parts(q * scale, p, t, scaled)[:, 1])
    slope = (potential[0] - potential[1]).reshape(np.shape(kinetic)) / (2 * RELATIVE_STRAIN)
    return (2 * kinetic - slope) / (len(lengths) * math.prod(lengths))


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
    from scipy.spatial import cKDTree

    lengths, dimension = np.array(_lengths(states, box)), len(_lengths(states, box))
    half = lengths.min() / 2
    if not 0 < (end := half if largest is None else largest) <= half:
        raise ArgumentError(f"largest must be positive and at most half of the shortest period, {half:g}, not {end:g}")
    edges = np.linspace(0, end, checked_count(bins, "bins", least=1) + 1)
    (positions,) = states.q.values()
    positions = positions.reshape(-1, positions.size // len(np.atleast_2d(states.q)) // dimension, dimension)
    inside = positions % lengths
    inside[inside >= lengths] = 0.0  # by rounding
    pairs = np.zeros(len(edges))
    for points in inside:
        tree = cKDTree(points, boxsize=lengths)
        pairs += tree.count_neighbors(tree, edges)
    ball = math.pi ** (dimension / 2) / math.gamma(dimension / 2 + 1)
    count = positions.shape[1]
    uniform = len(positions) * count * (count - 1) / lengths.prod() * ball * np.diff(edges**dimension)
    return (edges[1:] + edges[:-1]) / 2, np.diff(pairs) / uniform


def _kinetic(states: Run | Trajectory) -> Any:
    kinetic = np.asarray(states.energies)[..., 0]
    if states.stepper.interface.layout.momenta or not np.isfinite(kinetic).all():
        raise StateError(
            f"the kinetic energy is unknown for {states.stepper!r}: use a Lagrangian of arrays whose sizes are known "
            "at run time"
        )
    return kinetic


def _names(box: str | Sequence[str]) -> list[str]:
    return [box] if isinstance(box, str) else list(box)


def _lengths(states: Run | Trajectory, box: str | Sequence[str]) -> list[float]:
    """Return the length of a period of each component of a position."""
    stepper, names = states.stepper, _names(box)
    arrays = stepper.interface.layout.coordinates
    if len(arrays) != 1:
        raise StateError(f"{stepper!r} must have one array of coordinates, the positions, not {len(arrays)}")
    dimension = arrays[0].axes[-1].number or 1
    for name in names:
        if name not in stepper.parameters:
            raise ArgumentError(f"'{name}' is not a parameter of {stepper!r}: give the name of the length of the box")
    if len(names) not in (1, dimension):
        raise ArgumentError(f"box must be one name or {dimension}, one per component, not {len(names)}")
    lengths = [float(np.asarray(states.parameters)[stepper.parameters.index(name)]) for name in names]
    return lengths if len(lengths) == dimension else lengths * dimension
