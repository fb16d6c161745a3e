"""What the compiled map preserves: dq ^ dp, the way back, momentum maps; and how large its steps may be."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.conservation import MomentumMap, momentum_maps
from scvi_codegen.errors import StepFailedError
from scvi_codegen.mechanical_system import MechanicalSystem
from scvi_codegen.verification.certificate import Check, at_most, information, not_measured
from scvi_codegen.verification.subject import EPSILON, State, Subject

__all__ = ["largest_step", "structure_checks"]

Array = NDArray[np.float64]

ROUNDINGS = 64.0
SPREAD = 10.0
"""By how much the error of the derivative may exceed the disagreement of two widths of differences."""
TOO_ROUGH = 1e-6
STEPS = 1000
DOUBLINGS, BISECTIONS = 24, 10
TRIED = 3


def structure_checks(subject: Subject) -> Iterator[Check]:
    """All of this room that is promised."""
    yield _symplecticity(subject)
    if subject.method.symmetric:
        yield _reversal(subject)
    if subject.method.symplectic:
        yield from _momenta(subject)


def _symplecticity(subject: Subject) -> Check:
    name, promise = "symplecticity", "J^T Omega J = Omega, J by finite differences of the compiled step"
    m = subject.system.dimension
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m))
    defects, bounds = [], []
    for state in subject.states:
        found = subject.linearised(state)
        if found is None:
            return not_measured(name, promise, "steps from nearby states fail")
        J = found.matrix
        bounds.append(2 * m * SPREAD * float(np.abs(J).max()) * (found.uncertainty + EPSILON * ROUNDINGS))
        defects.append(float(np.abs(J.T @ omega @ J - omega).max()))
    defect, bound = max(defects), max(bounds)
    if not subject.method.symplectic:
        return information("symplecticity defect", "none is promised", defect, f"noise {bound:.1g}")
    if bound > TOO_ROUGH:
        return not_measured(name, promise, f"differences are good to {bound:.1g} only: try a smaller step")
    return at_most(name, promise, defect, bound, "the bound is the noise of the differences")


def _reversal(subject: Subject) -> Check:
    name, promise = "reversal", "a step with -h undoes the step with h"
    worst = 0.0
    try:
        for _, state, rounding in subject.roundings():
            q, p = subject.step(state)
            back = State(q, p, state.t + state.h, -state.h)
            noise = subject.rounding(back) + _carried_back(subject, back, rounding)
            worst = max(worst, float(np.max(np.abs(subject.ends(back) - state.z) / noise)))
    except StepFailedError as failure:
        return not_measured(name, promise, str(failure))
    return at_most(name, promise, worst, ROUNDINGS, "in units of rounding, 2 states")


def _carried_back(subject: Subject, back: State, rounding: Array) -> Array:
    """What the step back makes of the rounding errors of the step there."""
    around = subject.linearised(back)
    return rounding if around is None else around.carried(rounding)


def _conserved(system: MechanicalSystem) -> tuple[MomentumMap, ...]:
    return momentum_maps(system)


def _momenta(subject: Subject) -> Iterator[Check]:
    given = subject.given
    for quantity in _conserved(subject.system):
        name, promise = quantity.name, "a symmetry of the system conserves it to round-off"
        try:
            run = subject.stepper.integrate(given.q, given.p, h=given.h, steps=STEPS, t=given.t)
        except StepFailedError as failure:
            if failure.trajectory is None or len(failure.trajectory) <= TRIED:
                yield not_measured(name, promise, str(failure))
                continue
            run = failure.trajectory
        steps = len(run) - 1
        bound = ROUNDINGS * EPSILON * float(np.sqrt(steps))
        yield at_most(name, promise, quantity.error(run), bound, f"relative, {steps} steps of {given.h:g}")


def largest_step(subject: Subject) -> Check:
    """By bisection: the longest step for which the stage equations are solved, three times in a row."""
    name, what = "largest step", f"stage equations are solved up to h, {TRIED} steps in a row"
    given = subject.states[0]

    def usable(h: float) -> bool:
        try:
            subject.stepper.integrate(given.q, given.p, h=h, steps=TRIED, t=given.t, parameters=subject.parameters)
        except StepFailedError:
            return False
        return True

    good, bad = 0.0, given.h
    if usable(given.h):
        good = given.h
        for _ in range(DOUBLINGS):
            bad = 2 * good
            if not usable(bad):
                break
            good = bad
        else:
            return information(name, what, good, "none that fails was found")
    for _ in range(BISECTIONS):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if usable(middle) else (good, middle)
    return information(name, what, good)
