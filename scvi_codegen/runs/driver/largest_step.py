"""Largest step of tau that meets a tolerance, determined by short pilot runs.

With a suitable time transformation all steps of tau have similar errors, so a few hundred steps suffice. Later
violations appear in ``step_error`` of the run, the largest error of all its steps.
"""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from scvi_codegen.codegen.native.option_table import OPTION
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import MethodError, StateError, StepFailedError
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.states.validation import Parameters, States, check_inputs_given
from scvi_codegen.runs.stepping.step_plan import FixedSteps

ROUND_OFF = 2.0**-53
"""Relative error meant by a tolerance of 0."""
PILOT_STEPS = 256
REFINEMENTS = 4
"""Step sizes tried between a step size and its double."""
MOST_HALVINGS = 60
ALLOWED = 10.0
"""Factor by which the error of a run may exceed the tolerance of its pilot run."""
SIZES = "largest_v", "largest_a", "largest_dq", "largest_bend"
"""Sizes of the motion of a run in its memory in C (``sizes.h``)."""


def largest_step(
    stepper: Any,
    q: States,
    p: States,
    span: float,
    tolerance: float = 0.0,
    *,
    t: float = 0.0,
    parameters: Parameters = None,
    options: SolverOptions | None = None,
) -> float:
    """Return the largest step of tau, to a fifth, whose estimated errors in a pilot run do not exceed the tolerance.

    Args:
        stepper: :class:`Stepper` of a system in transformed time, or compiled with ``time_transformation``.
        q, p: (m,) initial state.
        span: duration of the run, negative for a run backward; pilot runs do not exceed it.
        tolerance: relative error of a step, 0 for round-off.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Returns:
        The step, with the sign of the span in transformed time, positive with the reversible controller.

    Raises:
        StateError: if a number is out of range, an input is not set, or no step is small enough.
        MethodError: if the method has no error estimate.
    """
    length, bound = OPTION["span"].checked(span), OPTION["tolerance"].checked(tolerance) if tolerance else 0.0
    check_inputs_given(stepper.interface, parameters)
    reversible, end = stepper.interface.time_transformation is not None, t + length
    start = partial(stepper.start, q, p, t=t, t_end=end if reversible else None, options=options)
    first = abs(length) if reversible else length
    values = start(h=first, parameters=parameters).parameters
    rate = float(stepper.rates(q, p, values)[0])
    sizes: dict[str, list[float]] = {}
    return _longest(lambda h: _pilot(start(h=h, parameters=values), end, sizes), first / rate, bound or ROUND_OFF)


def _longest(pilot: Callable[[float], tuple[float, int]], h: float, allowed: float) -> float:
    """Bracket the step by doubling or halving, then refine it geometrically."""
    error, steps = pilot(h)
    for _ in range(MOST_HALVINGS):
        if error <= allowed and steps <= 1:
            return h
        if error <= allowed:
            longer = pilot(2.0 * h)
            if longer[0] > allowed:
                break
            h, (error, steps) = 2.0 * h, longer
        else:
            h, (error, steps) = h / 2.0, pilot(h / 2.0)
    else:
        raise StateError(
            f"no step of tau has an error below {allowed:.1e}: use another time transformation or a larger tolerance"
        )
    between = (h * 2.0 ** (k / REFINEMENTS) for k in range(REFINEMENTS - 1, 0, -1))
    return next((longest for longest in between if pilot(longest)[0] <= allowed), h)


@without_accuracy_warnings()
def _pilot(run: Run, end: float, sizes: dict[str, list[float]]) -> tuple[float, int]:
    """Return the largest error of the first steps of a run, infinite if one fails, and their number.

    Errors are relative to the motions of all pilot runs, ``sizes``: from rest, the motion of a first
    short step is its own curvature, of which no step is small enough.
    """
    error, done, fixed = 0.0, 0, isinstance(run.plan, FixedSteps)
    for name, of_runs in sizes.items():
        getattr(run._memory, name)[0 : len(of_runs)] = of_runs
    while done < PILOT_STEPS and not run.arrived and not (fixed and (end - run.t) * run._step_size <= 0.0):
        size = max(1, done)
        try:
            error = run.record(size, save_every=size).step_error
        except StepFailedError:
            return math.inf, done + 1
        if math.isnan(error):
            raise MethodError(f"{run.stepper.interface.title} has no error estimate: give h")
        done = run.steps
        if error < 1.0:  # a step whose error is its motion has no size
            sizes.update({name: list(getattr(run._memory, name)) for name in SIZES})
    return error, done


def accuracy_message(step_error: float, t: float, tolerance: float) -> str | None:
    """Return a message if a run exceeded its tolerance (0: round-off), else ``None``."""
    allowed = tolerance or ROUND_OFF
    if step_error <= ALLOWED * allowed:
        return None
    return (
        f"the step from t = {t:g} has a relative error of about {step_error:.1e}, but {allowed:.1e} was requested: "
        "give a smaller step of tau, or use another time transformation"
    )
