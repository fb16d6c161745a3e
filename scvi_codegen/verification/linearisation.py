"""Jacobian of a step by finite differences, and the propagation of round-off through it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError

__all__ = ["WEIGHTS", "Jacobian", "linearised"]

Array = NDArray[np.float64]
Map = Callable[[Array], Array]

WEIGHTS = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
"""Weights of central differences of order six."""
WIDTHS = (0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4)
"""Widths of the differences, relative to the scales; the result is from the two neighbours that agree best."""


@dataclass(frozen=True, slots=True)
class Jacobian:
    """Jacobian of a step in units of the scales.

    Attributes:
        matrix: (2m, 2m), dimensionless.
        uncertainty: error estimate of its entries: the disagreement of two widths.
        scales: (2m,) sizes of q and of p, m times each.
    """

    matrix: Array
    uncertainty: float
    scales: Array

    def propagated(self, change: Array) -> Array:
        """Return (2m,) bounds on the change of the end for changes of the arguments of any sign."""
        spread: Array = self.scales * (np.abs(self.matrix) @ (np.abs(change) / self.scales))
        return spread


def linearised(step: Map, state: Array, scales: Array) -> Jacobian | None:
    """Return the Jacobian of ``step`` at ``state``; ``None`` if steps fail in the neighbourhood."""
    best: Jacobian | None = None
    before: Array | None = None
    for width in WIDTHS:
        try:
            now = _differences(step, state, scales, width)
        except StepFailedError:
            continue
        if before is not None:
            change = float(np.abs(now - before).max())
            if best is None or change < best.uncertainty:
                best = Jacobian(now, change, scales)
        before = now
    return best


def _differences(step: Map, state: Array, scales: Array, width: float) -> Array:
    columns = []
    for unit in np.diag(width * scales):
        derivatives = sum(w * (step(state + k * unit) - step(state - k * unit)) for k, w in WEIGHTS.items())
        columns.append(derivatives / (width * scales))
    matrix: Array = np.array(columns).T
    return matrix
