"""Picard iteration on the equations of a step, from a constant guess: (18) of SC and (30) of SVI in NumPy.

Both are Q = q0 + h c v0 + h^2 B f(E Q): E maps Q at the nodes to the points where forces are evaluated, the nodes
themselves for SC, and B solves for Q. Unlike the package's solvers it starts anew in each step, as the counts of the
paper do.

Iteration counts on Kepler's problem: as printed in Tables 8 and 9, by Picard iteration, by the package's solvers.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, perihelion
from scvi_codegen.reproduce.laboratory.drawing import Array
from scvi_codegen.reproduce.laboratory.running import BY_POINTS, SCHEMES, SECTION_3, Reading, steps_in, trajectory
from scvi_codegen.tables.basis import cardinal_derivatives, cardinal_values, differentiation_matrix
from scvi_codegen.tables.nodes import chebyshev_lobatto
from scvi_codegen.tables.quadrature import gauss_legendre

Force: TypeAlias = Callable[[Array], Array]
"""Function that returns accelerations (points, m) at positions (points, m); masses are 1."""


class NotSolvedError(Exception):
    """The iteration did not converge."""


@dataclass(frozen=True, slots=True)
class Equations:
    """Step of h = 1 on nodes that end at c = 1.

    Attributes:
        c: (s,) nodes without the first, in [0, 1].
        at: (points, s + 1) matrix from positions at all nodes to those where the force is evaluated.
        solution: (s, points) B, from forces to their contribution to the positions.
        momentum: (points,) from forces to their contribution to the momentum.
    """

    c: Array
    at: Array
    solution: Array
    momentum: Array


@lru_cache(maxsize=64)
def spectral_collocation(degree: int) -> Equations:
    """Return (18) on Chebyshev nodes: A^2 Q = F(Q) - a0 v0 - (A a0) q0."""
    nodes = chebyshev_lobatto(degree).points
    inverse = np.linalg.inv(2.0 * _array(differentiation_matrix(nodes))[1:, 1:])
    return Equations(_unit(nodes), np.eye(degree + 1)[1:], inverse @ inverse, inverse[-1])


@lru_cache(maxsize=64)
def galerkin(degree: int, points: int) -> Equations:
    """Return (30) on Chebyshev nodes with Gauss points: the first s rows of the stiffness (29), solved for Q."""
    nodes, rule = chebyshev_lobatto(degree).points, gauss_legendre(points)
    weights = _array([rule.weights])[0] / 2.0
    values, derivatives = (_array(table(nodes, rule.points)) for table in (cardinal_values, cardinal_derivatives))
    stiffness = 4.0 * (derivatives.T * weights) @ derivatives
    return Equations(_unit(nodes), values, -np.linalg.solve(stiffness[:-1, 1:], (values.T * weights)[:-1]), weights)


def picard_step(
    equations: Equations, force: Force, q: Array, p: Array, *, h: float, tolerance: float, max_iterations: int
) -> tuple[Array, Array, int]:
    """Return (q, p) after a step of h, and the number of iterations until max |dQ| < tolerance.

    Raises:
        NotSolvedError: if there are more than ``max_iterations``, or numbers overflow.
    """
    line = q + h * np.outer(equations.c, p)
    positions = np.tile(q, (len(line), 1))
    for count in range(1, max_iterations + 1):
        forces = force(equations.at @ np.vstack([q, positions]))
        updated = line + h**2 * (equations.solution @ forces)
        size = np.abs(updated - positions).max()
        positions = updated
        if size < tolerance:
            forces = force(equations.at @ np.vstack([q, positions]))
            return positions[-1], p + h * (equations.momentum @ forces), count
        if not np.isfinite(size):
            break
    raise NotSolvedError


def _array(table: object) -> Array:
    return np.array(table, dtype=float)


def _unit(nodes: object) -> Array:
    return (_array([nodes])[0, 1:] + 1.0) / 2.0


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
