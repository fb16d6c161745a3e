"""Accumulation of the growth of tangent vectors along one or many trajectories.

Tangent vectors are represented as Q R: orthonormal Q, and R with columns of length 1 and separate logarithms of norms.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.runtime.inputs import Array

__all__ = ["SERIES", "Growth", "ill_conditioned", "r_factors"]

SERIES = ("lengths", "greatest", "stretches", "rates", "mean_rates")
"""Names of the accumulated series, defined in :class:`~scvi_codegen.runtime.chaos_indicators.ChaosIndicators`."""

MOST_GROWTH_RATIO = 1e3
"""Largest ratio of growth between tangent vectors within a segment; bounds the loss of significant digits."""


class Growth:
    """Logarithms of norms and of the diagonal of R, and the integrals of MEGNO.

    Args:
        t: (n,) times of saved values.
        stretches: (k,) or (K, k) logarithms of the diagonal of R at the start, where norms are 1.

    Attributes:
        found: (5, n, k) or (5, n, K, k) values of :data:`SERIES`; NaN at times that were not reached.
    """

    def __init__(self, t: Array, stretches: Array) -> None:
        self.start, nothing = float(t[0]), np.zeros_like(stretches)
        self.stretches = stretches
        self.lengths = self.greatest = self.moments = self.rates = self.areas = nothing
        self.found = np.full((len(SERIES), len(t), *stretches.shape), np.nan)
        self.found[:, 0] = [nothing, nothing, stretches, nothing, nothing]

    def add(self, t: Array, numbers: NDArray[np.intp], grown: Array, stretched: Array) -> None:
        """Add consecutive steps; the integrals use the trapezoidal rule.

        Args:
            t: (steps + 1,) times at their ends.
            numbers: (steps,) index of the saved value at the end of each step, -1 for none.
            grown, stretched: (steps, .., k) logarithms relative to the start of the first step; of ``stretched`` only
                the saved rows and the last are used.
        """
        times = np.abs(t - self.start).reshape(-1, *[1] * self.lengths.ndim)
        lengths = self.lengths + grown
        greatest = np.maximum(np.maximum.accumulate(lengths, axis=0), self.greatest)
        steps = np.diff(lengths, axis=0, prepend=self.lengths[np.newaxis])
        moments = self.moments + np.cumsum((times[1:] + times[:-1]) / 2 * steps, axis=0)
        rates = 2.0 * moments / times[1:]
        means = rates.copy()
        means[1:] += rates[:-1]
        means[0] += self.rates
        areas = self.areas + np.cumsum(np.diff(times, axis=0) / 2 * means, axis=0)
        saved = np.flatnonzero(numbers >= 0)
        self.found[:, numbers[saved]] = [
            lengths[saved],
            greatest[saved],
            self.stretches + stretched[saved],
            rates[saved],
            areas[saved] / times[saved + 1],
        ]
        self.lengths, self.greatest, self.stretches = lengths[-1], greatest[-1], self.stretches + stretched[-1]
        self.moments, self.rates, self.areas = moments[-1], rates[-1], areas[-1]


def r_factors(images: Array) -> Array:
    """Return the (.., k, k) factors R of (.., 2m, k) matrices."""
    if images.shape[-1] == 1:
        found: Array = np.linalg.norm(images, axis=-2)[..., np.newaxis]
    else:
        found = np.asarray(np.linalg.qr(images, mode="r"))
    return found


def ill_conditioned(images: Array) -> NDArray[np.bool_]:
    """Return (..) flags of the factors R (.., k, k) whose tangent vectors lost too many significant digits."""
    largest = np.abs(images).max(axis=(-2, -1))
    least = np.abs(np.diagonal(images, axis1=-2, axis2=-1)).min(axis=-1)
    parted: NDArray[np.bool_] = ~(np.maximum(largest, 1.0) <= MOST_GROWTH_RATIO * np.minimum(least, 1.0))
    return parted
