"""Plots over time: energy error, momentum maps, and residuals of a fit."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.pictures.canvas import MOTIONS, Array, Motions, color, panel, plain, several, smooth
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, slots=True, eq=False)
class ResidualPlot:
    """Plot ``fit.plot()``: measured minus computed values over time, with bands of two standard deviations.

    Attributes:
        t: (n,) times.
        residuals: (n, c), NaN where nothing was measured.
        deviations: (c,) standard deviations of the noise.
        names: names of the quantities.
    """

    t: Array
    residuals: Array
    deviations: Array
    names: tuple[str, ...]

    def __call__(self, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Axes:
        """Draw on the axes ``ax`` or on new ones; write a .png, .svg or .pdf if a path is passed."""
        with panel(path, ax) as axes:
            curves = zip(self.names, self.residuals.T, self.deviations, strict=True)
            for number, (name, column, deviation) in enumerate(curves):
                axes.plot(self.t, column, ".", markersize=4, color=color(number), label=plain(name))
                axes.axhspan(-2.0 * deviation, 2.0 * deviation, color=color(number), alpha=0.1, linewidth=0)
            axes.axhline(0.0, color="black", linewidth=0.6)
            axes.set(xlabel="t", title="measured minus computed; bands of two standard deviations")
            axes.legend(loc="best", fontsize=8)
        return axes


BINS = 600
LOWEST = 1e-16
"""Error drawn on a logarithmic axis if all are 0."""


@checks_arguments(trajectories=MOTIONS, ax=Kind.CANVAS)
def plot_energy(trajectories: Motions, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None) -> Axes:
    """Draw the energy error ``|H - H_0| / |H_0|`` over time (absolute if H_0 = 0), a colour a trajectory.

    Where forces, damping or contacts change the energy of the exact motion, the change E - E0 is drawn on a linear
    axis. The title says which, and how well the balance with the work W closes if W is known.

    Args:
        trajectories: one or several trajectories, also of array systems.
        path, ax: as of :func:`~scvi_codegen.extras.pictures.overview.plot_motion`.

    Raises:
        StateError, PlotError: as :func:`~scvi_codegen.extras.pictures.overview.plot_motion`.
    """
    with panel(path, ax) as axes:
        for number, motion in enumerate(several(trajectories)):
            draw_energy_error(axes, motion, number)
    return axes


@checks_arguments(trajectory=MOTIONS, ax=Kind.CANVAS)
def plot_momentum_maps(
    trajectory: Motions, path: str | os.PathLike[str] | None = None, *, ax: Axes | None = None
) -> Axes:
    """Draw the change of each momentum map over time, relative to the largest size of its terms.

    Args:
        trajectory: trajectory of a system with symmetries, or several.
        path, ax: as of :func:`~scvi_codegen.extras.pictures.overview.plot_motion`.

    Raises:
        StateError, PlotError: as :func:`~scvi_codegen.extras.pictures.overview.plot_motion`; StateError without a
            symmetry.
    """
    motions = several(trajectory)
    interface = motions[0].stepper.interface
    if not interface.map_names:
        raise StateError(f"'{interface.system}' has no known symmetry, and therefore no momentum maps")
    with panel(path, ax) as axes:
        for which, motion in enumerate(motions):
            errors = np.abs(motion.momentum_errors())
            for number, name in enumerate(interface.map_names):
                _draw_error(axes, motion.t, errors[:, number], number, None if which else name)
        axes.set(xlabel="t", title="relative change of momentum maps")
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8)
    return axes


def draw_energy_error(axes: Axes, motion: Trajectory, number: int = 0) -> None:
    """Draw the error of a conserved energy or the change of another, with the title of the first trajectory."""
    account = motion.energy_account(limited=True)
    if account.reason is None:
        _draw_error(axes, motion.t, np.abs(account.values) / account.scale, number)
    else:
        between = smooth(motion)
        energy = np.asarray(between.energy())
        axes.plot(between.t, energy - energy[0], color=color(number), linewidth=0.9)
    if number == 0:
        balance = f"\n{np.abs(account.values).max():.0e} beside the work" if account.work is not None else ""
        change = f"energy change E - E0: {account.reason}{balance}"
        axes.set(xlabel="t", title=change if account.reason else account.title)


def _draw_error(axes: Axes, t: Array, error: Array, number: int, label: str | None = None) -> None:
    """Draw the largest error in each bin, on a logarithmic axis that also fits the curves drawn before."""
    times, largest = largest_in_bins(t, error)
    axes.plot(times, largest, color=color(number), linewidth=0.9, label=label)
    axes.set_yscale("log")
    errors = np.concatenate([np.asarray(line.get_ydata(), dtype=float) for line in axes.get_lines()])
    positive = errors[np.isfinite(errors) & (errors > 0.0)]
    positive = positive if positive.size else np.array([LOWEST])
    low = 10.0 ** np.floor(np.log10(positive.min()) - 0.3)
    axes.set_ylim(low, max(10.0 ** np.ceil(np.log10(positive.max()) + 0.3), 10.0 * low))


def largest_in_bins(t: Array, error: Array) -> tuple[Array, Array]:
    """Return (k,) times and the largest error from each to the next; zeros are half of the smallest positive error."""
    size = max(1, len(t) // BINS)
    starts = np.arange(0, len(t), size)
    largest: Any = np.maximum.reduceat(error, starts)
    positive = largest[largest > 0.0]
    return t[starts], np.where(largest == 0.0, positive.min() / 2 if positive.size else LOWEST, largest)
