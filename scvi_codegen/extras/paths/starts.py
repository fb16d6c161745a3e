"""Curves from which Newton's method for paths starts: at random, and around the centre of a rotational symmetry."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from scvi_codegen.api.states import Array
from scvi_codegen.extras.paths.size import SAME

WAVES = 3
"""Number of sine waves of a curve at random."""
MOST_ROTATED = 64
"""Largest number of coordinates that are searched for rotations."""


def curves_at_random(line: Array) -> Iterator[Array]:
    """Yield a straight line plus sine waves of its size, the same at each call."""
    random, k = np.random.default_rng(0), np.arange(1, WAVES + 1)
    shapes = np.sin(np.pi * np.linspace(0.0, 1.0, len(line))[:, np.newaxis] * k) / k
    shapes[[0, -1]] = 0.0
    while True:
        yield line + size_of(line) * shapes @ random.standard_normal((WAVES, line.shape[1]))


def size_of(line: Array) -> float:
    """Return the largest entry of the positions, and of their differences."""
    return max(float(np.abs(line).max()), float(np.ptp(line, axis=0).max())) or 1.0


def curves_around(stepper: Any, line: Array, t: float, parameters: Array, revolutions: int) -> Iterator[Array]:
    """Yield curves that go from end to end around the centre of each rotational symmetry.

    With the generator A of a rotation about c they are q(s) = c + exp(s a A) (line in the rotating frame), where the
    angle a takes q0 - c nearest to q1 - c, plus 2 pi for each revolution.

    Args:
        stepper: the compiled stepper, whose momentum maps p . (A q + b) are those of symmetries.
        line: (N + 1, m) positions with both ends.
        t, parameters: time and (k,) parameters at which momentum maps are evaluated.
        revolutions: whole revolutions before the end is reached, 0 for the shorter of both ways or, at opposite ends,
            the counterclockwise one; negative for those the other way around, from -1.
    """
    s = np.linspace(0.0, 1.0, len(line))
    for generator, centre in _rotations(stepper, t, parameters):
        first, last = line[0] - centre, line[-1] - centre
        values, vectors = np.linalg.eigh(1j * generator)
        planar = -generator @ generator  # projection onto the planes that turn
        angle = float(np.arctan2(last @ generator @ first, last @ planar @ first))
        angle = np.pi if angle <= -np.pi * (1.0 - SAME) else angle
        if not (np.any(generator @ first) and np.any(generator @ last)):
            continue
        total = angle + 2.0 * np.pi * revolutions

        def turned(by: float, vector: Array, values: Array = values, vectors: Array = vectors) -> Array:
            return np.real(vectors @ (np.exp(-1j * values * by) * (vectors.conj().T @ vector)))

        back = turned(-total, last)
        curve = np.array([centre + turned(share * total, first + share * (back - first)) for share in s])
        curve[[0, -1]] = line[[0, -1]]
        yield curve


def _rotations(stepper: Any, t: float, parameters: Array) -> Iterator[tuple[Array, Array]]:
    """Yield the (m, m) antisymmetric generators A of rotations, of eigenvalues 0 and +-i, and their (m,) centres."""
    m = stepper.dimension
    if m > MOST_ROTATED or not stepper.momentum_map_names:
        return
    units = np.vstack([np.zeros(m), np.eye(m)])
    q, p = np.repeat(units, m, axis=0), np.tile(np.eye(m), (m + 1, 1))
    maps = np.asarray(stepper.momentum_maps(q, p, np.full(len(q), t), parameters)).reshape(m + 1, m, -1)
    maps = maps - np.asarray(stepper.momentum_maps(q, 0.0 * p, np.full(len(q), t), parameters)).reshape(maps.shape)
    for shift, rates in zip(maps[0].T, (maps[1:] - maps[0]).transpose(2, 1, 0), strict=True):
        size = float(np.linalg.norm(rates, 2))
        if not size or np.abs(rates + rates.T).max() > SAME * size:
            continue
        generator = rates / size
        if np.abs(generator @ generator @ generator + generator).max() > SAME:
            continue  # turns planes at different rates
        yield generator, -np.linalg.pinv(generator) @ (shift / size)
