"""Plots of arrays of array systems: an image over index and time, a final image, or bodies in space."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.pictures.canvas import color, panel, plain
from scvi_codegen.validation import CANVAS, PATH, TEXT, ArgumentType, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes

IN_SPACE = (2, 3)
"""Lengths of the last axis of arrays of positions in space."""


class ArrayMotion(Protocol):
    """Trajectory to draw, of a system with arrays."""

    @property
    def t(self) -> NDArray[np.float64]: ...

    @property
    def q(self) -> NDArray[np.float64]: ...

    @property
    def stepper(self) -> Any: ...

    @property
    def observed(self) -> NDArray[np.float64] | None: ...


@checks_arguments(
    trajectory=ArgumentType("a trajectory of arrays", lambda value: hasattr(getattr(value, "q", None), "shapes")),
    array=TEXT,
    path=PATH,
    ax=CANVAS,
)
def plot_arrays(
    trajectory: ArrayMotion,
    path: str | os.PathLike[str] | None = None,
    *,
    array: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw an array of a trajectory of an array system.

    An array with one index, ``q[N]``, is an image over index and time; ``r[N, 2]`` or ``r[N, 3]`` are the first and
    last positions in space, in their first two components; any other array with two indices, ``u[NX, NY]``, is an image
    of the final state.

    Args:
        trajectory: result of :meth:`Stepper.integrate`.
        path, ax: as of :func:`~scvi_codegen.pictures.paths.plot_motion`.
        array: name of the array; by default the first.

    Raises:
        StateError: for an unknown array or one with more indices, and for a run with ``observe``.
        PlotError: without matplotlib.
    """
    arrays = trajectory.stepper.arrays(trajectory.q)
    name = next(iter(arrays)) if array is None else array
    if name not in arrays:
        raise StateError(f"there is no array '{name}'{closest(name, arrays)} Known: {', '.join(arrays)}")
    values = arrays[name]
    if trajectory.observed is not None and values.ndim == 2:
        raise StateError(
            "a run with observe saves only its first and last state: run it without observe to draw this array"
        )
    if values.ndim > 3:
        raise StateError(f"'{name}' has {values.ndim - 1} indices: only arrays with one or two can be drawn")
    with panel(path, ax) as drawn:
        drawn.grid(visible=False)
        if values.ndim == 3 and values.shape[2] in IN_SPACE:
            _draw_positions(drawn, values, name)
        elif values.ndim == 3:
            _draw_picture(drawn, values[-1].T, name, None)
            drawn.set(xlabel="first index", ylabel="second index", title=f"t = {trajectory.t[-1]:g}")
        else:
            span = (-0.5, values.shape[1] - 0.5, float(trajectory.t[0]), float(trajectory.t[-1]))
            _draw_picture(drawn, values, name, span if span[2] != span[3] else None)
            drawn.set(xlabel="index", ylabel="t")
    return drawn


def _draw_picture(drawn: Axes, values: NDArray[np.float64], name: str, extent: Any) -> None:
    """Draw an image with a colour scale that is symmetric about 0."""
    largest = float(np.abs(values).max()) or 1.0
    image = drawn.imshow(
        values, origin="lower", aspect="auto", extent=extent, cmap="RdBu_r", vmin=-largest, vmax=largest
    )
    drawn.figure.colorbar(image, ax=drawn, label=plain(name))


def _draw_positions(drawn: Axes, values: NDArray[np.float64], name: str) -> None:
    for number, (state, label) in enumerate(((values[0], "start"), (values[-1], "end"))):
        drawn.plot(state[:, 0], state[:, 1], ".", color=color(number), markersize=3, label=label)
    drawn.set_aspect("equal", adjustable="datalim")
    drawn.set(xlabel=plain(f"{name}[.., 0]"), ylabel=plain(f"{name}[.., 1]"))
    drawn.legend()
