"""Frames of robots in the world, x = x_p + R_p r, R = R_p C A(q) from parent to link; derivatives by complex steps."""

from collections import namedtuple
from typing import Any

import numpy as np

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.runs.states.attitudes import matrices, velocities_of_body
from scvi_codegen.runs.states.rotation_quantities import COMPLEX_STEP
from scvi_codegen.runs.states.rotations import members_of
from scvi_codegen.runs.states.validation import Array

Frame = namedtuple("Frame", "position rotation velocity angular_velocity jacobian angular_jacobian")
"""Vectors (n, 3), rotation (n, 3, 3), derivatives of velocities (n, 3, k) by rates and body angular velocities."""


def frame_at(interface: Interface, name: str, q: Array, velocity: Array) -> Frame:
    """Return the motion of a named frame at positions and velocities (.., m)."""
    links, members = interface.layout.links, members_of(interface.dimension, interface.rotations)
    places = {own: (link, *map(np.array, place)) for link in links for own, *place in link.frames}
    if name not in places:
        raise StateError(f"there is no frame '{name}' that moves{closest(name, places)} Known: {', '.join(places)}")
    columns: Any = {x: k for k, x in enumerate(interface.coordinates)} | {ball.name: ball.columns for ball in members}
    single = interface.dimension - 4 * len(members)
    along = np.zeros((*q.shape[:-1], single + 3 * len(members) + 1, q.shape[-1]))
    along[..., range(single), range(single)] = 1.0
    for row, ball in zip(range(single, along.shape[-2], 3), members, strict=False):
        along[..., row : row + 3, ball.columns] = velocities_of_body(q[..., np.newaxis, ball.columns], np.eye(3))
    along[..., -1, :] = velocity
    moved, turned = _in_world(links, places[name], q[..., np.newaxis, :] + 1j * COMPLEX_STEP * along, columns)
    turns = turned.imag @ np.swapaxes(turned.real, -1, -2) / COMPLEX_STEP
    slopes = moved.imag / COMPLEX_STEP, turns[..., [2, 0, 1], [1, 2, 0]]
    jacobians = (np.swapaxes(part[..., :-1, :], -1, -2) for part in slopes)
    return Frame(moved[..., -1, :].real, turned[..., -1, :, :].real, *(x[..., -1, :] for x in slopes), *jacobians)


def _in_world(links: Any, place: Any, q: Any, columns: Any) -> tuple[Array, Array]:
    """Return position (.., 3) and axes (.., 3, 3) in the world of a frame with a place (link, position, axes)."""
    link, position, axes = place
    origin, turn = np.array(link.position), np.array(link.rotation)
    if link.kind in ("ball", "free"):
        rotation = matrices(q[..., columns[f"R_{link.name}"]])
        turn = turn @ rotation if link.kind == "ball" else rotation
        origin = q[..., [columns[f"{x}_{link.name}"] for x in "xyz"]] if link.kind == "free" else origin
    else:
        name, factor, offset = link.follows or (link.name, 1.0, 0.0)
        moved = (factor * q[..., columns[name]] + offset - link.zero)[..., np.newaxis]
        x, y, z = turn.T
        if link.kind == "slide":
            origin, turn = origin + moved * z, np.broadcast_to(turn, (*moved.shape[:-1], 3, 3))
        else:
            turned = np.cos(moved) * x + np.sin(moved) * y, np.cos(moved) * y - np.sin(moved) * x, z + 0 * moved
            turn = np.stack(turned, axis=-1)
    position, axes = origin + (turn @ position[..., np.newaxis])[..., 0], turn @ axes
    return (position, axes) if link.parent < 0 else _in_world(links, (links[link.parent], position, axes), q, columns)
