"""What moves, found from coordinates and energies: bodies, pendulums hung on each other, chains, points."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.symmetry.bodies import bodies
from scvi_codegen.pictures.motion import Array, DrawnMotion

__all__ = ["MovingPoints", "shape_of"]

NUMBERED = re.compile(r"(.*?)_?(\d+)")
LENGTHS = ("l", "L", "length")
"""Parameters that are lengths of rods, alone or with a number behind."""
MOST_RODS = 6
GENERIC = 0.3, 0.17
"""First angle, and difference between angles, of a state at which nothing is equal by chance."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingPoints:
    """How to draw a state.

    Attributes:
        points: (n, k, d) places of k points in the plane or in space, from q and p (n, m).
        joined: whether a line goes through the points of a state.
        trails: points whose way is drawn.
        labels: of the axes, d of them; what they mean where a name would not say.
        names: of the points, or none.
        equal: whether all axes have one scale.
    """

    points: Callable[[Array, Array], Array]
    labels: tuple[str, ...]
    joined: bool = False
    trails: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    equal: bool = True


def shape_of(motion: DrawnMotion, positions: Callable[[Array], Array] | None = None) -> MovingPoints:
    """The shape of a system: bodies by their names, pendulums by their energy, else a point or a chain.

    Args:
        motion: whose coordinates are looked at.
        positions: (n, k, 2) or (n, k, 3) places of k points from q (n, m), in place of what is found.

    Raises:
        StateError: if ``positions`` gives another shape.
    """
    coordinates, m = motion.stepper.interface.coordinates, motion.q.shape[1]
    if positions is not None:
        return _given(motion, positions)
    if found := bodies(coordinates):
        columns = np.array([body.columns for body in found])
        names = tuple(body.name for body in found if body.name)
        labels = tuple("xyz"[: columns.shape[1]])
        return MovingPoints(
            points=lambda q, p: q[:, columns], labels=labels, trails=tuple(range(len(found))), names=names
        )
    if (sign := _hanging(motion)) is not None:
        return _pendulum(_lengths(motion), sign)
    if m == 1:
        labels = (coordinates[0], motion.stepper.interface.momenta[0])
        return MovingPoints(points=lambda q, p: np.stack([q, p], axis=2), labels=labels, trails=(0,), equal=False)
    if m == 2:
        return MovingPoints(points=lambda q, p: q[:, np.newaxis], labels=tuple(coordinates), trails=(0,))
    places = np.arange(1.0, m + 1)
    return MovingPoints(
        points=lambda q, p: np.stack([np.broadcast_to(places, q.shape), q], axis=2),
        labels=("number of the coordinate", "q"),
        joined=True,
        equal=False,
    )


def _given(motion: DrawnMotion, positions: Callable[[Array], Array]) -> MovingPoints:
    tried = np.shape(positions(motion.q[:1]))
    if len(tried) != 3 or tried[0] != 1 or tried[2] not in (2, 3):
        raise StateError(f"positions(q) must have shape (n, k, 2) or (n, k, 3); for n = 1 it has {tried}")
    return MovingPoints(
        points=lambda q, p: np.asarray(positions(q), dtype=float),
        labels=tuple("xyz"[: tried[2]]),
        trails=tuple(range(tried[1])),
    )


def _pendulum(lengths: Array, sign: float) -> MovingPoints:
    """Rods of these lengths, each hung (sign 1) or put (-1) on the end of the one before, the first on the origin."""

    def points(q: Array, p: Array) -> Array:
        rods = np.stack([lengths * np.sin(q), -sign * lengths * np.cos(q)], axis=2)
        ends = np.cumsum(rods, axis=1)
        return np.concatenate([np.zeros_like(ends[:, :1]), ends], axis=1)

    return MovingPoints(points=points, labels=("x", "y"), joined=True, trails=(len(lengths),))


def _hanging(motion: DrawnMotion) -> float | None:
    """1 if the coordinates are the angles of pendulums that hang at 0, -1 if these stand there, ``None`` if neither.

    They are if the energy at rest is that of weights, sum a_i (1 - cos q_i) with all a_i of one sign, and if each is
    moved by the next: the energy of two momenta is not the sum of that of each.
    """
    numbers, m = _numbers(motion.stepper.interface.coordinates), motion.q.shape[1]
    if m > MOST_RODS or (m > 1 and numbers is None):
        return None
    generic = GENERIC[0] + GENERIC[1] * np.arange(m)
    q = np.concatenate([np.zeros((1, m)), math.pi * np.eye(m), [generic]])
    try:
        at_rest = _energies(motion, q, np.zeros_like(q))
        a = (at_rest[1:-1] - at_rest[0]) / 2
        expected = at_rest[0] + a @ (1.0 - np.cos(generic))
        alone, both = np.eye(m), np.eye(m)[:-1] + np.eye(m)[1:]
        kinetic = _energies(motion, np.zeros_like(alone), alone) - at_rest[0]
        coupled = _energies(motion, np.zeros_like(both), both) - at_rest[0] - kinetic[:-1] - kinetic[1:]
    except StateError:
        return None
    close = math.isclose(at_rest[-1], expected, rel_tol=0.0, abs_tol=1e-9 * float(np.abs(a).max()))
    one_sign = bool((a > 0.0).all() or (a < 0.0).all())
    together = bool((np.abs(coupled) > 1e-9 * np.abs(kinetic).max()).all())
    return float(np.sign(a[0])) if close and one_sign and together else None


def _energies(motion: DrawnMotion, q: Array, p: Array) -> Array:
    return np.asarray(motion.stepper.energy(q, p, motion.t[0], motion.parameters), dtype=float)


def _numbers(names: Sequence[str]) -> tuple[int, ...] | None:
    """The numbers of theta_1, theta_2, .. or theta1, theta2, ..; ``None`` if they are not called so."""
    found = [NUMBERED.fullmatch(name) for name in names]
    if not all(found) or len({match[1] for match in found if match}) > 1:
        return None
    return tuple(int(match[2]) for match in found if match)


def _lengths(motion: DrawnMotion) -> Array:
    """(m,) lengths of rods, by the names of parameters; 1 where there is none."""
    interface, m = motion.stepper.interface, motion.q.shape[1]
    values = dict(zip(interface.parameters, motion.parameters, strict=True))
    numbers = _numbers(interface.coordinates) or (0,) * m
    lengths = []
    for number in numbers:
        names = [f"{name}{end}" for end in (number, f"_{number}", "") for name in LENGTHS]
        lengths.append(next((float(values[name]) for name in names if name in values), 1.0))
    return np.array(lengths)
