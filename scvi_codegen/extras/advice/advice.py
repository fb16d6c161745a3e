"""Choice of a fixed step size (and degree) for an error at the end of a run, by the errors of pilot runs.

The error of a run (:mod:`scvi_codegen.runs.accuracy.run_error`) of order r is proportional to h^r, so that one run
gives the step size h (target / error)^(1/r) of another one, whose error is computed as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.methods import Discretisation, Method
from scvi_codegen.api.runs import Products, without_accuracy_warnings
from scvi_codegen.api.states import Parameters, States, checked_number
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import Html, summary
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import (
    ArgumentError,
    MethodError,
    ScviCodegenError,
    StateError,
    StepFailedError,
    UnresolvedError,
)
from scvi_codegen.extras.exact.arrays import unrolled_at
from scvi_codegen.extras.paths.size import ROUNDOFF, largest_range
from scvi_codegen.methods import as_method
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.systems.lagrangian import LagrangianSystem

DEGREES = {1: (2, 4, 6, 8, 10, 12), 2: (8, 12, 16, 20, 24, 32)}
"""Degrees, or numbers of stages, among which ``advise`` chooses, by the number of words of the states."""
LANES, OVERHEAD = 8, {1: 3.0, 2: 25.0}
"""Numbers in a vector register, and the cost of a step beside its iterations, in iterations, by the number of words."""
SAFETY, FACTOR = 2.0, 4
"""Ratio of the tolerance to the error aimed at, and the largest factor from one number of steps to the next."""
NUMBERS, EXPONENTIAL = 2**18, 4.0
"""Numbers of positions of a pilot run, which is shorter than the span if it would have more; power of time from which
on growth of errors is exponential, as errors of regular motions are linear or quadratic in time."""


class Evidence(NamedTuple):
    """Result of one pilot run.

    Attributes:
        h: step size.
        error: error at the end of the span; infinite if a step failed.
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
        expected_error: ``run.error.relative`` at the end: of positions and momenta, relative to their ranges.
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
            ("step", Html.plain(f"h = {self.h:.6g}, {self.steps} of them")),
            ("expected error", Html.plain(f"{self.expected_error:.1e}")),
            *(("warning", Html.plain(warning)) for warning in self.warnings),
        ]
        formats = "{:.4g}", "{:.1e}", "{:.1f}", "{:.2e}"
        rows = [tuple(map(Html.plain, map(str.format, formats, row))) for row in self.evidence]
        head = ("h", "error at the end", "iterations per step", "seconds per unit of time")
        pilots = Html.grid(rows, head=head, caption="Pilot runs") if rows else Html("")
        return Html.card(f"Advice: {self.method.title}", facts, pilots)


@checks_arguments(system=MechanicalSystem.OR_ARRAYS)
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
    parameters: Parameters = None,
    t: float = 0.0,
    degree: bool = False,
    solver: str = "auto",
    options: SolverOptions | None = None,
    precision: str = "double",
) -> Advice:
    """Recommend the largest fixed step size with which a run meets a tolerance at its end.

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
        tolerance: required: wanted error at the end, as ``run.error.relative``; the step size aims at half of it.
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
    words = 2 if precision == "double-double" else 1
    for candidate in _candidates(method, words) if degree else [method]:
        for stepper in _steppers(system, candidate, solver, precision):
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


def _steppers(system: MechanicalSystem, method: Method, solver: str, precision: str) -> Iterator[Stepper]:
    """Yield steppers for a solver; for ``"auto"`` the fixed-point solver first, whose limit on h is best respected."""
    if solver == "auto":
        with suppress(MethodError):
            yield compile_stepper(system, method, solver="fixed-point", precision=precision)
    yield compile_stepper(system, method, solver=solver, precision=precision)


def _candidates(method: Method, words: int) -> list[Method]:
    specification = dict(method.specification())
    sized = [name for name in ("degree", "stages") if name in specification]
    if not sized:
        raise MethodError(f"{method.name} has no degree or number of stages to choose: pass degree=False")
    if specification.get("quadrature") == f"gauss-legendre:{specification.get('degree')}":
        del specification["quadrature"]  # the default of its degree: each degree has its own
    return [as_method(specification | {sized[0]: number}) for number in DEGREES[words]]


def _work(advice: Advice, words: int) -> float:
    """Return the evaluations of L for a unit of time, in full registers, by the pilot run nearest to the advice."""
    simplest = LagrangianSystem.from_text(name="free particle", coordinates=["q"], lagrangian="q_dot**2/2")
    points = sum(len(group.abscissae) for group in advice.method.stage_system(simplest).stage_groups)
    row = min(advice.evidence, key=lambda row: abs(math.log(row.h / advice.h)))
    return (row.iterations + OVERHEAD[words]) * math.ceil(points / LANES) * LANES / abs(advice.h)


def missed_tolerance(run: Any, tolerance: float) -> str:
    """Return why the error at the end of a run exceeds ``tolerance``, or is not known; ``""`` if it does not.

    A run of which only the first state was saved is the pilot run that its step size was tried with.
    """
    if len(run) < 2:
        return ""
    try:
        size = float(run.error.relative[-1])
    except ScviCodegenError as unknown:
        return f"the tolerance {tolerance:g} is not confirmed: {unknown}"
    remedy = "use adaptive step size (t_end, --tolerance)"
    return "" if size <= tolerance else f"the tolerance {tolerance:g} is missed: the error is {size:.1e}; {remedy}"


class _Trial(NamedTuple):
    """Pilot run with n steps for the span, or with the first of them.

    Attributes:
        evidence: what users see of it.
        rounding: part of the error that rounding causes.
        lost: whether rounding errors alone, which grow exponentially, exceed the tolerance.
        power: power of time by which errors grow.
        judged, until: times until which errors have digits, and until which they are below the tolerance.
        breaks: time at which the run fails, or loses all digits at once.
        failure: why it fails.
    """

    n: int
    evidence: Evidence
    rounding: float = 0.0
    lost: bool = False
    power: float = 0.0
    judged: float = 0.0
    until: float = 0.0
    breaks: float = math.inf
    failure: str = ""

    def missed(self, tolerance: float) -> float:
        """Return the error relative to that aimed at: half of the tolerance, or twice what rounding leaves."""
        most = tolerance if self.rounding < tolerance else math.inf
        return self.evidence.error / max(tolerance / SAFETY, min(SAFETY * self.rounding, most))


class _Pilot(NamedTuple):
    """Pilot runs of one trajectory, of at most so many steps."""

    most: int
    stepper: Stepper
    q: Any
    p: Any
    settings: dict[str, Any]
    span: float
    tolerance: float
    order: int

    def first(self) -> int:
        """Return the number of steps of the size of the first adaptive one that loses its digits."""
        end = self.settings["t"] + self.span
        try:
            run = self.stepper.products.finer.start(self.q, self.p, t_end=end, tolerance=Products.LOST, **self.settings)
            return max(1, math.ceil(abs(self.span / float(run.record(1).step_sizes[0]))))
        except (MethodError, StepFailedError):
            return 1

    def tried(self, n: int) -> _Trial:
        """Return the run with n steps for the span, or with the first of them; StateError for a motion at rest."""
        h, steps, began = self.span / n, min(n, self.most), time.perf_counter()
        if self.stepper.interface.words > 1:  # sums of short mantissas are exact
            mantissa, exponent = math.frexp(h)
            h = math.ldexp(float(np.float32(mantissa)), exponent)
        try:
            run = self.stepper.integrate(self.q, self.p, h=h, steps=steps, **self.settings)
        except StepFailedError as failure:
            lasted = abs(failure.t - self.settings["t"])
            return _Trial(n, Evidence(h, math.inf, 0.0, 0.0), breaks=lasted, failure=failure.status)
        if largest_range(np.asarray(run.q)) <= Products.RESOLVED * ROUNDOFF * np.abs(np.asarray(run.q)).max():
            raise StateError(
                f"the motion is at rest over t = {abs(h) * steps:.3g}: errors relative to its size are undefined; give "
                "an initial state that moves, or choose h below the shortest period"
            )
        seconds = (time.perf_counter() - began) / abs(h * steps)
        row = Evidence(h, math.inf, float(run.iterations.sum() / steps), seconds)
        if run.step_error >= 1.0:  # the error of a step is the motion
            return _Trial(n, row, breaks=abs(run.worst_step_time - run.t[0]))
        with np.errstate(over="ignore"):  # of chaotic motions
            return self.judged(run, n, row)

    def judged(self, run: Any, n: int, evidence: Evidence) -> _Trial:
        """Return a pilot run with its errors, which grow by powers of time, or exponentially, to the end of the span.

        Where rounding errors alone exceed the tolerance and grow exponentially, errors are those before they do.
        """
        error, t = run.error, np.abs(np.asarray(run.t) - run.t[0])
        last = int(np.flatnonzero(error.relative < Products.LOST)[-1])
        sizes, errors = error.relative_until(last + 1)
        both = np.array([errors, np.maximum.accumulate(error.roundings(sizes)[: last + 1])])
        half, ratio = both[:, np.searchsorted(t, t[last] / 2.0)], max(1.0, abs(self.span) / (t[last] or math.inf))
        powers = np.log2(np.maximum(1.0, both[:, last] / np.where(half > 0.0, half, math.inf)))
        grown = powers * np.where(powers > EXPONENTIAL, 2.0 * (ratio - 1.0), math.log2(ratio))
        at_end, row = both[:, last] * 2.0 ** np.minimum(grown, 1000.0), last
        lost = bool(powers[1] > EXPONENTIAL and SAFETY * at_end[1] > self.tolerance)
        if lost:
            row = int(np.flatnonzero(SAFETY * both[1] <= self.tolerance)[-1])
            at_end = both[:, row]
        until = float(t[np.flatnonzero(errors <= self.tolerance)[-1]])
        by_steps = row == last < len(t) - 1  # digits are lost by errors of steps
        at_once = by_steps and until >= (1.0 - 1.0 / FACTOR**2) * t[last]
        unknown = at_once or (lost and (by_steps or row == 0))
        return _Trial(
            n,
            evidence._replace(error=math.inf if unknown else float(at_end[0])),
            rounding=float(at_end[1]),
            lost=lost,
            power=float(powers[int(lost)]),  # neighbours leave each other as rounding errors grow
            judged=float(t[last]),
            until=until,
            breaks=float(t[last]) if at_once else math.inf,
        )

    def trials(self, n: int) -> list[_Trial]:
        """Return runs with numbers of steps from n on, each by the error of the last one, until it is that aimed at."""
        trials: dict[int, _Trial] = {}
        while n not in trials:
            trials[n] = trial = self.tried(n)
            missed = math.sqrt(SAFETY) * trial.missed(self.tolerance)
            worst, best = _bracket(trials.values(), self.tolerance)
            if best and (best <= SAFETY ** (1.0 / self.order) * worst or (n == best and missed * SAFETY >= 1.0)):
                break
            n = math.ceil(n * min(max(missed ** (1.0 / self.order), 1.0 / FACTOR), FACTOR))
            if not worst < n < (best or math.inf):
                n = max(1, math.ceil(math.sqrt(worst * best))) if best else FACTOR * worst
            if best or n <= self.most:
                continue
            if any(k.evidence.error < Products.LOST and not k.lost for k in trials.values()):
                break
            if math.inf > trial.breaks > abs(self.span) * self.most / n:  # the next run would not reach it
                raise UnresolvedError(
                    f"no pilot run of {self.most} steps is accurate, with step sizes down to "
                    f"{abs(trial.evidence.h):.3g}: the solution may end in a singularity or have a close encounter; "
                    "use adaptive step size (t_end, --tolerance), or a shorter span"
                )
        return list(trials.values())


def _bracket(trials: Iterable[_Trial], tolerance: float) -> tuple[int, int]:
    """Return the largest number of steps that misses the tolerance, and the smallest one above that meets it; or 0."""
    worst = max((k.n for k in trials if k.missed(tolerance) > 1.0), default=0)
    return worst, min((k.n for k in trials if k.n > worst), default=0)


def _warnings(trial: _Trial, error: float, tolerance: float, span: float) -> Iterator[str]:
    """Yield warnings about conditions that prevent, or may prevent, the tolerance from being met."""
    tenfold = trial.judged / 2.0 / (max(trial.power, 1.0) * math.log10(2.0))
    chaos = f"neighbouring trajectories diverge tenfold every {tenfold:.3g} units of time (chaos)"
    if trial.lost:
        yield f"the tolerance cannot be met: {chaos}, so round-off alone exceeds it"
        yield f"the recommended step meets it until t = {trial.until:.4g}"
    elif error > tolerance and SAFETY * trial.rounding > error:
        yield f"round-off alone causes an error of about {trial.rounding:.1g}, which smaller steps do not reduce"
    elif trial.power > EXPONENTIAL and SAFETY * trial.judged < abs(span):
        yield f"{chaos}, at an uncertain rate later"


def _advised(
    stepper: Stepper, method: Method, symplectic: bool, q: States, state: dict[str, Any], span: float, tolerance: float
) -> Advice:
    """Return the recommendation for one stepper.

    Of an ensemble the step is found for one trajectory, and the errors of all with that step are computed; if another
    one misses the tolerance, a smaller step is found for that.
    """
    settings, n, done = {"t": state["t"], "options": state["options"]}, 0, set[int]()
    most = NUMBERS // stepper.dimension
    starts, together = _starts(stepper, q, state)
    members, at_rest = list(range(len(starts))), StateError(f"all {len(starts)} trajectories are at rest")
    while members:
        member = members.pop(0)
        q, p, own = starts[member]
        pilot = _Pilot(most, stepper, q, p, {**settings, "parameters": own}, span, tolerance, method.order or 1)
        try:
            trials = pilot.trials(n or pilot.first())
        except StateError as failure:
            at_rest = at_rest if together else failure
            continue
        result = _described(pilot, trials, method, symplectic, member if together else None)
        if not together:
            return result
        done.add(member)
        steps = min(result.steps, max(FACTOR, most // len(starts)))
        runs = stepper.integrate_ensemble(*together[:2], h=result.h, steps=steps, parameters=together[2], **settings)
        errors = [float(runs[j].error.relative[-1]) if runs.ok[j] else math.inf for j in range(len(starts))]
        worst = int(np.argmax(errors))
        if errors[worst] <= tolerance or worst in done:
            return result
        members, n = [worst], result.steps
    raise at_rest


def _starts(stepper: Stepper, q: States, state: dict[str, Any]) -> tuple[list[tuple[Any, Any, Any]], Any]:
    """Return (m,) positions and momenta with parameters of each trajectory; and (k, m) those of an ensemble."""
    t, parameters = state["t"], state["parameters"]
    q, p, velocity = stepper.products.states.start(q, state["p"], state["velocity"])
    if stepper.products.states.axes(q) != 2:
        start = stepper.start(q, p, velocity=velocity, t=t, parameters=parameters, h=1.0)  # checks the arguments
        return [(start.q, start.p, parameters)], ()
    together = stepper.products.ensemble_start(q, p, velocity, t=t, parameters=parameters)
    by_name = (lambda values: values) if stepper.interface.words > 1 else stepper.parameters_by_name
    return [(x, y, by_name(values)) for x, y, values in zip(*together, strict=True)], together


def _described(pilot: _Pilot, trials: list[_Trial], method: Method, symplectic: bool, member: int | None) -> Advice:
    """Return the step with the least work of those that meet the tolerance, in numbers and words."""
    tolerance, specification = pilot.tolerance, method.specification()
    overhead, trials = OVERHEAD[pilot.stepper.interface.words], sorted(trials, key=lambda k: k.n)
    good = [k for k in trials if k.n > _bracket(trials, tolerance)[0]]
    trial = min(good or trials[-1:], key=lambda k: k.n * (k.evidence.iterations + overhead))
    n, h, error = trial.n, trial.evidence.h, 1.0 if trial.lost else min(1.0, trial.evidence.error)
    covered = min(n, pilot.most)
    growth = "exponentially" if trial.power > EXPONENTIAL else f"like t^{trial.power:.1f}"
    sentences = [f"The pilot runs covered {abs(h) * covered:.4g} of {abs(pilot.span):.4g}, where errors grew {growth}."]
    if covered == n:
        sentences = ["The pilot runs covered the whole span."]
    if member is not None:
        sentences.append(f"Trajectory {member} (from 0) of the ensemble has the largest error.")
    if not good:
        missed = trial.missed(tolerance)
        n, error = math.ceil(n * missed ** (1.0 / pilot.order)), trial.evidence.error / missed
        h = pilot.span / n
        sentences.append(f"So small a step was not tried: the error is extrapolated by order {pilot.order}.")
    if failing := [k for k in trials if k.failure]:
        sentences.append(
            f"The solver fails at a step size of {abs(failing[-1].evidence.h):.3g}: {failing[-1].failure}."
        )
    if symplectic:
        sentences.append("The method is symplectic only at this fixed step size.")
    steps = n if pilot.stepper.interface.words == 1 else math.ceil(pilot.span / h)
    degree = specification.get("degree", specification.get("stages"))
    message = f"{steps} steps of {h:.6g} by {method.name}, for an expected error of {error:.1g}. {' '.join(sentences)}"
    return Advice(
        h=h,
        steps=steps,
        degree=degree if isinstance(degree, int) else None,
        method=method,
        expected_error=error,
        evidence=tuple(k.evidence for k in trials),
        message=message,
        warnings=tuple(_warnings(trial, error, tolerance, pilot.span)),
        member=member,
    )
