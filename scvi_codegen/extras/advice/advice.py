"""Choice of a fixed step size (and degree) for an error at the end of a run, by the errors of pilot runs.

The error of a run (:mod:`scvi_codegen.runs.accuracy.run_error`) of order r is proportional to h^r, so that one run
gives the step size h (target / error)^(1/r) of another one, whose error is computed as well.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
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
        h: step size.
        error, rounding: relative errors at the end of the span, and the part that rounding causes; of runs that are
            lost by the end those at the last time at which rounding alone meets the tolerance.
        power: power of time by which the error grows.
        duration, until: times until which digits are left, and until which the tolerance is met.
        judged: time at which the error is judged.
        covered: duration of the run.
        lost: whether no digits are left at its end.
    """

    n: int
    h: float
    error: float = math.inf
    rounding: float = 0.0
    power: float = 0.0
    duration: float = 0.0
    until: float = 0.0
    judged: float = 0.0
    covered: float = 0.0
    lost: bool = True
    iterations: float = 0.0
    seconds: float = 0.0
    failure: str = ""

    def aim(self, tolerance: float) -> float:
        """Return half of the tolerance, or what rounding leaves of it, at least twice the error of rounding."""
        return max(
            tolerance / SAFETY, min(SAFETY * self.rounding, tolerance if self.rounding < tolerance else math.inf)
        )

    @property
    def tenfold(self) -> float:
        """Time in which errors grow tenfold, infinite unless they grow exponentially."""
        return math.inf if self.power <= EXPONENTIAL else self.judged / 2.0 / (self.power * math.log10(2.0))


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
            return _Trial(n, h, covered=abs(h) * steps, duration=lasted, failure=failure.status)
        price = {"seconds": (time.perf_counter() - began) / abs(h * steps), "iterations": run.iterations.sum() / steps}
        if largest_range(np.asarray(run.q)) <= Products.RESOLVED * ROUNDOFF * np.abs(np.asarray(run.q)).max():
            raise StateError(
                f"the motion is at rest over t = {abs(h) * steps:.3g}: errors relative to its size are undefined; give "
                "an initial state that moves, or choose h below the shortest period"
            )
        with np.errstate(over="ignore"):  # of chaotic motions
            return self.judged(run, _Trial(n, h, covered=abs(h) * steps, **price))

    def judged(self, run: Any, trial: _Trial) -> _Trial:
        """Return a pilot run with its errors."""
        error, t = run.error, np.abs(np.asarray(run.t) - run.t[0])
        lost = not error.relative[-1] < Products.LOST
        rows = int(np.flatnonzero(error.relative < Products.LOST)[-1]) + 1
        sizes, errors = error.relative_until(rows)
        roundings = np.maximum.accumulate(error.roundings(sizes)[:rows])
        row = int(np.flatnonzero(SAFETY * roundings <= self.tolerance)[-1]) if lost else rows - 1
        half = int(np.searchsorted(t, t[row] / 2.0))
        powers = [math.log2(max(1.0, x[row] / x[half])) if x[half] else 0.0 for x in (errors, roundings)]
        ratio = 1.0 if lost else max(1.0, abs(self.span) / t[row])
        power = powers[1] if lost else powers[0]  # neighbours leave each other as rounding errors grow
        grown = [k * (2.0 * (ratio - 1.0) if power > EXPONENTIAL else math.log2(ratio)) for k in powers]
        ends = [float(x[row]) * 2.0 ** min(k, 1000.0) for x, k in zip((errors, roundings), grown, strict=True)]
        if not lost and ends[1] >= Products.LOST:  # rounding alone exceeds it later: judged as far as it goes
            lost, power, ends = True, powers[1], [float(errors[row]), float(roundings[row])]
        if lost and (row == 0 or row == rows - 1 < len(t) - 1):  # errors are those of the steps, not of rounding
            ends[0] = math.inf
        met = np.flatnonzero(errors <= self.tolerance)[-1]
        times: Any = {name: float(t[k]) for name, k in (("duration", rows - 1), ("judged", row), ("until", met))}
        return trial._replace(error=ends[0], rounding=ends[1], power=power, lost=lost, **times)

    def trials(self, n: int) -> list[_Trial]:
        """Return runs with numbers of steps, from n on, until the error is half of the tolerance."""
        trials: list[_Trial] = []
        while n not in [k.n for k in trials]:
            trials.append(trial := self.tried(n))
            worst = max((k.n for k in trials if k.error > k.aim(self.tolerance)), default=0)
            best = min((k.n for k in trials if k.n > worst), default=0)
            aim = trial.aim(self.tolerance) / math.sqrt(SAFETY)
            if best and (best <= SAFETY ** (1.0 / self.order) * worst or (n == best and trial.error * SAFETY >= aim)):
                break
            n = math.ceil(n * min(max((trial.error / aim) ** (1.0 / self.order), 1.0 / FACTOR), FACTOR))
            if not worst < n < (best or math.inf):
                n = max(1, math.ceil(math.sqrt(worst * best))) if best else FACTOR * worst
            if n > self.most and not best:
                if any(k.error < Products.LOST and not k.lost for k in trials):
                    break
                # Digits are lost at once at an encounter or a singularity, by and by where neighbours diverge.
                at_once = trial.until > (1.0 - 1.0 / FACTOR**2) * trial.duration
                before = trials[-2].duration if len(trials) > 1 and trials[-2].failure else math.inf
                fails = trial.failure and 0.0 < before < math.inf and FACTOR * trial.duration <= (FACTOR + 1) * before
                if (at_once and trial.lost and not trial.failure) or fails or n > self.most**2:
                    raise UnresolvedError(
                        f"no pilot run over t = {trial.covered:.3g} is accurate, with step sizes down to "
                        f"{abs(trial.h):.3g}: the solution may end in a singularity or have a close encounter; use "
                        "adaptive step size (t_end, --tolerance), or a shorter span"
                    )
        return trials


def _warnings(trial: _Trial, tolerance: float, span: float) -> Iterator[str]:
    """Yield warnings about conditions that prevent, or may prevent, the tolerance from being met."""
    chaos = f"neighbouring trajectories diverge tenfold every {trial.tenfold:.3g} units of time (chaos)"
    if trial.lost:
        yield f"the tolerance cannot be met: {chaos}, so round-off alone exceeds it"
        yield f"the recommended step meets it until t = {trial.until:.4g}"
    elif trial.error > tolerance and SAFETY * trial.rounding > trial.error:
        yield f"round-off alone causes an error of about {trial.rounding:.1g}, which smaller steps do not reduce"
    elif trial.tenfold < math.inf and trial.covered < 0.9 * abs(span):
        yield f"{chaos}, at an uncertain rate later"


def _advised(
    stepper: Stepper, method: Method, symplectic: bool, q: States, state: dict[str, Any], span: float, tolerance: float
) -> Advice:
    """Return the recommendation for one stepper.

    Of an ensemble the step is found for one trajectory, and the errors of all with that step are computed; if another
    one misses the tolerance, a smaller step is found for that.
    """
    settings, n, done = {"t": state["t"], "options": state["options"]}, FACTOR**2, set[int]()
    most = NUMBERS // stepper.dimension
    starts, together = _starts(stepper, q, state)
    members, at_rest = list(range(len(starts))), StateError(f"all {len(starts)} trajectories are at rest")
    while members:
        member = members.pop(0)
        q, p, own = starts[member]
        pilot = _Pilot(most, stepper, q, p, {**settings, "parameters": own}, span, tolerance, method.order or 1)
        try:
            trials = pilot.trials(n)
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
    overhead, trials = OVERHEAD[pilot.stepper.interface.words], sorted(trials)
    worst = max((k.n for k in trials if k.error > k.aim(tolerance)), default=0)
    good = [k for k in trials if k.n > worst]
    trial = min(good or trials[-1:], key=lambda k: k.n * (k.iterations + overhead))
    n, h, error = trial.n, trial.h, min(1.0, trial.error) if not trial.lost else 1.0
    sentences = [f"The pilot runs covered {trial.covered:.4g} of {abs(pilot.span):.4g}, where errors grew "]
    sentences[0] += f"like t^{trial.power:.1f}." if trial.tenfold == math.inf else "exponentially."
    if trial.covered >= (1.0 - 0.5**10) * abs(pilot.span):
        sentences = ["The pilot runs covered the whole span."]
    if member is not None:
        sentences.append(f"Trajectory {member} (from 0) of the ensemble has the largest error.")
    if not good:
        error = trial.aim(tolerance)
        n = math.ceil(n * (trial.error / error) ** (1.0 / pilot.order))
        h = pilot.span / n
        sentences.append(f"So small a step was not tried: the error is extrapolated by order {pilot.order}.")
    if failing := [k for k in trials if k.failure]:
        sentences.append(f"The solver fails at a step size of {abs(failing[-1].h):.3g}: {failing[-1].failure}.")
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
        evidence=tuple(Evidence(k.h, k.error, float(k.iterations), k.seconds) for k in trials),
        message=message,
        warnings=tuple(_warnings(trial, tolerance, pilot.span)),
        member=member,
    )
