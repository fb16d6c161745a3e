"""Grouping of coordinates into Cartesian positions of bodies, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

AXES = "xyz"
AXIS_FIRST = re.compile(r"^([xyz])_?(\w+)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """Coordinates that are the Cartesian position of one body.

    Attributes:
        name: ``"jupiter"`` for jupiter_x, jupiter_y, jupiter_z, ``"1"`` for x1, y1, z1; empty for plain x, y, z.
        columns: their indices among all coordinates, x first; two or three.
    """

    name: str
    columns: tuple[int, ...]


def bodies(coordinates: Sequence[str]) -> tuple[Body, ...]:
    """Group names such as jupiter_x, jupiter_y, or x1, y1, x2, y2, or x_sun, y_sun, or x, y, into bodies.

    Returns:
        The bodies, all in the plane or all in space, or none if a coordinate belongs to no body.

    >>> [body.name for body in bodies(["sun_x", "sun_y", "moon_x", "moon_y"])]
    ['sun', 'moon']
    >>> [body.name for body in bodies(["x1", "y1", "x2", "y2"])]
    ['1', '2']
    >>> bodies(["theta", "x", "y"])
    ()
    """
    return _grouped(coordinates) or _grouped([AXIS_FIRST.sub(r"\2_\1", name) for name in coordinates])


def _grouped(coordinates: Sequence[str]) -> tuple[Body, ...]:
    """Group names that end in the axis."""
    groups: dict[str, dict[str, int]] = {}
    for index, name in enumerate(coordinates):
        stem, axis = (name[:-2], name[-1]) if name[-2:-1] == "_" else ("", name)
        groups.setdefault(stem, {})[axis] = index
    shapes = {"".join(sorted(group)) for group in groups.values()}
    if shapes not in ({"xy"}, {"xyz"}) or sum(map(len, groups.values())) != len(coordinates):
        return ()
    shape = shapes.pop()
    return tuple(Body(name=stem, columns=tuple(group[axis] for axis in shape)) for stem, group in groups.items())
