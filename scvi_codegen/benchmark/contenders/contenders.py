"""Contender: one integrator at one setting, ready to be timed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from scvi_codegen.benchmark.cases import Array

__all__ = ["OURS", "Contender"]

OURS = "scvi-codegen"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contender:
    """Compiled integrator at one setting.

    Attributes:
        method: name of the work-precision curve, as in ``"heyoka"``.
        setting: step size or tolerance.
        options: formulation and options, for the reader.
        compile_seconds: time from the equations to a function that can be called.
        prepare: function from the number of a run, which is that of its initial state, to a function that integrates
            from it and returns the final q.
        momenta: (k, m) initial momenta, if they are its state; ``None`` if it starts from velocities.
        trajectories: number of trajectories of one run; the final q of an ensemble is (trajectories, m).
    """

    method: str
    setting: str
    options: str
    compile_seconds: float
    prepare: Callable[[int], Callable[[], Array]]
    momenta: Array | None = None
    trajectories: int = 1
