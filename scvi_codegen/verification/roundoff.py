"""What rounding adds up to: sums that lose nothing, low parts that count, walks that do not drift.

A step of fixed length changes a state by less than rounding lets a double show; runs therefore carry along what was cut
off (compensated sums). With them errors walk at random (Brouwer's law), without them, or with coefficients of 53 bits,
they drift. The first two checks are deterministic: steps so short that the carry is all of them, and a carry so long
that to forget it anywhere shows. The third is Student's t of what many runs make of an invariant, with sweeps that go
on until nothing changes. By default they stop when what is left is less than a rounding; it has a sign, and what it
adds up to is measured by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.exact.motion import numbers
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.methods import SCVI
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.ensemble import Ensemble, LaneBlock
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import BrokenError, Check, Finding, checked
from scvi_codegen.verification.subject import EPSILON, State, Subject

__all__ = ["roundoff_checks"]

Array = NDArray[np.float64]

ROUNDINGS = 16.0
SHORT = 2.0**-40
SHORT_STEPS = 64
LOST = 1e-6
"""Of 64 such steps, relative; a sum that loses what a double cannot hold errs by 1e-3, one that keeps it by 1e-15."""
LONG_CARRY = 1e-6
"""Part of the state, in place of some 1e-17."""
FORGOTTEN = 1e-3
"""Part of its effect that may be lost; what sweeps leave to second order in h is a tenth of that."""
SHORTER = 1 / 64
"""Part of h: points of a sweep may lack the carry, of second order in h, until its last pass."""
CARRIED_STEPS = 3
LANES = 3
RUNS, SPREAD = 64, 0.02
WORK, FEWEST_STEPS, MOST_STEPS = 2**14, 2**9, 2**13
"""Steps times coordinates of each run."""
STUDENT = 7.0
"""Of 63 degrees of freedom: sound code exceeds it once in a billion times."""
TO_REST = SolverOptions(tolerance=2.0**-68)
LEFT = 0.25
"""Part of the tolerance, a rounding, that sweeps may leave, see ``templates/support/contraction.h``."""
NO_TRUNCATION = 2.0**-56
"""Relative change of the energy in one exact step, below which what changes it is rounding."""


def roundoff_checks(subject: Subject) -> Iterator[Check]:
    """All of this room."""
    for name, promise, measure in (
        ("sums", f"{SHORT_STEPS} steps of h 2^-40 add up to one as long as all", _sums),
        ("low parts", "what rounding cut off a state enters the next step", _low_parts),
        ("ensemble", "lanes take the steps of single runs, with their low parts", _ensemble),
        ("drift", "with sweeps that come to rest invariants walk at random: Student's t of their mean", _drift),
        ("drift of ensembles", "the same in lanes", _drift_of_lanes),
        ("rest of sweeps", "as sweeps stop by default, they move an invariant by part of a rounding a step", _rests),
    ):
        yield from checked(name, promise, partial(measure, subject))


def _compensated(subject: Subject) -> bool:
    """Whether momenta are sums: those that a Legendre transform gives at each end, or two that cancel, are not."""
    return subject.method.symplectic or subject.method.specification().get("form") == "phase-space"


def _carries(subject: Subject) -> bool:
    """Whether the artefact has sweeps or leapfrog steps, to which carries are handed."""
    forms = forms_of(subject.moved)
    leaps = bool(subject.method.fractions) and (forms.separable or forms.split)
    return leaps or subject.stepper.interface.has_fallback


def _steppers(subject: Subject) -> tuple[Stepper, ...]:
    newton = subject.newton
    return (subject.stepper,) if newton is None or newton is subject.stepper else (subject.stepper, newton)


def _advanced(
    subject: Subject, stepper: Stepper, state: State, steps: int, carry: Array | None = None
) -> tuple[Array, Array]:
    """(2m,) the state after a run that began with a carry, and (2m,) its carry."""
    run = stepper.start(state.q, state.p, h=state.h, t=state.t, parameters=subject.parameters)
    if carry is not None:
        run.resume_at(0, (state.t, 0.0), (carry[: len(state.q)], carry[len(state.q) :]))
    run.advance(steps)
    return np.concatenate([run.q, run.p]), np.concatenate(run.carries)


def _sums(subject: Subject) -> Finding:
    first = subject.states[0]
    m, worst = len(first.q), 0.0
    kept = slice(None) if _compensated(subject) else slice(m)
    for stepper in _steppers(subject):
        short = State(first.q, first.p, first.t, first.h * SHORT)
        whole = State(first.q, first.p, first.t, short.h * SHORT_STEPS)
        ways = [_advanced(subject, stepper, *way) for way in ((short, SHORT_STEPS), (whole, 1))]
        moved, expected = ((end - first.z + carry)[kept] for end, carry in ways)
        for part in (slice(m), slice(m, None)):
            size = np.abs(expected[part]).max(initial=0.0)
            if size > 0.0:
                worst = max(worst, float(np.abs(moved - expected)[part].max() / size))
    return Finding(worst, LOST, "relative")


def _long_carry(state: State, scales: Array) -> Array:
    carry: Array = LONG_CARRY * scales * np.cos(1.0 + 2.0 * np.arange(len(state.z)))
    return carry


def _low_parts(subject: Subject) -> Finding | None:
    """The same state, a part of it as carry or not, must go the same way; Newton's iteration forgets it by design."""
    if not (_carries(subject) and _compensated(subject)):
        return None
    state, m = subject.states[0], len(subject.given.q)
    carry = _long_carry(state, subject.scales(state))
    whole = state.z + carry
    rest = (state.z - whole) + carry
    state, joined = (State(z[:m], z[m:], state.t, SHORTER * state.h) for z in (state.z, whole))
    ways = ((state, CARRIED_STEPS, carry), (joined, CARRIED_STEPS, rest))
    (end, low), (other, other_low) = (_advanced(subject, subject.stepper, *way) for way in ways)
    scales = subject.scales(state)
    apart, moved = np.abs((end - other) + (low - other_low)) / scales, np.abs(end - state.z) / scales
    return Finding(float(apart.max() / (LONG_CARRY * moved.max())), FORGOTTEN, "part of the effect of a long carry")


def _ensemble(subject: Subject) -> Finding | None:
    """Of lanes that differ, long steps and such that are all carry."""
    if subject.stepper.ensemble is None:
        return None
    first, worst = subject.states[0], 0.0
    scales = subject.scales(first)
    for h, steps, unit in (
        (first.h, CARRIED_STEPS, ROUNDINGS * (subject.rounding(first) + LONG_CARRY**2 * scales)),
        (first.h * SHORT, SHORT_STEPS, LOST * SHORT_STEPS * SHORT * scales),
    ):
        state = State(first.q, first.p, first.t, h)
        carry = _long_carry(state, scales) if h == first.h else np.zeros_like(scales)
        starts = [_beside(state, scales, lane) for lane in range(LANES)]
        found = _lanes(subject, starts, steps, carry)
        for start, (end, low) in zip(starts, found, strict=False):  # a block may have fewer lanes
            other, other_low = _advanced(subject, subject.stepper, start, steps, carry)
            apart = np.abs((end - other) + (low - other_low))
            worst = max(worst, float(np.max(apart / unit)))
    return Finding(worst, 1.0, f"in units of {ROUNDINGS:g} roundings, lanes that differ")


def _beside(state: State, scales: Array, lane: int) -> State:
    z, m = state.z + 1e-3 * lane * scales * np.sin(1.0 + np.arange(len(scales))), len(state.q)
    return State(z[:m], z[m:], state.t, state.h)


def _lanes(subject: Subject, starts: list[State], steps: int, carry: Array) -> Iterator[tuple[Array, Array]]:
    """As :func:`_advanced`, of each lane: the states that it stores."""
    q, p = (np.array([getattr(start, name) for start in starts]) for name in "qp")
    first, m = starts[0], len(carry) // 2
    work = Ensemble(subject.stepper, q, p, h=first.h, steps=steps, t=first.t, parameters=subject.parameters)
    make, width = work.blocks()
    block = make(0)
    assert isinstance(block, LaneBlock)
    block.lanes("carry_q")[:] = carry[:m, None]
    block.lanes("carry_p")[:] = carry[m:, None]
    block.advance(steps)
    if block.left:
        raise BrokenError("single runs take these steps, lanes fail")
    low = np.concatenate([block.lanes(name) for name in ("carry_q", "carry_p")])
    for lane in range(min(width, len(starts))):
        yield np.concatenate([work.q[-1, lane], work.p[-1, lane]]), low[:, lane]


@dataclass(frozen=True, slots=True)
class _Invariant:
    """What exact steps conserve, as a function of (n, m) states and of time: (n,) values and their sizes."""

    name: str
    values: Callable[[Array, Array, float], tuple[Array, Array]]


def _invariants(subject: Subject) -> list[_Invariant]:
    """The momentum maps that the method keeps, and the energy where it errs by less than rounding in a step.

    Where coefficients have low parts or there are none: other sweeps round the increments, which may drift.
    """
    stepper, parameters, method = subject.stepper, subject.parameters, subject.method
    exact_sums = _carries(subject) and forms_of(subject.moved).separable and not isinstance(method, SCVI)
    if not (exact_sums and method.symplectic):
        return []

    def map_values(k: int, q: Array, p: Array, t: float) -> tuple[Array, Array]:
        values, sizes = stepper.momentum_maps_and_sizes(q, p, t, parameters)
        return values[:, k], sizes[:, k]

    def energies(q: Array, p: Array, t: float) -> tuple[Array, Array]:
        values = stepper.energy(q, p, t, parameters)
        return values, np.abs(values)

    described = stepper.interface
    exact = [k for k, kept in enumerate(described.map_exact) if kept]
    found = [_Invariant(described.map_names[k], partial(map_values, k)) for k in exact]
    return [*found, _Invariant("energy", energies)] if _keeps_energy(subject) else found


def _keeps_energy(subject: Subject) -> bool:
    if subject.system.formula.has(subject.system.time):
        return False
    state = subject.states[0]
    try:
        motion, end = subject.motion, subject.solved(0)
    except StateError:
        return False
    before = motion.energy(numbers(state.q), numbers(state.p), mp.mpf(state.t))
    after = motion.energy(numbers(end.q), numbers(end.p), mp.mpf(state.t))
    return bool(abs(after - before) <= NO_TRUNCATION * abs(before))


@dataclass(frozen=True, slots=True)
class _Walk:
    """What many runs from states near each other make of an invariant: mean and spread of its relative changes."""

    name: str
    steps: int
    mean: float
    spread: float
    runs: int

    @property
    def student(self) -> float:
        """Student's t of the mean."""
        return abs(self.mean) / math.hypot(self.spread, EPSILON / 4) * math.sqrt(self.runs)

    @property
    def sure(self) -> float:
        """Of the mean what is no chance, in roundings a step."""
        return max(abs(self.mean) - STUDENT * self.spread / math.sqrt(self.runs), 0.0) / (EPSILON * self.steps)

    @property
    def remark(self) -> str:
        """What was measured, where."""
        return f"{self.name}, {RUNS} runs of {self.steps} steps"


def _walks(subject: Subject, run: Callable[[Array, Array, int], tuple[Array, Array]]) -> Iterator[_Walk]:
    """Of each invariant."""
    invariants = _invariants(subject)
    if not invariants:
        return
    given, m = subject.given, len(subject.given.q)
    starts = given.z + SPREAD * subject.scales(given) * np.random.default_rng(0).uniform(-1.0, 1.0, (RUNS, 2 * m))
    steps = min(MOST_STEPS, max(FEWEST_STEPS, WORK // m))
    end = run(starts[:, :m], starts[:, m:], steps)
    for invariant in invariants:
        before, sizes = invariant.values(starts[:, :m], starts[:, m:], given.t)
        after, _ = invariant.values(*end, given.t + steps * given.h)
        changes = (after - before) / sizes
        changes = changes[np.isfinite(changes)]
        if len(changes) < RUNS // 2:
            raise StateError(f"{invariant.name}: runs of {steps} steps fail")
        yield _Walk(invariant.name, steps, float(np.mean(changes)), float(np.std(changes, ddof=1)), len(changes))


def _runs(subject: Subject, options: SolverOptions | None, q: Array, p: Array, steps: int) -> tuple[Array, Array]:
    """The ends of runs, one by one."""
    ends = []
    given: dict[str, Any] = {"h": subject.given.h, "t": subject.given.t, "parameters": subject.parameters}
    for start in zip(q, p, strict=True):
        own = subject.stepper.start(*start, **given, options=options)
        own.advance(steps)
        ends.append((own.q, own.p))
    return np.array([end[0] for end in ends]), np.array([end[1] for end in ends])


def _judged(walks: Iterator[_Walk]) -> Finding | None:
    """The largest t."""
    return max((Finding(walk.student, STUDENT, walk.remark) for walk in walks), default=None)


def _drift(subject: Subject) -> Finding | None:
    return _judged(_walks(subject, partial(_runs, subject, TO_REST)))


def _rests(subject: Subject) -> Finding | None:
    walks = _walks(subject, partial(_runs, subject, None))
    return max((Finding(walk.sure, LEFT, walk.remark) for walk in walks), default=None)


def _drift_of_lanes(subject: Subject) -> Finding | None:
    if subject.stepper.ensemble is None:
        return None

    def run(q: Array, p: Array, steps: int) -> tuple[Array, Array]:
        given = subject.given
        runs = subject.stepper.integrate_ensemble(
            q, p, h=given.h, steps=steps, every=steps, t=given.t, parameters=subject.parameters, options=TO_REST
        )
        return runs.q[-1], runs.p[-1]

    return _judged(_walks(subject, run))
