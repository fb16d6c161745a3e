"""What is summed over the steps of a motion, or of many at once, while small changes of it grow.

Changes on their way are Q R: Q orthonormal, R with columns of length 1 and the logarithms of what they had.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.runtime.inputs import Array

__all__ = ["SERIES", "Growth", "apart", "triangles"]

SERIES = ("lengths", "greatest", "stretches", "rates", "mean_rates")
"""What is told at each time that is kept, as :class:`~scvi_codegen.runtime.deviations.Deviations` describes it."""

APART = 1e3
"""How much longer one change may grow than another within a piece: what it costs of their digits."""


class Growth:
    """Logarithms of lengths and of diagonals of R, and the integrals of MEGNO.

    Args:
        t: (n,) times to keep.
        stretches: (k,) or (K, k) logarithms of the diagonal of R at the start, lengths being 1.

    Attributes:
        found: (5, n, k) or (5, n, K, k) :data:`SERIES` at these times; not numbers where nothing was reached.
    """

    def __init__(self, t: Array, stretches: Array) -> None:
        self.start, nothing = float(t[0]), np.zeros_like(stretches)
        self.stretches = stretches
        self.lengths = self.greatest = self.moments = self.rates = self.areas = nothing
        self.found = np.full((len(SERIES), len(t), *stretches.shape), np.nan)
        self.found[:, 0] = [nothing, nothing, stretches, nothing, nothing]

    def add(self, t: Array, numbers: NDArray[np.intp], grown: Array, stretched: Array) -> None:
        """Steps that follow each other; the moment of each is taken at its middle.

        Args:
            t: (steps + 1,) times at their ends.
            numbers: (steps,) of the time to keep at the end of each, -1 where none is.
            grown, stretched: (steps, .., k) logarithms since the first began; of the second only those are needed that
                are kept, and the last.
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
        kept = np.flatnonzero(numbers >= 0)
        self.found[:, numbers[kept]] = [
            lengths[kept],
            greatest[kept],
            self.stretches + stretched[kept],
            rates[kept],
            areas[kept] / times[kept + 1],
        ]
        self.lengths, self.greatest, self.stretches = lengths[-1], greatest[-1], self.stretches + stretched[-1]
        self.moments, self.rates, self.areas = moments[-1], rates[-1], areas[-1]


def triangles(images: Array) -> Array:
    """(.., k, k) the R of each of (.., 2m, k)."""
    if images.shape[-1] == 1:
        found: Array = np.linalg.norm(images, axis=-2)[..., np.newaxis]
    else:
        found = np.asarray(np.linalg.qr(images, mode="r"))
    return found


def apart(images: Array) -> NDArray[np.bool_]:
    """(..) whether what became of a frame, by the R (.., k, k) of it, is no longer known to nearly all digits."""
    largest = np.abs(images).max(axis=(-2, -1))
    least = np.abs(np.diagonal(images, axis1=-2, axis2=-1)).min(axis=-1)
    parted: NDArray[np.bool_] = ~(np.maximum(largest, 1.0) <= APART * np.minimum(least, 1.0))
    return parted
