"""Poses of robots from files (URDF, MJCF): links in space at a few times."""

from __future__ import annotations

from typing import Any

import numpy as np

from scvi_codegen.pictures.animation import drawn_shape, positions_of
from scvi_codegen.pictures.canvas import DrawnMotion, color

POSES = 6
"""Number of poses in a plot."""


def links_of(motion: DrawnMotion) -> Any:
    """Return the links of the robot that moves, with parents before children; none if it is not read from a file."""
    return motion.stepper.interface.layout.links


def draw_robot(axes: Any, motion: DrawnMotion, number: int = 0) -> None:
    """Draw the links at equidistant times, the last pose in full colour, and the paths of the tips."""
    shape = drawn_shape(motion)
    seen = positions_of(shape, motion)[..., slice(None) if axes.name == "3d" else [0, 2]]
    rows = np.unique(np.searchsorted(abs(motion.t - motion.t[0]), np.linspace(0, 1, POSES) * abs(np.ptp(motion.t))))
    for row in rows.clip(max=len(seen) - 1):
        alpha = 1.0 if row == rows[-1] else 0.25
        for mark in shape.marks:
            axes.plot(*seen[row, mark["points"]].T, "-", color=color(number), linewidth=1.8, alpha=alpha)
        joints = seen[row, [mark["points"][0] for mark in shape.marks]]
        axes.plot(*joints.T, "o", color=color(number), markersize=3, alpha=alpha)
    for tip in shape.trails:
        axes.plot(*seen[:, tip].T, color=color(number + 1), linewidth=0.7)
    axes.set(xlabel="x", title="links")
    axes.set(**({"ylabel": "y", "zlabel": "z"} if axes.name == "3d" else {"ylabel": "z"}))
    axes.set_aspect("equal", adjustable="datalim")
