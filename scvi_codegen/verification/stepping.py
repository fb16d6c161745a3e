"""Whether the compiled step solves the equations of its method: against 60 digits, and by finite differences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.binding import SolverOptions
from scvi_codegen.derived_step import compiled_equations
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.exact_motion import numbers
from scvi_codegen.precision import mp
from scvi_codegen.stepper import Stepper
from scvi_codegen.verification.certificate import Check, at_most, broken, not_measured
from scvi_codegen.verification.linearisation import WEIGHTS
from scvi_codegen.verification.subject import LARGEST, State, Subject

__all__ = ["step_checks"]

Array = NDArray[np.float64]

ROUNDINGS = 64.0
"""Roundings, each of the size that the state itself has, that a step may add up."""
ANY_UPDATE = SolverOptions(tolerance=1e300)
"""Newton's iteration ends after its first update."""
WRONG_PART = 1e-6
"""Of its way to the solution that Newton's first update may miss otherwise than the exact one does."""
SMALLER, MOST_SWEEPS = 256, 10
"""An iteration that contracts in proportion to h, somehow at h, takes 52 bits / 8 bits a sweep at h / 256; some more
for the first and the last one."""
RUN_STEPS = 12
STATIONARY = mp.mpf(10) ** -25
TRANSFORM = 1e-11
SLOPES = 1e-6


def step_checks(subject: Subject) -> Iterator[Check]:
    """All of this room."""
    yield _solves(subject, subject.stepper, "stage equations", "a step solves the paper's equations (60 digits)")
    yield from _newton(subject)
    yield from _fallback(subject)
    yield _contraction(subject)
    yield _run(subject)
    yield from _action_by_differences(subject)
    yield from _transforms(subject)
    yield from _discrete_transforms(subject)


def _solves(subject: Subject, stepper: Stepper, name: str, promise: str) -> Check:
    worst = 0.0
    for index, state in enumerate(subject.states):
        try:
            expected = subject.solved(index)
        except (StateError, ArithmeticError) as error:
            return not_measured(name, promise, str(error))
        try:
            apart = np.abs(subject.ends(state, stepper) - _rounded(expected.q, expected.p))
            worst = max(worst, float(np.max(apart / subject.rounding(state))))
        except StepFailedError as failure:
            return broken(name, promise, f"they have a solution, but {failure}")
    return at_most(name, promise, worst, ROUNDINGS, "largest distance in units of rounding, 2 states")


def _rounded(*parts: object) -> Array:
    return np.concatenate([np.array(part, dtype=float) for part in parts])


def _newton(subject: Subject) -> Iterator[Check]:
    """The same of Newton's solver, and its matrix by its first update."""
    if subject.newton is None:
        return
    if subject.newton is not subject.stepper:
        yield _solves(subject, subject.newton, "Newton's solver", "it solves the same equations")
    name = "Newton's matrix"
    promise = "its first update is that of the exact matrix (finite differences, 60 digits)"
    state = subject.states[0]
    equations = compiled_equations(subject.moved, subject.method)
    if equations.unknowns > LARGEST:
        yield not_measured(name, promise, f"{equations.unknowns} unknowns are more than the {LARGEST} in 60 digits")
        return
    try:
        expected = equations.first_update(state.q, state.p, state.h, state.t)
        end = np.array([*subject.solved(0).q, *subject.solved(0).p])
    except (StateError, ArithmeticError, ZeroDivisionError) as error:
        yield not_measured(name, promise, str(error))
        return
    exact = np.array([*expected.q, *expected.p])
    m, scales = len(state.q), subject.scales(state)
    v = subject.motion.velocity(numbers(state.q), numbers(state.p), mp.mpf(state.t))
    way = np.abs(np.concatenate([end[:m] - state.q - state.h * v, end[m:] - state.p]).astype(float) / scales).max()
    rounding = float(np.max(subject.rounding(state) / scales))
    if way < 1e6 * rounding:
        yield not_measured(name, promise, "a straight line is the solution already")
        return
    found = subject.ends(state, subject.newton, ANY_UPDATE)
    wrong = float(np.max(np.abs((found - exact).astype(float)) / scales))
    missed = max(0.0, wrong - ROUNDINGS * rounding) / way
    yield at_most(name, promise, float(missed), WRONG_PART, "part of the way that it misses")


def _fallback(subject: Subject) -> Iterator[Check]:
    """Newton's iteration in the artefact itself, reached where so few sweeps do not converge."""
    if subject.newton is None or subject.newton is subject.stepper:
        return
    name, promise = "fallback", "where sweeps fail, Newton's iteration solves the same equations"
    reached = _newton_after_sweeps(subject)
    if reached is None:
        yield not_measured(name, promise, "sweeps need no more iterations than Newton, or are not tried")
        return
    state, found = reached
    try:
        expected = subject.derived()(state.q, state.p, state.h, state.t)
    except (StateError, ArithmeticError) as error:
        yield not_measured(name, promise, str(error))
        return
    ratio = float(np.max(np.abs(found - _rounded(expected.q, expected.p)) / subject.rounding(state)))
    yield at_most(name, promise, ratio, ROUNDINGS, f"in units of rounding, h = {state.h:.3g}")


def _newton_after_sweeps(subject: Subject) -> tuple[State, Array] | None:
    """A state whose step took more iterations than the sweeps were allowed, and the end of that step."""
    first = subject.states[0]
    for factor in (1, 2, 4, 8):
        for most in range(3, 30):
            options = SolverOptions(max_iterations=most)
            state = State(first.q, first.p, first.t, factor * first.h)
            try:
                iterations, end = _counted(subject, subject.stepper, state, options)
            except StepFailedError:
                continue
            if iterations > most:
                return state, end
            break
    return None


def _counted(subject: Subject, stepper: Stepper, state: State, options: SolverOptions | None) -> tuple[int, Array]:
    """Iterations of a step, and its end."""
    run = stepper.integrate(
        state.q, state.p, h=state.h, steps=1, t=state.t, parameters=subject.parameters, options=options
    )
    return int(run.iterations[1]), np.concatenate([run.q[1], run.p[1]])


def _contraction(subject: Subject) -> Check:
    name, promise = "contraction", f"iterations shrink errors in proportion to h or better (count at h / {SMALLER})"
    first = subject.states[0]
    state = State(first.q, first.p, first.t, first.h / SMALLER)
    try:
        iterations, _ = _counted(subject, subject.stepper, state, None)
    except StepFailedError as failure:
        return broken(name, promise, str(failure))
    return at_most(name, promise, iterations, MOST_SWEEPS)


def _run(subject: Subject) -> Check:
    """A run remembers stages and carries rounding errors; each of its steps must be the step all the same."""
    name, promise = "run", "each step of a run, with its memory, is the step from the same state"
    first, worst = subject.states[0], 0.0
    try:
        run = subject.stepper.integrate(
            first.q, first.p, h=first.h, steps=RUN_STEPS, t=first.t, parameters=subject.parameters
        )
        for k in range(RUN_STEPS):
            state = State(run.q[k], run.p[k], float(run.t[k]), first.h)
            change = np.abs(subject.ends(state) - np.concatenate([run.q[k + 1], run.p[k + 1]]))
            worst = max(worst, float(np.max(change / subject.rounding(state))))
    except StepFailedError as failure:
        return not_measured(name, promise, str(failure))
    return at_most(name, promise, worst, ROUNDINGS, f"in units of rounding, {RUN_STEPS} steps")


def _action_by_differences(subject: Subject) -> Iterator[Check]:
    """The action S by evaluation of L alone, its slopes by differences: dS = p1 dq1 - p0 dq0 at the solution."""
    name, promise = "stationarity", "the action is stationary, p0 and p1 are its slopes (finite differences, 60 digits)"
    state = subject.states[0]
    try:
        equations, solved = subject.derived(), subject.solved(0)
        slopes = equations.action_slopes(solved, state.q, state.p, state.h, state.t)
    except (StateError, ArithmeticError) as error:
        yield not_measured(name, promise, str(error))
        return
    if slopes is None:
        return
    p0, p1 = numbers(state.p), np.array(solved.p, dtype=object)
    row = numbers(equations.stages.end_position.entries[0])
    powers = [mp.mpf(state.h) ** block.power for block in equations.stages.blocks]
    by_unknown = np.array([row[b + 1] * power * p1 for b, power in enumerate(powers)], dtype=object)
    wrong = [*(slopes[0] - row[0] * p1 + p0), *(slopes[1] - by_unknown).ravel()]
    size = max(1, *map(abs, p0), *map(abs, p1))
    yield at_most(name, promise, float(max(map(abs, wrong)) / size), float(STATIONARY))


def _transforms(subject: Subject) -> Iterator[Check]:
    name, promise = "Legendre transform", "momentum, velocity and energy are those of the formula (60 digits)"
    state, motion = subject.states[0], subject.motion
    q, p, t = numbers(state.q), numbers(state.p), mp.mpf(state.t)
    try:
        v, energy = motion.velocity(q, p, t), motion.energy(q, p, t)
        found = [subject.stepper.velocity(state.q, state.p, state.t, subject.parameters)]
        wrong = [_apart(found[0], v)]
        if not motion.hamiltonian:
            back = subject.stepper.momentum(state.q, v.astype(float), state.t, subject.parameters)
            wrong.append(_apart(back, p))
        value = subject.stepper.energy(state.q, state.p, state.t, subject.parameters)
        terms = abs(p) @ abs(v) + abs(energy)
        wrong.append(float(abs(value - energy) / (terms or 1)))
    except (StateError, ArithmeticError) as error:
        yield not_measured(name, promise, str(error))
        return
    yield at_most(name, promise, max(wrong), TRANSFORM, "relative")


def _apart(found: Array, expected: Array) -> float:
    return float(max(abs(found - expected)) / (max(map(abs, expected)) or 1))


def _discrete_transforms(subject: Subject) -> Iterator[Check]:
    """The discrete Lagrangian and its slopes, compiled, by central differences."""
    if not subject.stepper.interface.has_action:
        return
    name, promise = "discrete Lagrangian", "p0 and p1 of a step are its slopes, compiled and by finite differences"
    state = subject.states[0]
    try:
        q1, p1 = subject.step(state)
        slopes = _slopes(subject, state, q1)
        p0 = subject.stepper.discrete_legendre_minus(state.q, q1, state.h, state.t, subject.parameters)[1]
        end = subject.stepper.discrete_legendre_plus(state.q, q1, state.h, state.t, subject.parameters)[1]
    except StepFailedError as failure:
        yield not_measured(name, promise, str(failure))
        return
    size = max(np.abs(state.p).max(), np.abs(p1).max()) or 1.0
    found = np.concatenate([slopes + np.concatenate([state.p, -p1]), p0 - state.p, end - p1])
    yield at_most(name, promise, float(np.abs(found).max() / size), SLOPES, "relative")


def _slopes(subject: Subject, state: State, q1: Array) -> Array:
    """(2m,) of the compiled L_d by q0 and q1, the best of several widths by their agreement."""
    m, both = len(state.q), np.concatenate([state.q, q1])

    def action(ends: Array) -> float:
        return subject.stepper.discrete_lagrangian(ends[:m], ends[m:], state.h, state.t, subject.parameters)

    found = []
    for width in (3e-2, 1e-2, 3e-3, 1e-3):
        moved = width * (np.abs(q1 - state.q).max() or 1.0)
        units = np.eye(2 * m) * moved
        changes = [sum(w * (action(both + k * e) - action(both - k * e)) for k, w in WEIGHTS.items()) for e in units]
        found.append(np.array(changes) / moved)
    best = min(range(1, len(found)), key=lambda k: float(np.abs(found[k] - found[k - 1]).max()))
    slopes: Array = found[best]
    return slopes
