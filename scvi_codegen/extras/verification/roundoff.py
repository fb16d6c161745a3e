"""Checks of round-off: compensated sums, low words of the state, and random-walk growth of errors (Brouwer's law).

A step changes the state by less than doubles resolve; runs therefore carry compensation terms (compensated summation).
With them errors grow as a random walk, without them, or with coefficients of 53 bits, linearly. The first two checks
are deterministic: steps so small that their whole increment is in the compensation, and a compensation so large that
losing it shows. The third is Student's t of the change of invariants over many runs, with fixed-point iterations
that continue until nothing changes. By default the iterations stop when the residual is below one rounding; the
residual has a sign, and the drift that it causes is measured by itself.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from scvi_codegen.api.formulas import mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array
from scvi_codegen.api.systems import forms_of
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError
from scvi_codegen.extras.exact.solution import numbers
from scvi_codegen.extras.verification.certificate import Check, Finding, ViolationError, checked
from scvi_codegen.extras.verification.system_under_test import (
    CONSECUTIVE_STEPS,
    EPSILON,
    PERTURBATION,
    ROUND_OFF,
    ROUNDINGS,
    STEP_DIVISOR,
    State,
    SystemUnderTest,
)
from scvi_codegen.methods import SCVI
from scvi_codegen.runs.stepper import Stepper

SHORT = 2.0**-40
SHORT_STEPS = 64
LARGE_COMPENSATION = 1e-6
"""Compensation relative to the state in tests, instead of about 1e-17."""
LARGE_IN_LANES = 1e-13
"""The same where lanes are compared with single runs, which take it into their stages in other iterations."""
MAX_LOSS = 1e-3
"""Part of the effect of the compensation that may be lost; the term of second order in h is a tenth of it."""
LANES = 3
RUNS = 64
Invariant: TypeAlias = Callable[[Array, Array, float], tuple[Array, Array]]
"""Conserved quantity as a function of (n, m) states and time: (n,) values and their sizes."""
WORK = 2**14
"""Number of coordinates times steps of each run."""
STUDENT = 7.0
"""Bound on Student's t with 63 degrees of freedom; correct code exceeds it once in 10^9 cases."""
TO_CONVERGENCE = SolverOptions(tolerance=2.0**-68)
"""Solver options that iterate until nothing changes."""
MAX_RESIDUAL = 0.25
"""Residual of the fixed-point iteration, in units of rounding; see ``templates/support/iteration/convergence.h``."""
NO_TRUNCATION = EPSILON / ROUNDINGS
"""Relative energy change of one exact step below which round-off dominates."""


def roundoff_checks(tested: SystemUnderTest) -> Iterator[Check]:
    """Yield all checks of this module."""
    for name, statement, measure in (
        ("compensated sums", f"{SHORT_STEPS} steps of h 2^-40 equal one of {SHORT_STEPS} h 2^-40", _sums),
        ("low words", "the compensation terms of the state enter the next step", _low_words),
        ("ensemble", "SIMD lanes equal single runs, including compensation terms", _ensemble),
        ("drift", "invariants drift no more than a random walk (Student's t), converged iterations", _drift),
        ("drift of ensembles", "the same for SIMD lanes", _drift_of_lanes),
        ("residual drift", "default convergence criterion: drift below part of a rounding per step", _residual_drift),
    ):
        yield from checked(name, statement, partial(measure, tested))


def _compensated(tested: SystemUnderTest) -> bool:
    """Return True if momenta are compensated sums, not results of a Legendre transform at each end."""
    if forms_of(tested.system).one_form:
        return False
    return tested.method.symplectic or tested.method.specification().get("form") == "phase-space"


def _has_compensation(tested: SystemUnderTest) -> bool:
    """Return True if the method has fixed-point iterations or leapfrog steps, which use the compensation."""
    return Discretisation(tested.moved, tested.method).explicit or tested.stepper.interface.has_fallback


def _advanced(
    tested: SystemUnderTest, stepper: Stepper, state: State, steps: int, carry: Array | None = None
) -> tuple[Array, Array]:
    """Return (2m,) the final state of a run started with compensation terms, and (2m,) its compensation terms."""
    run = stepper.start(state.q, state.p, h=state.h, t=state.t, parameters=tested.parameters)
    if carry is not None:
        run._resume_at(0, (state.t, 0.0), (carry[: len(state.q)], carry[len(state.q) :]))
    run.advance(steps)
    return np.concatenate([run.q, run.p]), np.concatenate(run._compensation)


def _sums(tested: SystemUnderTest) -> Finding:
    first = tested.states[0]
    m, worst = len(first.q), 0.0
    selected = slice(None) if _compensated(tested) else slice(m)
    for stepper in tested.steppers:
        short = State(first.q, first.p, first.t, first.h * SHORT)
        whole = State(first.q, first.p, first.t, short.h * SHORT_STEPS)
        ways = [_advanced(tested, stepper, *way) for way in ((short, SHORT_STEPS), (whole, 1))]
        moved, expected = ((end - first.z + carry)[selected] for end, carry in ways)
        for part in (slice(m), slice(m, None)):
            size = np.abs(expected[part]).max(initial=0.0)
            if size > 0.0:
                worst = max(worst, float(np.abs(moved - expected)[part].max() / size))
    return Finding(worst, ROUND_OFF, "relative")


def _large_compensation(state: State, scales: Array) -> Array:
    return np.asarray(LARGE_COMPENSATION * scales * np.cos(1.0 + 2.0 * np.arange(len(state.z))))


def _low_words(tested: SystemUnderTest) -> Finding | None:
    """Compare runs from one state split differently into high and low word; Newton's method ignores the low word."""
    if not (_has_compensation(tested) and _compensated(tested)):
        return None
    state, m = tested.states[0], len(tested.initial.q)
    carry = _large_compensation(state, tested.scales(state))
    whole = state.z + carry
    rest = (state.z - whole) + carry
    state, joined = (State(z[:m], z[m:], state.t, state.h / STEP_DIVISOR**2) for z in (state.z, whole))
    ways = ((state, CONSECUTIVE_STEPS, carry), (joined, CONSECUTIVE_STEPS, rest))
    # Shorter steps: until the last iteration the stages may lack the compensation, a term of second order in h.
    (end, low), (other, other_low) = (_advanced(tested, tested.stepper, *way) for way in ways)
    scales = tested.scales(state)
    difference = np.abs((end - other) + (low - other_low)) / scales
    moved = np.abs(end - state.z) / scales
    return Finding(
        float(difference.max() / (LARGE_COMPENSATION * moved.max())),
        MAX_LOSS,
        "relative to the effect of a large compensation",
    )


def _ensemble(tested: SystemUnderTest) -> Finding | None:
    """Compare SIMD lanes with different states with single runs, for ordinary and very small steps."""
    if tested.stepper.ensemble is None:
        return None
    first, worst = tested.states[0], 0.0
    scales = tested.scales(first)
    large = LARGE_IN_LANES / LARGE_COMPENSATION * _large_compensation(first, scales)
    rounding = ROUNDINGS * (tested.rounding(first) + LARGE_IN_LANES**2 * scales)
    for h, steps, carry, unit in (
        (first.h, CONSECUTIVE_STEPS, large, rounding),
        (first.h * SHORT, SHORT_STEPS, np.zeros_like(large), ROUND_OFF * SHORT_STEPS * SHORT * scales),
    ):
        state = State(first.q, first.p, first.t, h)
        starts = [_perturbed(state, scales, lane) for lane in range(LANES)]
        result = _lanes(tested, starts, steps, carry)
        for start, (end, low) in zip(starts, result, strict=False):  # a block may have fewer lanes
            other, other_low = _advanced(tested, tested.stepper, start, steps, carry)
            difference = np.abs((end - other) + (low - other_low))
            worst = max(worst, float(np.max(difference / unit)))
    return Finding(worst, 1.0, f"in units of {ROUNDINGS:g} roundings, lanes with different states")


def _perturbed(state: State, scales: Array, lane: int) -> State:
    z, m = state.z + 1e-3 * lane * scales * np.sin(1.0 + np.arange(len(scales))), len(state.q)
    return State(z[:m], z[m:], state.t, state.h)


def _lanes(tested: SystemUnderTest, starts: list[State], steps: int, carry: Array) -> Iterator[tuple[Array, Array]]:
    """Yield final state and compensation terms of each lane, as :func:`_advanced`."""
    q, p = (np.array([getattr(start, name) for start in starts]) for name in "qp")
    first, m = starts[0], len(carry) // 2
    settings = {"h": first.h, "steps": steps, "t": first.t, "parameters": tested.parameters}
    work: Any = tested.stepper.products.ensemble_runs(q, p, settings)
    batch = work.batch()
    block = batch.part(0, min(batch.width, len(starts)))
    block.begin()
    block.lanes("carry_q")[:] = carry[:m, None]
    block.lanes("carry_p")[:] = carry[m:, None]
    block.advance()
    if (batch.status > 0).any():
        raise ViolationError("single runs succeed, SIMD lanes fail")
    low = np.concatenate([block.lanes(name) for name in ("carry_q", "carry_p")])
    for lane in range(min(batch.width, len(starts))):
        yield np.concatenate([work.q[-1, lane], work.p[-1, lane]]), low[:, lane]


def _invariants(tested: SystemUnderTest) -> dict[str, Invariant]:
    """Return the momentum maps that the method conserves, and the energy if its error per step is below round-off."""
    stepper, parameters, method = tested.stepper, tested.parameters, tested.method
    # Without low words of the coefficients increments are rounded, which may cause drift.
    exact_sums = _has_compensation(tested) and forms_of(tested.moved).separable and not isinstance(method, SCVI)
    if not (exact_sums and method.symplectic):
        return {}

    def map_values(k: int, q: Array, p: Array, t: float) -> tuple[Array, Array]:
        values, sizes = stepper._momentum_maps_and_sizes(q, p, t, parameters)
        return values[:, k], sizes[:, k]

    def energies(q: Array, p: Array, t: float) -> tuple[Array, Array]:
        values = stepper.energy(q, p, t, parameters)
        kinetic = np.sum(p * stepper.velocity(q, p, t, parameters), axis=1)
        return values, np.maximum(np.abs(values), np.abs(kinetic))

    described = stepper.interface
    exact = [k for k, conserved in enumerate(described.map_exact) if conserved]
    result: dict[str, Invariant] = {described.map_names[k]: partial(map_values, k) for k in exact}
    return {**result, "energy": energies} if _keeps_energy(tested) else result


def _keeps_energy(tested: SystemUnderTest) -> bool:
    if tested.system.formula.has(tested.system.time):
        return False
    state = tested.states[0]
    try:
        motion, end = tested.motion, tested.solved(0)
    except StateError:
        return False
    before = motion.energy(numbers(state.q), numbers(state.p), mp.mpf(state.t))
    after = motion.energy(numbers(end.q), numbers(end.p), mp.mpf(state.t))
    return bool(abs(after - before) <= NO_TRUNCATION * abs(before))


@dataclass(frozen=True, slots=True)
class _Walk:
    """Mean and standard deviation of the relative changes of an invariant over runs from neighbouring states."""

    name: str
    steps: int
    mean: float
    spread: float
    runs: int

    @property
    def significant(self) -> float:
        """Significant part of the mean, in roundings per step."""
        return max(abs(self.mean) - STUDENT * self.spread / math.sqrt(self.runs), 0.0) / (EPSILON * self.steps)

    @property
    def remark(self) -> str:
        return f"{self.name}, {RUNS} runs of {self.steps} steps"


def _walks(tested: SystemUnderTest, run: Callable[[Array, Array, int], tuple[Array, Array]]) -> Iterator[_Walk]:
    invariants = _invariants(tested)
    if not invariants:
        return
    initial, m = tested.initial, len(tested.initial.q)
    starts = initial.z + PERTURBATION * tested.scales(initial) * np.random.default_rng(0).uniform(
        -1.0, 1.0, (RUNS, 2 * m)
    )
    steps = -(-WORK // m)
    end = run(starts[:, :m], starts[:, m:], steps)
    for name, invariant in invariants.items():
        before, sizes = invariant(starts[:, :m], starts[:, m:], initial.t)
        after, last_sizes = invariant(*end, initial.t + steps * initial.h)
        changes, grown = (after - before) / sizes, last_sizes / sizes
        finite = np.isfinite(changes) & np.isfinite(grown)
        changes, grown = changes[finite], grown[finite]
        if len(changes) < RUNS // 2:
            raise StateError(f"{name}: runs of {steps} steps failed")
        # Rounding of terms that grow alike in all runs, such as g t^2/2 of a falling body, has the same sign in all.
        mean, common = float(np.mean(changes)), EPSILON * max(float(np.mean(grown)) - 1.0, 0.0)
        mean = math.copysign(max(abs(mean) - common, 0.0), mean)
        yield _Walk(name, steps, mean, float(np.std(changes, ddof=1)), len(changes))


def _runs(
    tested: SystemUnderTest, options: SolverOptions | None, q: Array, p: Array, steps: int
) -> tuple[Array, Array]:
    ends = []
    arguments: dict[str, Any] = {"h": tested.initial.h, "t": tested.initial.t, "parameters": tested.parameters}
    for start in zip(q, p, strict=True):
        run = tested.stepper.start(*start, **arguments, options=options)
        run.advance(steps)
        ends.append((run.q, run.p))
    return np.array([end[0] for end in ends]), np.array([end[1] for end in ends])


def _largest_student(walks: Iterator[_Walk]) -> Finding | None:
    students = (
        (abs(walk.mean) / math.hypot(walk.spread, EPSILON / 4) * math.sqrt(walk.runs), walk.remark) for walk in walks
    )
    return max((Finding(value, STUDENT, remark) for value, remark in students), default=None)


def _drift(tested: SystemUnderTest) -> Finding | None:
    return _largest_student(_walks(tested, partial(_runs, tested, TO_CONVERGENCE)))


def _residual_drift(tested: SystemUnderTest) -> Finding | None:
    walks = _walks(tested, partial(_runs, tested, None))
    return max((Finding(walk.significant, MAX_RESIDUAL, walk.remark) for walk in walks), default=None)


def _drift_of_lanes(tested: SystemUnderTest) -> Finding | None:
    if tested.stepper.ensemble is None:
        return None

    def run(q: Array, p: Array, steps: int) -> tuple[Array, Array]:
        plan: dict[str, Any] = {"h": tested.initial.h, "t": tested.initial.t, "steps": steps, "save_every": steps}
        plan |= {"parameters": tested.parameters, "options": TO_CONVERGENCE}
        runs = tested.stepper.integrate_ensemble(q, p, **plan)
        return runs.q[-1], runs.p[-1]

    return _largest_student(_walks(tested, run))
