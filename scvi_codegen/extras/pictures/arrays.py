"""Plots of arrays and fields: an image over index and time, an image of a state, bodies in space, spectra."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.extras.pictures.canvas import color, panel, plain
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes

IN_SPACE = (2, 3)
"""Lengths of the last axis of arrays of positions in space."""


ARRAYS = Kind("a trajectory of arrays", lambda value: isinstance(value, Trajectory) and hasattr(value.q, "items"))


def mesh_of(motion: Trajectory) -> Any:
    """Return the mesh of the fields of a trajectory, or ``None`` if they are not discretised from a density."""
    layout = motion.stepper.interface.layout
    return None if layout is None else layout.mesh


def array_values(motion: Trajectory, name: str | None) -> tuple[str, NDArray[np.float64]]:
    """Return name and values (n, ..) of an array or field, by default the first with an index; else StateError."""
    mesh = mesh_of(motion)
    arrays = mesh.fields_of(np.asarray(motion.q), np.asarray(motion.p)) if mesh else motion.stepper.arrays(motion.q)
    if name is None:
        name = max(arrays, key=lambda array: arrays[array].ndim > 1)
    if name not in arrays:
        raise StateError(f"there is no array '{name}'{closest(name, arrays)} Known: {', '.join(arrays)}")
    return name, arrays[name]


@checks_arguments(trajectory=ARRAYS, ax=Kind.CANVAS)
def plot_arrays(
    trajectory: Trajectory,
    path: str | os.PathLike[str] | None = None,
    *,
    array: str | None = None,
    state: int = -1,
    ax: Axes | None = None,
) -> Axes:
    """Draw an array of a trajectory of an array system, or a field on a mesh.

    An array with one index, ``q[N]``, is an image over index and time; ``r[N, 2]`` or ``r[N, 3]`` are the first and
    last positions in space, in their first two components; any other array with two indices, ``u[NX, NY]``, is an image
    of one state; a coordinate without an index is a curve over time. Fields on a mesh are drawn over the coordinates of
    its points.

    Args:
        trajectory: result of :meth:`Stepper.integrate`.
        path, ax: as of :func:`~scvi_codegen.extras.pictures.overview.plot_motion`.
        array: name of the array or field; by default the first one with an index.
        state: index of the state drawn of two indices.

    Raises:
        StateError: for an unknown array or one with more indices, an unknown state, and for a run with ``observe``.
        PlotError: without matplotlib.
    """
    name, values = array_values(trajectory, array)
    mesh = mesh_of(trajectory)
    if trajectory.observed is not None and values.ndim == 2:
        raise StateError(
            "a run with observe saves only its first and last state: run it without observe to draw this array"
        )
    if values.ndim > 3:
        raise StateError(f"'{name}' has {values.ndim - 1} indices: only arrays with one or two can be drawn")
    if not -len(values) <= state < len(values):
        raise StateError(f"there is no state {state} in a trajectory with {len(values)}")
    labels = ["index"] if values.ndim == 2 else ["first index", "second index"]
    points = [np.arange(size) for size in values.shape[1:]]
    if mesh:
        labels, points = [axis.name for axis in mesh.axes], [axis.points for axis in mesh.axes]
    with panel(path, ax) as panel_axes:
        panel_axes.grid(visible=False)
        if values.ndim == 3 and values.shape[2] in IN_SPACE and not mesh:
            _draw_positions(panel_axes, values, name)
        elif values.ndim == 3:
            _draw_picture(panel_axes, points, values[state].T, name)
            panel_axes.set(xlabel=labels[0], ylabel=labels[1], title=f"t = {trajectory.t[state]:g}")
        elif values.ndim == 1:
            panel_axes.plot(trajectory.t, values)
            panel_axes.set(xlabel="t", ylabel=plain(name))
        else:
            _draw_picture(panel_axes, [points[0], trajectory.t], values, name)
            panel_axes.set(xlabel=labels[0], ylabel="t")
    return panel_axes


def _draw_picture(axes: Axes, points: Any, values: NDArray[np.float64], name: str) -> None:
    """Draw an image with a colour scale that is symmetric about 0."""
    largest = float(np.abs(values).max()) or 1.0
    limits: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
    image = axes.pcolormesh(*points, values, shading="nearest", rasterized=True, **limits)
    axes.figure.colorbar(image, ax=axes, label=plain(name))


def _draw_positions(axes: Axes, values: NDArray[np.float64], name: str) -> None:
    for number, (state, label) in enumerate(((values[0], "start"), (values[-1], "end"))):
        axes.plot(state[:, 0], state[:, 1], ".", color=color(number), markersize=3, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=plain(f"{name}[.., 0]"), ylabel=plain(f"{name}[.., 1]"))
    axes.legend()


@checks_arguments(trajectory=ARRAYS, ax=Kind.CANVAS)
def plot_spectrum(
    trajectory: Trajectory,
    path: str | os.PathLike[str] | None = None,
    *,
    field: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the spectrum of a field on a mesh in the first and last state: squared amplitudes of the modes of each axis.

    The modes are Fourier modes, or on elements Legendre polynomials (the largest of all elements); they must decay for
    the mesh to resolve the field. Arguments and errors as of :func:`plot_arrays`; StateError without a mesh.
    """
    if (mesh := mesh_of(trajectory)) is None:
        raise StateError("the system is not discretised from a density: a spectrum needs a mesh")
    name, values = array_values(trajectory, field)
    with panel(path, ax) as panel_axes:
        for k, axis in enumerate(mesh.axes):
            modes = axis.modes(np.moveaxis(values[[0, -1]], k + 1, -1)).max(axis=-2)
            for row, line in ((0, ":"), (-1, "-")):
                spectrum = modes[row].reshape(-1, modes.shape[-1]).max(axis=0)
                spectrum = np.fmax(spectrum, spectrum[spectrum > 0.0].min(initial=spectrum.max() or 1.0) / 2)
                label = f"{axis.name}, t = {trajectory.t[row]:g}"
                panel_axes.semilogy(np.arange(1, len(spectrum) + 1), spectrum, line, color=color(k), label=label)
        panel_axes.set(xlabel="number of the mode", ylabel=plain(f"squared amplitude of {name}"))
        panel_axes.legend()
    return panel_axes
