"""Newton's iteration that refines mpmath numbers with a Jacobian in double precision.

The residual has 60 digits and the Jacobian 16: close to the zero each iteration adds some ten digits, as in iterative
refinement of linear systems.
"""

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import Number, mp

Array: TypeAlias = NDArray[Any]
"""Array of mpmath numbers."""
Floats: TypeAlias = NDArray[np.float64]
Solve: TypeAlias = Callable[[Array], Array]

MAX_NEWTON_ITERATIONS = 60
STALE = 1e-3
"""Convergence factor of the updates above which the Jacobian is recomputed."""
MIN_FRACTION = 1e-4
"""Part of a Newton step below which damping has failed, after 13 halvings."""


class NotConvergedError(ArithmeticError):
    """Failure of Newton's iteration to converge."""


def largest(values: Array) -> Number:
    """Return the largest absolute value."""
    return max(map(abs, values.ravel()), default=mp.zero)


def newton(residual: Solve, linearised: Callable[[Array], Solve], x: Array, digits: int, stale: float = STALE) -> Array:
    """Return the zero of ``residual`` near x, by damped Newton iteration with a Jacobian in double precision.

    Args:
        residual: raises ``ArithmeticError`` where it is undefined.
        linearised: returns a solver with the Jacobian at a point; reused while updates shrink by ``stale``.
        x: initial guess.
        digits: requested digits, relative to the largest entry of x.
        stale: convergence factor above which the Jacobian is recomputed; larger for expensive Jacobians.
    """
    scale, value, solve = largest(x), residual(x), linearised(x)
    update = solve(value)
    for _ in range(MAX_NEWTON_ITERATIONS):
        size = largest(update)
        scale = max(scale, largest(x), size)
        if size <= scale * mp.mpf(10) ** -(digits + 2):
            return x - update
        x, value, update = damped(residual, solve, x, update)
        if largest(update) > stale * size:
            solve = linearised(x)
            update = solve(value)
    raise NotConvergedError(f"no convergence in {MAX_NEWTON_ITERATIONS} iterations")


def damped(residual: Solve, solve: Solve, x: Array, update: Array) -> tuple[Array, Array, Array]:
    """Return the first of the damped steps 1, 1/2, 1/4 ... that shortens the next update with the same Jacobian."""
    fraction, size = 1.0, largest(update)
    while fraction > MIN_FRACTION:
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
    """Return the inverse of a matrix that is regular wherever the mass matrix is."""
    try:
        result = np.asarray(np.linalg.inv(matrix), dtype=np.float64)
    except np.linalg.LinAlgError as failure:
        raise NotConvergedError("the mass matrix d2L/dv2 is singular at an iterate") from failure
    if not np.isfinite(result).all():
        raise NotConvergedError("an iterate exceeds the range of double precision")
    return result


def scaled(solve: Callable[[Floats], Floats], right: Array) -> Array:
    """Apply a linear function of doubles to numbers of any size, scaled to size 1."""
    size = largest(right)
    if size == 0:
        return right
    solution = [mp.mpf(float(value)) * size for value in solve((right / size).astype(float).ravel())]
    return np.array(solution, dtype=object).reshape(right.shape)


def solver(matrix: Floats) -> Solve:
    """Return a linear solver with this matrix."""
    inverted = inverse(matrix)
    return lambda right: scaled(lambda floats: inverted @ floats, right)
