"""Momentum maps of arrays."""

from __future__ import annotations

import numpy as np

from scvi_codegen.indices import ArrayMap
from scvi_codegen.runtime.arrays.interface import Numbers


def momentum_of(q: Numbers, p: Numbers, of: ArrayMap, *, absolute: bool = False) -> float:
    """Return the value of a momentum map from the positions and momenta of its array; ``absolute``: sum of terms."""
    if of.phase:
        return float(np.sum(q**2 + p**2) / 2)
    if of.component is None:
        return float(np.sum(p))
    if of.other is None:
        return float(np.sum(p[..., of.component]))
    sign = 1.0 if absolute else -1.0
    return float(np.sum(q[..., of.component] * p[..., of.other] + sign * q[..., of.other] * p[..., of.component]))
