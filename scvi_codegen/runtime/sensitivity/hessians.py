"""Second derivatives of functions of the states of a run: tangent propagation, then second-order adjoints.

With J the Jacobian of all states and F', F'' the derivatives of a function F of the states, the Hessian of F with
respect to the initial data times a direction v is J^T F'' J v plus F' contracted with the second derivative of the
states along v (tangent over adjoint).
"""

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.sensitivity.gradients import checked_cotangents, finite, pieces, propagate, starts_of
from scvi_codegen.runtime.sensitivity.step_derivatives import LinearisedMethod
from scvi_codegen.runtime.trajectory.saved_states import SavedStates


def checked_function(
    stepper: LinearisedMethod, count: int, cotangents: ArrayLike, curvatures: ArrayLike | None
) -> tuple[Array, Array]:
    """Return validated (n, 2m) first and (n, 2m, 2m) second derivatives of one function of ``count`` states."""
    size, derivatives = 2 * stepper.dimension, checked_cotangents(stepper, count, cotangents)
    if derivatives.ndim == 3:
        raise StateError(f"cotangents of one function must have shape ({count}, {size}), not {derivatives.shape}")
    shape = (count, size, size)
    hessian_blocks = np.broadcast_to(0.0, shape) if curvatures is None else finite(curvatures, "curvatures")
    if hessian_blocks.shape != shape:
        raise StateError(
            f"curvatures, Hessians by (q, p) of each state, must have shape {shape}, not {hessian_blocks.shape}"
        )
    return derivatives, hessian_blocks


def second_order_adjoints(
    states: SavedStates, derivatives: Array, hessian_blocks: Array, tangents: Array, now: Array
) -> Array:
    """Return (2, k, variables) adjoints at the start and their tangents, from those ``now`` after the last state.

    Args:
        derivatives, hessian_blocks: (n, 2m) and (n, 2m, 2m) derivatives of the function.
        tangents: (k, variables) tangent vectors at the start.
        now: (2, k, variables) adjoints and their tangents after the last state.
    """
    between = list(pieces(states))
    at_starts = _tangents_at_starts(states, between, tangents)
    for (first, last), start in zip(reversed(between), reversed(at_starts), strict=True):
        starts, numbers = starts_of(states, first, last)
        moved = np.zeros((len(numbers), *tangents.shape))
        moved[0] = start
        propagate(states, starts, numbers, moved, back=False)
        vectors = np.zeros((len(numbers), 2, *tangents.shape))
        saved = np.flatnonzero(numbers[1:] > 0) + 1
        vectors[saved] = _seeds(derivatives[numbers[saved]], hessian_blocks[numbers[saved]], moved[saved])
        vectors[-1] += now
        states.stepper._second_order_adjoint(starts, moved, vectors, states.parameters, states.options)
        now = vectors[0]
    return np.asarray(now + _seeds(derivatives[:1], hessian_blocks[:1], tangents[np.newaxis])[0])


def _tangents_at_starts(states: SavedStates, between: list[tuple[int, int]], tangents: Array) -> list[Array]:
    tangents_at = [tangents]
    for first, last in between[:-1]:
        starts, numbers = starts_of(states, first, last)
        moved = np.zeros((len(numbers), *tangents.shape))
        moved[0] = tangents_at[-1]
        propagate(states, starts, numbers, moved, back=False)
        tangents_at.append(moved[-1])
    return tangents_at if between else []


def _seeds(derivatives: Array, hessian_blocks: Array, moved: Array) -> Array:
    """Return (n, 2, k, variables) derivatives of F with respect to n states, and their tangents."""
    size = derivatives.shape[1]
    seeds = np.zeros((len(derivatives), 2, *moved.shape[1:]))
    seeds[:, 0, :, :size] = derivatives[:, np.newaxis]
    seeds[:, 1, :, :size] = np.einsum("nij,nkj->nki", hessian_blocks, moved[:, :, :size])
    return seeds
