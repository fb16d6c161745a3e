"""Second derivatives of functions of the states of a run: tangent propagation, then second-order adjoints."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.gradients import (
    Gradient,
    carry,
    changes_of,
    checked_slopes,
    finite,
    gradient_of,
    pieces,
    starts_of,
)
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.kept_states import KeptStates
from scvi_codegen.runtime.linearised import LinearisedMethod

__all__ = ["bent_back", "checked_function", "hessian_product"]


def hessian_product(
    states: KeptStates, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None
) -> Gradient:
    """Return the Hessian-vector product of a function F of the states along directions.

    With J the Jacobian of all states and F', F'' the derivatives of F, the result is J^T F'' J v plus F' contracted
    with the second derivative of the states along v (tangent over adjoint).

    Args:
        cotangents: (n, 2m) F'.
        directions: directions v of (q, p), or of (q, p, parameters, t, h).
        curvatures: (n, 2m, 2m) F'' at each state.
    """
    slopes, bends = checked_function(states.stepper, len(states), cotangents, curvatures)
    given = finite(directions, "directions")
    states.stepper._second_derivatives  # noqa: B018  (raises MethodError if unavailable)
    changes = changes_of(states.stepper, given)
    found = bent_back(states, slopes, bends, changes, np.zeros((2, *changes.shape)))
    return gradient_of(states, found[1].T.reshape(states.stepper._input_size, *given.shape[1:]))


def checked_function(
    stepper: LinearisedMethod, count: int, cotangents: ArrayLike, curvatures: ArrayLike | None
) -> tuple[Array, Array]:
    """Return validated (n, 2m) first and (n, 2m, 2m) second derivatives of one function of ``count`` states."""
    size, slopes = 2 * stepper.dimension, checked_slopes(stepper, count, cotangents)
    if slopes.ndim == 3:
        raise StateError(f"cotangents of one function must have shape ({count}, {size}), not {slopes.shape}")
    shape = (count, size, size)
    bends = np.broadcast_to(0.0, shape) if curvatures is None else finite(curvatures, "curvatures")
    if bends.shape != shape:
        raise StateError(f"curvatures, Hessians by (q, p) of each state, must have shape {shape}, not {bends.shape}")
    return slopes, bends


def bent_back(states: KeptStates, slopes: Array, bends: Array, changes: Array, now: Array) -> Array:
    """Return (2, k, variables) adjoints at the start and their tangents, from those ``now`` after the last state.

    Args:
        slopes, bends: (n, 2m) and (n, 2m, 2m) derivatives of the function.
        changes: (k, variables) tangent vectors at the start.
        now: (2, k, variables) adjoints and their tangents after the last state.
    """
    between = list(pieces(states))
    at_starts = _changes_at_starts(states, between, changes)
    for (first, last), start in zip(reversed(between), reversed(at_starts), strict=True):
        starts, numbers = starts_of(states, first, last)
        moved = np.zeros((len(numbers), *changes.shape))
        moved[0] = start
        carry(states, starts, numbers, moved, back=False)
        vectors = np.zeros((len(numbers), 2, *changes.shape))
        kept = np.flatnonzero(numbers[1:] > 0) + 1
        vectors[kept] = _seeds(slopes[numbers[kept]], bends[numbers[kept]], moved[kept])
        vectors[-1] += now
        states.stepper._second_order_adjoint(starts, moved, vectors, states.parameters, states.options)
        now = vectors[0]
    first_slopes: Array = now + _seeds(slopes[:1], bends[:1], changes[np.newaxis])[0]
    return first_slopes


def _changes_at_starts(states: KeptStates, between: list[tuple[int, int]], changes: Array) -> list[Array]:
    """Return the tangent vectors at the start of each segment."""
    found = [changes]
    for first, last in between[:-1]:
        starts, numbers = starts_of(states, first, last)
        moved = np.zeros((len(numbers), *changes.shape))
        moved[0] = found[-1]
        carry(states, starts, numbers, moved, back=False)
        found.append(moved[-1])
    return found if between else []


def _seeds(slopes: Array, bends: Array, moved: Array) -> Array:
    """Return (n, 2, k, variables) derivatives of F with respect to n states, and their tangents."""
    size = slopes.shape[1]
    seeds = np.zeros((len(slopes), 2, *moved.shape[1:]))
    seeds[:, 0, :, :size] = slopes[:, np.newaxis]
    seeds[:, 1, :, :size] = np.einsum("nij,nkj->nki", bends, moved[:, :, :size])
    return seeds
