"""Runs with one degree of freedom: energy errors, drift, area in the phase plane, and their tables and pictures."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from scvi_codegen.errors import MethodWarning
from scvi_codegen.methods import SVI
from scvi_codegen.reproduce.laboratory.drawing import Array, Figure, draw_error, draw_orbit, largest_in_bins, panels
from scvi_codegen.reproduce.laboratory.experiment import Cell, Comparison, Picture, Result, TableBlock, series_table
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

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


DOTS = {"linestyle": "", "marker": ".", "markersize": 2}
"""Style of states in the phase plane."""


def draw_phase(
    orbits: Mapping[str, tuple[Array, ...]], exact: tuple[Array, Array], style: Mapping[str, Any], figure: Figure
) -> None:
    """Draw orbits in the phase plane by scheme, over the exact one."""
    limit = 1.05 * max(largest(np.concatenate(orbit)) for orbit in orbits.values())
    for axes, (scheme, (q, p)) in zip(panels(figure, 1, len(orbits)), orbits.items(), strict=True):
        draw_orbit(axes, q, p, scheme_name(scheme), scheme, **style)
        axes.plot(*exact, color="black", linestyle="--", linewidth=0.7, label="exact")
        axes.set(xlabel="q", ylabel="p", title=scheme, aspect="equal", xlim=(-limit, limit), ylim=(-limit, limit))
        axes.legend(loc="center", markerscale=3)


def scheme_name(scheme: str) -> str:
    """Return the name of a scheme without its degree or order."""
    return scheme.partition(",")[0].rstrip("46")


def energy_result(
    setting: tuple[str, ...],
    runs: Mapping[str, Trajectory],
    checks: Callable[[Mapping[str, Array]], tuple[Comparison, ...]],
) -> Result:
    """Return the result for the energy errors of several runs of equal steps."""
    errors, t = {scheme: energy_error(run) for scheme, run in runs.items()}, next(iter(runs.values())).t
    return Result(
        setting=setting,
        checks=checks(errors),
        tables=(energy_table(runs), curves_table("curves", t, errors)),
        picture=Picture(draw=partial(draw_energy, t, errors), width=7.0),
    )


LINES = ("-", ":", "--")
"""Styles of the curves of a scheme, in turn."""


def draw_energy(t: Array, errors: Mapping[str, Array], figure: Figure) -> None:
    """Draw energy errors over time: a colour for each scheme."""
    (axes,) = panels(figure, 1, 1)
    drawn = Counter[str]()
    for label, error in errors.items():
        scheme = scheme_name(label)
        draw_error(axes, t, error, scheme, label, linestyle=LINES[drawn[scheme]])
        drawn[scheme] += 1
    axes.set(xlabel="t", ylabel="|H - H(0)|")
    axes.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
