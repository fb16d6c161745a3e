"""One integrator at one setting, ready to be timed, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from scvi_codegen.benchmark.cases import Array

__all__ = ["OURS", "Contender"]

OURS = "scvi-codegen"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Contender:
    """An integrator that was compiled.

    Attributes:
        method: name of the family whose settings make one work-precision curve, as in ``"heyoka"``.
        setting: what distinguishes it on that curve: a step or a tolerance.
        options: formulation and options chosen, for the reader.
        compile_seconds: from the equations to a function that can be called.
        prepare: from the number of a run, which is that of its initial state, to a function that integrates from there
            and gives the final q.
        momenta: (k, m) momenta that it starts from, where they are its state; ``None`` if it starts from velocities.
        trajectories: initial states that one run starts from; the final q of an ensemble is (trajectories, m).
    """

    method: str
    setting: str
    options: str
    compile_seconds: float
    prepare: Callable[[int], Callable[[], Array]]
    momenta: Array | None = None
    trajectories: int = 1
