"""Checks of preserved structure: symplectic form, reversibility, momentum maps, constraints; largest usable step."""

import math
from collections.abc import Iterator
from functools import partial

import numpy as np

from scvi_codegen.api.formulas import mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array, Reduction
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.extras.exact.solution import numbers
from scvi_codegen.extras.verification.certificate import Check, Finding, checked, information
from scvi_codegen.extras.verification.system_under_test import (
    BOUND,
    CONSECUTIVE_STEPS,
    EPSILON,
    LONG_RUN,
    NOISE_OF_DIFFERENCES,
    ROUNDINGS,
    SHORT_RUN,
    TRIALS,
    Jacobian,
    State,
    SystemUnderTest,
    canonical_form,
)
from scvi_codegen.runs.trajectory import Trajectory

SPREAD = 10.0
"""Safety factor of the error of the finite-difference Jacobian over the disagreement of two widths."""
SPACES = {"rotation": "T*SO(3)", "direction": "T*S^2", "spin": "S^2"}
LENGTH, PHASE = 1.7, complex(np.exp(0.7j))
"""Factors of quaternions and directions, and of spins, to which steps must be invariant."""


def structure_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the checks that apply to method and system."""
    if Discretisation(tested.system, tested.method).symplectic:
        statement = "J^T Omega J = Omega, J by finite differences of the compiled step"
        yield from checked("symplecticity", statement, partial(_symplecticity, tested))
    elif Discretisation(tested.system, tested.method).conformally_symplectic:
        statement = "J^T Omega J = exp(-gamma h) Omega, gamma the damping, J by finite differences of the compiled step"
        yield from checked("conformal symplecticity", statement, partial(_symplecticity, tested))
    if rotations := tested.stepper.interface.rotations:
        statement = "a step commutes with changes of the lengths of quaternions and directions, and of phases of spins"
        yield from checked("gauge invariance", statement, partial(_gauge_invariance, tested))
        if Discretisation(tested.system, tested.method).symplectic and not tested.system.constraints:
            kinds = " and ".join(dict.fromkeys(SPACES[declaration.split()[0]] for declaration in rotations))
            statement = f"A^T Omega A = Omega of the derivative A of the step on the reduced space ({kinds})"
            yield from checked("reduced symplecticity", statement, partial(_reduced_symplecticity, tested))
    if tested.system.constraints:
        statement = f"they and their rates are 0 up to round-off at {SHORT_RUN} states of {LONG_RUN} steps"
        yield from checked("constraints", statement, partial(_constraints, tested))
        statement = "the compiled multipliers are those of the exact motion (60 digits)"
        yield from checked("multipliers", statement, partial(_multipliers, tested))
    if tested.method.symmetric:
        yield from checked("reversal", "a step with -h undoes the step with h", partial(_reversal, tested))
    if tested.method.symplectic:
        described = tested.stepper.interface
        for k, name in enumerate(described.map_names):
            if described.map_exact[k]:
                statement = "conserved to round-off (symmetry of the system)"
                yield from checked(name, statement, partial(_momentum, tested, k))


def _symplecticity(tested: SystemUnderTest) -> Finding:
    worst = Finding(0.0, np.inf)
    for state in tested.states:
        around = tested.linearised(state)
        if around is None:
            raise StateError("steps from neighbouring states fail")
        m, shrunk = len(state.q), math.exp(-tested.damping * state.h)
        areas = around.scales[:m] * around.scales[m:]
        forms = (tested.two_form(state), tested.two_form(tested.after(state)))
        if tested.system.constraints:
            defect, noise = _defect(around, tested.tangents(state), float(np.median(areas)), shrunk, forms)
        else:
            units = np.sqrt(np.outer(np.tile(areas, 2), np.tile(areas, 2)))
            defect, noise = _defect(around, np.eye(2 * m), units, shrunk, forms)
        if noise.max() > NOISE_OF_DIFFERENCES:
            raise StateError(f"finite differences have noise {noise.max():.1g}: use a smaller step size")
        index = np.unravel_index(np.argmax(defect / noise), defect.shape)
        result = Finding(float(defect[index]), float(noise[index]), "the bound is the noise of the differences")
        worst = max(worst, result, key=lambda finding: finding.measured / finding.bound)
    return worst


def _normalised_states(tested: SystemUnderTest, reduction: Reduction) -> list[State]:
    return [State(*reduction.normalised(state.q, state.p), state.t, state.h) for state in tested.states]


def _reduced_symplecticity(tested: SystemUnderTest) -> Finding:
    """Return the largest defect of the symplectic form in canonical coordinates of the reduced space."""
    reduction, worst = tested.stepper.products.reduction, 0.0
    form = canonical_form(reduction.size // 2)
    for state in _normalised_states(tested, reduction):
        derivative = tested.stepper.jacobian(state.q, state.p, state.h, state.t, tested.parameters)
        step = reduction.outward(*tested.step(state)) @ derivative @ reduction.inward(state.q, state.p)
        units = EPSILON * (np.abs(step.T) @ np.abs(form) @ np.abs(step)).max()
        worst = max(worst, float(np.abs(step.T @ form @ step - form).max() / units))
    return Finding(worst, ROUNDINGS, "in units of rounding, exact derivatives of 2 steps")


def _gauge_invariance(tested: SystemUnderTest) -> Finding:
    reduction, worst = tested.stepper.products.reduction, 0.0
    for state in _normalised_states(tested, reduction):
        z = state.q + 1j * state.p
        for member in reduction.members:
            part = z[member.columns]
            z[member.columns] = part * PHASE if member.kind == "spin" else part.real * LENGTH + 1j * part.imag / LENGTH
        other, end = tested.ends(State(z.real, z.imag, state.t, state.h)), tested.ends(state)
        worst = max(worst, tested.in_roundings(reduction.aligned(other, end) - end, state))
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _defect(
    around: Jacobian, tangents: Array, units: Array | float, shrunk: float, forms: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return |J^T Omega J - exp(-gamma h) Omega| on pairs of tangents, and its noise, in units of areas."""
    before, omega = (form * np.outer(around.scales, around.scales) for form in forms)
    error = np.full_like(around.matrix, SPREAD * (around.uncertainty + EPSILON * ROUNDINGS))
    ends = around.matrix @ tangents
    # First-order bound |dJ^T Omega J + J^T Omega dJ| for an error |dJ| <= error of the differences.
    half = np.abs(tangents.T) @ error.T @ np.abs(omega) @ np.abs(ends)
    return np.abs(ends.T @ omega @ ends - shrunk * tangents.T @ before @ tangents) / units, (half + half.T) / units


def _constraints(tested: SystemUnderTest) -> Finding | None:
    """Return the largest constraint residual and its rate along a run without modes, in units of its rounding."""
    if tested.stepper.interface.mode_names:
        return None
    first, stepper, parameters = tested.states[0], tested.stepper, tested.constant_inputs
    q, p = stepper.project(first.q, first.p, t=first.t, parameters=parameters)
    run = stepper.integrate(q, p, h=first.h, steps=LONG_RUN, t=first.t, parameters=parameters)
    worst = 0.0
    for k in range(0, len(run), LONG_RUN // SHORT_RUN):
        state = State(run.q[k], run.p[k], float(run.t[k]), first.h)
        units = EPSILON * np.maximum(np.abs(state.z), tested.scales(state))
        partials = np.abs(tested.constraint_derivatives(state, units / EPSILON)).sum(axis=1) + _by_time(tested, state)
        values = np.abs(np.concatenate(stepper.constraint_values(state.q, state.p, state.t, parameters)))
        varying = partials > 0.0  # a constraint on velocities has no position residual
        worst = max(worst, float(np.max(values[varying] / (EPSILON * partials[varying]))))
    return Finding(worst, ROUNDINGS, f"in units of rounding, steps of {first.h:g}")


def _by_time(tested: SystemUnderTest, state: State) -> Array:
    """Return (2c,) changes of constraints and of their rates by a rounding of time, in units of rounding."""
    moment = 1e-5 * (abs(state.t) + abs(state.h))
    values = [
        np.concatenate(
            tested.stepper.constraint_values(state.q, state.p, state.t + sign * moment, tested.constant_inputs)
        )
        for sign in (1, -1)
    ]
    return np.abs(values[0] - values[1]) / 2e-5


def _multipliers(tested: SystemUnderTest) -> Finding:
    state, motion = tested.states[0], tested.motion
    q, p, t = numbers(state.q), numbers(state.p), mp.mpf(state.t)
    v = motion.velocity(q, p, t)
    result = tested.stepper.multipliers(state.q, state.p, state.t, tested.parameters)
    exact = motion.multipliers(q, v, t)
    size = max(float(max(map(abs, exact))), np.finfo(float).tiny)
    return Finding(float(np.abs(result - exact.astype(float)).max() / size), BOUND, "relative")


def _reversal(tested: SystemUnderTest) -> Finding:
    worst = 0.0
    for state in tested.states:
        q, p = tested.step(state)
        back, rounding = State(q, p, state.t + state.h, -state.h), tested.rounding(state)
        around = tested.linearised(back)
        noise = tested.rounding(back) + (rounding if around is None else around.propagated(rounding))
        worst = max(worst, float(np.max(np.abs(tested.ends(back) - state.z) / noise)))
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _momentum(tested: SystemUnderTest, k: int) -> Finding:
    initial, stepper = tested.initial, tested.stepper
    try:
        run = stepper.integrate(
            initial.q, initial.p, h=initial.h, steps=LONG_RUN, t=initial.t, parameters=stepper.defaults
        )
    except StepFailedError as failure:
        run = Trajectory.before(failure)
        if len(run) <= CONSECUTIVE_STEPS:
            raise
    return momentum_error(run, k, f" of {initial.h:g}")


def momentum_error(run: Trajectory, k: int, such: str = "") -> Finding:
    """Return the largest relative change of the k-th momentum map along a run, with its random-walk bound."""
    steps = len(run) - 1
    bound = ROUNDINGS * EPSILON * float(np.sqrt(steps))
    error = float(np.abs(run.momentum_errors()[:, k]).max())
    return Finding(error, bound, f"relative, {steps} steps{such}")


def largest_step(tested: SystemUnderTest) -> Check:
    """Return the largest step size at which the stage equations are solved three times in a row, by bisection."""
    name, statement = "largest step", f"largest h at which {CONSECUTIVE_STEPS} steps in a row are solved"
    state = tested.states[0]

    def usable(h: float) -> bool:
        try:
            tested.stepper.integrate(
                state.q, state.p, h=h, steps=CONSECUTIVE_STEPS, t=state.t, parameters=tested.parameters
            )
        except StepFailedError:
            return False
        return True

    good, bad = 0.0, state.h
    if usable(state.h):
        good = state.h
        for _ in range(TRIALS):
            bad = 2 * good
            if not usable(bad):
                break
            good = bad
        else:
            return information(name, statement, good, "no failing step size was found")
    for _ in range(TRIALS):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if usable(middle) else (good, middle)
    return information(name, statement, good)
