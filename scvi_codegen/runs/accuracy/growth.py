"""Growth of errors along runs: a tangent vector to which the errors of the steps are added (``error_growth.h``).

C carries it beside the run and compares it with the range of the motion. An error above ten thousand tolerances (1e-10
with steps of round-off) or above 1e-2 is reported; nothing is repeated.
"""

import math
import sys

from scvi_codegen.common.errors import AccuracyWarning, warn
from scvi_codegen.common.representation import counted
from scvi_codegen.runs.accuracy.size import roundoff
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Adaptive, StepPlan, absolute_tolerances

UNCHECKED, MEANINGLESS = 1e-4, 1e-2
"""Tolerance from which on only a requested check is made, and error beyond which no digit is left."""


def measures_growth(stepper: Integrator, plan: StepPlan, requested: bool | None) -> bool:
    """Return whether a run carries its error.

    Raises:
        MethodError: for a requested check of a stepper that does not carry it.
    """
    if requested:
        require(stepper, "check_growth")
        return warnings_wanted()
    is_checked = requested is None and isinstance(plan, Adaptive) and (plan.tolerance or 0.0) < UNCHECKED
    return is_checked and stepper._carries_errors and warnings_wanted()


def warn_of_error_growth(run: Memory, t_end: float, *, requested: bool) -> None:
    """Warn if errors grew along a run that carried its error to ``t_end``, or if a requested check failed."""
    growth = run._growth
    if growth is None:
        if requested and run.steps:
            cause = "Newton's method solved a step, or the derivatives of a step did not converge"
            warn(f"the growth of errors was not checked: {cause}. Reduce the steps, or use error=", AccuracyWarning)
        return
    error, limit, accurate_until, meaningful_until = growth
    if error <= limit or _error_that_matters(run, error) <= limit:
        return
    if error > MEANINGLESS:
        what = f"no meaningful digits are left after t = {meaningful_until:g}"
    else:
        left = counted(math.floor(-math.log10(error)), "digit")
        what = f"they grow far above the tolerance after t = {accurate_until:g}, which leaves {left} at t = {t_end:g}"
    cause = _rounding_far_from_origin(run, error) or f"the motion amplifies errors: {what} (estimated)."
    warn(
        f"{cause} Use error= to find the time until which digits are confirmed, or check_growth=False to skip this "
        "check",
        AccuracyWarning,
    )


def _error_that_matters(run: Memory, error: float) -> float:
    """Return the error relative to sizes that are at least the absolute tolerances, below which no error matters."""
    plan, memory = run.plan, run._memory
    if not isinstance(plan, Adaptive) or plan.absolute_tolerance == ():
        return error
    absolute = absolute_tolerances(run.stepper.interface, run.stepper.dimension, plan.absolute_tolerance).tolist()
    ranges = zip(memory.largest_error, memory.lowest, memory.highest, absolute, strict=True)
    return float(max(largest / max(high - low, least, sys.float_info.min) for largest, low, high, least in ranges))


def _rounding_far_from_origin(run: Memory, error: float) -> str:
    """Return the cause where rounding of positions makes the error, and would not near the motion.

    The roundings r of N steps add up to N^(3/2) r or less where no motion amplifies them (D. Brouwer, On the
    accumulation of errors in numerical integration, Astron. J. 46 (1937) 149-153).
    """
    memory, tolerance, sums = run._memory, getattr(run.plan, "tolerance", None) or 0.0, run.steps**1.5
    for i, name in enumerate(run.stepper.interface.coordinates):
        low, high = memory.lowest[i], memory.highest[i]
        size, motion = max(abs(low), abs(high)), high - low
        rounding = roundoff(1) * size / motion if motion > 0.0 else 0.0
        if rounding > tolerance and sums * roundoff(1) < error <= sums * rounding:
            return (
                f"{name}, of size {size:.3g}, moves by {motion:.3g}, so that numbers are rounded by {rounding:.1e} of "
                f"the motion, more than the steps err: choose an origin of {name} near the motion, or give "
                f"absolute_tolerance={{'{name}': ..}}, the size below which its motion does not matter."
            )
    return ""
