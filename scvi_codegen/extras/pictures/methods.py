"""Methods of runs and ensembles: pictures and films."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from os import PathLike
from typing import Any

from scvi_codegen.api.states import Array
from scvi_codegen.extras.pictures.animation import Film, animate
from scvi_codegen.extras.pictures.overview import Plots
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory

MOST_DRAWN = 64
"""Number of trajectories of an ensemble that are drawn."""


class OfRuns:
    """Pictures of trajectories and ensembles."""

    @property
    def plot(self: Any) -> Plots:
        """Plots: ``run.plot()`` gives an overview, ``run.plot.energy("energy.png")`` a single plot in a file.

        There are ``motion``, ``phase``, ``energy``, ``momentum_maps`` and ``section``, and of fields on a mesh
        ``field`` and ``spectrum``; each returns Matplotlib axes. Of an ensemble the first 64 trajectories are drawn.
        """
        return Plots(_drawn(self))

    def animate(
        self: Any,
        path: str | PathLike[str] | None = None,
        *,
        seconds: float = 8.0,
        positions: Callable[[Array], Array] | None = None,
        picture: Mapping[str, Any] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Film:
        """Return an animation for a notebook, or write .gif, .html or .mp4; see :func:`scvi_codegen.animate`.

        Of an ensemble the first 64 trajectories are drawn together.
        """
        return animate(_drawn(self), path, seconds=seconds, positions=positions, picture=picture, progress=progress)


OfEnsembles = OfRuns


def _drawn(run: Any) -> Any:
    """Return the run, of an ensemble the first trajectories."""
    return [run[j] for j in range(min(len(run), MOST_DRAWN))] if isinstance(run, EnsembleTrajectory) else run
