"""Poincare sections: points where trajectories cross a surface."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from scvi_codegen.errors import StateError
from scvi_codegen.pictures.canvas import color, panel, plain
from scvi_codegen.pictures.trajectory_interface import MOTIONS, Array, DrawnMotion, Motions, column, several
from scvi_codegen.validation import CANVAS, NAMES, PATH, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FEW_POINTS = 2000
DIRECTION_TEXT = {1: ", rising", 0: "", -1: ", falling"}


@checks_arguments(trajectories=MOTIONS, path=PATH, ax=CANVAS, axes=NAMES)
def plot_section(
    trajectories: Motions,
    path: str | os.PathLike[str] | None = None,
    *,
    axes: tuple[str, str],
    event: int = 0,
    ax: Axes | None = None,
) -> Axes:
    """Draw a Poincare section, a colour a trajectory.

    Args:
        trajectories: one or several trajectories of the same system, integrated with ``events``.
        path: file for the picture, .png or .svg; ``None`` to write none.
        axes: two names of coordinates or momenta (``p_`` before the coordinate, or as the Hamiltonian names it).
        event: index of the event that defines the surface.
        ax: axes to draw on; ``None`` for new ones.

    Raises:
        StateError: for an unknown name, or without such an event.
        PlotError: without matplotlib.
    """
    result = several(trajectories)
    points = [[_at_crossings(motion, name, event) for name in axes] for motion in result]
    size = 2.0 if sum(len(x) for x, _ in points) > FEW_POINTS else 4.0
    stepper = result[0].stepper
    cut = stepper.events[event]
    with panel(path, ax, (5.6, 5.2)) as drawn:
        for number, (x, y) in enumerate(points):
            drawn.plot(x, y, ".", color=color(number), markersize=size, markeredgewidth=0.0)
        drawn.set(xlabel=axes[0], ylabel=axes[1])
        drawn.set_title(plain(f"{stepper.interface.system}: {cut.function} = 0{DIRECTION_TEXT[cut.direction]}"))
    return drawn


def _at_crossings(motion: DrawnMotion, name: str, event: int) -> Array:
    """Return (k,) values of a coordinate or momentum at the crossings of an event."""
    if not -len(motion.events) <= event < len(motion.events):
        raise StateError(
            f"there is no event {event} in a trajectory with {len(motion.events)}: integrate(..., events=...)"
        )
    return column(motion.stepper.interface, motion.events[event], name)
