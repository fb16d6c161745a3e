"""What a run remembers for its next step: how much of the way to the solution the guess from former steps saves.

One iteration, of sweeps or of Newton's solver, is made from the straight line, and from what former steps left; what
remains of the way shows how good each guess was. The stages of one step tell the curve to an order of h more than a
line does, those of two to more yet, so that at a short step the guess is far better than the line. A wrong table, or
stages that are not those of the step before, still lead to the solution, only later: no state shows them.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.subject import EPSILON, State, Subject

__all__ = ["guess_checks"]

ONE_ITERATION = SolverOptions(tolerance=1e300)
HALVINGS = 12
SEEN = 1e4 * EPSILON
"""What one iteration from the straight line must leave, in parts of the state, to measure a guess beside it."""
STEPS = (1, 3, 4)
"""Before the step that is guessed: from the third on, the two before are both known, and near each other."""
GAINED = 0.25
"""What a guess may leave in parts of what the line does; at short steps it is a hundredth and less."""


def guess_checks(subject: Subject) -> Iterator[Check]:
    """All of this room, of what iterates; one stage, or curves of degree 1, say no more than the line does."""
    method = subject.method
    if method.implicit and method.exactness.curve != 1 and len(discretise(subject.system, method).blocks) > 1:
        promise = "from former steps an iteration leaves less to do than from a straight line, at a short step"
        yield from checked("guesses", promise, partial(_guesses, subject))


def _guesses(subject: Subject) -> Finding | None:
    found = [_worst(subject, stepper) for stepper in {subject.stepper, subject.newton or subject.stepper}]
    seen = [each for each in found if each is not None]
    if not seen:
        return None
    worst, h = max(seen)
    return Finding(worst, GAINED, f"in parts of what the line leaves, h = {h:.3g}")


def _worst(subject: Subject, stepper: Stepper) -> tuple[float, float] | None:
    """What is left from former steps, in parts of what the line leaves, at the shortest h at which that is seen."""
    for k in reversed(range(HALVINGS)):
        h = subject.states[0].h / 2**k
        with suppress(StepFailedError):
            left = [_left(subject, stepper, h, steps) for steps in STEPS]
            if min(line for line, _ in left) >= SEEN:
                return max(guess / line for line, guess in left), h
    return None


def _left(subject: Subject, stepper: Stepper, h: float, steps: int) -> tuple[float, float]:
    """After so many steps of h what one iteration leaves, in parts of the state: from the line, from former steps."""
    first, parameters = subject.states[0], subject.parameters
    run = stepper.start(first.q, first.p, h=h, t=first.t, parameters=parameters)
    run.advance(steps)
    here, saved = State(run.q, run.p, run.t, h), run.save()
    runs = (
        stepper.restore(saved, parameters=parameters),
        stepper.start(here.q, here.p, h=h, t=here.t, parameters=parameters, options=ONE_ITERATION),
        stepper.restore(saved, parameters=parameters, options=ONE_ITERATION),
    )
    for each in runs:
        each.advance(1)
    solved, line, guess = (np.concatenate([each.q, each.p]) / subject.scales(here) for each in runs)
    return float(np.max(np.abs(line - solved))), float(np.max(np.abs(guess - solved)))
