"""Adaptive step sizes, as data."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import NumberTable

__all__ = ["AdaptivePredictor", "Control"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Adaptive steps with sizes h = 2^(k / levels), by fixed-point iteration or Newton's method; or a step density.

    Attributes:
        mantissas: 2^(k / levels) for the levels of an octave.
        predictor: predictor of the fixed-point iteration, ``None`` without one.
        stage_growth: factor of the error estimate per level for Newton's method; 0 if there is no estimate.
        density: 1/g and -d(log g)/dt at (q, v), or (q, p) of a Hamiltonian, of a time transformation g; instead of the
            predictor.
    """

    mantissas: tuple[float, ...] = ()
    predictor: AdaptivePredictor | None = None
    stage_growth: float = 0.0
    density: Kernel | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptivePredictor:
    """Predictor tables of the fixed-point iteration for varying step sizes, and the growth of the error estimate.

    Attributes:
        reach: largest change of level between successive steps.
        alone: by the change into the next step, -reach .. reach: from the last step to the next.
        last, before: by the changes into the last step and into the next: from these two steps.
        growth: factor of the error estimate per level.
    """

    reach: int
    alone: tuple[NumberTable, ...]
    last: tuple[tuple[NumberTable, ...], ...]
    before: tuple[tuple[NumberTable, ...], ...]
    growth: float
