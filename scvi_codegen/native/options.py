"""What a caller may set and what a step may answer: solver options, status codes, advice for each failure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.given.counts import checked_count
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.rendering.stopping import MAX_ITERATIONS, TOLERANCE

__all__ = ["STATUS", "VANISHED", "SolverOptions", "checked_options", "step_failure"]

STATUS = {1: "not converged", 2: "singular", 3: "not finite", 4: "vanished", 5: "strayed", 6: "no memory"}
NEEDED = 6
"""Newton's iteration is needed, and is not there (:mod:`scvi_codegen.native.binding`), or had no memory."""

VANISHED = (
    "the step size is below machine precision: the motion ends there (a collision, a singularity, a mass of 0), its "
    "forces are not smooth, or from rest at the origin they "
    "grow as a power of t beyond the method's degree: take a higher one"
)
ADVICE = {
    "not converged": "try a smaller step, solver='newton' where the system is stiff, or more iterations",
    "singular": "the Newton matrix has no inverse there: check that no mass is 0 with these parameters, else try "
    "a smaller step, or more quadrature points",
    "vanished": VANISHED,
    "strayed": "the equations of the step were solved by what is no motion: take a shorter step, or give t_end",
    "no memory": "Newton's iteration found none: the machine's is used up",
    "not finite": "the Lagrangian is undefined there, or the step is far too large",
}


MOST_ITERATIONS = 10**6


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverOptions:
    """When the iteration on the stage equations has converged.

    Attributes:
        tolerance: size of the last update relative to the state (default: round-off), or absolute.
        max_iterations: after which a step fails.
        absolute: compare the update itself, the paper's rule ``max(|dQ|, |dP|) < TOL``.
    """

    tolerance: float = TOLERANCE
    max_iterations: int = MAX_ITERATIONS
    absolute: bool = False

    def __post_init__(self) -> None:
        if not checked_number(self.tolerance, "the tolerance") > 0.0:
            raise StateError(f"the tolerance must be positive, not {self.tolerance!r}")
        if not isinstance(self.absolute, bool):
            raise StateError(f"absolute must be True or False, not {self.absolute!r}")
        checked_count(self.max_iterations, "max_iterations", least=1, most=MOST_ITERATIONS)


def checked_options(options: SolverOptions | None) -> SolverOptions | None:
    """The options, or StateError for something else."""
    if options is not None and not isinstance(options, SolverOptions):
        raise StateError(f"options must be SolverOptions(...), not {options!r}")
    return options


def step_failure(
    status: int, report: Any, *, step: int, h: float, kept: object = None, advice: Mapping[str, str] = ADVICE
) -> StepFailedError:
    """The exception for a failed step: which, when, by what h (0: its own), how far, what to try; what it ``kept``."""
    word = STATUS[status]
    length = f" with h = {h:g}" if h else ""
    message = (
        f"step {step} at t = {report.t:.17g}{length} failed: {word} "
        f"(last update {report.change:.3g}, {report.iterations} iterations in all); {advice[word]}"
    )
    return StepFailedError(message, status=word, step=step, t=report.t, residual=report.change, trajectory=kept)
