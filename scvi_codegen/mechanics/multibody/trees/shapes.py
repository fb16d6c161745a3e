"""Mass and inertia of bodies of constant density: sphere, ellipsoid, box, cylinder, capsule."""

from collections.abc import Callable

import numpy as np

from scvi_codegen.mechanics.multibody.trees.tree import Vector

Sizes = Vector


def _ellipsoid(size: Sizes) -> tuple[float, Vector]:
    squares = size**2
    return 4 / 3 * np.pi * float(np.prod(size)), (squares.sum() - squares) / 5


def _box(size: Sizes) -> tuple[float, Vector]:
    squares = size**2
    return 8 * float(np.prod(size)), (squares.sum() - squares) / 3


def _cylinder(size: Sizes) -> tuple[float, Vector]:
    r, half = size
    across = r**2 / 4 + half**2 / 3
    return 2 * np.pi * r**2 * half, np.array([across, across, r**2 / 2])


def _capsule(size: Sizes) -> tuple[float, Vector]:
    """Return those of a cylinder with two half spheres, whose centers lie 3 r/8 beyond its ends."""
    r, half = size
    tube, moments = _cylinder(size)
    ball = 4 / 3 * np.pi * r**3
    across = 2 / 5 * r**2 + half**2 + 3 / 4 * half * r
    caps = np.array([across, across, 2 / 5 * r**2])
    return tube + ball, (tube * moments + ball * caps) / (tube + ball)


SHAPES: dict[str, tuple[int, Callable[[Sizes], tuple[float, Vector]]]] = {
    "sphere": (1, lambda size: _ellipsoid(np.repeat(size[0], 3))),
    "ellipsoid": (3, _ellipsoid),
    "box": (3, _box),
    "cylinder": (2, _cylinder),
    "capsule": (2, _capsule),
}
"""By shape: the number of its sizes, and a function of these that returns the volume and the three principal moments of
inertia by mass, about the center and the axes x, y, z. Sizes are the radius; half axes; half lengths; radius and half
length along z, of a capsule without its caps."""
