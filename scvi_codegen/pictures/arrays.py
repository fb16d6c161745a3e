"""What arrays do: a line of places in space and time, a plane of them at the end, bodies where they began and ended."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, closest
from scvi_codegen.given.kinds import CANVAS, PATH, TEXT, Kind, takes
from scvi_codegen.pictures.canvas import color, panel, plain

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["plot_arrays"]

IN_SPACE = (2, 3)
"""Components of places in space."""


class ArrayMotion(Protocol):
    """What is drawn: times, and states by the name of their array."""

    @property
    def t(self) -> NDArray[np.float64]: ...

    @property
    def q(self) -> Mapping[str, NDArray[np.float64]]: ...

    @property
    def observed(self) -> NDArray[np.float64] | None: ...


@takes(
    trajectory=Kind("a trajectory of arrays", lambda given: hasattr(given, "energies")),
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
    """Draw an array of a run over sums over indices.

    One of one axis, ``q[N]``, as a picture of places and time; of ``r[N, 2]`` or ``r[N, 3]``, places in space, the
    first and the last in its first two components; any other of two axes, ``u[NX, NY]``, at the end.

    Args:
        trajectory: of :meth:`IndexedStepper.integrate`.
        path, ax: as of :func:`~scvi_codegen.pictures.paths.plot_motion`.
        array: its name; by default the first.

    Raises:
        StateError: for an array that is not there, or of more axes, and where a run was observed.
        PlotError: without matplotlib.
    """
    name = next(iter(trajectory.q)) if array is None else array
    if name not in trajectory.q:
        raise StateError(f"there is no array '{name}'{closest(name, trajectory.q)} Known: {', '.join(trajectory.q)}")
    values = trajectory.q[name]
    if trajectory.observed is not None and values.ndim == 2:
        raise StateError("of an observed run the first and the last state alone are kept: run it without observe")
    if values.ndim > 3:
        raise StateError(f"'{name}' has {values.ndim - 1} axes: arrays of one or two are drawn")
    with panel(path, ax) as drawn:
        drawn.grid(visible=False)
        if values.ndim == 3 and values.shape[2] in IN_SPACE:
            _draw_places(drawn, values, name)
        elif values.ndim == 3:
            _draw_picture(drawn, values[-1].T, name, None)
            drawn.set(xlabel="first index", ylabel="second index", title=f"t = {trajectory.t[-1]:g}")
        else:
            span = (-0.5, values.shape[1] - 0.5, float(trajectory.t[0]), float(trajectory.t[-1]))
            _draw_picture(drawn, values, name, span if span[2] != span[3] else None)
            drawn.set(xlabel="index", ylabel="t")
    return drawn


def _draw_picture(drawn: Axes, values: NDArray[np.float64], name: str, extent: Any) -> None:
    """Colours about 0, as large above as below."""
    largest = float(np.abs(values).max()) or 1.0
    image = drawn.imshow(
        values, origin="lower", aspect="auto", extent=extent, cmap="RdBu_r", vmin=-largest, vmax=largest
    )
    drawn.figure.colorbar(image, ax=drawn, label=plain(name))


def _draw_places(drawn: Axes, values: NDArray[np.float64], name: str) -> None:
    for number, (state, label) in enumerate(((values[0], "start"), (values[-1], "end"))):
        drawn.plot(state[:, 0], state[:, 1], ".", color=color(number), markersize=3, label=label)
    drawn.set_aspect("equal", adjustable="datalim")
    drawn.set(xlabel=plain(f"{name}[.., 0]"), ylabel=plain(f"{name}[.., 1]"))
    drawn.legend()
