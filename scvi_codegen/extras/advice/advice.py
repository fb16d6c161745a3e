"""Choice of a fixed step size (and degree) for an error at the end of a run, by the errors of pilot runs.

The error of a run (:mod:`scvi_codegen.runs.accuracy.run_error`) of order r is proportional to h^r, so that one run
gives the step size h (target / error)^(1/r) of another one, whose error is computed as well: a recommended step was
tried.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.methods import Discretisation, Method, method_from_specification
from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.api.states import Array, States, checked_number
from scvi_codegen.api.systems import SYSTEM_OR_ARRAYS, MechanicalSystem
from scvi_codegen.api.text import Html, card, grid, plain, summary
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import (
    ArgumentError,
    MethodError,
    ScviCodegenError,
    StateError,
    StepFailedError,
    UnresolvedError,
)
from scvi_codegen.extras.advice.size import distances_from_mean, relative_to_motion
from scvi_codegen.methods import ARGUMENTS, as_method
from scvi_codegen.runs.accuracy.run_error import DEVIATIONS, LOST
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.ensembles.ensemble import momenta_of_each, start_of_ensemble
from scvi_codegen.runs.states.validation import EnsembleParameters
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.rolling import unrolled_at

DEGREES = {1: (2, 4, 6, 8, 10, 12), 2: (8, 12, 16, 20, 24, 32)}
"""Degrees, or numbers of stages, among which ``advise`` chooses, by the number of words of the states."""
LANES, OVERHEAD = 8, {1: 3.0, 2: 25.0}
"""Numbers in a vector register, and the cost of a step beside its iterations, in iterations, by the number of words."""
SHORT_MANTISSA = 2.0**20
"""Steps of two words have so short a mantissa that their sums are exact; a shorter last one ends at the span."""
SAFETY, CLOSE = 2.0, 1.1
"""Ratio of the tolerance to the error aimed at, and of neighbouring step sizes at which the search ends."""
FIRST, FACTOR, MOST_PARTS = 16, 4, 4**10
"""Steps of the first pilot run, largest factor from one to the next, largest ratio of the span to a pilot run."""
NUMBERS, FEWEST = 2**18, 2**12
"""Numbers of positions of a pilot run, which is shorter than the span if it would have more, and its fewest steps."""
EXPONENTIAL, FEWEST_ROWS = 4.0, 8
"""Power of time from which on growth of errors and of rounding is exponential, as errors of regular motions are linear
or quadratic in time, and the fewest states that show growth."""


class Evidence(NamedTuple):
    """Result of one pilot run.

    Attributes:
        h: step size.
        error: estimate of the error at the end of the span; infinite if a step failed.
        iterations: iterations of the solver per step.
        seconds: computing time per unit of time t.
    """

    h: float
    error: float
    iterations: float
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """Recommended step size, and the pilot runs that support it.

    Attributes:
        h: step size, ``span / steps``, of states of two words slightly less; negative for a span backward.
        steps: number of steps.
        degree: degree or number of stages of ``method``, ``None`` if it has none.
        method: recommended method: the one passed, or the one of the best degree.
        expected_error: error of the positions at the end, relative to their distance from their mean.
        member: index of the trajectory that determines the step of an ensemble, ``None`` for a single state.
        evidence: pilot runs of ``method``, largest step size first.
        message: recommendation in a few sentences.
        warnings: reasons why the tolerance may be missed; empty if there are none.
    """

    h: float
    steps: int
    degree: int | None
    method: Method
    expected_error: float
    evidence: tuple[Evidence, ...]
    message: str
    warnings: tuple[str, ...]
    member: int | None = None

    __repr__ = summary("h", "steps", "method", "expected_error")

    def _repr_html_(self) -> str:
        facts = [
            ("step", plain(f"h = {self.h:.6g}, {self.steps} of them")),
            ("expected error", plain(f"{self.expected_error:.1e}")),
            *(("warning", plain(warning)) for warning in self.warnings),
        ]
        rows = [
            (plain(f"{h:.4g}"), plain(f"{error:.1e}"), plain(f"{iterations:.1f}"), plain(f"{seconds:.2e}"))
            for h, error, iterations, seconds in self.evidence
        ]
        head = ("h", "error at the end", "iterations per step", "seconds per unit of time")
        pilots = grid(rows, head=head, caption="Pilot runs") if rows else Html("")
        return card(f"Advice: {self.method.title}", facts, pilots)


@checks_arguments(system=SYSTEM_OR_ARRAYS)
@without_accuracy_warnings()
def advise(
    system: MechanicalSystem,
    method: Method | str,
    q: States,
    p: States | None = None,
    span: float | None = None,
    tolerance: float | None = None,
    *,
    velocity: States | None = None,
    parameters: EnsembleParameters = None,
    t: float = 0.0,
    degree: bool = False,
    solver: str = "auto",
    options: SolverOptions | None = None,
    precision: str = "double",
) -> Advice:
    """Recommend the largest fixed step size with which positions at the end of a run meet a tolerance.

    A smaller one is recommended if it needs less work in all, near the largest step at which the fixed-point iteration
    converges.

    The step size is constant over the run: a symplectic method with a step size that depends on the state is no longer
    symplectic, and its energy drifts. Close encounters therefore determine the step size of the whole run; a pilot run
    that ends before an encounter does not resolve it.

    Of many initial states all trajectories are integrated with each step size that is tried, in one call, and the step
    size is that of the trajectory with the largest error.

    Args:
        system: mechanical system; arrays of run-time sizes have the sizes of q.
        method: method, or its name, as ``"svi:8"``.
        q, p, velocity: (m,) initial positions with one of momenta and velocities, or arrays by name; of an ensemble
            (k, m) each.
        span: duration of the run, negative to integrate backward; required.
        tolerance: required: wanted error ``|q - q_exact| / |q - mean q|`` at the end; the step size aims at half of it.
        parameters: values by name (others keep their defaults), or all in order; of an ensemble also (k,) values.
        t: initial time.
        degree: also choose the degree (or number of stages) among 2, 4, ..., 12: the one with the fewest evaluations in
            vector registers of 8 points; with states of two words among 8, 12, 16, 20, 24 and 32.
        solver, options: solver of the stage equations, as of ``compile_stepper``, and options of the run.
        precision: ``"double-double"`` for tolerances below 1e-12, as of ``compile_stepper``; the last step of a run
            to ``t + span`` is then shorter.

    Returns:
        The recommendation, reproducible. It has warnings if the tolerance cannot be met (round-off, chaos), or if that
        is uncertain.

    Raises:
        StateError: on wrong shapes, names or numbers, and for a motion at rest, relative to which errors are undefined.
        UnresolvedError: if no pilot run is accurate.
        MethodError: if the degree is to be chosen for a method that has none, or time is transformed.
        BuildError: without a C compiler.
    """
    system, parameters = unrolled_at(system, q, parameters)
    method = as_method(method, system)
    if system.clock is not None:
        raise MethodError(
            f"'{system.name}' is in transformed time: no step size is recommended; use largest_step or try h"
        )
    if system.has_contacts:
        raise MethodError(
            f"steps end at the contacts of '{system.name}', so that none is recommended: use t_end and a tolerance"
        )
    length, target = _checked_request(span, tolerance)
    state = {"p": p, "velocity": velocity, "t": t, "parameters": parameters, "options": options}
    result, failures = list[Advice](), list[StateError]()
    if precision not in ("double", "double-double"):
        raise MethodError(f"advise requires precision='double' or 'double-double', not {precision!r}")
    compiled, words = partial(compile_stepper, precision=precision), 2 if precision == "double-double" else 1
    for candidate in _candidates(method, words) if degree else [method]:
        for stepper in _steppers(compiled, system, candidate, solver):
            try:
                result.append(
                    _advised(stepper, candidate, Discretisation(system, candidate).symplectic, q, state, length, target)
                )
            except StateError as failure:
                failures.append(failure)
                continue
            if result[-1].expected_error <= target:
                break
    if not result:
        raise failures[-1]
    accurate = [advice for advice in result if advice.expected_error <= target]
    if len(accurate) > 1:
        return min(accurate, key=lambda advice: _work(advice, words))
    return min(result, key=lambda advice: advice.expected_error)


def _checked_request(span: float | None, tolerance: float | None) -> tuple[float, float]:
    for name, value, words in (("span", span, "duration of the run"), ("tolerance", tolerance, "error at the end")):
        if value is None:
            raise ArgumentError(f"advise requires {name}, the {words}: advise(system, method, q, p, {name}=...)")
    length, target = checked_number(span, "the span"), checked_number(tolerance, "the tolerance")
    if length == 0.0:
        raise StateError("the span is 0: it must be positive, or negative to integrate backward")
    if target <= 0.0:
        raise StateError(f"the tolerance must be positive, not {tolerance!r}")
    return length, target


def _steppers(
    compiled: Callable[..., Stepper], system: MechanicalSystem, method: Method, solver: str
) -> Iterator[Stepper]:
    """Yield steppers for a solver; for ``"auto"`` the fixed-point solver first, whose limit on h is best respected."""
    if solver == "auto":
        with suppress(MethodError):
            yield compiled(system, method, solver="fixed-point")
    yield compiled(system, method, solver=solver)


def _candidates(method: Method, words: int) -> list[Method]:
    specification = dict(method.specification())
    sized = [name for name in ("degree", "stages") if name in ARGUMENTS[str(specification["method"])]]
    if not sized:
        raise MethodError(f"{method.name} has no degree or number of stages to choose: pass degree=False")
    if specification.get("quadrature") == f"gauss-legendre:{specification.get('degree')}":
        del specification["quadrature"]  # the default of its degree: each degree has its own
    return [method_from_specification(specification | {sized[0]: number}) for number in DEGREES[words]]


def _work(advice: Advice, words: int) -> float:
    """Return the evaluations of L for a unit of time, in full registers, by the pilot run nearest to the advice."""
    simplest = LagrangianSystem.from_text(name="free particle", coordinates=["q"], lagrangian="q_dot**2/2")
    points = sum(len(group.abscissae) for group in advice.method.stage_system(simplest).stage_groups)
    row = min(advice.evidence, key=lambda row: abs(math.log(row.h / advice.h)))
    return (row.iterations + OVERHEAD[words]) * math.ceil(points / LANES) * LANES / abs(advice.h)


class FinalError(NamedTuple):
    """Error |q - q_exact| / |q - mean q| of a run, from its states that have digits.

    Attributes:
        size: error at the end, at least the root mean square of the last quarter, as errors pass through zero.
        rounding: the part of it that rounding causes.
        duration: time of the run until digits are lost.
        until: time of the last state before the error exceeds a tolerance.
        growth: power of time by which the error grows.
        tenfold: time in which rounding errors grow tenfold, infinite unless they grow exponentially.
        at_rest: whether the motion has no size.
    """

    size: float = math.inf
    rounding: float = 0.0
    duration: float = 0.0
    until: float = 0.0
    growth: float = math.inf
    tenfold: float = math.inf
    at_rest: bool = False


def final_error(run: Any, tolerance: float = 0.0, span: float = 0.0) -> FinalError:
    """Return the error at the end of a run, or of a longer ``span`` that it is extrapolated to, by its ``error``."""
    with np.errstate(over="ignore"):  # of chaotic motions
        error, t = run.error, np.asarray(run.t)
    lost = np.flatnonzero(~(error.relative < LOST))
    rows = int(lost[0]) if len(lost) else len(t)
    if rows < min(len(t), FEWEST_ROWS):
        return FinalError()
    known = np.flatnonzero(np.isfinite(error.q[:rows]).all(axis=1))
    q, duration = np.asarray(run.q)[:rows], abs(float(t[known[-1]] - t[0]))
    norms = [np.linalg.norm(part[known], axis=1) for part in (error.q, error.rounding_q)]
    sizes, at_rest = [relative_to_motion(norm, q) for norm in norms], bool(distances_from_mean(q) == 0.0)
    powers, ratio = [_power(size) for size in sizes], max(1.0, abs(span) / duration)
    slower = min(powers)
    tenfold = duration / 2.0 / (slower * math.log10(2.0)) if slower > EXPONENTIAL else math.inf
    grown = [2.0 * power * (ratio - 1.0) if tenfold < math.inf else power * math.log2(ratio) for power in powers]
    last = [max(size[-1], _rms(size[-max(1, len(size) // 4) :])) for size in sizes]
    size, rounding = (float(x * 2.0 ** min(doublings, 1000.0)) for x, doublings in zip(last, grown, strict=True))
    missed = np.flatnonzero(sizes[0] + DEVIATIONS * sizes[1] > tolerance)
    until = float(t[known[max(0, int(missed[0]) - 1) if len(missed) else -1]])
    return FinalError(size, rounding, duration, until, powers[0], tenfold, at_rest)


def missed_tolerance(run: Any, tolerance: float) -> str:
    """Return why the error at the end of a run exceeds ``tolerance``, or is not known; ``""`` if it does not.

    A run of which only the first state was saved is the pilot run that its step size was tried with.
    """
    if len(run) < 2:
        return ""
    try:
        size = final_error(run).size
    except ScviCodegenError as unknown:
        return f"the tolerance {tolerance:g} is not confirmed: {unknown}"
    remedy = "use adaptive step size (t_end, --tolerance)"
    return "" if size <= tolerance else f"the tolerance {tolerance:g} is missed: the error is {size:.1e}; {remedy}"


def _power(errors: Array) -> float:
    """Return the power of time by which errors grow: by their root mean squares in the second quarter and half."""
    early, late = _rms(errors[len(errors) // 4 : len(errors) // 2]), _rms(errors[len(errors) // 2 :])
    return math.log2(late / early) if 0.0 < early < late else 0.0


def _rms(values: Array) -> float:
    largest = float(values.max(initial=0.0)) or 1.0  # squares of chaotic errors overflow
    return largest * float(np.sqrt(np.mean(np.square(values / largest)))) if len(values) else 0.0


class _Trial(NamedTuple):
    """Pilot run with n steps for the span, its duration, error at the end of the span, and price."""

    n: int
    duration: float
    error: FinalError
    iterations: float = 0.0
    seconds: float = 0.0
    failure: str = ""


class _Pilot:
    """Pilot runs of one trajectory, from positions q and momenta p (m,), with step sizes of a method of some order."""

    def __init__(self, stepper: Stepper, q: Array, p: Array, settings: dict[str, Any], aims: tuple[float, float, int]):
        self.stepper, self.q, self.p, self.settings = stepper, q, p, settings
        self.span, self.tolerance, self.order = aims
        self.most, self.parts, self.trials = max(FEWEST, NUMBERS // stepper.dimension), 1, list[_Trial]()

    def step(self, n: float) -> float:
        """Return the step size of n steps."""
        mantissa, exponent = math.frexp(self.span / n)
        if self.stepper.interface.words > 1:
            mantissa = math.trunc(mantissa * SHORT_MANTISSA) / SHORT_MANTISSA
        return math.ldexp(mantissa, exponent)

    def aim(self, error: FinalError) -> float:
        """Return half of the tolerance, at least twice the error of rounding, which no step size reduces."""
        return max(self.tolerance / SAFETY, SAFETY * error.rounding)

    def is_good(self, trial: _Trial) -> bool:
        """Return whether the error of a pilot run is at most the one aimed at."""
        return trial.error.size <= self.aim(trial.error)

    @property
    def coarse(self) -> int:
        """Largest number of steps whose error is larger than the one aimed at, 0 if there is none."""
        return max((trial.n for trial in self.trials if not self.is_good(trial)), default=0)

    @property
    def good(self) -> list[_Trial]:
        """Pilot runs with errors as aimed at, as those of all smaller steps, largest step first."""
        return sorted(trial for trial in self.trials if trial.n > self.coarse)

    def run(self, n: int) -> _Trial:
        """Return a run with n steps for the span, or with those of its beginning."""
        h, steps, began = self.step(n), -(-n // self.parts), time.perf_counter()
        try:
            run = self.stepper.integrate(self.q, self.p, h=h, steps=steps, **self.settings)
            seconds, iterations = time.perf_counter() - began, float(run.iterations.sum()) / steps
            error = final_error(run, self.tolerance, self.span)
            result = _Trial(n, abs(h) * steps, error, iterations, seconds)
        except StepFailedError as failure:
            error = FinalError(duration=abs(failure.t - self.settings["t"]))
            result = _Trial(n, abs(h) * steps, error, 0.0, time.perf_counter() - began, failure.status)
        self.trials.append(result)
        return result

    def search(self, n: int) -> bool:
        """Run with numbers of steps until the error is half of the tolerance; return False at rest."""
        while True:
            trial, coarser = self.run(n), [k for k in self.trials[-2:-1] if k.n < n]
            error, aim = trial.error, self.aim(trial.error)
            if error.at_rest:
                return False
            if self.parts > MOST_PARTS or (coarser and self.breaks_off(coarser[0], trial)):
                raise self.unresolved
            best, worst = [float(k.n) for k in self.good[:1]], self.coarse
            if best and (best[0] <= CLOSE * worst or (n == best[0] and error.size >= aim / SAFETY)):
                return True
            change = (error.size / (0.9 * aim)) ** (1.0 / self.order)
            n = math.ceil(n * min(max(change, 1.0 / FACTOR), FACTOR))
            if not worst < n < (best or [math.inf])[0]:
                n = max(1, math.ceil(math.sqrt(worst * best[0]))) if best else FACTOR * worst
            if n in [k.n for k in self.trials]:
                return True
            if n > self.parts * self.most * (FACTOR if error.size < LOST or error.growth <= EXPONENTIAL else 1):
                if error.size < LOST or error.rounding > self.tolerance:
                    return True
                self.parts *= FACTOR

    def breaks_off(self, coarser: _Trial, trial: _Trial) -> bool:
        """Return whether digits are lost at once: with a smaller step, or after a time that longer steps reach.

        Such a motion has an encounter, or ends in a singularity; that of a chaotic one loses its digits by and by.
        """
        lost, error = coarser.error, trial.error
        if lost.size < LOST <= error.size:
            return True
        late = coarser.duration > 2.0 * trial.duration and lost.duration >= trial.duration
        return late and error.tenfold == math.inf and (bool(coarser.failure) or lost.growth > EXPONENTIAL)

    @property
    def unresolved(self) -> UnresolvedError:
        """Error of a motion that no pilot run resolves."""
        trial = self.trials[-1]
        return UnresolvedError(
            f"no pilot run over t = {trial.duration:.3g} is accurate, with step sizes down to "
            f"{abs(self.step(trial.n)):.3g}: the solution may end in a singularity or have a close encounter; use "
            "adaptive step size (t_end, --tolerance), or a shorter span"
        )


class _Choice(NamedTuple):
    """Number of steps for the span, expected error at its end, warnings, and whether the step was tried."""

    n: int
    error: float
    warnings: tuple[str, ...] = ()
    tried: bool = True


def _choose(pilot: _Pilot) -> _Choice:
    """Return the step with the least work of those that meet the tolerance, or whose error is that of rounding."""
    trial, overhead = max(pilot.trials), OVERHEAD[pilot.stepper.interface.words]
    if pilot.good:
        trial = min(pilot.good, key=lambda k: k.n * (k.iterations + overhead))
    warnings = tuple(_warnings(pilot, trial))
    if pilot.good or trial.error.rounding > pilot.tolerance:
        return _Choice(trial.n, min(1.0, trial.error.size), warnings)
    if not trial.error.size < LOST:
        raise pilot.unresolved
    aim, coarser = pilot.aim(trial.error), [k for k in pilot.trials if k.n < trial.n]
    if coarser and coarser[-1].error.size > trial.error.size * (trial.n / coarser[-1].n) ** (pilot.order / 2.0):
        n = trial.n * (trial.error.size / aim) ** (1.0 / pilot.order)
        return _Choice(math.ceil(n), aim, warnings, tried=False)
    words = f"the tolerance may be missed: the errors of runs with steps down to {abs(pilot.step(trial.n)):.3g} do not "
    return _Choice(trial.n, trial.error.size, (*warnings, f"{words}follow the order of the method yet"))


def _warnings(pilot: _Pilot, trial: _Trial) -> Iterator[str]:
    """Yield warnings about conditions that prevent, or may prevent, the tolerance from being met."""
    error = trial.error
    chaos = f"neighbouring trajectories diverge tenfold every {error.tenfold:.3g} units of time (chaos)"
    if SAFETY * error.rounding <= pilot.tolerance:
        if error.tenfold < math.inf and pilot.parts > 1:
            yield f"{chaos}, at an uncertain rate later"
        elif error.growth > EXPONENTIAL and pilot.parts > 1:
            yield f"errors grew like t^{error.growth:.1f} in the pilot run, a rate that may not continue"
    elif error.tenfold < math.inf:
        yield f"the tolerance cannot be met: {chaos}, so round-off alone exceeds it"
        yield f"the recommended step meets it until t = {error.until:.4g}"
    else:
        yield f"round-off alone causes an error of about {error.rounding:.1g} at the end, for any step size"


def _advised(
    stepper: Stepper, method: Method, symplectic: bool, q: States, state: dict[str, Any], span: float, tolerance: float
) -> Advice:
    """Return the recommendation for one stepper.

    Of an ensemble the step is found for one trajectory, and the errors of all with that step are computed; if another
    one misses the tolerance, a smaller step is found for that.
    """
    aims, settings = (span, tolerance, method.order or 1), {"t": state["t"], "options": state["options"]}
    starts, together = _starts(stepper, q, state)
    n, members, done = FIRST, list(range(len(starts))), set[int]()
    while members:
        member = members.pop(0)
        one, other, own = starts[member]
        pilot = _Pilot(stepper, one, other, {**settings, "parameters": own}, aims)
        if not pilot.search(n):
            continue
        result = _described(pilot, method, symplectic, member if together else None)
        if not together:
            return result
        done.add(member)
        steps = min(-(-result.steps // pilot.parts), max(FEWEST, round(pilot.most / math.sqrt(len(starts)))))
        runs = stepper.integrate_ensemble(*together[:2], h=result.h, steps=steps, parameters=together[2], **settings)
        errors = [final_error(runs[j], tolerance, span).size if runs.ok[j] else math.inf for j in range(len(starts))]
        worst = int(np.argmax(errors))
        if errors[worst] <= tolerance or worst in done:
            return result
        members, n = [worst], result.steps
    which = f"all {len(starts)} trajectories are" if together else "the motion is"
    raise StateError(
        f"{which} at rest over t = {pilot.trials[-1].duration:.3g}: errors relative to its size are undefined; give an "
        "initial state that moves, or choose h below the shortest period"
    )


def _starts(stepper: Stepper, q: States, state: dict[str, Any]) -> tuple[list[tuple[Array, Array, Any]], Any]:
    """Return (m,) positions and momenta with parameters of each trajectory; and (k, m) those of an ensemble."""
    t, parameters = state["t"], state["parameters"]
    q, p, velocity = stepper._states.start(q, state["p"], state["velocity"])
    if stepper._states.axes(q) != 2:
        start = stepper.start(q, p, velocity=velocity, t=t, parameters=parameters, h=1.0)  # checks the arguments
        return [(start.q, start.p, parameters)], ()
    momenta = momenta_of_each(stepper, q, p, velocity, t, parameters)
    together = start_of_ensemble(stepper, q, momenta, t, parameters)
    by_name = (lambda values: values) if stepper.interface.words > 1 else stepper.parameters_by_name
    return [(x, y, by_name(values)) for x, y, values in zip(*together, strict=True)], together


def _described(pilot: _Pilot, method: Method, symplectic: bool, member: int | None) -> Advice:
    """Return the recommendation in numbers and words."""
    choice = _choose(pilot)
    h, specification, trials = pilot.step(choice.n), method.specification(), sorted(pilot.trials)
    steps = choice.n if pilot.stepper.interface.words == 1 else math.ceil(pilot.span / h)
    degree = specification.get("degree", specification.get("stages"))
    nearest = min(trials, key=lambda trial: abs(math.log(trial.n / choice.n)))
    sentences = list(_sentences(pilot, choice, nearest, member))
    if symplectic:
        sentences.append("The method is symplectic only at this fixed step size.")
    return Advice(
        h=h,
        steps=steps,
        degree=degree if isinstance(degree, int) else None,
        method=method,
        expected_error=choice.error,
        evidence=tuple(Evidence(pilot.step(k.n), k.error.size, k.iterations, k.seconds / k.duration) for k in trials),
        message=f"{steps} steps of {h:.6g} by {method.name}, {' '.join(sentences)}",
        warnings=choice.warnings,
        member=member,
    )


def _sentences(pilot: _Pilot, choice: _Choice, nearest: _Trial, member: int | None) -> Iterator[str]:
    yield f"for an expected error of {choice.error:.1g}."
    if pilot.parts == 1:
        yield "The pilot runs covered the whole span."
    else:
        growth = f"like t^{nearest.error.growth:.1f}" if nearest.error.tenfold == math.inf else "exponentially"
        yield f"The pilot runs covered {nearest.duration:.4g} of {abs(pilot.span):.4g}, where errors grew {growth}."
    if member is not None:
        yield f"Trajectory {member} (from 0) of the ensemble has the largest error."
    if not choice.tried:
        yield f"So small a step was not tried: the error is extrapolated by order {pilot.order}."
    failing = [trial for trial in pilot.trials if trial.failure]
    if failing:
        worst = max(failing)
        yield f"The solver fails at a step size of {abs(pilot.step(worst.n)):.3g}: {worst.failure}."
