"""What the compiled map preserves: dq ^ dp, the way back, momentum maps; and how large its steps may be."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.methods.method import is_symplectic
from scvi_codegen.runtime.trajectory import Trajectory
from scvi_codegen.verification.certificate import Check, Finding, checked, information
from scvi_codegen.verification.linearisation import Linearised
from scvi_codegen.verification.subject import EPSILON, State, Subject

__all__ = ["largest_step", "structure_checks"]

Array = NDArray[np.float64]

ROUNDINGS = 16.0
SPREAD = 10.0
"""By how much the error of the derivative may exceed the disagreement of two widths of differences."""
TOO_ROUGH = 1e-6
STEPS = 1000
DOUBLINGS, BISECTIONS = 24, 10
TRIED = 3


def structure_checks(subject: Subject) -> Iterator[Check]:
    """All of this room that is promised."""
    if is_symplectic(subject.method, subject.system):
        promise = "J^T Omega J = Omega, J by finite differences of the compiled step"
        yield from checked("symplecticity", promise, partial(_symplecticity, subject))
    if subject.method.symmetric:
        yield from checked("reversal", "a step with -h undoes the step with h", partial(_reversal, subject))
    if subject.method.symplectic:
        described = subject.stepper.interface
        for k, name in enumerate(described.map_names):
            if described.map_exact[k]:
                promise = "a symmetry of the system conserves it to round-off"
                yield from checked(name, promise, partial(_momentum, subject, k))


def _symplecticity(subject: Subject) -> Finding:
    worst = Finding(0.0, np.inf)
    for state in subject.states:
        around = subject.linearised(state)
        if around is None:
            raise StateError("steps from nearby states fail")
        defect, noise = _defect(around)
        if noise.max() > TOO_ROUGH:
            raise StateError(f"differences are good to {noise.max():.1g} only: try a smaller step")
        place = np.unravel_index(np.argmax(defect / noise), defect.shape)
        found = Finding(float(defect[place]), float(noise[place]), "the bound is the noise of the differences")
        worst = max(worst, found, key=lambda finding: finding.measured / finding.bound)
    return worst


def _defect(around: Linearised) -> tuple[Array, Array]:
    """(2m, 2m) sizes of J^T Omega J - Omega, and of their noise, each in units of the areas of its two coordinates."""
    m, J = len(around.scales) // 2, around.matrix
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m)) * np.outer(around.scales, around.scales)
    areas = np.tile(around.scales[:m] * around.scales[m:], 2)
    units = np.sqrt(np.outer(areas, areas))
    error = np.full_like(J, SPREAD * (around.uncertainty + EPSILON * ROUNDINGS))
    half = error.T @ np.abs(omega) @ np.abs(J)
    return np.abs(J.T @ omega @ J - omega) / units, (half + half.T) / units


def _reversal(subject: Subject) -> Finding:
    worst = 0.0
    for _, state, rounding in subject.roundings():
        q, p = subject.step(state)
        back = State(q, p, state.t + state.h, -state.h)
        noise = subject.rounding(back) + _carried_back(subject, back, rounding)
        worst = max(worst, float(np.max(np.abs(subject.ends(back) - state.z) / noise)))
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _carried_back(subject: Subject, back: State, rounding: Array) -> Array:
    """What the step back makes of the rounding errors of the step there."""
    around = subject.linearised(back)
    return rounding if around is None else around.carried(rounding)


def _momentum(subject: Subject, k: int) -> Finding:
    """The k-th momentum map along a run."""
    given = subject.given
    try:
        run = subject.stepper.integrate(given.q, given.p, h=given.h, steps=STEPS, t=given.t)
    except StepFailedError as failure:
        run = Trajectory.before(failure)
        if len(run) <= TRIED:
            raise
    steps = len(run) - 1
    bound = ROUNDINGS * EPSILON * float(np.sqrt(steps))
    error = float(np.abs(run.momentum_errors()[:, k]).max())
    return Finding(error, bound, f"relative, {steps} steps of {given.h:g}")


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
