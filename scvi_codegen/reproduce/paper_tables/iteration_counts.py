"""Iteration counts on Kepler's problem: as printed in Tables 8 and 9, by Picard iteration, by the package's solvers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.reproduce.kepler.exact_flow import SYSTEM, perihelion
from scvi_codegen.reproduce.laboratory.picard import (
    Equations,
    NotSolvedError,
    galerkin,
    picard_step,
    spectral_collocation,
)
from scvi_codegen.reproduce.laboratory.readings import BY_POINTS, SCHEMES, Reading
from scvi_codegen.reproduce.laboratory.running import SECTION_3, steps_in, trajectory

__all__ = [
    "ECCENTRICITY",
    "SPAN",
    "Agreement",
    "Count",
    "Counts",
    "Setting",
    "agreement",
    "attraction",
    "compiled_count",
    "compiled_counts",
    "picard_counts",
    "printed_counts",
]

Array = NDArray[np.float64]

SPAN = 100.0
COUNTS = (2, 5, 10, 15, 20)
"""Values of N."""
ECCENTRICITY: Mapping[int, float] = {8: 0.2, 9: 0.5}
PRINTED: Mapping[int, Mapping[float, str]] = {
    8: {
        0.5: "-       10/1520  8/1271  7/1168  7/1176  7/1176   7/1181   7/1181   7/1186   7/1185",
        1.0: "-       -        11/870  9/735   9/709   8/695    8/696    8/695    8/697    8/697",
        2.0: "-       -        37/739  11/485  11/476  10/416   10/451   10/414   10/425   10/417",
        5.0: "-       -        -       -       -       15/279   18/311   14/240   14/261   17/239",
        8.0: "-       -        -       -       -       -        -        23/225   135/536  29/215",
    },
    9: {
        0.5: "-       -        13/1511 10/1303 9/1277  9/1270   9/1271   9/1271   9/1274   9/1274",
        1.0: "-       -        -       14/834  13/815  11/764   11/771   11/760   11/765   11/762",
        2.0: "-       -        -       19/674  -       14/504   17/535   13/481   14/504   18/492",
        5.0: "-       -        -       -       -       15/279   -        65/433   -        114/607",
    },
}
"""Counts by table and h: max/total for N = 2, 5, 10, 15, 20, SC and SVI each; a dash where the paper has none."""


@dataclass(frozen=True, slots=True)
class Count:
    """Iterations of a run: largest per step, total, and its largest relative energy error; or why it failed."""

    largest: int | None
    total: int | None
    failure: str = ""
    energy: float = math.nan

    @property
    def converged(self) -> bool:
        """True if every step converged."""
        return self.total is not None

    @property
    def sound(self) -> bool:
        """True if also the relative energy error is below 1; it is not if the body escapes."""
        return self.converged and self.energy < 1.0


Setting: TypeAlias = tuple[float, int, str]
"""Step size, N and scheme."""

Counts: TypeAlias = Mapping[Setting, Count]


def printed_counts(number: int) -> Counts:
    """Return the paper's table."""
    columns = [(n, scheme) for n in COUNTS for scheme in reversed(SCHEMES)]
    return {
        (h, n, scheme): _parsed(cell)
        for h, text in PRINTED[number].items()
        for (n, scheme), cell in zip(columns, text.split(), strict=True)
    }


def _parsed(cell: str) -> Count:
    if cell == "-":
        return Count(None, None)
    largest, total = map(int, cell.split("/"))
    return Count(largest, total)


@lru_cache(maxsize=4)
def compiled_counts(number: int, solver: str) -> Counts:
    """Return the counts of a solver of this package at the settings of a table, N counting points."""
    return {setting: compiled_count(ECCENTRICITY[number], *setting, solver) for setting in printed_counts(number)}


def compiled_count(e: float, h: float, n: int, scheme: str, solver: str) -> Count:
    """Return the count at one setting."""
    try:
        run = trajectory(SYSTEM, BY_POINTS.method(scheme, n), *perihelion(e), h=h, span=SPAN, solver=solver)
    except StepFailedError as error:
        return Count(None, None, f"step {error.step}: {error.status}")
    largest = int(run.iterations.max())
    if largest > SECTION_3.max_iterations:
        step = int(run.iterations.argmax()) - 1
        return Count(None, None, f"step {step}: {largest} iterations")
    energy = float(np.abs(run.energy() / run.energy()[0] - 1.0).max())
    return Count(largest, int(run.iterations.sum()), energy=energy)


@lru_cache(maxsize=16)
def picard_counts(number: int, reading: Reading, tolerance: float = SECTION_3.tolerance) -> Counts:
    """Return the counts of Picard iteration from a constant guess in every step, at the settings of a table."""
    equations: Mapping[str, Callable[[int], Equations]] = {
        "SC": lambda n: spectral_collocation(reading.degree(n)),
        "SVI": lambda n: galerkin(reading.degree(n), n),
    }
    return {
        (h, n, scheme): _picard_count(ECCENTRICITY[number], h, equations[scheme](n), tolerance)
        for h, n, scheme in printed_counts(number)
    }


def attraction(q: Array) -> Array:
    """Return accelerations at positions (n, 2)."""
    with np.errstate(all="ignore"):  # iterates that reach the centre or diverge do not converge
        result: Array = -q / np.hypot(q[:, :1], q[:, 1:]) ** 3
    return result


def _picard_count(e: float, h: float, equations: Equations, tolerance: float) -> Count:
    (q, p), counts, energy = map(np.array, perihelion(e)), list[int](), 0.0
    for step in range(steps_in(SPAN, h)):
        try:
            q, p, count = picard_step(
                equations, attraction, q, p, h=h, tolerance=tolerance, max_iterations=SECTION_3.max_iterations
            )
        except NotSolvedError:
            return Count(None, None, f"step {step}: not converged")
        counts.append(count)
        energy = max(energy, float(abs(p @ p - 2.0 / np.hypot(*q) + 1.0)))
    return Count(max(counts), sum(counts), energy=energy)


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of counts with the printed ones.

    Attributes:
        cells: number of cells of the table.
        alike: number of cells that converge or fail as printed.
        ratio: median ratio of all iterations, measured over printed, where both converge.
    """

    cells: int
    alike: int
    ratio: float


def agreement(result: Counts, printed: Counts) -> Agreement:
    """Compare counts cell by cell."""
    pairs = [(result[setting], count) for setting, count in printed.items()]
    ratios = [ours.total / theirs.total for ours, theirs in pairs if ours.total and theirs.total]
    return Agreement(len(pairs), sum(a.converged == b.converged for a, b in pairs), statistics.median(ratios))
