"""Steps that choose their own length, as data."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import NumberTable

__all__ = ["Control", "Ladder"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Steps on a ladder, h = 2^(k / rungs), by sweeps or by Newton's iteration; or steps of a density of their own.

    Attributes:
        mantissas: 2^(k / rungs) for the rungs of an octave.
        ladder: of sweeps, ``None`` without these.
        stage_growth: of the error of the curve of Newton's iteration from rung to rung; 0 where that tells no error.
        density: 1/g and -d(log g)/dt at (q, v), or (q, p) of a Hamiltonian, of a monitor g; in place of the ladder.
    """

    mantissas: tuple[float, ...] = ()
    ladder: Ladder | None = None
    stage_growth: float = 0.0
    density: Kernel | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Ladder:
    """Guesses of sweeps for steps on a ladder, and how the error of a step goes with its length.

    Attributes:
        reach: rungs between one step and the next, at most.
        alone: by the change into the next step, -reach .. reach: from the last step to the next.
        last, before: by the changes into the last step and into the next: from these two steps.
        growth: of the error of a curve from rung to rung.
    """

    reach: int
    alone: tuple[NumberTable, ...]
    last: tuple[tuple[NumberTable, ...], ...]
    before: tuple[tuple[NumberTable, ...], ...]
    growth: float
