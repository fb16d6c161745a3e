"""Quantities of runs with one degree of freedom: energy errors, drift, area in the phase plane."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import MethodWarning
from scvi_codegen.methods import SVI
from scvi_codegen.reproduce.laboratory.drawing import largest_in_bins
from scvi_codegen.reproduce.laboratory.experiment import Cell, TableBlock, series_table
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

Array = NDArray[np.float64]

NO_DRIFT = 1e-12
"""Largest error that counts as round-off."""


def svi_with_points(degree: int, points: int) -> SVI:
    """Return an SVI with any number of Gauss points, without the warning for fewer than the degree."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MethodWarning)
        return SVI(degree, f"gauss-legendre:{points}")


def energy_error(run: Trajectory) -> Array:
    """Return H - H(0) along a run."""
    error: Array = run.energy() - run.energy()[0]
    return error


def largest(error: Array) -> float:
    """Return the largest absolute value."""
    return float(np.abs(error).max())


def drift(error: Array) -> float:
    """Return the mean over the last fifth of a run less that over the first: 0.8 of the end of a straight line."""
    part = max(1, len(error) // 5)
    return float(error[-part:].mean() - error[:part].mean())


def drifts(error: Array) -> bool:
    """Return True if more than a third of the largest error is drift, not oscillation; never for round-off."""
    return largest(error) > NO_DRIFT and abs(drift(error)) > largest(error) / 3


def area_change(run: Trajectory) -> float:
    """Return the area enclosed by the last fifth of a run relative to the first fifth, less 1.

    The states must surround the origin of the phase plane. For n states the polygon is smaller than the curve by about
    (2 pi / n)^2 / 3.
    """
    part = len(run) // 5
    first, last = (_enclosed_area(run.q[states, 0], run.p[states, 0]) for states in np.s_[:part, -part:])
    return last / first - 1.0


def _enclosed_area(q: Array, p: Array) -> float:
    """Return the area of the polygon through points in the order of their angle about the origin."""
    order = np.argsort(np.arctan2(p, q))
    x, y = q[order], p[order]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def area_factor(stepper: Stepper, q: float, p: float, h: float, *, distance: float = 1e-4) -> float:
    """Return the determinant of the Jacobian of one step, by central differences: 1 for a symplectic step."""

    def difference(dq: float, dp: float) -> Array:
        ahead, behind = (stepper.step([q + sign * dq], [p + sign * dp], h=h) for sign in (1.0, -1.0))
        return (np.concatenate(ahead) - np.concatenate(behind)) / (2.0 * distance)

    return float(np.linalg.det(np.array([difference(distance, 0.0), difference(0.0, distance)])))


def offset_from_curve(run: Trajectory, *, distance: float = 1e-5) -> Array:
    """Return the distance of each state from the energy curve, to first order: (H - H(0)) / |grad H|."""

    def derivative(dq: float, dp: float) -> Array:
        ahead, behind = (run.stepper.energy(run.q + s * dq, run.p + s * dp, run.t, run.parameters) for s in (1.0, -1.0))
        difference: Array = (ahead - behind) / (2.0 * distance)
        return difference

    offset: Array = energy_error(run) / np.hypot(derivative(distance, 0.0), derivative(0.0, distance))
    return offset


def energy_table(runs: Mapping[str, Trajectory]) -> TableBlock:
    """Return largest energy error, drift and change of the enclosed area of each run, by scheme."""
    rows: list[tuple[Cell, ...]] = []
    for scheme, run in runs.items():
        error = energy_error(run)
        rows.append((scheme, run.stepper.title.partition(": ")[2], largest(error), drift(error), area_change(run)))
    return TableBlock(
        columns=("scheme", "method", "largest energy error", "drift of the energy", "change of the phase area"),
        rows=tuple(rows),
        formats={"largest energy error": ".2e", "drift of the energy": ".1e", "change of the phase area": ".1e"},
    )


def curves_table(name: str, t: Array, errors: Mapping[str, Array], *, bins: int = 1000) -> TableBlock:
    """Return the curves of a plot of errors over time; the largest |error| in each bin for long ones."""
    columns = [largest_in_bins(t, error, bins=bins) for error in errors.values()]
    named = {scheme: values.tolist() for scheme, (_, values) in zip(errors, columns, strict=True)}
    return series_table({"t": columns[0][0].tolist(), **named}, name)
