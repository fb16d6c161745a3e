"""The longest step of transformed time whose ends are as accurate as is wanted, found by short runs.

Where a monitor fits, all steps of tau are about as hard as the first ones, so a few hundred of them tell. What they do
not tell is seen in the run itself: its ``step_error`` is the largest of all its steps.
"""

from __future__ import annotations

import math

from numpy.typing import ArrayLike

from scvi_codegen.errors import MethodError, StateError, StepFailedError
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.inputs import Parameters
from scvi_codegen.runtime.run import Run
from scvi_codegen.runtime.stepper import Stepper

__all__ = ["ROUND_OFF", "longest_step", "too_wrong"]

ROUND_OFF = 2.0**-53
"""What is meant by a tolerance of 0."""
PILOT_STEPS = 256
RUNGS = 4
"""Steps tried between one and its double."""
MOST_HALVINGS = 60
ALLOWED = 10.0
"""A run keeps what was promised for its start up to this factor."""


def longest_step(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike,
    span: float,
    tolerance: float = 0.0,
    *,
    t: float = 0.0,
    parameters: Parameters = None,
    options: SolverOptions | None = None,
) -> float:
    """The longest step of tau, to a fifth, at which no step of a pilot run has an estimated error beyond the tolerance.

    Args:
        stepper: of a system in transformed time.
        q, p: (m,) initial state.
        span: of time, negative to go back; pilot runs do not go further.
        tolerance: relative error of the end of a step, 0 for round-off.
        t, parameters, options: as of :meth:`Stepper.integrate`.

    Raises:
        StateError: for numbers out of range, and where no step is short enough.
        MethodError: for a method whose steps have no estimate of their error.
    """
    length, wanted = checked_number(span, "the span"), checked_number(tolerance, "the tolerance")
    if length == 0.0 or not 0.0 <= wanted < 1.0:
        raise StateError(f"a span of {length:g} with a tolerance of {wanted:g}: the one is not 0, the other in [0, 1)")
    run = stepper.start(q, p, h=math.copysign(1.0, length), t=t, parameters=parameters, options=options)
    rate = float(stepper.rates(q, p, run.parameters)[0])

    def serves(h: float) -> bool:
        pilot = stepper.start(q, p, h=h, t=t, parameters=run.parameters, options=options)
        return _largest_error(pilot, t + length) <= (wanted or ROUND_OFF)

    h = length / rate
    for _ in range(MOST_HALVINGS):
        if serves(h):
            break
        h /= 2.0
    else:
        raise StateError(
            f"no step of tau keeps an error of {wanted or ROUND_OFF:.1e}: is the monitor fit for this motion?"
        )
    longer = (h * 2.0 ** (k / RUNGS) for k in range(RUNGS - 1, 0, -1))
    return next((longest for longest in longer if serves(longest)), h)


def _largest_error(run: Run, end: float) -> float:
    """Of the first steps; infinite if one of them fails."""
    done = 0
    while done < PILOT_STEPS and (end - run.t) * run.h > 0.0:
        size = max(1, done)
        try:
            error = run.record(size, every=size).step_error
        except StepFailedError:
            return math.inf
        if math.isnan(error):
            raise MethodError(f"{run.stepper.interface.title}: steps have no estimate of their error, give a step h")
        done += size
    return error


def too_wrong(step_error: float, t: float, tolerance: float) -> str | None:
    """What is to be said of a run whose steps were to keep a tolerance (0: round-off), or ``None`` if they did."""
    allowed = tolerance or ROUND_OFF
    if step_error <= ALLOWED * allowed:
        return None
    return (
        f"the step from t = {t:g} has a relative error of about {step_error:.1e}, where {allowed:.1e} was wanted: the "
        "monitor does not fit the whole motion, give a shorter step of tau"
    )
