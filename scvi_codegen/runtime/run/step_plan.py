"""Step plan of a run with adaptive steps: target time, tolerance or step in transformed time."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.validation import check_tolerance


@dataclass(frozen=True, slots=True, kw_only=True)
class StepPlan:
    """Target time and step-size control of a run.

    Attributes:
        t_end: target time.
        tolerance: largest relative error of a step; 0 for round-off.
        tau: instead of a tolerance, the constant step of fictitious time of a time transformation; 0 otherwise.
    """

    t_end: float
    tolerance: float = 0.0
    tau: float = 0.0

    @classmethod
    def checked(cls, t_end: float, tolerance: float | None) -> StepPlan:
        """Construct from user arguments; raise ``StateError`` unless they are a finite time and a relative error."""
        if tolerance is None:
            return cls(t_end=checked_number(t_end, "t_end"))
        allowed = checked_number(tolerance, "the tolerance")
        check_tolerance(allowed)
        return cls(t_end=checked_number(t_end, "t_end"), tolerance=allowed)

    @classmethod
    def in_tau(cls, g: str, h: float | None, t_end: float | None, tolerance: float | None) -> StepPlan:
        """Construct the step plan of a stepper with a time transformation from user arguments."""
        if h is None or t_end is None or tolerance is not None:
            raise StateError(
                f"a stepper with the time transformation {g} requires h (constant step in tau) and t_end, and no "
                "tolerance"
            )
        tau = checked_step(h)
        if tau < 0.0:
            raise StateError(f"h = {h:g} must be positive with a time transformation: t_end determines the direction")
        return cls(t_end=checked_number(t_end, "t_end"), tau=tau)
