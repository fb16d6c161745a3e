"""Multiple shooting: measurements divided into segments with separate initial states and continuity constraints.

First the jumps between segments are weak residuals, which gives an initial guess in phase with all segments. Then
continuity is imposed by the generalised Gauss-Newton method of H. G. Bock, *Recent advances in parameter identification
techniques for O.D.E.*, Progress in Scientific Computing 2 (1983) 95: linearised jumps are equality constraints of a
linear least-squares problem, so errors do not grow over the whole record.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import EventError, FitError, StepFailedError
from scvi_codegen.extras.exact.newton import MIN_FRACTION
from scvi_codegen.extras.fits.measurements import Measurements

LOOSE, TIGHT = 0.1, 1e-9
"""Jumps, relative to the size of states, that weigh as much as a measurement residual: initially, and finally."""
MOST = 100
"""Largest number of Gauss-Newton iterations."""
ARMIJO = 1e-4
"""Fraction of the predicted descent that a step must attain (L. Armijo, Pac. J. Math. 16 (1966) 1; J. Nocedal,
S. J. Wright, Numerical Optimization, 2006, 3.1)."""
JOINED, SETTLED, ROUNDING_LEVEL = 1e-10, 1e-9, 1e-12
"""Convergence: largest jump, largest relative change of the residuals, and rounding level of the measurements."""
NEAR = 1e-5
"""Jumps and changes below which full steps are taken, as rounding hides the descent."""
SMALL = 1e-6
"""Residuals, relative to the measurements, below which the fit counts as exact."""
BOUNDED = 8
"""Base number of updates of the active-set iteration, whose bounds a gradient above ``SETTLED`` releases."""
GAUGE = 1e3
"""Weight of the equations that fix the lengths of quaternions, relative to that of a measurement."""
PARABOLA_NEIGHBOURS = 3
"""Number of measurements on each side of a node for a parabola fit."""


Limits: TypeAlias = tuple[Array, Array]
"""Lower and upper bounds of all unknowns; infinite for no bound."""


@dataclass(eq=False)
class Chain:
    """Residuals and jumps as functions of the unknowns: parameters and initial state, then states at later nodes.

    Attributes:
        parts: measurements of each segment.
        prior: (2m + parameters,) values of the initial guess; those of the unknowns are overwritten.
        unknown_indices: (k,) indices of the unknowns in (q, p, parameters).
        sizes: (2m,) sizes of state entries.
        jump: jump relative to ``sizes`` that weighs as much as a residual of ``unit``.
    """

    parts: tuple[Measurements, ...]
    prior: Array
    unknown_indices: NDArray[np.intp]
    sizes: Array
    jump: float = TIGHT
    unit: float = 1.0
    at: Array | None = field(default=None, init=False)

    @property
    def state(self) -> int:
        """Number of entries of a state, 2m."""
        return 2 * self.parts[0].stepper.dimension

    def values(self, x: Array) -> Array:
        """Return (2m + parameters,) initial state and parameters."""
        values = self.prior.copy()
        values[self.unknown_indices] = x[: len(self.unknown_indices)]
        return values

    def residuals(self, x: Array) -> Array:
        """Return residuals in standard deviations, then jumps; infinite if a step fails, which shortens the update."""
        try:
            return self.evaluated(x)[0]
        except (EventError, StepFailedError):
            if self.at is None:
                raise
            return np.full(len(self.evaluation[0]), np.inf)

    def jacobian(self, x: Array) -> Array:
        """Return the (residuals and jumps, unknowns) Jacobian."""
        return self.evaluated(x)[1]

    def scaled(self, x: Array) -> Array:
        """Return the residuals of the measurements."""
        residuals = self.evaluated(x)[0]
        return residuals[: len(residuals) - self.jumps.size]

    def typical(self, x: Array) -> float:
        """Return the root mean square residual of the measurements, bounded below."""
        scaled = self.scaled(x)
        sizes = [np.nanmax(np.abs(part.measured / part.deviations)) for part in self.parts if part.used.any()]
        return max(float(np.sqrt(np.mean(scaled**2))), SMALL * float(max(sizes, default=1.0)), 1e-300)

    @property
    def measured(self) -> float:
        """Norm of all measurements in standard deviations."""
        return float(np.sqrt(sum(np.nansum((part.measured / part.deviations) ** 2) for part in self.parts)))

    def typical_unknowns(self, x: Array) -> Array:
        """Return (unknowns,) typical sizes; 0 for parameters whose initial guess is 0."""
        guess, sizes = self.prior[self.unknown_indices], np.zeros(len(self.prior))
        sizes[: self.state] = self.sizes
        typical = np.where(guess != 0.0, np.maximum(np.abs(guess), np.abs(x[: len(guess)])), 0.0)
        first = np.maximum(typical, sizes[self.unknown_indices])
        return np.concatenate([first, np.tile(self.sizes, len(self.parts) - 1)])

    def evaluated(self, x: Array) -> tuple[Array, Array]:
        """Return residuals and Jacobian from one integration; the last evaluation is cached."""
        if self.at is None or not np.array_equal(x, self.at):
            by_part = [self._part(j, x) for j in range(len(self.parts))]
            nodes = x[len(self.unknown_indices) :].reshape(-1, self.state)
            self.computed = np.concatenate([computed for computed, *_ in by_part])
            self.jumps = np.stack([end for *_, end, _ in by_part])[:-1] - nodes
            rows, jacobian = [], []
            for part, (computed, by, *_) in zip(self.parts, by_part, strict=True):
                rows.append(((computed - part.measured) / part.deviations)[part.used])
                jacobian.append((by / part.deviations[:, np.newaxis])[part.used])
            gauge, by_gauge = self._gauge(x)
            rows.append(gauge)
            jacobian.append(by_gauge)
            weights = self.unit / (self.jump * self.sizes)
            for j, (*_, by) in enumerate(by_part[:-1]):
                by[:, self._node(j + 1)] -= np.eye(self.state)
                rows.append(self.jumps[j] * weights)
                jacobian.append(by * weights[:, np.newaxis])
            self.at, self.evaluation = x.copy(), (np.concatenate(rows), np.concatenate(jacobian))
        return self.evaluation

    def _gauge(self, x: Array) -> tuple[Array, Array]:
        """Return residuals, with derivatives, that fix the gauge of rotations in the initial state if it is unknown."""
        stepper, size = self.parts[0].stepper, self.state
        if not stepper.interface.rotations or size - 1 not in self.unknown_indices:
            return np.zeros(0), np.zeros((0, len(x)))
        weight = GAUGE / min(float(part.deviations.min()) for part in self.parts)
        values, rows = stepper.products.reduction.gauge(self.values(x)[:size], self.prior[:size])
        by_all = np.zeros((len(values), len(self.prior)))
        by_all[:, :size] = rows
        jacobian = np.zeros((len(values), len(x)))
        jacobian[:, : len(self.unknown_indices)] = by_all[:, self.unknown_indices]
        return weight * values, weight * jacobian

    def _node(self, j: int) -> slice:
        """Return the indices of the state of node j among the unknowns."""
        first = len(self.unknown_indices) + (j - 1) * self.state
        return slice(first, first + self.state)

    def _part(self, j: int, x: Array) -> tuple[Array, Array, Array, Array]:
        """Return the computed measurements and the end of segment j, each with derivatives by all unknowns."""
        part, values, size = self.parts[j], self.values(x), self.state
        tangents = np.zeros((len(x), part.stepper.products.tangents))
        tangents[np.arange(len(self.unknown_indices)), self.unknown_indices] = 1.0
        start = values[:size]
        if j > 0:
            tangents[: len(self.unknown_indices), :size] = 0.0
            tangents[self._node(j), :size] = np.eye(size)
            start = x[self._node(j)]
        moving = np.flatnonzero(tangents.any(axis=1))
        computed, by, end, at_end = part.motion(start, tangents[moving], values[size:])
        jacobian, partials_at_end = np.zeros((*computed.shape, len(x))), np.zeros((size, len(x)))
        jacobian[..., moving], partials_at_end[:, moving] = by, at_end[:, :size].T
        return computed, jacobian, end, partials_at_end


def _node_states_from_measurements(whole: Measurements, parts: Sequence[Measurements], prior: Array) -> Array:
    """Return (parts - 1, 2m) guesses of node states by parabolas through neighbouring measurements.

    Unless all coordinates are measured the guesses are from the trajectory of the initial guess.
    """
    m = whole.stepper.dimension
    measured_columns = [np.flatnonzero(whole.columns == k) for k in range(m)]
    if not all(len(columns) for columns in measured_columns):
        return _node_states_from_guess(parts, prior)
    states = []
    for part in parts[1:]:
        values = whole.stepper.products.parameters_at(part.start, prior[2 * m :], whole.inputs)
        parabolas = [_parabola(whole, int(columns[0]), part.start) for columns in measured_columns]
        q, v = np.array(parabolas).T
        states.append(np.concatenate([q, whole.stepper.momentum(q, v, part.start, values)]))
    return np.array(states).reshape(-1, 2 * m)


def _node_states_from_guess(parts: Sequence[Measurements], prior: Array) -> Array:
    size = 2 * parts[0].stepper.dimension
    state, states = prior[:size], []
    for part in parts[:-1]:
        state = part.motion(state, np.zeros((0, part.stepper.products.tangents)), prior[size:])[2]
        states.append(state)
    return np.array(states).reshape(-1, size)


def _parabola(whole: Measurements, column: int, t: float) -> tuple[float, float]:
    rows = np.flatnonzero(np.isfinite(whole.measured[:, column]))
    near = rows[np.argsort(np.abs(whole.t[rows] - t), kind="stable")[: 2 * PARABOLA_NEIGHBOURS + 1]]
    coefficients = np.polynomial.polynomial.polyfit(
        whole.t[near] - t, whole.measured[near, column], min(2, len(near) - 1)
    )
    return float(coefficients[0]), float(np.append(coefficients, 0.0)[1])


def chained(whole: Measurements, prior: Array, unknown_indices: NDArray[np.intp], count: int) -> tuple[Chain, Array]:
    """Return a chain of ``count`` segments, and an initial guess of all unknowns."""
    parts = whole.cut(count) if count > 1 else (whole,)
    nodes = _node_states_from_measurements(whole, parts, prior)
    sizes = _sizes(parts, prior, nodes)
    return Chain(parts, prior, unknown_indices, sizes), np.concatenate([prior[unknown_indices], nodes.ravel()])


def _sizes(parts: Sequence[Measurements], prior: Array, nodes: Array) -> Array:
    """Return (2m,) ranges of the state entries over the nodes; constant entries get the largest range of their kind."""
    size = nodes.shape[1]
    states = np.concatenate([prior[np.newaxis, :size], nodes])
    if len(states) == 1:
        end = parts[0].motion(prior[:size], np.zeros((0, parts[0].stepper.products.tangents)), prior[size:])[2]
        states = np.stack([states[0], end])
    kinds = np.ptp(states, axis=0).reshape(2, -1)
    largest = kinds.max(axis=1, keepdims=True)
    return np.where(kinds > 0.0, kinds, np.where(largest > 0.0, largest, 1.0)).ravel()


def joined(chain: Chain, x: Array, limits: Limits) -> tuple[Array, NDArray[np.bool_], int]:
    """Return the unknowns that satisfy continuity within bounds, the mask of those at bounds, and the iterations."""
    whole, (low, high) = replace(chain, jump=1.0, unit=1.0), limits
    rounding = ROUNDING_LEVEL * whole.measured
    for iteration in range(1, MOST + 1):
        residuals, jacobian = whole.evaluated(x)
        rows = len(residuals) - whole.jumps.size
        update, multipliers, at_bound = _bounded_update(jacobian, residuals, rows, (low - x, high - x))
        moved, size = float(np.linalg.norm(jacobian[:rows] @ update)), float(np.linalg.norm(residuals[:rows]))
        jump, moved = float(np.abs(residuals[rows:]).max()), moved / max(size, rounding / SETTLED)
        if jump < JOINED and moved <= SETTLED:
            return x, at_bound, iteration
        near = jump < NEAR and moved < NEAR
        part = 1.0 if near else _step_length(whole, x, update, 2.0 * float(np.abs(multipliers).max()))
        x = np.clip(x + part * update, low, high)
    raise FitError(f"the segments do not join within {MOST} iterations: give a better initial guess, or more segments")


def _bounded_update(
    jacobian: Array, residuals: Array, rows: int, limits: Limits
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return the update that minimises the first rows subject to zeros in the others and to bounds.

    Active-set method (Nocedal & Wright, *Numerical Optimization*, 16.5): move towards the equality-constrained solution
    up to the first bound, which becomes active; release a bound whose multiplier has the wrong sign.

    Returns:
        The update, the multipliers of the other rows, and the mask of unknowns at bounds.
    """
    low, high = limits
    update, at_bound = np.zeros(jacobian.shape[1]), np.zeros(jacobian.shape[1], dtype=bool)
    for _ in range(BOUNDED + 3 * int(np.isfinite(np.concatenate(limits)).sum())):
        target, multipliers = update.copy(), np.zeros(len(residuals) - rows)
        rest = residuals + jacobian[:, at_bound] @ update[at_bound]
        target[~at_bound], multipliers = _equality_constrained_update(jacobian[:, ~at_bound], rest, rows)
        beyond, limit = (target < low) | (target > high), np.where(target < low, low, high)
        if beyond.any():
            parts = np.full(len(update), np.inf)
            parts[beyond] = (limit - update)[beyond] / (target - update)[beyond]
            first = int(np.argmin(parts))
            update = np.clip(update + parts[first] * (target - update), low, high)
            update[first], at_bound[first] = limit[first], True
            continue
        update = target
        predicted = residuals[:rows] + jacobian[:rows] @ update
        uphill = jacobian[:rows].T @ predicted - jacobian[rows:].T @ multipliers
        inward = np.where(at_bound, np.where(update <= low, -uphill, uphill), 0.0)
        if not (inward > SETTLED * np.abs(uphill).max(initial=0.0)).any():
            break
        at_bound[int(np.argmax(inward))] = False
    return update, multipliers, at_bound


def _step_length(chain: Chain, x: Array, update: Array, weight: float) -> float:
    """Return a step length with sufficient descent of the merit function; raise FitError if there is none."""
    residuals, jacobian = chain.evaluated(x)
    rows = len(residuals) - chain.jumps.size
    before, part = _merit(residuals, rows, weight), 1.0
    # derivative of the merit function along the update u, which cancels the linearised jumps: r . J u - weight |c|_1
    descent = residuals[:rows] @ jacobian[:rows] @ update - weight * np.abs(residuals[rows:]).sum()
    while not _merit(chain.residuals(x + part * update), rows, weight) <= before + ARMIJO * part * descent:
        part /= 2.0
        if part < MIN_FRACTION:
            raise FitError(
                "the segments do not join, as no step reduces the residuals: give a better initial guess or more "
                "segments, or treat poorly determined parameters as known"
            )
    return part


def _merit(residuals: Array, rows: int, weight: float) -> float:
    """Return the l1 merit function |r|^2 / 2 + weight |c|_1 of residuals r and jumps c.

    It is an exact penalty function (Nocedal & Wright, *Numerical Optimization*, 15.4).
    """
    return float(0.5 * residuals[:rows] @ residuals[:rows] + weight * np.abs(residuals[rows:]).sum())


def _equality_constrained_update(jacobian: Array, residuals: Array, rows: int) -> tuple[Array, Array]:
    """Return the update u that minimises |r + J u|^2 / 2 subject to c + C u = 0, and the multipliers of the latter.

    r and J are the first ``rows`` rows, c and C the others. With s = -(r + J u) and J^T s + C^T y = 0, y the
    multipliers, u follows from the augmented system, whose matrix is as sparse as J and C.
    """
    from scipy.sparse import block_array, csc_array, identity
    from scipy.sparse.linalg import splu

    unknowns = jacobian.shape[1]
    J, C = csc_array(jacobian[:rows]), csc_array(jacobian[rows:])
    # [1 J 0; J^T 0 C^T; 0 C 0] (s, u, y) = -(r, 0, c)
    matrix = block_array([[identity(rows), J, None], [J.T, None, C.T], [None, C, None]], format="csc")
    s_u_y = splu(matrix).solve(-np.concatenate([residuals[:rows], np.zeros(unknowns), residuals[rows:]]))
    return s_u_y[rows : rows + unknowns], s_u_y[rows + unknowns :]
