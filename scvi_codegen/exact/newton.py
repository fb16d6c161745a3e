"""Newton's iteration that refines mpmath numbers with a Jacobian in double precision.

The residual has 60 digits and the Jacobian 16: close to the zero each iteration adds some ten digits, as in iterative
refinement of linear systems.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.tables.precision import Number, mp

__all__ = ["Array", "Floats", "NotConvergedError", "Solve", "inverse", "largest", "newton", "scaled", "solver"]

Array: TypeAlias = NDArray[Any]
"""Of mpmath numbers."""
Floats: TypeAlias = NDArray[np.float64]
Solve: TypeAlias = Callable[[Array], Array]

MOST_ITERATIONS = 60
STALE = 1e-3
"""A Jacobian is computed anew where an iteration with the old one gains less than this factor."""
LEAST_FRACTION = 1e-4


class NotConvergedError(ArithmeticError):
    """Newton's iteration found no solution."""


def largest(values: Array) -> Number:
    """The largest absolute value."""
    return max(map(abs, values.ravel()), default=mp.zero)


def newton(residual: Solve, linearised: Callable[[Array], Solve], x: Array, digits: int, stale: float = STALE) -> Array:
    """The zero of ``residual`` near x, to so many digits of its largest entry: damped, its Jacobian in doubles.

    Args:
        residual: raises ``ArithmeticError`` where it is not defined.
        linearised: solves with the Jacobian at a point; kept while updates shrink by ``stale``.
        x: the first guess.
        digits: of the largest entry of x.
        stale: the dearer a Jacobian is beside a residual, the larger.

    Raises:
        NotConvergedError: if there is no zero near.
    """
    scale, value, solve = largest(x), residual(x), linearised(x)
    update = solve(value)
    for _ in range(MOST_ITERATIONS):
        size = largest(update)
        scale = max(scale, largest(x), size)
        if size <= scale * mp.mpf(10) ** -(digits + 2):
            return x - update
        x, value, update = damped(residual, solve, x, update)
        if largest(update) > stale * size:
            solve = linearised(x)
            update = solve(value)
    raise NotConvergedError(f"no convergence in {MOST_ITERATIONS} iterations")


def damped(residual: Solve, solve: Solve, x: Array, update: Array) -> tuple[Array, Array, Array]:
    """The longest of the steps 1, 1/2, 1/4 ... of the update that shortens the next update of the same Jacobian."""
    fraction, size = 1.0, largest(update)
    while fraction > LEAST_FRACTION:
        moved = x - update * mp.mpf(fraction)
        try:
            value = residual(moved)
        except ArithmeticError:
            fraction /= 2
            continue
        following = solve(value)
        if largest(following) <= (1 - fraction / 4) * size:
            return moved, value, following
        fraction /= 2
    raise NotConvergedError("Newton's iteration stalls")


def inverse(matrix: Floats) -> Floats:
    """The inverse of a matrix that is regular wherever the mass matrix is."""
    try:
        found = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    except np.linalg.LinAlgError as failure:
        raise NotConvergedError("the mass matrix d2L/dv2 is singular on the way") from failure
    if not np.isfinite(found).all():
        raise NotConvergedError("the iteration runs out of the range of double precision")
    return found


def scaled(solve: Callable[[Floats], Floats], right: Array) -> Array:
    """A linear function of floats, applied to numbers of any size: they are scaled to size 1 first."""
    size = largest(right)
    if size == 0:
        return right
    found = [mp.mpf(float(value)) * size for value in solve((right / size).astype(float).ravel())]
    return np.array(found, dtype=object).reshape(right.shape)


def solver(matrix: Floats) -> Solve:
    """Solves with this matrix."""
    inverted = inverse(matrix)
    return lambda right: scaled(lambda floats: inverted @ floats, right)
