"""Newton's method for paths, with natural monotonicity, and continuation in the duration.

A step is damped until the simplified Newton correction decreases, |H^-1 r(q + s dq)| < (1 - s/4) |dq| (Deuflhard,
Newton Methods for Nonlinear Problems, sec. 3.3), which does not depend on units of the residual.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from scvi_codegen.api.runs import Products
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import PathError, StateError, StepFailedError
from scvi_codegen.extras.exact.newton import MIN_FRACTION
from scvi_codegen.extras.fits.multiple_shooting import ARMIJO
from scvi_codegen.extras.paths.equations import Bordered, BorderedClosed, Closed, closed_residual, factors_of
from scvi_codegen.extras.paths.intervals import Intervals, Linearised
from scvi_codegen.extras.paths.size import ROUNDOFF, SAME, SizeOfMotion, largest_range, size_for_updates

TOLERANCE = 1e-11
"""Newton correction, relative to the range of the path, at which the iteration ends."""
ROUNDING = 1e-14
"""Residual, relative to the momenta, that is rounding; a correction below its root then ends the iteration, since what
Newton's method leaves is of the order of its square."""
GAUGED = 1.2
"""Ratio of momenta to those of velocities from which on the latter are their size."""
MOST_ITERATIONS = 60
FEW_ITERATIONS = 25
"""Largest number of iterations from one of several starts, and of a part of a continuation."""
FIRST_PART, MOST_GROWTH, LEAST_GROWTH = 16, 2.0, 1.005
"""Continuation: part of the duration it starts from, and factors of the duration."""
DURATIONS = 2.0 ** np.linspace(-3.0, 3.0, 25)
"""Parts of the duration in one of which a curve may be nearly a motion."""
UNSOLVED = PathError, StepFailedError, StateError, ArithmeticError, np.linalg.LinAlgError
MINIMISER_ITERATIONS = 100
NEAR = 0.01
"""Newton correction, relative to the range of the path, below which Newton's method alone finds it: a descent ends."""
FIRST_SHIFT, MOST_SHIFT = 1e-2, 1e3
"""Shifts of the Hessian relative to its largest entry."""

States = Callable[[Array, Array], tuple[Array, Array]]
"""Type of a function of (n, m) positions and momenta that returns (n,) energies and (n, m) velocities."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Positions of a path, its steps with their derivatives, and the factors of its Hessian."""

    q: Array
    intervals: Intervals
    at: Linearised
    factors: Any
    iterations: int

    @cached_property
    def at_rest(self) -> bool:
        """True if all positions are equal, up to rounding or relative to the start of the search."""
        rounding = Products.RESOLVED * ROUNDOFF * float(np.abs(self.q).max())
        return largest_range(self.q) <= max(SAME * self.intervals.range_of_start, rounding)

    @property
    def momenta(self) -> Array:
        """(N + 1, m) momenta of the nodes."""
        return np.concatenate([self.at.p0, self.at.p1[-1:]])

    @cached_property
    def size(self) -> SizeOfMotion:
        """Size of the motion; of a path at rest that of the start of the search.

        Momenta of velocities are about dp/dq1 times the displacements in steps: other ones are those of a gauge of L.
        """
        intervals, q, steepness = self.intervals, self.q, float(np.abs(self.at.blocks).max())
        moved = np.array([intervals.tangent(k, row) for k, row in enumerate(np.diff(q, axis=0))])
        of_velocity = float(np.abs(intervals.products(self.at.blocks[1], moved)).max())
        own = SizeOfMotion.of(q, self.momenta)
        own = replace(own, momentum=of_velocity) if own.momentum > GAUGED * of_velocity else own
        of_q, of_p = own.rounding
        own = replace(own, rounding=(of_q, of_p + of_q * steepness))
        if not self.at_rest:
            return own
        position = intervals.range_of_start or float(np.abs(q).max())
        return replace(own, position=position, momentum=position * steepness)


def newton(
    evaluate: Callable[[Array, bool], tuple[Linearised, Array]],
    factorise: Callable[[Linearised], Any],
    move: Callable[[Array, Array], Array],
    relative: Callable[[Array, Array], float],
    q: Array,
    most: int,
) -> tuple[Array, Linearised, Any, int]:
    """Solve r(q) = 0 by Newton's method.

    Args:
        evaluate: function of q that returns the steps, with derivatives if requested, and r.
        factorise: function that returns the factors of the derivatives of r.
        move: function of q and a correction that returns the unknowns moved by it.
        relative: function of q and a correction that returns its size relative to the motion.
        q: start of the iteration.
        most: largest number of iterations.
    """
    damping = 1.0
    for iteration in range(most):
        at, r = evaluate(q, True)
        factors = factorise(at)
        correction = -factors.solve(r)
        size = float(np.abs(correction).max(initial=0.0))
        if not np.isfinite(size):
            break
        rounding = float(np.abs(r).max(initial=0.0)) <= ROUNDING * float(np.abs(at.p0).max() + np.abs(at.p1).max())
        if relative(q, correction) <= (math.sqrt(ROUNDING) if rounding else TOLERANCE):
            return move(q, correction), at, factors, iteration
        damping = min(1.0, 2.0 * damping)
        while True:
            trial = move(q, damping * correction)
            with suppress(*UNSOLVED):
                simplified = float(np.abs(factors.solve(evaluate(trial, False)[1])).max())
                if simplified < (1.0 - damping / 4.0) * size:
                    break
            damping /= 2.0
            if damping < MIN_FRACTION:
                raise PathError("Newton's method made no progress")
        q = trial
    raise PathError(f"Newton's method did not converge in {most} iterations")


def _relative(intervals: Intervals, q: Array, correction: Array) -> float:
    """Return the largest correction of a node relative to the range of the path, or to that of a path at rest."""
    size = size_for_updates(q, TOLERANCE, SAME * intervals.range_of_start)
    return float(np.abs(correction).max(initial=0.0)) / (size or 1.0)


def solved(intervals: Intervals, q: Array, most: int = MOST_ITERATIONS) -> Solution:
    """Return the path between fixed ends near q."""

    def evaluate(q: Array, derivatives: bool) -> tuple[Linearised, Array]:
        at = intervals.linearised(q) if derivatives else intervals.evaluated(q)
        return at, at.residual

    q, at, factors, iterations = newton(
        evaluate, lambda at: factors_of(at, intervals), intervals.moved, partial(_relative, intervals), q, most
    )
    return Solution(q, intervals, at, factors, iterations)


def continued(intervals: Intervals, q: Array, duration: float, first: float | None = None) -> Solution:
    """Return the path by continuation in the duration from ``first``.

    By default this is a sixteenth, where the straight line is nearly exact.
    """
    reached, growth = duration / FIRST_PART if first is None else first, MOST_GROWTH
    solution = solved(intervals.lasting(reached), q)
    total = solution.iterations
    while abs(math.log(reached / duration)) > 1e-12:
        trial = duration
        if abs(math.log(reached / duration)) > math.log(growth):
            trial = reached * growth ** math.copysign(1.0, math.log(duration / reached))
        try:
            solution = solved(intervals.lasting(trial), solution.q, FEW_ITERATIONS)
            total, reached, growth = total + solution.iterations, trial, min(MOST_GROWTH, growth**1.5)
        except UNSOLVED as error:
            growth **= 0.5
            if growth < LEAST_GROWTH:
                raise PathError(f"continuation in the duration ended at {reached:g} of {duration:g}") from error
    return replace(solution, iterations=total)


def continued_from_motion(intervals: Intervals, q: Array, duration: float) -> Solution:
    """Return the path by continuation from the duration in which the curve q is nearest to a motion.

    It is the one of ``DURATIONS`` with the smallest jumps of the momentum relative to the momenta.
    """
    jumps = {}
    for first in (duration * DURATIONS).tolist():
        with suppress(*UNSOLVED):
            at = intervals.lasting(first).linearised(q)
            jumps[first] = float(np.abs(at.residual).max() / np.abs(at.p0).max())
    if not jumps:
        raise PathError("no step along the start has a solution")
    return continued(intervals, q, duration, min(jumps, key=lambda first: jumps[first]))


def descended(intervals: Intervals, q: Array) -> Solution:
    """Return a minimum of the action below q, by Newton's method with a shift that makes the Hessian positive definite.

    PathError if there is none, as on paths longer than their first conjugate time.
    """
    at = intervals.linearised(q)
    scale = float(np.abs(at.blocks[3]).max())
    shift, iterations = FIRST_SHIFT, 0
    while True:
        iterations += 1
        factors = factors_of(at, intervals, shift * scale)
        if iterations > MOST_ITERATIONS or shift > MOST_SHIFT:
            raise PathError("no minimum of the action was found")
        correction = -factors.solve(at.residual)
        decrease = float(np.sum(correction * at.residual))
        try:
            if not factors.positive or decrease >= 0:
                raise PathError("no direction of descent")
            trial = intervals.moved(q, correction)
            there = intervals.linearised(trial)
            if not there.actions.sum() <= at.actions.sum() + ARMIJO * decrease:
                raise PathError("no decrease of the action")
        except UNSOLVED:
            shift *= 4.0
            continue
        q, at, shift = trial, there, shift / 4.0
        if _relative(intervals, q, correction) <= NEAR:
            break
    solution = solved(intervals, q)
    return replace(solution, iterations=iterations + solution.iterations)


class AtEnergy:
    """Equations of a path of given energy, with its duration T as a further unknown behind those of the path.

    The residuals are the derivatives of S(q, T) + E T. Between fixed ends the energy is that of the first node. Of a
    closed path it is the mean of the nodes: its gradient is that of the discrete energy -dS/dT to the order of the
    method, which makes the matrix symmetric.

    Args:
        intervals: steps of an estimate of T.
        energy: required value.
        states: function of (q, p) that returns the energies and velocities at nodes.
        M: symmetry of a closed path.
    """

    def __init__(self, intervals: Intervals, energy: float, states: States, M: Any = None) -> None:
        self.intervals, self.energy, self.states, self.M = intervals, energy, states, M
        self.rows, self.velocities = len(intervals.h) - (M is None), np.empty(0)

    def solved(self, q: Array, iterations: int = 0) -> Solution:
        """Return the path near the nodes q, and the duration of the intervals."""
        M = self.M
        x = np.append(q if M is None else q[: self.rows], float(self.intervals.h.sum()))
        try:
            x, at, _, more = newton(self.evaluate, self.factorise, self.move, self.relative, x, MOST_ITERATIONS)
        except UNSOLVED as error:
            raise PathError(
                f"no path of energy {self.energy:g} was found ({error}): give another T to start from, or another "
                "energy, which must be that of a motion"
            ) from error
        intervals = self.intervals.lasting(float(x[-1]))
        own = factors_of(at, intervals) if M is None else Closed(at, self.intervals.basis_map(M), symmetric=True)
        return Solution(self.nodes(x), intervals, at, own, iterations + more)

    def nodes(self, x: Array) -> Array:
        """Return the positions of all nodes."""
        q = x[:-1].reshape(-1, self.intervals.stepper.dimension)
        return q if self.M is None else np.concatenate([q, (self.M @ q[0])[np.newaxis]])

    def evaluate(self, x: Array, derivatives: bool) -> tuple[Linearised, Array]:
        """Return the steps, and the residuals of the nodes followed by that of the energy."""
        if x[-1] * self.intervals.h[0] <= 0:
            raise PathError("the duration became 0")
        self.intervals = intervals = self.intervals.lasting(float(x[-1]))
        at = (intervals.linearised if derivatives else intervals.evaluated)(self.nodes(x))
        r = at.residual if self.M is None else closed_residual(at, self.M, intervals)
        count = 1 if self.M is None else self.rows
        energies, self.velocities = self.states(self.nodes(x)[:count], at.p0[:count])
        return at, np.append(r, self.energy - energies.mean())

    def factorise(self, at: Linearised) -> Any:
        """Return the factors of the bordered matrix."""
        intervals, (start, end) = self.intervals, at.by_h / len(at.p0)
        velocities = [intervals.tangent(k, np.asarray(v)) for k, v in enumerate(self.velocities)]
        corner = -float(np.mean([v @ by_h for v, by_h in zip(velocities, start, strict=False)]))
        border = end[:-1] - start[1:]
        if self.M is not None:
            M = intervals.basis_map(self.M)
            return BorderedClosed(at, M, np.concatenate([(M.T @ end[-1] - start[0])[np.newaxis], border]), corner)
        first = at.blocks[1][0] if not intervals.sparse else _first_block(at, intervals)
        return Bordered(factors_of(at, intervals), border, -(first.T @ velocities[0]), corner)

    def relative(self, x: Array, correction: Array) -> float:
        """Return the larger one of the relative corrections of the nodes and of the duration."""
        return max(_relative(self.intervals, self.nodes(x), correction[:-1]), float(abs(correction[-1] / x[-1])))

    def move(self, x: Array, correction: Array) -> Array:
        """Return the nodes and the duration moved by a correction."""
        q = self.intervals.moved(self.nodes(x), correction[:-1].reshape(self.rows, -1))
        return np.append(q if self.M is None else q[:-1], x[-1] + correction[-1])


def _first_block(at: Linearised, intervals: Any) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix((at.blocks[1][0], (intervals.rows, intervals.columns)), shape=(intervals.dimension,) * 2)


def closed(
    intervals: Intervals, q: Array, M: Array, *, minimise: bool, symmetric: bool, energy: float | None, states: States
) -> Solution:
    """Return the closed path q_N = M q_0 near the (N, d) nodes q; with ``minimise`` near a minimum of the action.

    With an energy the duration of the intervals is the first estimate. If Newton's method for both from q fails, it
    starts from the path of this duration.
    """
    intervals.symmetry = M

    def whole(nodes: Array) -> Array:
        return np.concatenate([nodes, (M @ nodes[0])[np.newaxis]])

    def moved(nodes: Array, y: Array) -> Array:
        return intervals.moved(whole(nodes), y)[:-1]

    def evaluate(nodes: Array, derivatives: bool) -> tuple[Linearised, Array]:
        at = intervals.linearised(whole(nodes)) if derivatives else intervals.evaluated(whole(nodes))
        return at, closed_residual(at, M, intervals)

    q = intervals.on_manifold_all(q)
    if energy is not None:
        with suppress(*UNSOLVED):
            return AtEnergy(intervals, energy, states, M).solved(q)

    def factorise(at: Linearised) -> Closed:
        return Closed(at, intervals.basis_map(M), symmetric=symmetric)

    def relative(nodes: Array, correction: Array) -> float:
        return _relative(intervals, whole(nodes), correction)

    at, r = evaluate(q, True)
    if minimise and relative(q, factorise(at).solve(r)) >= NEAR:
        q = _minimised(evaluate, q)
    q, at, factors, iterations = newton(evaluate, factorise, moved, relative, q, MOST_ITERATIONS)
    if energy is not None:
        return AtEnergy(intervals, energy, states, M).solved(q, iterations)
    return Solution(whole(q), intervals, at, factors, iterations)


def _minimised(evaluate: Callable[[Array, bool], tuple[Linearised, Array]], q: Array) -> Array:
    """Return nodes of smaller action and residual, or q."""
    from scipy.optimize import minimize

    def action(x: Array) -> tuple[float, Array]:
        try:
            at, r = evaluate(x.reshape(q.shape), False)
        except UNSOLVED:
            return math.inf, np.full_like(x, math.inf)
        return float(at.actions.sum()), r.ravel()

    before = action(q.ravel())[1]
    with np.errstate(all="ignore"):  # the action may be unbounded below
        result = minimize(action, q.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": MINIMISER_ITERATIONS})
    after = np.abs(result.jac).max()
    return np.asarray(result.x.reshape(q.shape)) if after < np.abs(before).max() or not before.any() else q
