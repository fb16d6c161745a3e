"""Size of a motion: the range of each coordinate over a run, which errors are relative to.

A size that is the coordinate itself would depend on the origin. Coordinates that share a unit share their range: the
entries of an array, the components of a rotation.
"""

from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.rotations import members_of
from scvi_codegen.runs.states.validation import Array, coordinate_shapes

LOST = 0.1
"""Relative error from which on a state has no meaningful digits, as squares of relative errors count."""
RESOLVED = 64.0
"""Range in roundings of the largest value from which on a coordinate moves."""
NOISE_OF_MOMENTA = 1e4
"""The same of momenta, relative to the largest one, and of positions at rest by reactions: errors accumulate."""
SAMPLES = 16
"""Number of states whose momenta without velocity are computed."""


def roundoff(words: int) -> float:
    """Return the largest relative rounding error of numbers of one or two words."""
    return float(2.0 ** (-53 * words))


def first_of_groups(interface: Interface, dimension: int) -> NDArray[np.intp]:
    """Return the indices of the first coordinates of groups with a common unit: coordinates, arrays, rotations."""
    if not (interface.arrays or interface.rotations):
        return np.arange(dimension)
    counts = [int(np.prod(shape)) for _, shape in coordinate_shapes(interface)]
    if sum(counts) != dimension or interface.rotations:
        counts = [1] * dimension
    firsts = np.concatenate([[0], np.cumsum(counts)[:-1]])
    for member in members_of(dimension, interface.rotations):
        columns = member.columns
        if isinstance(columns, slice):
            firsts = np.setdiff1d(firsts, np.arange(columns.start + 1, columns.stop))
    return firsts.astype(np.intp)


def sizes_of_motion(
    q: Array,
    p: Array,
    errors: Array,
    kinetic: Array,
    by_reactions: Array,
    firsts: NDArray[np.intp],
    epsilon: float,
    absolute: Array | float,
) -> Array:
    """Return (2, m) sizes of positions and momenta of (m, n) states.

    Positions: max(range, absolute); of a coordinate that is at rest, up to rounding, its largest value, at least
    ``by_reactions`` (2, m) (``motion_by_reactions``). Momenta: the range, at least ``kinetic`` (m,), those of
    velocities, times the ratio of the size to the range of their coordinate, or the least one; at rest at least those
    of reactions, infinite where these are 0, so that errors are those of the positions. Of those that consist of
    rounding errors of others, by which ``errors`` (2, m) are as large, both are the largest one.

    Args:
        q, p, errors, kinetic, by_reactions: as above.
        firsts: as of :func:`first_of_groups`.
        epsilon: largest relative rounding error.
        absolute: sizes below which errors do not matter, one number or (m,).
    """

    def of_groups(values: Array) -> Array:
        if len(firsts) == len(values):
            return values
        return np.asarray(np.repeat(np.maximum.reduceat(values, firsts), np.diff(firsts, append=len(values))))

    least_q, most_q = q.min(axis=1), q.max(axis=1)
    ranges, largest = of_groups(most_q - least_q), of_groups(np.maximum(most_q, -least_q))
    momenta = of_groups(np.maximum(np.ptp(p, axis=1), kinetic))
    displacements, impulses = map(of_groups, by_reactions)
    resolution = RESOLVED * epsilon
    unmoved = resolution * max(2.0 * largest.max(), NOISE_OF_MOMENTA * displacements.max())
    moves = ranges.min() > unmoved and momenta.min() > NOISE_OF_MOMENTA * resolution * momenta.max()
    if moves and not np.any(absolute):  # nothing rests, or is noise
        return np.array([ranges, momenta])
    rest = ranges <= resolution * np.maximum(largest, displacements)
    rest |= _is_noise(ranges, errors[0], NOISE_OF_MOMENTA * resolution * displacements)
    noise = _is_noise(ranges, errors[0], resolution * ranges.max(initial=0.0))
    sizes = np.where(noise, ranges.max(initial=0.0), np.where(rest, np.maximum(ranges, largest), ranges))
    sizes = np.maximum(sizes, absolute)
    with np.errstate(all="ignore"):
        ratio = np.maximum(1.0, sizes / ranges)
        least = np.fmin.reduce(ratio, initial=1.0 / epsilon)  # NaN: of 0 by 0
        noise_of_p = _is_noise(momenta, errors[1], NOISE_OF_MOMENTA * resolution * momenta.max(initial=0.0))
        of_p = np.where(noise_of_p, momenta.max(initial=0.0), momenta) * np.where(rest | noise, least, ratio)
    found = np.where(rest, np.maximum([sizes, of_p], [displacements, impulses]), [sizes, of_p])
    found[1, rest & (found[1] == 0.0)] = np.inf
    return np.asarray(found)


def _is_noise(sizes: Array, errors: Array, rounding: Array | float) -> NDArray[np.bool_]:
    """Return which sizes are rounding errors, of what the bounds ``rounding`` are those of: errors are as large."""
    return np.asarray((sizes < rounding) & (100.0 * errors >= sizes))


def momenta_of_velocities(stepper: Any, t: Array, q: Array, p: Array, parameters: Array) -> Array:
    """Return (m,) largest absolute p(q, v) - p(q, 0) of ``SAMPLES`` states; |p| if that is undefined.

    Those without velocity, of a vector potential, depend on its gauge.
    """
    rows = slice(None, None, -(-len(t) // SAMPLES))
    kinetic = np.asarray(p[rows]) - _momenta_at_rest(stepper, t[rows], q[rows], parameters)
    return np.asarray(np.abs(kinetic).max(axis=0))


def _momenta_at_rest(stepper: Any, t: Array, q: Array, parameters: Array) -> Array | float:
    """Return (n, m) momenta without velocity, in one call of C if they do not depend on time; 0 if undefined."""
    at_rest, binding = np.zeros(np.shape(q)), stepper.binding
    if stepper.interface.words == 1 and stepper.interface.conserves_energy and not stepper.in_tau:
        q, v = np.ascontiguousarray(q), np.zeros_like(at_rest)
        pointers = map(binding.pointer, (q, v, parameters, at_rest))
        binding.function("call_momenta")(len(q), float(t[0]), q.shape[1], 0, *pointers, binding.workspace())
        return np.where(np.isfinite(at_rest), at_rest, 0.0)
    with suppress(StateError):  # Hamiltonians, inputs that are not set
        return np.asarray(stepper.momentum(q, at_rest, t, parameters))
    return 0.0


def relative(errors: Array, sizes: Array) -> Array:
    """Return errors (.., m) relative to sizes; 0 for errors of 0, infinite for others of sizes of 0."""
    with np.errstate(all="ignore"):
        return np.asarray(np.where(errors == 0.0, 0.0, errors / sizes))
