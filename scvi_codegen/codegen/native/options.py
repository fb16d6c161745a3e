"""Solver options, status codes of steps, and advice for each failure."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from scvi_codegen.codegen.native.capacity import TOO_MANY_STATES
from scvi_codegen.codegen.native.option_table import OPTION, POSITIVE
from scvi_codegen.codegen.rendering.text import MAX_ITERATIONS, TOLERANCE
from scvi_codegen.common.errors import StateError, StepFailedError

OUTCOMES = ("not converged", "singular", "not finite", "step size underflow", "spurious solution", "no memory")
STATUS = dict(enumerate(OUTCOMES, 1))
REASONS = {
    1: "the iteration did not converge",
    2: "a matrix is singular",
    3: "a value is infinite or NaN",
    4: "the step size is below machine precision",
    5: "the iteration converged to a spurious solution",
    6: "there is not enough memory",
}
"""Descriptions of the status of computations at a state."""
FALLBACK_REQUIRED = 6
"""Status of a step that requires Newton's method (:mod:`scvi_codegen.codegen.native.binding`), or memory for it."""

NOT_CONVERGED = "not converged"
FAILURES = {
    NOT_CONVERGED: (
        "the iteration on the stage equations did not converge",
        "Use a smaller step, solver='newton' if the system is stiff, or a larger max_iterations",
    ),
    "singular": (
        "the Newton matrix is singular",
        "Check that no mass is 0 with these parameters; otherwise use a smaller step, or more quadrature points",
    ),
    "not finite": (
        "a value is infinite or NaN: the Lagrangian is undefined there, or the step is far too large",
        "Use a smaller step, and check that no mass is 0 with these parameters, and that the Lagrangian is defined all "
        "along the motion",
    ),
    "step size underflow": (
        "the step size is below machine precision",
        "The motion ends there (a collision, a singularity, a mass of 0), or its forces are not smooth. Set t_end "
        "before that time, or give h (fixed step size). At the start of a run: the mass matrix is singular or a force "
        "undefined there (a pole of the coordinates, a spring of length 0): start elsewhere, or use other coordinates",
    ),
    "spurious solution": (
        "the iteration converged to a spurious solution of the stage equations",
        "Use a smaller step, or give t_end alone for adaptive steps",
    ),
    "no memory": (
        "there is not enough memory for Newton's method",
        "Free memory, or use solver='fixed-point' with a smaller step",
    ),
    TOO_MANY_STATES: (
        "its states exceed the memory, and only the first and the last are returned",
        "Save fewer states (t_eval or save_every), or observe fixed steps (h, steps and observe)",
    ),
}
"""Cause and remedy of a failure, by status."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolverOptions:
    """Convergence criterion of the iteration on the stage equations.

    Attributes:
        tolerance: size of the last update relative to the state (default: round-off), or absolute.
        max_iterations: after which a step fails.
        absolute: compare the update itself, the paper's rule ``max(|dQ|, |dP|) < TOL``.
    """

    tolerance: float = TOLERANCE
    max_iterations: int = MAX_ITERATIONS
    absolute: bool = False

    def __post_init__(self) -> None:
        criterion = OPTION["solver_tolerance"]
        if self.absolute:  # in the units of the states
            criterion = replace(criterion, range=POSITIVE)
        criterion.checked(self.tolerance, name="SolverOptions.tolerance")
        if not isinstance(self.absolute, bool):
            raise StateError(f"absolute must be True or False, not {self.absolute!r}")
        OPTION["max_iterations"].checked(self.max_iterations)


def checked_options(options: SolverOptions | None) -> SolverOptions | None:
    """Return the options; raise StateError for another type."""
    if options is not None and not isinstance(options, SolverOptions):
        raise StateError(f"options must be SolverOptions(...), not {options!r}")
    return options


def step_failure(
    status: int,
    report: Any,
    *,
    step: int,
    h: float,
    remark: str = "",
    failures: Mapping[str, tuple[str, str]] = FAILURES,
) -> StepFailedError:
    """Return the exception for a failed step: number, time, step size (0: adaptive), cause, remedy and a remark.

    ``failures``: those of the binding.
    """
    word = STATUS[status]
    length = f" with h = {h:g}" if h else ""
    cause, remedy = failures[word]
    if word == NOT_CONVERGED:
        cause += f" (last update {report.change:.3g}; {report.iterations} iterations in this call)"
    message = f"step {step} at t = {report.t:.17g}{length} failed: {cause}. {remedy}{remark}"
    return StepFailedError(message, status=word, step=step, t=report.t, residual=report.change)
