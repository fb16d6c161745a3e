"""Rank of the constraint Jacobian G at a state: detect linearly dependent and contradictory constraints.

G is computed from the rates G v + g_t, which are linear in v, at unit velocities. A constraint implied by others only
on the constraint manifold (``(u - 1)**2 + y**2 = 1`` by ``x**2 + y**2 = 1`` and ``u = x + 1``) reduces the rank there
but not at generic points.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.runtime.core.validation import Array

DEPENDENT = 1e-9
"""Smallest singular value of G, with rows of length 1, below which rows count as linearly dependent."""
NEARLY_DEPENDENT = 0.15
"""The same for constraints at a state from which a step fails."""
NAMED_SHARE = 1e-6
"""Entries of a null vector above this fraction of 1 mark the constraints that are dependent."""
CONTRADICTED = 1e-7
"""Residual at the nearest state, relative to the size of q, above which constraints count as contradictory."""
ITERATIONS = 30

Jacobian: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""Values g and Jacobian G of the constraints at positions."""


def _unit_rows(jacobian: Array) -> Array:
    with np.errstate(over="ignore"):
        sizes = np.linalg.norm(jacobian, axis=1, keepdims=True)
    return jacobian / np.where(sizes > 0.0, sizes, 1.0)


def dependence(jacobian: Array) -> tuple[int, NDArray[np.intp]]:
    """Return the rank of (c, m) rows, and the (k,) indices of those that depend on each other."""
    left, values, _ = np.linalg.svd(_unit_rows(jacobian))
    null = left[:, np.append(values, np.zeros(len(left) - len(values))) <= DEPENDENT]
    shares = np.abs(null).max(axis=1, initial=0.0)
    return len(left) - null.shape[1], np.flatnonzero(shares > NAMED_SHARE)


def nearly_dependent(jacobian: Array) -> str:
    """Return a remark with the rank that a nearly singular Jacobian loses, or ""."""
    values = np.linalg.svd(_unit_rows(jacobian), compute_uv=False) if np.isfinite(jacobian).all() else np.ones(1)
    if values[-1] > NEARLY_DEPENDENT:
        return ""
    return (
        f". The Jacobian of the constraints is nearly singular there (smallest singular value {values[-1]:.2g} with "
        f"rows of length 1; rank {np.count_nonzero(values > NEARLY_DEPENDENT)} of {len(values)} where it is 0), as at "
        "a dead point of a mechanism: end the run before it, or prescribe the motion of another coordinate"
    )


def rank_deficiency(names: Sequence[str], q: Array, at: Jacobian, *, nearest: bool = False) -> str:
    """Return what is wrong with constraints of deficient rank, and what to do; "" if they are independent.

    Args:
        names: formulas of the constraints.
        q: (m,) positions.
        at: function that returns g and G at positions.
        nearest: first minimise the constraint residual by Gauss-Newton iteration.
    """
    for _ in range(ITERATIONS if nearest else 0):
        g, jacobian = at(q)
        if not (np.isfinite(g).all() and np.isfinite(jacobian).all()):
            return ""
        q = q - np.linalg.lstsq(jacobian, g, rcond=DEPENDENT)[0]
    g, jacobian = at(q)
    if not (np.isfinite(g).all() and np.isfinite(jacobian).all()):
        return ""
    rank, rows = dependence(jacobian)
    if not len(rows):
        return ""
    listed = " and ".join(f"'{names[k]}'" for k in rows) if len(rows) < 5 else f"{len(rows)} of them"
    rests = ", ".join(f"{g[k]:.3g}" for k in rows[:4])
    if nearest and np.abs(g).max() > CONTRADICTED * max(float(np.abs(q).max()), 1e-300):
        return (
            f"the constraints {listed} contradict each other or cannot be reached: at the nearest positions their "
            f"values are {rests}, not 0. Change or remove one of them"
        )
    return (
        f"the constraints {listed} are linearly dependent there (rank {rank} of {len(g)}), so their multipliers are "
        "undetermined. Remove one that follows from the others, or start from a state where they are independent"
    )
