"""Links of robots from files (URDF, MJCF) in space: forward kinematics of the tree of rigid bodies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from scvi_codegen.pictures.canvas import Array, DrawnMotion, color

POSES = 6
"""Number of poses in a plot."""


def links_of(motion: DrawnMotion) -> Any:
    """Return the links of the robot that moves, with parents before children; none if it is not read from a file."""
    return motion.stepper.interface.layout.links


def skeleton(motion: DrawnMotion) -> tuple[Array, tuple[slice, ...], tuple[int, ...]]:
    """Return points (n, k, 3) of the links, the slice of those of each link, and the numbers of the tips.

    A link joins the origin of its frame to those of its children; one without children ends at twice the distance
    of its center of mass. The rotation of link i into the world is A_i = A_p C_i R(q_i), its origin is o_p + A_p r_i.
    """
    links, parts, tips = links_of(motion), [], []
    values = dict(zip(motion.stepper.interface.coordinates, np.asarray(motion.q).T, strict=True))
    n = len(motion.q)
    joints = {link.name: link for link in links}
    origins, turns = np.zeros((len(links), n, 3)), np.zeros((len(links), n, 3, 3))
    for i, link in enumerate(links):
        origins[i], turns[i] = _placed(motion, link, joints, values)
        if link.parent >= 0:
            origins[i] = origins[link.parent] + np.einsum("nij,nj->ni", turns[link.parent], origins[i])
            turns[i] = turns[link.parent] @ turns[i]
    based = [i for i, link in enumerate(links) if link.parent < 0 and link.kind != "free" and origins[i].any()]
    paths = [[np.zeros((n, 3)), origins[i]] for i in based]
    for i, link in enumerate(links):
        children = [origins[k] for k, each in enumerate(links) if each.parent == i]
        tip = origins[i] + 2 * turns[i] @ np.array(link.center)
        paths.append([point for child in children or [tip] for point in (origins[i], child)])
        tips += [] if children else [sum(map(len, paths)) - 1]
    ends = np.cumsum([0, *map(len, paths)])
    parts = [point for path in paths for point in path]
    return np.stack(parts, axis=1), tuple(map(slice, ends[:-1], ends[1:])), tuple(tips)


def _placed(motion: DrawnMotion, joint: Any, joints: Mapping[str, Any], values: Mapping[str, Array]) -> tuple[Any, Any]:
    """Return the origins (n, 3) of a link in the frame of its parent, and its rotations (n, 3, 3) into it."""
    constant, position = np.array(joint.rotation), np.array(joint.position)
    if joint.kind == "free":
        return np.stack([values[f"{axis}_{joint.name}"] for axis in "xyz"], 1), motion.rotation(f"R_{joint.name}")
    if joint.kind == "ball":
        return position, constant @ motion.rotation(f"R_{joint.name}")
    moved = _displacement(joint, joints, values) - joint.zero
    if joint.kind == "slide":
        return position + np.multiply.outer(moved, constant[:, 2]), constant
    turned = np.zeros((len(moved), 3, 3))
    turned[:, 0, 0], turned[:, 0, 1], turned[:, 2, 2] = np.cos(moved), -np.sin(moved), 1.0
    turned[:, 1, 0], turned[:, 1, 1] = np.sin(moved), np.cos(moved)
    return position, constant @ turned


def _displacement(joint: Any, joints: Mapping[str, Any], values: Mapping[str, Array]) -> Array:
    if joint.follows is None:
        return values[joint.name]
    other, factor, offset = joint.follows
    return np.asarray(factor * _displacement(joints[other], joints, values) + offset)


def draw_robot(axes: Any, motion: DrawnMotion, number: int = 0) -> None:
    """Draw the links at equidistant times, the last pose in full colour, and the paths of the tips."""
    points, parts, tips = skeleton(motion)
    rows = np.unique(np.searchsorted(abs(motion.t - motion.t[0]), np.linspace(0, 1, POSES) * abs(np.ptp(motion.t))))
    in_space = axes.name == "3d"
    seen = points if in_space else points[..., [0, 2]]
    for row in rows.clip(max=len(points) - 1):
        last = row == rows[-1]
        for part in parts:
            axes.plot(*seen[row, part].T, "-", color=color(number), linewidth=1.8, alpha=1.0 if last else 0.25)
        joints = seen[row, [part.start for part in parts]]
        axes.plot(*joints.T, "o", color=color(number), markersize=3, alpha=1.0 if last else 0.25)
    for tip in tips:
        axes.plot(*seen[:, tip].T, color=color(number + 1), linewidth=0.7)
    axes.set(xlabel="x", title="links")
    axes.set(**({"ylabel": "y", "zlabel": "z"} if in_space else {"ylabel": "z"}))
    axes.set_aspect("equal", adjustable="datalim")
