"""The attribute ``trajectory.plot``: a callable for the overview, with a method for each kind of plot."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from scvi_codegen.pictures.conserved import plot_energy, plot_momentum_maps
from scvi_codegen.pictures.overview import plot_trajectory
from scvi_codegen.pictures.paths import plot_motion, plot_phase
from scvi_codegen.pictures.section import plot_section
from scvi_codegen.pictures.trajectory_interface import DrawnMotion

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Path = str | os.PathLike[str] | None


@dataclass(frozen=True, slots=True)
class Plots:
    """Pictures of one trajectory: ``run.plot()``, ``run.plot.energy()``, ``run.plot.phase("orbit.png")``.

    Each draws on the axes ``ax`` or on new ones, writes to a .png or .svg if a path is given, and returns the axes.
    """

    trajectory: DrawnMotion = field(repr=False)

    def __call__(self, path: Path = None) -> tuple[Axes, ...]:
        """Draw path and energy error, as :func:`scvi_codegen.plot_trajectory`."""
        return plot_trajectory(self.trajectory, path)

    def motion(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the path, as :func:`scvi_codegen.plot_motion`."""
        return plot_motion(self.trajectory, path, ax=ax)

    def phase(self, path: Path = None, *, axes: tuple[str, str] | None = None, ax: Axes | None = None) -> Axes:
        """Draw a phase portrait, as :func:`scvi_codegen.plot_phase`."""
        return plot_phase(self.trajectory, path, axes=axes, ax=ax)

    def energy(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the energy error over time, as :func:`scvi_codegen.plot_energy`."""
        return plot_energy(self.trajectory, path, ax=ax)

    def momentum_maps(self, path: Path = None, *, ax: Axes | None = None) -> Axes:
        """Draw the errors of momentum maps, as :func:`scvi_codegen.plot_momentum_maps`."""
        return plot_momentum_maps(self.trajectory, path, ax=ax)

    def section(self, path: Path = None, *, axes: tuple[str, str], event: int = 0, ax: Axes | None = None) -> Axes:
        """Draw a Poincare section, as :func:`scvi_codegen.plot_section`."""
        return plot_section(self.trajectory, path, axes=axes, event=event, ax=ax)
