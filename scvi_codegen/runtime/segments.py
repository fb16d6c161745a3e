"""A measured motion in parts, each from a state of its own, that come to join: multiple shooting.

First the parts nearly by themselves, the jumps between them being residuals among others, from which a guess is found
in which every part is in phase. Then by the generalised Gauss-Newton method of H. G. Bock, *Recent advances in
parameter identification techniques for O.D.E.*, Progress in Scientific Computing 2 (1983) 95: the jumps, linearised,
are constraints of each linear least squares, so that what parts motions from each other never piles up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import FitError, StepFailedError
from scvi_codegen.runtime.driven import parameters_at
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.measurements import Measurements

__all__ = ["LOOSE", "TIGHT", "Chain", "Limits", "chained", "joined"]

LOOSE, TIGHT = 0.1, 1e-9
"""Of the size of states: what jump weighs as much as the residual of a measurement, at first and once all joins."""
MOST = 100
"""Iterations that join the parts."""
LEAST_PART = 1e-4
"""Of an iteration, which is halved as long as it leads uphill."""
ENOUGH = 1e-4
"""Of the descent that slopes promise: what an iteration must bring."""
JOINED, SETTLED, LEFT = 1e-10, 1e-9, 1e-12
"""Jumps of no size; by how much the last iteration changes residuals, beside these, or, by rounding, beside all that is
measured, by rounding."""
NEAR = 1e-5
"""Of jumps and of such changes: rounding hides what is downhill, and iterations are taken whole."""
SMALL = 1e-6
"""Of the size of measurements: residuals that are smaller are as good as none."""
BOUNDED, RELEASED = 8, 1e-9
"""Updates of the set of bounds that hold an unknown, beside three a bound; beside the steepest slope, what lets go."""
BESIDE = 3
"""Measurements before and after a node, through which a parabola is laid."""


Limits: TypeAlias = tuple[Array, Array]
"""The least and the greatest of all unknowns, infinite where there is no bound."""


@dataclass(eq=False)
class Chain:
    """Residuals and jumps as functions of the unknowns: those of places, then the state at each later node.

    Attributes:
        parts: measurements, each from its node on.
        known: (2m + parameters,) values of all, those of the unknowns overwritten.
        places: (k,) where unknowns stand among (q, p, parameters).
        sizes: (2m,) of states.
        jump: beside these, what weighs as much as a residual of ``unit``.
    """

    parts: tuple[Measurements, ...]
    known: Array
    places: NDArray[np.intp]
    sizes: Array
    jump: float = TIGHT
    unit: float = 1.0
    at: Array | None = field(default=None, init=False)

    @property
    def state(self) -> int:
        """Numbers of a state."""
        return 2 * self.parts[0].stepper.dimension

    def values(self, x: Array) -> Array:
        """(2m + parameters,) of the motion from its start."""
        values = self.known.copy()
        values[self.places] = x[: len(self.places)]
        return values

    def residuals(self, x: Array) -> Array:
        """Of all measurements, in standard deviations, then jumps; infinite where a motion fails, which turns back."""
        try:
            return self.evaluated(x)[0]
        except StepFailedError:
            if self.at is None:
                raise
            return np.full(len(self.found[0]), np.inf)

    def slopes(self, x: Array) -> Array:
        """(measurements and jumps, unknowns) of the same."""
        return self.evaluated(x)[1]

    def scaled(self, x: Array) -> Array:
        """Residuals of measurements alone."""
        found = self.evaluated(x)[0]
        return found[: len(found) - self.jumps.size]

    def typical(self, x: Array) -> float:
        """The root mean square residual of measurements, or a small one where there is none."""
        scaled = self.scaled(x)
        sizes = [np.nanmax(np.abs(part.measured / part.deviations)) for part in self.parts if part.used.any()]
        return max(float(np.sqrt(np.mean(scaled**2))), SMALL * float(max(sizes, default=1.0)), 1e-300)

    @property
    def measured(self) -> float:
        """The norm of all that is measured, in standard deviations."""
        return float(np.sqrt(sum(np.nansum((part.measured / part.deviations) ** 2) for part in self.parts)))

    def typical_unknowns(self, x: Array) -> Array:
        """(unknowns,) sizes: of parameters theirs, of states at least that of the motion; 0 where there is none."""
        guess, sizes = self.known[self.places], np.zeros(len(self.known))
        sizes[: self.state] = self.sizes
        own = np.where(guess != 0.0, np.maximum(np.abs(guess), np.abs(x[: len(guess)])), 0.0)
        first = np.maximum(own, sizes[self.places])
        return np.concatenate([first, np.tile(self.sizes, len(self.parts) - 1)])

    def evaluated(self, x: Array) -> tuple[Array, Array]:
        """Both, of one computation of the motion."""
        if self.at is None or not np.array_equal(x, self.at):
            found = [self._part(j, x) for j in range(len(self.parts))]
            nodes = x[len(self.places) :].reshape(-1, self.state)
            self.computed = np.concatenate([computed for computed, *_ in found])
            self.jumps = np.stack([end for *_, end, _ in found])[:-1] - nodes
            rows, slopes = [], []
            for part, (computed, by, *_) in zip(self.parts, found, strict=True):
                rows.append(((computed - part.measured) / part.deviations)[part.used])
                slopes.append((by / part.deviations[:, np.newaxis])[part.used])
            weights = self.unit / (self.jump * self.sizes)
            for j, (*_, by) in enumerate(found[:-1]):
                by[:, self._node(j + 1)] -= np.eye(self.state)
                rows.append(self.jumps[j] * weights)
                slopes.append(by * weights[:, np.newaxis])
            self.at, self.found = x.copy(), (np.concatenate(rows), np.concatenate(slopes))
        return self.found

    def _node(self, j: int) -> slice:
        """Where the state of a later node stands among the unknowns."""
        first = len(self.places) + (j - 1) * self.state
        return slice(first, first + self.state)

    def _part(self, j: int, x: Array) -> tuple[Array, Array, Array, Array]:
        """What it has at its measurements and at its end, each with its slopes by all unknowns."""
        part, values, size = self.parts[j], self.values(x), self.state
        changes = np.zeros((len(x), part.stepper.given))
        changes[np.arange(len(self.places)), self.places] = 1.0
        start = values[:size]
        if j > 0:
            changes[: len(self.places), :size] = 0.0
            changes[self._node(j), :size] = np.eye(size)
            start = x[self._node(j)]
        moving = np.flatnonzero(changes.any(axis=1))
        computed, by, end, at_end = part.motion(start, changes[moving], values[size:])
        slopes, slopes_at_end = np.zeros((*computed.shape, len(x))), np.zeros((size, len(x)))
        slopes[..., moving], slopes_at_end[:, moving] = by, at_end[:, :size].T
        return computed, slopes, end, slopes_at_end


def _states_told(whole: Measurements, parts: Sequence[Measurements], known: Array) -> Array:
    """(parts - 1, 2m) guesses of the states at later nodes: of parabolas through the measurements around them.

    Where not all coordinates are measured, those of the motion from the first guess.
    """
    m = whole.stepper.dimension
    order = [np.flatnonzero(whole.columns == k) for k in range(m)]
    if not all(len(each) for each in order):
        return _states_moved(parts, known)
    found = []
    for part in parts[1:]:
        values = parameters_at(whole.stepper.parameters, known[2 * m :], whole.inputs, part.start)
        told = [_parabola(whole, int(each[0]), part.start) for each in order]
        q, v = np.array(told).T
        found.append(np.concatenate([q, whole.stepper.momentum(q, v, part.start, values)]))
    return np.array(found).reshape(-1, 2 * m)


def _states_moved(parts: Sequence[Measurements], known: Array) -> Array:
    size = 2 * parts[0].stepper.dimension
    state, found = known[:size], []
    for part in parts[:-1]:
        state = part.motion(state, np.zeros((0, part.stepper.given)), known[size:])[2]
        found.append(state)
    return np.array(found).reshape(-1, size)


def _parabola(whole: Measurements, column: int, t: float) -> tuple[float, float]:
    """Value and slope at a time."""
    rows = np.flatnonzero(np.isfinite(whole.measured[:, column]))
    near = rows[np.argsort(np.abs(whole.t[rows] - t), kind="stable")[: 2 * BESIDE + 1]]
    coefficients = np.polynomial.polynomial.polyfit(
        whole.t[near] - t, whole.measured[near, column], min(2, len(near) - 1)
    )
    return float(coefficients[0]), float(np.append(coefficients, 0.0)[1])


def chained(whole: Measurements, known: Array, places: NDArray[np.intp], count: int) -> tuple[Chain, Array]:
    """So many parts, and a first guess of all unknowns."""
    parts = whole.cut(count) if count > 1 else (whole,)
    nodes = _states_told(whole, parts, known)
    sizes = _sizes(parts, known, nodes)
    return Chain(parts, known, places, sizes), np.concatenate([known[places], nodes.ravel()])


def _sizes(parts: Sequence[Measurements], known: Array, nodes: Array) -> Array:
    """(2m,) by how much each number of a state changes from node to node; those at rest as the most of their kind."""
    size = nodes.shape[1]
    states = np.concatenate([known[np.newaxis, :size], nodes])
    if len(states) == 1:
        end = parts[0].motion(known[:size], np.zeros((0, parts[0].stepper.given)), known[size:])[2]
        states = np.stack([states[0], end])
    kinds = np.ptp(states, axis=0).reshape(2, -1)
    largest = kinds.max(axis=1, keepdims=True)
    return np.where(kinds > 0.0, kinds, np.where(largest > 0.0, largest, 1.0)).ravel()


def joined(chain: Chain, x: Array, limits: Limits) -> tuple[Array, NDArray[np.bool_], int]:
    """The unknowns with which the parts join, which of them a bound holds, and after how many iterations.

    Near those that leave jumps, and within their bounds.

    Raises:
        FitError: where no iteration leads downhill, or too many are made.
    """
    whole, (low, high) = replace(chain, jump=1.0, unit=1.0), limits
    rounding = LEFT * whole.measured
    for iteration in range(1, MOST + 1):
        found, slopes = whole.evaluated(x)
        rows = len(found) - whole.jumps.size
        update, multipliers, held = _within(slopes, found, rows, (low - x, high - x))
        moved, size = (float(np.linalg.norm(each)) for each in (slopes[:rows] @ update, found[:rows]))
        jump, moved = float(np.abs(found[rows:]).max()), moved / max(size, rounding / SETTLED)
        if jump < JOINED and moved <= SETTLED:
            return x, held, iteration
        near = jump < NEAR and moved < NEAR
        part = 1.0 if near else _part_of(whole, x, update, 2.0 * float(np.abs(multipliers).max()))
        x = np.clip(x + part * update, low, high)
    raise FitError(f"the segments do not join within {MOST} iterations: give a nearer first guess, or more of them")


def _within(slopes: Array, found: Array, rows: int, limits: Limits) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The update that makes the first rows least and the others zero, of all that bounds allow, and their multipliers.

    By an active set: from no update towards the one wanted, as far as the first bound in the way, which then holds its
    unknown; one is let go where that leads downhill (Nocedal & Wright, *Numerical Optimization*, 16.5).

    Returns:
        The update, the multipliers of the other rows, and which unknowns a bound holds.
    """
    low, high = limits
    update, held = np.zeros(slopes.shape[1]), np.zeros(slopes.shape[1], dtype=bool)
    for _ in range(BOUNDED + 3 * int(np.isfinite(np.concatenate(limits)).sum())):
        wanted, multipliers = update.copy(), np.zeros(len(found) - rows)
        rest = found + slopes[:, held] @ update[held]
        wanted[~held], multipliers = _constrained(slopes[:, ~held], rest, rows)
        beyond, bound = (wanted < low) | (wanted > high), np.where(wanted < low, low, high)
        if beyond.any():
            parts = np.full(len(update), np.inf)
            parts[beyond] = (bound - update)[beyond] / (wanted - update)[beyond]
            first = int(np.argmin(parts))
            update = np.clip(update + parts[first] * (wanted - update), low, high)
            update[first], held[first] = bound[first], True
            continue
        update = wanted
        residuals = found[:rows] + slopes[:rows] @ update
        uphill = slopes[:rows].T @ residuals - slopes[rows:].T @ multipliers
        inward = np.where(held, np.where(update <= low, -uphill, uphill), 0.0)
        if not (inward > RELEASED * np.abs(uphill).max(initial=0.0)).any():
            break
        held[int(np.argmax(inward))] = False
    return update, multipliers, held


def _part_of(chain: Chain, x: Array, update: Array, weight: float) -> float:
    """How much of an update leads downhill; FitError where nothing does. Jumps weigh more than their multipliers."""
    found, slopes = chain.evaluated(x)
    rows = len(found) - chain.jumps.size
    before, part = _merit(found, rows, weight), 1.0
    descent = found[:rows] @ slopes[:rows] @ update - weight * np.abs(found[rows:]).sum()
    while not _merit(chain.residuals(x + part * update), rows, weight) <= before + ENOUGH * part * descent:
        part /= 2.0
        if part < LEAST_PART:
            raise FitError(
                "the segments do not come to join: give a nearer first guess, or more of them, or take as known what "
                "fewer unknowns show the measurements not to tell"
            )
    return part


def _merit(found: Array, rows: int, weight: float) -> float:
    """Half the sum of squares, and the jumps."""
    return float(0.5 * found[:rows] @ found[:rows] + weight * np.abs(found[rows:]).sum())


def _constrained(slopes: Array, found: Array, rows: int) -> tuple[Array, Array]:
    """The update that makes the first rows least and the others zero, and the multipliers of those; sparse."""
    from scipy.sparse import block_array, csc_array, identity
    from scipy.sparse.linalg import splu

    by, of = csc_array(slopes[:rows]), csc_array(slopes[rows:])
    matrix = block_array([[identity(rows), by, None], [by.T, None, of.T], [None, of, None]], format="csc")
    solved = splu(matrix).solve(-np.concatenate([found[:rows], np.zeros(slopes.shape[1]), found[rows:]]))
    return solved[rows : rows + slopes.shape[1]], solved[rows + slopes.shape[1] :]
