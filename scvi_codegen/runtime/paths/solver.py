"""Newton's method for paths, with natural monotonicity, and continuation in the duration.

A step is damped until the simplified Newton correction decreases, |H^-1 r(q + s dq)| < (1 - s/4) |dq| (Deuflhard,
Newton Methods for Nonlinear Problems, sec. 3.3), which does not depend on units of the residual.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.errors import PathError, StateError, StepFailedError
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.paths.equations import Closed, closed_residual, factors_of
from scvi_codegen.runtime.paths.intervals import Intervals, Linearised

TOLERANCE = 1e-11
"""Newton correction, relative to 1 + max|q|, at which the iteration ends."""
ROUNDING, ILL_CONDITIONED = 1e-14, 1e-7
"""Residual, relative to the momenta, that is rounding, and the correction that then ends the iteration."""
MOST_ITERATIONS, LEAST_STEP = 60, 1e-4
FIRST_PART, MOST_GROWTH, LEAST_GROWTH, CONTINUED_ITERATIONS = 16, 2.0, 1.005, 15
"""Continuation: part of the duration it starts from, factors of the duration, and iterations of each."""
UNSOLVED = PathError, StepFailedError, StateError, ArithmeticError, np.linalg.LinAlgError
MINIMISER_ITERATIONS, NEAR_CLOSED = 100, 0.01
"""Iterations of the minimiser, and relative Newton correction below which a closed path is not minimised first."""
FIRST_SHIFT, MOST_SHIFT, LEAST_SHIFT, MOST_DESCENTS = 1e-2, 1e3, 1e-10, 60
"""Shifts of the Hessian relative to its largest entry, and most iterations of the descent."""
LEAST_DECREASE, NEAR = 1e-4, 1e-3
"""Part of the predicted decrease of the action that is required (Armijo), and the correction that ends the descent."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Positions of a path, its steps with their derivatives, and the factors of its Hessian."""

    q: Array
    intervals: Intervals
    at: Linearised
    factors: Any
    iterations: int


def newton(
    evaluate: Callable[[Array, bool], tuple[Linearised, Array]],
    factorise: Callable[[Linearised], Any],
    move: Callable[[Array, Array], Array],
    q: Array,
    most: int,
) -> tuple[Array, Linearised, Any, int]:
    """Solve r(q) = 0 by Newton's method; ``evaluate`` returns the steps, with derivatives if requested, and r.

    Raises:
        PathError: if the iteration does not converge.
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
        if size <= (ILL_CONDITIONED if rounding else TOLERANCE) * (1.0 + float(np.abs(q).max())):
            return move(q, correction), at, factors, iteration
        damping = min(1.0, 2.0 * damping)
        while True:
            trial = move(q, damping * correction)
            try:
                simplified = float(np.abs(factors.solve(evaluate(trial, False)[1])).max())
                if simplified < (1.0 - damping / 4.0) * size:
                    break
            except UNSOLVED:
                pass
            damping /= 2.0
            if damping < LEAST_STEP:
                raise PathError("Newton's method made no progress")
        q = trial
    raise PathError(f"Newton's method did not converge in {most} iterations")


def solved(intervals: Intervals, q: Array, most: int = MOST_ITERATIONS) -> Solution:
    """Return the path between fixed ends near q."""

    def evaluate(q: Array, derivatives: bool) -> tuple[Linearised, Array]:
        at = intervals.linearised(q) if derivatives else intervals.evaluated(q)
        return at, at.residual

    q, at, factors, iterations = newton(evaluate, lambda at: factors_of(at, intervals), intervals.moved, q, most)
    return Solution(q, intervals, at, factors, iterations)


def continued(intervals: Intervals, q: Array, duration: float) -> Solution:
    """Return the path by continuation in the duration, from a sixteenth, where the straight line is nearly exact."""
    now, growth = duration / FIRST_PART, MOST_GROWTH
    found = solved(intervals.lasting(now), q)
    total = found.iterations
    while abs(now) < abs(duration) * (1.0 - 1e-12):
        longer = duration if abs(now * growth) >= abs(duration) else now * growth
        try:
            found = solved(intervals.lasting(longer), found.q, CONTINUED_ITERATIONS)
            total, now, growth = total + found.iterations, longer, min(MOST_GROWTH, growth**1.5)
        except UNSOLVED as error:
            growth **= 0.5
            if growth < LEAST_GROWTH:
                raise PathError(f"continuation in the duration ended at {now:g} of {duration:g}") from error
    return Solution(found.q, found.intervals, found.at, found.factors, total)


def descended(intervals: Intervals, q: Array) -> Solution:
    """Return a minimum of the action below q, by Newton's method with a shift that makes the Hessian positive definite.

    Raises:
        PathError: if there is none, as on paths longer than their first conjugate time.
    """
    at = intervals.linearised(q)
    scale = float(np.abs(at.blocks[3]).max())
    shift, iterations = FIRST_SHIFT, 0
    while shift >= LEAST_SHIFT:
        iterations += 1
        factors = factors_of(at, intervals, shift * scale)
        if iterations > MOST_DESCENTS or shift > MOST_SHIFT:
            raise PathError("no minimum of the action was found")
        correction = -factors.solve(at.residual)
        decrease = float(np.sum(correction * at.residual))
        try:
            if not factors.positive or decrease >= 0:
                raise PathError("no direction of descent")
            trial = intervals.moved(q, correction)
            there = intervals.linearised(trial)
            if not there.actions.sum() <= at.actions.sum() + LEAST_DECREASE * decrease:
                raise PathError("no decrease of the action")
        except UNSOLVED:
            shift *= 4.0
            continue
        q, at, shift = trial, there, shift / 4.0
        if float(np.abs(correction).max()) <= NEAR * (1.0 + float(np.abs(q).max())):
            break
    found = solved(intervals, q)
    return Solution(found.q, intervals, found.at, found.factors, iterations + found.iterations)


def at_energy(found: Solution, duration: float, energy: float, start: Callable[[Array, Array], Any]) -> Solution:
    """Return the path of a given energy, whose duration is a further unknown (bordered Newton's method).

    Args:
        start: function of (q0, p0) that returns the energy and the velocity there.
    """
    q, count, damping = found.q, len(found.intervals.h), 1.0
    for iteration in range(MOST_ITERATIONS):
        intervals = found.intervals.lasting(duration)
        at = intervals.linearised(q)
        factors = factors_of(at, intervals)
        by_time = (at.by_h[1][:-1] - at.by_h[0][1:]) / count
        along = -factors.solve(by_time)
        value, velocity = start(q[0], at.p0[0])
        first = at.blocks[1][0] if not intervals.sparse else _first_block(at, intervals)
        velocity = intervals.tangent(0, velocity)
        derivative = velocity @ (first @ along[0] + at.by_h[0][0] / count)

        def correction(
            r: Array,
            miss: float,
            factors: Any = factors,
            first: Any = first,
            velocity: Array = velocity,
            derivative: float = derivative,
            along: Array = along,
        ) -> tuple[Array, float]:
            own = -factors.solve(r)
            change = -(miss + velocity @ (first @ own[0])) / derivative
            return own + change * along, float(change)

        moved, change = correction(at.residual, value - energy)
        size = max(float(np.abs(moved).max()), abs(change))
        if not np.isfinite(size):
            break
        if size <= TOLERANCE * (1.0 + float(np.abs(q).max())):
            return Solution(q, intervals, at, factors, found.iterations + iteration)
        damping = min(1.0, 2.0 * damping)
        while True:
            trial, longer = intervals.moved(q, damping * moved), duration + damping * change
            try:
                there = intervals.lasting(longer).evaluated(trial)
                simplified = correction(there.residual, start(trial[0], there.p0[0])[0] - energy)
                if max(float(np.abs(simplified[0]).max()), abs(simplified[1])) < (1.0 - damping / 4.0) * size:
                    break
            except UNSOLVED:
                pass
            damping /= 2.0
            if damping < LEAST_STEP:
                raise PathError("Newton's method for the duration at this energy made no progress")
        q, duration = trial, longer
    raise PathError(f"no path of energy {energy:g} was found: give another T to start from")


def _first_block(at: Linearised, intervals: Any) -> Any:
    from scipy.sparse import csc_matrix

    return csc_matrix((at.blocks[1][0], (intervals.rows, intervals.columns)), shape=(intervals.dimension,) * 2)


def closed(intervals: Intervals, q: Array, M: Array, *, minimise: bool, symmetric: bool) -> Solution:
    """Return the closed path q_N = M q_0 near the (N, d) nodes q; with ``minimise`` near a minimum of the action."""
    intervals.symmetry = M

    def whole(nodes: Array) -> Array:
        return np.concatenate([nodes, (M @ nodes[0])[np.newaxis]])

    def moved(nodes: Array, y: Array) -> Array:
        return intervals.moved(whole(nodes), y)[:-1]

    def evaluate(nodes: Array, derivatives: bool) -> tuple[Linearised, Array]:
        at = intervals.linearised(whole(nodes)) if derivatives else intervals.evaluated(whole(nodes))
        return at, closed_residual(at, M, intervals)

    q = intervals.on_manifold_all(q)
    at, r = evaluate(q, True)
    near = float(np.abs(Closed(at, intervals.basis_map(M), symmetric=symmetric).solve(r)).max()) < NEAR_CLOSED * float(
        np.abs(q).max()
    )
    if minimise and not near:
        q = _minimised(evaluate, q)
    found, at, factors, iterations = newton(
        evaluate, lambda at: Closed(at, intervals.basis_map(M), symmetric=symmetric), moved, q, MOST_ITERATIONS
    )
    return Solution(whole(found), intervals, at, factors, iterations)


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
