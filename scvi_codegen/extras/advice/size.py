"""Sizes of motions by the distances from their mean."""

import numpy as np

from scvi_codegen.api.states import RESOLVED, Array, roundoff
from scvi_codegen.runs.accuracy.size import relative


def distances_from_mean(q: Array) -> Array:
    """Return (..) root mean square distances of the later half of (n, .., m) positions from the mean of all.

    Those of positions at rest, up to rounding, are 0: such a motion has no size.
    """
    q = np.asarray(q)
    with np.errstate(all="ignore"):  # runs that failed
        late, mean = q[len(q) // 2 :], q.mean(axis=0)
        away = np.sqrt(np.mean(np.sum((late - mean) ** 2, axis=-1), axis=0))
    return np.asarray(np.where(away <= _resolution(q), 0.0, away))


def relative_to_motion(errors: Array, q: Array) -> Array:
    """Return errors (.., k) of norms of positions relative to :func:`distances_from_mean` of (n, k, m) positions.

    Those of a motion at rest are 0 up to rounding, else infinite.
    """
    sizes = distances_from_mean(q)
    return relative(np.where((sizes == 0.0) & (errors <= _resolution(np.asarray(q))), 0.0, errors), sizes)


def _resolution(q: Array) -> Array:
    """Return (..) distances below which (n, .., m) positions do not differ, up to rounding."""
    with np.errstate(all="ignore"):
        return np.asarray(RESOLVED * roundoff(1) * np.sqrt(np.mean(np.sum(q**2, axis=-1), axis=0)))
