"""Steps that choose their own length, as data."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.sweeps import LaneTable

__all__ = ["Control"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Guesses for steps on a ladder, h = 2^(k / rungs), and how the error of a step goes with its length.

    Attributes:
        mantissas: 2^(k / rungs) for the rungs of an octave.
        reach: rungs between one step and the next, at most.
        alone: by the change into the next step, -reach .. reach: from the last step to the next.
        last, before: by the changes into the last step and into the next: from these two steps.
        growth: of the error of a curve from rung to rung.
    """

    mantissas: tuple[float, ...]
    reach: int
    alone: tuple[LaneTable, ...]
    last: tuple[tuple[LaneTable, ...], ...]
    before: tuple[tuple[LaneTable, ...], ...]
    growth: float
