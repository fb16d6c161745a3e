"""Accumulation of the growth of tangent vectors along one or many trajectories.

Tangent vectors are represented as Q R: orthonormal Q, and R with columns of length 1 and separate logarithms of norms.
"""

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.runtime.core.validation import Array

SERIES = ("log_norms", "max_log_norms", "log_r_diagonal", "rates", "mean_rates")
"""Names of the accumulated series, defined in :class:`~scvi_codegen.runtime.chaos.indicators.ChaosIndicators`."""

MOST_GROWTH_RATIO = 1e3
"""Largest ratio of growth between tangent vectors within a segment; bounds the loss of significant digits."""


class Growth:
    """Logarithms of norms and of the diagonal of R, and the integrals of MEGNO.

    Args:
        t: (n,) times of saved values.
        log_r_diagonal: (k,) or (K, k) logarithms of the diagonal of R at the start, where norms are 1.

    Attributes:
        values: (5, n, k) or (5, n, K, k) values of :data:`SERIES`; NaN at times that were not reached.
    """

    def __init__(self, t: Array, log_r_diagonal: Array) -> None:
        self.start, nothing = float(t[0]), np.zeros_like(log_r_diagonal)
        self.log_r_diagonal = log_r_diagonal
        self.log_norms = self.max_log_norms = self.moments = self.rates = self.areas = nothing
        self.values = np.full((len(SERIES), len(t), *log_r_diagonal.shape), np.nan)
        self.values[:, 0] = [nothing, nothing, log_r_diagonal, nothing, nothing]

    def add(self, t: Array, numbers: NDArray[np.intp], log_growth: Array, log_diagonals: Array) -> None:
        """Add consecutive steps; the integrals use the trapezoidal rule.

        Args:
            t: (steps + 1,) times at their ends.
            numbers: (steps,) index of the saved value at the end of each step, -1 for none.
            log_growth, log_diagonals: (steps, .., k) logarithms relative to the start of the first step; of
                ``log_diagonals`` only the saved rows and the last are used.
        """
        times = np.abs(t - self.start).reshape(-1, *[1] * self.log_norms.ndim)
        log_norms = self.log_norms + log_growth
        max_log_norms = np.maximum(np.maximum.accumulate(log_norms, axis=0), self.max_log_norms)
        steps = np.diff(log_norms, axis=0, prepend=self.log_norms[np.newaxis])
        moments = self.moments + np.cumsum((times[1:] + times[:-1]) / 2 * steps, axis=0)
        rates = 2.0 * moments / times[1:]
        means = rates.copy()
        means[1:] += rates[:-1]
        means[0] += self.rates
        areas = self.areas + np.cumsum(np.diff(times, axis=0) / 2 * means, axis=0)
        saved = np.flatnonzero(numbers >= 0)
        self.values[:, numbers[saved]] = [
            log_norms[saved],
            max_log_norms[saved],
            self.log_r_diagonal + log_diagonals[saved],
            rates[saved],
            areas[saved] / times[saved + 1],
        ]
        self.log_norms = log_norms[-1]
        self.max_log_norms = max_log_norms[-1]
        self.log_r_diagonal = self.log_r_diagonal + log_diagonals[-1]
        self.moments, self.rates, self.areas = moments[-1], rates[-1], areas[-1]


def r_factors(images: Array) -> Array:
    """Return the (.., k, k) factors R of (.., 2m, k) matrices."""
    if images.shape[-1] == 1:
        return np.asarray(np.linalg.norm(images, axis=-2)[..., np.newaxis])
    return np.asarray(np.linalg.qr(images, mode="r"))


def ill_conditioned(images: Array) -> NDArray[np.bool_]:
    """Return (..) flags of the factors R (.., k, k) whose tangent vectors lost too many significant digits."""
    largest = np.abs(images).max(axis=(-2, -1))
    least = np.abs(np.diagonal(images, axis1=-2, axis2=-1)).min(axis=-1)
    return np.asarray(~(np.maximum(largest, 1.0) <= MOST_GROWTH_RATIO * np.minimum(least, 1.0)))
