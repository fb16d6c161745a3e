"""Plots of fields on meshes: space-time diagrams, images of a state, spectra."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.errors import StateError, closest
from scvi_codegen.pictures.canvas import MOTION, Array, DrawnMotion, color, panel, plain
from scvi_codegen.validation import CANVAS, PATH, TEXT, checks_arguments

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def mesh_of(motion: Any) -> Any:
    """Return the mesh of the fields of a trajectory, or ``None`` if they are not discretised from a density."""
    layout = motion.stepper.interface.layout
    return None if layout is None else layout.mesh


def field_values(motion: Any, name: str | None) -> tuple[Any, str, Array]:
    """Return mesh, name and values (n, shape of the fields) of a field, by default the first.

    Raises:
        StateError: without a mesh, for an unknown field, and for a run with ``observe``.
    """
    if (mesh := mesh_of(motion)) is None:
        raise StateError("the system is not discretised from a density: plots of fields need a mesh; see plot_arrays")
    if motion.observed is not None:
        raise StateError("a run with observe saves only its first and last state: run it without observe")
    arrays = mesh.fields_of(np.asarray(motion.q), np.asarray(motion.p))
    chosen = next(iter(arrays)) if name is None else name
    if chosen not in arrays:
        raise StateError(f"there is no field '{chosen}'{closest(chosen, arrays)} Known: {', '.join(arrays)}")
    return mesh, chosen, arrays[chosen]


@checks_arguments(trajectory=MOTION, field=TEXT, path=PATH, ax=CANVAS)
def plot_field(
    trajectory: DrawnMotion,
    path: str | os.PathLike[str] | None = None,
    *,
    field: str | None = None,
    state: int = -1,
    ax: Axes | None = None,
) -> Axes:
    """Draw a field of a mesh: over space and time on one axis, one state on two, its middle plane z on three.

    Args:
        trajectory: result of :meth:`Stepper.integrate` for the system of a :class:`~scvi_codegen.MeshSystem`.
        path, ax: as of :func:`~scvi_codegen.plot_motion`.
        field: name of the field; by default the first.
        state: index of the state drawn of two and three axes.

    Raises:
        StateError: if the system has no mesh or no such field, and for a run with ``observe``.
        PlotError: without matplotlib.
    """
    mesh, name, values = field_values(trajectory, field)
    labels = [axis.name for axis in mesh.axes]
    points = [axis.points for axis in mesh.axes]
    if not -len(values) <= state < len(values):
        raise StateError(f"there is no state {state} in a trajectory with {len(values)}")
    title = None
    if len(labels) == 1:
        across, up, shown, labels = points[0], trajectory.t, values, [*labels, "t"]
    else:
        shown = values[state] if len(labels) == 2 else values[state, :, :, len(points[2]) // 2]
        across, up, shown = points[0], points[1], shown.T
        title = f"t = {trajectory.t[state]:g}"
    largest = float(np.abs(values).max()) or 1.0
    with panel(path, ax) as drawn:
        drawn.grid(visible=False)
        limits: dict[str, Any] = {"cmap": "RdBu_r", "vmin": -largest, "vmax": largest}
        image = drawn.pcolormesh(across, up, shown, shading="nearest", rasterized=True, **limits)
        drawn.figure.colorbar(image, ax=drawn, label=plain(name))
        drawn.set(xlabel=labels[0], ylabel=labels[1], title=title)
        if len(points) > 1:
            drawn.set_aspect("equal")
    return drawn


@checks_arguments(trajectory=MOTION, field=TEXT, path=PATH, ax=CANVAS)
def plot_spectrum(
    trajectory: DrawnMotion,
    path: str | os.PathLike[str] | None = None,
    *,
    field: str | None = None,
    ax: Axes | None = None,
) -> Axes:
    """Draw the spectrum of a field in the first and last state: squared amplitudes of the modes along each axis.

    The modes are Fourier modes, or on elements Legendre polynomials (the largest of all elements); they must decay for
    the mesh to resolve the field. Arguments as of :func:`plot_field`.
    """
    mesh, name, values = field_values(trajectory, field)
    with panel(path, ax) as drawn:
        for k, axis in enumerate(mesh.axes):
            modes = axis.modes(np.moveaxis(values[[0, -1]], k + 1, -1)).max(axis=-2)
            for row, marker in ((0, ":"), (-1, "-")):
                spectrum = modes[row].reshape(-1, modes.shape[-1]).max(axis=0)
                label = f"{axis.name}, t = {trajectory.t[row]:g}"
                drawn.semilogy(np.arange(1, len(spectrum) + 1), spectrum, marker, color=color(k), label=label)
        drawn.set(xlabel="number of the mode", ylabel=plain(f"squared amplitude of {name}"))
        drawn.legend()
    return drawn
