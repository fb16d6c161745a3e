"""Checks of the compiled step against the stage equations of the method, in 60 digits and by finite differences.

The predictor is checked by one iteration from it and one from the straight line: at a small step size it leaves a far
smaller error. An error in its tables changes only the number of iterations, so that no state would show it.
"""

import itertools
from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import numpy as np

from scvi_codegen.api.formulas import mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.extras.exact.solution import Numbers, numbers
from scvi_codegen.extras.exact.step import SolvedStep, compiled_equations
from scvi_codegen.extras.verification.certificate import Check, Finding, ViolationError, checked
from scvi_codegen.extras.verification.system_under_test import (
    EPSILON,
    EQUAL,
    LARGEST_RATIO,
    MAX_UNKNOWNS,
    NOISE_OF_DIFFERENCES,
    ROUND_OFF,
    ROUNDINGS,
    SHORT_RUN,
    STEP_DIVISOR,
    TRIALS,
    WEIGHTS,
    WIDTHS,
    State,
    SystemUnderTest,
)
from scvi_codegen.runs.stepper import Stepper

ANY_UPDATE = SolverOptions(tolerance=1e300, absolute=True)
"""Solver options that accept any update, so that a step makes one iteration."""
LEAST_UPDATE = 1e6
"""Least size of the first update in units of rounding, for it to distinguish a wrong matrix."""
MUCH_SHORTER, MAX_ITERATIONS = STEP_DIVISOR**3, 10
"""Divisor of h, and bound on iterations at h/512.

There an error factor proportional to h is at most 2^-9 per iteration: 53 bits take 6, plus a few."""
SAMPLED_STEPS = (0, 1, 2, 5, SHORT_RUN - 1)
"""Steps of the run that are checked; the first ones have no full predictor history."""


def step_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield all checks of this module."""
    for name, statement, measure in (
        ("stage equations", "a step solves the paper's equations (60 digits)", lambda x: _solves(x, x.stepper)),
        ("Newton's solver", "Newton's method alone solves the same equations", _newton),
        ("solvers", "the default solver and Newton's method give the same step", _agree),
        ("Newton's matrix", "its first update is that of the exact Jacobian (finite differences, 60 digits)", _matrix),
        ("fallback", "if the fixed-point iteration fails, Newton's method solves the same equations", _fallback),
        (
            "convergence rate",
            f"error factor per iteration proportional to h or better (count at h/{MUCH_SHORTER})",
            _convergence_rate,
        ),
        ("run", "each step of a run, with its predictor, equals a single step from the same state", _run),
        ("stationarity", "dS = p1 dq1 - p0 dq0 for the discrete action S (finite differences, 60 digits)", _action),
        ("Legendre transform", "momentum, velocity, energy are those of the formula (60 digits)", _transform),
        ("discrete Lagrangian", "p0 and p1 are its derivatives, compiled and by finite differences", _discrete),
    ):
        yield from checked(name, statement, partial(measure, tested))


def _newton(tested: SystemUnderTest) -> Finding | None:
    if tested.newton is None or tested.newton is tested.stepper:
        return None
    return _solves(tested, tested.newton)


def _solves(tested: SystemUnderTest, stepper: Stepper) -> Finding:
    worst = 0.0
    for index, state in enumerate(tested.states):
        expected = tested.solved(index)
        try:
            worst = max(worst, tested.in_roundings(tested.ends(state, stepper) - _joined(expected), state))
        except StepFailedError as failure:
            raise ViolationError(f"the equations have a solution, but {failure}") from failure
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _agree(tested: SystemUnderTest) -> Finding | None:
    """Compare the stepper under test with Newton's method; applies to large systems, too."""
    if tested.newton is None or tested.newton is tested.stepper:
        return None
    differences = (tested.ends(state) - tested.ends(state, tested.newton) for state in tested.states)
    worst = max(map(tested.in_roundings, differences, tested.states))
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _joined(step: SolvedStep) -> Numbers:
    """Return the end (q, p) of a step in 60 digits."""
    return np.array([*step.q, *step.p], dtype=object)


def _matrix(tested: SystemUnderTest) -> Finding | None:
    """Compare the first Newton update from the straight line with the exact one, in units of rounding."""
    if tested.newton is None:
        return None
    end = _joined(tested.solved(0))
    state, equations = tested.states[0], compiled_equations(tested.moved, tested.method)
    if equations.unknowns > MAX_UNKNOWNS:
        raise StateError(f"{equations.unknowns} unknowns exceed the limit of {MAX_UNKNOWNS} in 60 digits")
    scales = tested.scales(state)
    exact = _joined(equations.first_update(state.q, state.p, state.h, state.t))
    v = tested.motion.velocity(numbers(state.q), numbers(state.p), mp.mpf(state.t))
    straight = np.concatenate([numbers(state.q) + v * state.h, numbers(state.p)])
    rounding = float(np.max(tested.rounding(state) / scales))
    if _size(end - straight, scales) < LEAST_UPDATE * rounding:
        raise StateError("the straight line is the solution")
    missed = _size(tested.ends(state, tested.newton, ANY_UPDATE) - exact, scales)
    return Finding(missed / rounding, ROUNDINGS, "in units of rounding")


def _size(vector: Numbers, scales: Array) -> float:
    return float(np.max(np.abs(vector.astype(float)) / scales))


def _fallback(tested: SystemUnderTest) -> Finding | None:
    """Check Newton's method as fallback of the stepper under test, reached with a limit on the iterations."""
    if tested.newton is None or not tested.stepper.interface.has_fallback:
        return None
    for factor, start in itertools.product((1, 2, 4, 8, 16), tested.states):
        state = State(start.q, start.p, start.t, factor * start.h)
        for most in range(3, SHORT_RUN):
            try:
                iterations, end = _counted(tested, state, SolverOptions(max_iterations=most))
            except StepFailedError:
                continue
            if iterations <= most + 1:  # the iterations converged
                break
            expected = tested.derived()(state.q, state.p, state.h, state.t)
            distance = tested.in_roundings(end - _joined(expected), state)
            return Finding(distance, ROUNDINGS, f"in units of rounding, h = {state.h:.3g}")
    raise StateError("the fallback was not reached: the fixed-point iteration converges as fast as Newton's method")


def _counted(tested: SystemUnderTest, state: State, options: SolverOptions | None = None) -> tuple[int, Array]:
    run = tested.stepper.integrate(
        state.q, state.p, h=state.h, steps=1, t=state.t, parameters=tested.parameters, options=options
    )
    return int(run.iterations[1]), np.concatenate([run.q[1], run.p[1]])


def _convergence_rate(tested: SystemUnderTest) -> Finding:
    first = tested.states[0]
    try:
        iterations, _ = _counted(tested, State(first.q, first.p, first.t, first.h / MUCH_SHORTER))
    except StepFailedError as failure:
        raise ViolationError(str(failure)) from failure
    return Finding(iterations, MAX_ITERATIONS)


def _run(tested: SystemUnderTest) -> Finding | None:
    if tested.stepper.interface.mode_names:
        return None  # steps may end at transitions
    worst = max(_run_of(tested, stepper) for stepper in tested.steppers)
    return Finding(worst, ROUNDINGS, f"in units of rounding, {SHORT_RUN} steps, also with Newton's method alone")


def _run_of(tested: SystemUnderTest, stepper: Stepper) -> float:
    first, worst = tested.states[0], 0.0
    run = stepper.integrate(first.q, first.p, h=first.h, steps=SHORT_RUN, t=first.t, parameters=tested.parameters)
    for k in SAMPLED_STEPS:
        start = State(run.q[k], run.p[k], float(run.t[k]), first.h)
        end = np.concatenate([run.q[k + 1], run.p[k + 1]])
        worst = max(worst, tested.in_roundings(tested.ends(start) - end, start))
    return worst


def _action(tested: SystemUnderTest) -> Finding | None:
    """Check dS = p1 dq1 - p0 dq0 at the solution: S from L alone, its derivatives by finite differences."""
    if tested.system.forces or tested.system.damping != 0:
        return None
    state, equations, solved = tested.states[0], tested.derived(), tested.solved(0)
    partials = equations.action_gradient(solved, state.q, state.p, state.h, state.t)
    if partials is None:
        return None
    p0 = tested.motion.momenta(numbers(state.q), numbers(state.p), mp.mpf(state.t))
    p1 = np.array(solved.momenta, dtype=object)
    row = numbers(equations.stages.end_position.entries[0])
    powers = [mp.mpf(state.h) ** block.power for block in equations.stages.blocks]
    expected = np.array([p1 * (row[b + 1] * power) for b, power in enumerate(powers)], dtype=object)
    wrong = [*(partials[0] - p1 * row[0] + p0), *(partials[1] - expected.ravel())]
    size = max(1, *map(abs, p0), *map(abs, p1))
    return Finding(float(max(map(abs, wrong)) / size), EQUAL)


def _transform(tested: SystemUnderTest) -> Finding:
    state, motion, stepper = tested.states[0], tested.motion, tested.stepper
    q, p, t = numbers(state.q), numbers(state.p), mp.mpf(state.t)
    v, energy = motion.velocity(q, p, t), motion.energy(q, p, t)
    wrong = [_relative(stepper.velocity(state.q, state.p, state.t, tested.parameters), v)]
    if not motion.hamiltonian:
        wrong.append(_relative(stepper.momentum(state.q, v.astype(float), state.t, tested.parameters), p))
    value = stepper.energy(state.q, state.p, state.t, tested.parameters)
    wrong.append(float(abs(value - energy) / (abs(p) @ abs(v) + abs(energy) or 1)))
    return Finding(max(wrong), ROUND_OFF, "relative")


def _relative(result: Array, expected: Numbers) -> float:
    return float(max(abs(result - expected)) / (max(map(abs, expected)) or 1))


def _discrete(tested: SystemUnderTest) -> Finding | None:
    stepper, state = tested.stepper, tested.states[0]
    if not stepper.interface.has_action:
        return None
    q1, p1 = tested.step(state)
    arguments = (state.q, q1, state.h, state.t, tested.parameters)
    try:
        p0, end = stepper.discrete_legendre_minus(*arguments)[1], stepper.discrete_legendre_plus(*arguments)[1]
        partials = _action_derivatives(tested, state, q1)
    except StepFailedError as failure:
        raise ViolationError(f"a curve from q0 to q1 exists, but {failure}") from failure
    sizes = tested.scales(state)[len(q1) :]
    wrong = np.array([*(partials + np.concatenate([state.p, -p1])).reshape(2, -1), p0 - state.p, end - p1])
    return Finding(float(np.max(np.abs(wrong) / sizes)), NOISE_OF_DIFFERENCES, "relative")


def _action_derivatives(tested: SystemUnderTest, state: State, q1: Array) -> Array:
    """Return (2m,) derivatives of the compiled L_d with respect to (q0, q1), from the widths that agree best."""
    m, both = len(state.q), np.concatenate([state.q, q1])

    def action(ends: Array) -> float:
        return tested.stepper.discrete_lagrangian(ends[:m], ends[m:], state.h, state.t, tested.parameters)

    result: list[Array] = []
    for width in WIDTHS:
        moved = width * (np.abs(q1 - state.q).max() or 1.0)
        units = np.eye(2 * m) * moved
        changes = [sum(w * (action(both + k * e) - action(both - k * e)) for k, w in WEIGHTS.items()) for e in units]
        result.append(np.array(changes) / moved)
    best = min(range(1, len(result)), key=lambda k: float(np.abs(result[k] - result[k - 1]).max()))
    return result[best]


LEAST_ERROR = 1e4 * EPSILON
"""Least error that one iteration from the straight line must leave, relative to the state, for a comparison."""
STEPS = (1, 3, 4)
"""Numbers of steps before the predicted one; from the third on, two previous steps are available."""


def predictor_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield the check for implicit methods; one stage, or curves of degree 1, predict no more than a line.

    The curve of degree s of a quadrature of order q has an error O(h^(q - s + 1)), which extrapolation multiplies by
    powers of 2: where that is below s - 1, the predictor need not be better than a line.
    """
    method = tested.method
    s, q = method.exactness.curve, method.exactness.quadrature
    if 0 <= q < 2 * s - 2:
        return
    if method.implicit and s != 1 and len(Discretisation(tested.system, method).equations.blocks) > 1:
        statement = "one iteration leaves a smaller error from the predictor than from a straight line, at small h"
        yield from checked("predictor", statement, partial(_predictor, tested))


def _predictor(tested: SystemUnderTest) -> Finding | None:
    framed = Discretisation(
        tested.system, tested.method
    ).in_moving_frame  # whose fixed-point iteration has no predictor
    steppers = tested.steppers[1:] if framed else tested.steppers
    ratios = [ratio for ratio in (_worst(tested, stepper) for stepper in steppers) if ratio is not None]
    if not ratios:
        return None
    worst, h = max(ratios)
    return Finding(worst, LARGEST_RATIO, f"ratio of the errors, h = {h:.3g}")


def _worst(tested: SystemUnderTest, stepper: Stepper) -> tuple[float, float] | None:
    """Return the largest ratio of the errors left by predictor and line, and the smallest h at which it shows."""
    for k in reversed(range(TRIALS)):
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
        stepper.start(here.q, here.p, h=h, t=here.t, parameters=parameters, options=ANY_UPDATE),
        stepper.from_checkpoint(saved, parameters=parameters, options=ANY_UPDATE),
    )
    for run in runs:
        run.advance(1)
    solved, line, guess = (np.concatenate([run.q, run.p]) / tested.scales(here) for run in runs)
    return float(np.max(np.abs(line - solved))), float(np.max(np.abs(guess - solved)))
