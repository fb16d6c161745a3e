"""Step plan of a run: fixed step size, adaptive steps to a time, or constant steps in transformed time to a time."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.runtime.core.features import FEATURES, refusal
from scvi_codegen.runtime.core.words import check_doubles
from scvi_codegen.runtime.run.times import steps_to
from scvi_codegen.validation import check_tolerance, checked_count


@dataclass(frozen=True, slots=True, kw_only=True)
class StepPlan:
    """Step sizes of a run and the time at which it ends.

    Attributes:
        t_end: target time; infinite for a number of fixed steps.
        tolerance: largest relative error of an adaptive step; 0 for round-off.
        tau: constant step of fictitious time of the reversible controller; 0 otherwise.
        h: fixed step size, of tau in transformed time; 0 otherwise.
    """

    t_end: float = math.inf
    tolerance: float = 0.0
    tau: float = 0.0
    h: float = 0.0
    max_step: float = math.inf

    @property
    def fixed(self) -> bool:
        """Return whether h is the step size; then a last step that is shorter is not taken by the run itself."""
        return self.h != 0.0

    @property
    def adaptive(self) -> bool:
        """Return whether step sizes follow from the tolerance."""
        return not (self.h or self.tau)


@dataclass(frozen=True, slots=True, eq=False)
class AdaptivePlans(Sequence[StepPlan]):
    """Step plans of trajectories with adaptive steps of one tolerance, made when they are read.

    Attributes:
        ends: (k,) target times.
    """

    ends: NDArray[np.float64]
    tolerance: float

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, j: Any) -> Any:
        if isinstance(j, slice):
            return AdaptivePlans(self.ends[j], self.tolerance)
        return StepPlan(t_end=float(self.ends[j]), tolerance=self.tolerance)


def checked_plan(
    h: float | None, t_end: float | None, tolerance: float | None, controller: str = "", in_tau: bool = False, /
) -> StepPlan:
    """Return the step plan of arguments of users.

    Args:
        h, t_end, tolerance: step size; target time; relative error of an adaptive step.
        controller: time transformation of the reversible controller, "" without one.
        in_tau: whether the system is one in transformed time, which has fixed steps only.

    Raises:
        StateError: if a number is invalid, or they do not determine the steps.
    """
    if controller:
        if h is None or t_end is None or tolerance is not None:
            remedy = FEATURES["adaptive", "with a time transformation"]
            raise StateError(f"the time transformation {controller} determines the step size: {remedy}")
        tau = checked_step(h)
        if tau < 0.0:
            raise StateError(f"h = {h:g} must be positive with a time transformation: t_end determines the direction")
        return StepPlan(t_end=checked_number(t_end, "t_end"), tau=tau)
    if h is None and in_tau:
        raise refusal("adaptive", "in transformed time")
    if (t_end is None) == (h is None):
        raise StateError(
            f"give either h (fixed step size) or t_end (adaptive step size); got {'neither' if h is None else 'both'}"
        )
    if h is not None:
        if tolerance is not None:
            raise StateError("tolerance requires adaptive steps: give t_end without h and steps")
        return StepPlan(h=checked_step(h))
    allowed = 0.0
    if tolerance is not None:
        check_tolerance(allowed := checked_number(tolerance, "the tolerance"))
    return StepPlan(t_end=checked_number(t_end, "t_end"), tolerance=allowed)


@lru_cache(maxsize=256, typed=True)
def planned_steps(
    h: float | None,
    steps: int | None,
    t_end: float | None,
    tolerance: float | None,
    save_every: int,
    t: float | Fraction,
    controller: str,
    in_tau: bool,
    words: int,
    /,
) -> tuple[StepPlan, int | None]:
    """Return the plan of :meth:`Stepper.integrate` and its number of steps, ``None`` to t_end.

    Args:
        h, steps, t_end, tolerance, save_every, t: arguments of :meth:`Stepper.integrate`; t matters with h and t_end.
        controller, in_tau: as of :func:`checked_plan`.
        words: number of words of the states; runs in double-double end at t_end to 32 digits.

    Raises:
        StateError: if a number is invalid, or they do not determine the steps.
    """
    fixed = h is not None and not controller
    plan = checked_plan(h, None if fixed else t_end, tolerance, controller, in_tau)
    if words > 1:
        check_doubles(t_end=t_end)
    if not fixed:  # Adaptive, or equal steps of tau by the controller
        if steps is not None:
            raise StateError(f"adaptive steps end at t_end={plan.t_end:g}: omit steps={steps}, or give h and steps")
        return plan, None
    if t_end is None:  # Steps
        if steps is None:
            raise StateError("h requires steps or t_end (fixed step size); give t_end without h for adaptive steps")
        return plan, checked_count(steps, "steps", least=0)
    count = None if in_tau or steps is not None else steps_to(t, t_end, plan.h, exactly=words > 1)
    if count is not None and count % checked_count(save_every, "save_every", least=1) == 0:
        return plan, count
    end = checked_number(t_end, "the time t_end")
    if steps is not None:
        raise StateError(f"give either steps={steps} or t_end={end:g} with h, not both")
    if (end - checked_number(t, "the time t")) * plan.h < 0.0:
        raise StateError(f"h = {plan.h:g} has the wrong sign for a run from t = {t:g} to t_end = {end:g}")
    return replace(plan, t_end=end), None
