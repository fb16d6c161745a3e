"""Check of the predictor: the initial guess of the stages, extrapolated from previous steps.

One iteration is made from the straight line and one from the predictor; the errors that remain are compared. The stages
of one step predict the curve to a higher order in h than a straight line, those of two steps to a higher order still,
so that at a small step size the predictor is far better. An error in its tables does not change the solution, only the
number of iterations, so that no state would show it.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.system_under_test import EPSILON, State, SystemUnderTest

__all__ = ["predictor_checks"]

ONE_ITERATION = SolverOptions(tolerance=1e300)
"""Solver options that accept any update, so that a step makes one iteration."""
HALVINGS = 12
LEAST_ERROR = 1e4 * EPSILON
"""Least error that one iteration from the straight line must leave, relative to the state, for a comparison."""
STEPS = (1, 3, 4)
"""Numbers of steps before the predicted one; from the third on, two previous steps are available."""
LARGEST_RATIO = 0.25
"""Largest ratio of the errors left by the predictor and by the line; at small h it is 0.01 and less."""


def predictor_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the check for implicit methods; one stage, or curves of degree 1, predict no more than a line."""
    method = tested.method
    if method.implicit and method.exactness.curve != 1 and len(discretise(tested.system, method).blocks) > 1:
        statement = "one iteration leaves a smaller error from the predictor than from a straight line, at small h"
        yield from checked("predictor", statement, partial(_predictor, tested))


def _predictor(tested: SystemUnderTest) -> Finding | None:
    result = [_worst(tested, stepper) for stepper in {tested.stepper, tested.newton or tested.stepper}]
    seen = [each for each in result if each is not None]
    if not seen:
        return None
    worst, h = max(seen)
    return Finding(worst, LARGEST_RATIO, f"ratio of the errors, h = {h:.3g}")


def _worst(tested: SystemUnderTest, stepper: Stepper) -> tuple[float, float] | None:
    """Return the largest ratio of the errors left by predictor and line, and the smallest h at which it shows."""
    for k in reversed(range(HALVINGS)):
        h = tested.states[0].h / 2**k
        with suppress(StepFailedError):
            left = [_errors_left(tested, stepper, h, steps) for steps in STEPS]
            if min(line for line, _ in left) >= LEAST_ERROR:
                return max(guess / line for line, guess in left), h
    return None


def _errors_left(tested: SystemUnderTest, stepper: Stepper, h: float, steps: int) -> tuple[float, float]:
    """Return the errors left by one iteration after ``steps`` steps, relative to the state: from line and predictor."""
    first, parameters = tested.states[0], tested.parameters
    run = stepper.start(first.q, first.p, h=h, t=first.t, parameters=parameters)
    run.advance(steps)
    here, saved = State(run.q, run.p, run.t, h), run.checkpoint()
    runs = (
        stepper.from_checkpoint(saved, parameters=parameters),
        stepper.start(here.q, here.p, h=h, t=here.t, parameters=parameters, options=ONE_ITERATION),
        stepper.from_checkpoint(saved, parameters=parameters, options=ONE_ITERATION),
    )
    for each in runs:
        each.advance(1)
    solved, line, guess = (np.concatenate([each.q, each.p]) / tested.scales(here) for each in runs)
    return float(np.max(np.abs(line - solved))), float(np.max(np.abs(guess - solved)))
