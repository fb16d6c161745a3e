"""Choice of a fixed step size (and degree) for a wanted error: the largest one that short pilot runs confirm.

Steps are halved until the error at the end, as predicted by pilot runs (:mod:`scvi_codegen.analysis.advice.pilot`), is
small enough; bisection between the two step sizes that enclose it follows, so that the recommended step was tried, not
only fitted. Methods of low order may need steps too small to try: their number follows from the order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import takewhile
from typing import NamedTuple

from scvi_codegen.analysis.advice.pilot import EXPONENTIAL_POWER, Pilot, Trials, run_pilot
from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE, PRECISIONS
from scvi_codegen.common.display.cards import Html, card, grid, plain
from scvi_codegen.common.errors import ArgumentError, MethodError, StateError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.methods import ARGUMENTS, Method, as_method, method_from_specification
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.states.validation import EnsembleParameters, States
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.rolling import unrolled_at
from scvi_codegen.systems.system import SYSTEM_OR_ARRAYS, MechanicalSystem

DEGREES = {1: (2, 4, 6, 8, 10, 12), 2: (8, 12, 16, 20, 24, 32)}
"""Degrees, or numbers of stages, among which ``advise`` chooses, by the number of words of the states."""
SAFETY = 2.0
"""Ratio of the tolerance to the error aimed at."""
BISECTION_RATIO = 1.5
"""Ratio of the errors of neighbouring step sizes at which bisection ends."""
ORDER_MARGIN = 0.3
"""Largest relative deviation of the measured from the claimed order for extrapolating to untried steps."""
LANES = 8
"""Numbers in a vector register, for the cost of an evaluation."""
OVERHEAD = {1: 3.0, 2: 25.0}
"""Cost of a step in addition to its iterations, in iterations, by the number of words of the states."""
SHORT_MANTISSA = 2.0**20
"""Steps of two words have so short a mantissa that their sums are exact; a shorter last one ends at the span."""
WORK_RATIO = 0.9
"""Ratio of work at which a smaller step is preferred to the largest admissible one."""
NUMBERS, FEWEST, MOST = 2**21, 2**13, 2**18
"""Number of stage positions computed in one pilot run, and bounds of its number of steps."""
FEWEST_TOGETHER = 2**10
"""Fewest steps of the longest pilot run of an ensemble, whose number falls with the root of that of trajectories."""


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
    result: list[tuple[float, Advice]] = []
    failures: list[StateError] = []
    if precision not in PRECISIONS[:2]:
        raise MethodError(f"advise requires precision='double' or 'double-double', not {precision!r}")
    compiled = partial(compile_stepper, precision=precision)
    words = 2 if precision == DOUBLE_DOUBLE else 1
    for candidate in _candidates(method, words) if degree else [method]:
        for stepper in _steppers(compiled, system, candidate, solver):
            try:
                trials = Trials(stepper, q, state)
                result.append(_advised(trials, candidate, is_symplectic(candidate, system), length, target))
            except StateError as failure:
                failures.append(failure)
                continue
            if result[-1][1].expected_error <= target:
                break
    if not result:
        raise failures[-1]
    accurate = [(cost, advice) for cost, advice in result if advice.expected_error <= target]
    if accurate:
        return min(accurate, key=lambda pair: pair[0])[1]
    return min((advice for _, advice in result), key=lambda advice: advice.expected_error)


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


def _advised(trials: Trials, method: Method, symplectic: bool, span: float, tolerance: float) -> tuple[float, Advice]:
    """Return the cost of a unit of time with the recommendation for one stepper, and the recommendation."""
    points = _points(method)
    most = min(max(FEWEST, NUMBERS // (points * trials.stepper.dimension)), MOST)
    most = max(min(most, FEWEST_TOGETHER), round(most / math.sqrt(trials.count)))
    pilot = run_pilot(
        trials.integrate,
        method,
        trials.q,
        span,
        symplectic=symplectic,
        target_error=tolerance / SAFETY,
        most=most,
        words=trials.stepper.interface.words,
    )
    choice, overhead = _choose(pilot, tolerance), OVERHEAD[pilot.words]
    nearest = min(pilot.good, key=lambda k: abs(math.log(k / choice.n)))
    evaluations = (pilot.runs[nearest].iterations + overhead) * math.ceil(points / LANES) * LANES  # in full registers
    return evaluations / pilot.step(choice.n), _advice(pilot, choice, method)


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


def _points(method: Method) -> int:
    """Return the number of evaluation points of the Lagrangian per step, which is the same for every system."""
    simplest = LagrangianSystem.from_text(name="free particle", coordinates=["q"], lagrangian="q_dot**2/2")
    return sum(len(group.abscissae) for group in method.stage_system(simplest).stage_groups)


class _Choice(NamedTuple):
    """Number of steps for the length of the pilot, expected error at the end of the span, and warnings."""

    n: float
    error: float
    warnings: tuple[str, ...] = ()
    tried: bool = True


def _choose(pilot: Pilot, tolerance: float) -> _Choice:
    """Return the largest step that meets the tolerance, or whose error is dominated by round-off."""
    floor, (coarse, fine) = pilot.floor_at_end, pilot.compared[-2:]
    target_error = max(tolerance / SAFETY, 2.0 * floor)
    n = _cheapest(pilot, _bisected(pilot, target_error))
    if n is not None or (pilot.rate and floor > tolerance):
        n = n or fine
        return _Choice(n, min(1.0, pilot.error(n)), tuple(_warnings(pilot, tolerance, n)))
    doubts = tuple(_warnings(pilot, tolerance, fine))
    missed, ratio = pilot.error(fine) / target_error, pilot.error(coarse) / pilot.error(fine)
    if ratio > 1.0 and abs(math.log(ratio, fine / coarse) - pilot.order) <= ORDER_MARGIN * pilot.order:
        return _Choice(fine * missed ** (1.0 / pilot.order), target_error, doubts, tried=False)
    words = (
        f"the tolerance may be missed: the errors of runs with steps down to {pilot.step(pilot.finest):.3g} do not "
        "follow the order of the method yet"
    )
    return _Choice(fine, min(1.0, pilot.error(fine)), (*doubts, words))


def _warnings(pilot: Pilot, tolerance: float, n: int) -> Iterator[str]:
    """Yield warnings about conditions that prevent, or may prevent, the tolerance from being met."""
    floor = pilot.floor_at_end
    if pilot.rate:
        tenfold = math.log(10.0) / pilot.rate
        chaos = f"neighbouring trajectories diverge tenfold every {tenfold:.3g} units of time (chaos)"
        if floor <= tolerance:
            yield f"{chaos}, at an uncertain rate later"
            return
        yield f"the tolerance cannot be met: {chaos}, so round-off alone exceeds it"
        digits = math.log10(tolerance / max(pilot.final_quarter_error(n), 2.0**-52))
        reliable = max(0.0, abs(pilot.length) + digits * tenfold)
        yield f"the recommended step meets it for about {reliable:.3g} units of time"
    elif floor > tolerance / SAFETY:
        yield f"round-off alone causes an error of about {floor:.1g} at the end, for any step size"
    elif not pilot.whole and pilot.growth > EXPONENTIAL_POWER:
        yield f"errors grew like t^{pilot.growth:.1f} in the pilot runs, a rate that may not continue"


def _bisected(pilot: Pilot, target_error: float) -> int | None:
    """Return the fewest steps that meet the bound, as all larger numbers do; ``None`` if the finest run does not."""
    fits = list(takewhile(lambda n: pilot.error(n) <= target_error, reversed(pilot.compared)))
    if not fits:
        return None
    best, worse = fits[-1], max((n for n in pilot.runs if n < fits[-1]), default=0)
    while worse and best / worse > BISECTION_RATIO ** (1.0 / pilot.order):
        middle = _sampled(math.sqrt(worse * best))
        if not worse < middle < best:
            break
        pilot.run(middle)
        worse, best = (worse, middle) if pilot.error(middle) <= target_error else (middle, best)
    return best


def _cheapest(pilot: Pilot, n: int | None) -> int | None:
    """Return n, or a larger number of steps with much less work: iterations increase near the convergence limit."""
    if n is None:
        return None
    work = {k: k * (pilot.runs[k].iterations + OVERHEAD[pilot.words]) for k in pilot.compared if k >= n}
    best = min(work, key=work.__getitem__)
    return best if work[best] < WORK_RATIO * work[n] else n


def _sampled(n: float) -> int:
    """Return a number near n that is a multiple of a power of 2, so that runs have sample times in common."""
    unit = 1 << min(6, max(0, int(n).bit_length() - 6))
    return math.ceil(n / unit) * unit


def _advice(pilot: Pilot, choice: _Choice, method: Method) -> Advice:
    """Return the recommendation in numbers and words."""
    steps = max(1, math.ceil(choice.n * (pilot.span / pilot.length) * (1.0 - 1e-12)))
    h = pilot.span / steps
    if pilot.words > 1:
        mantissa, exponent = math.frexp(h)
        h = math.ldexp(math.trunc(mantissa * SHORT_MANTISSA) / SHORT_MANTISSA, exponent)
        steps = math.ceil(pilot.span / h)
    specification = method.specification()
    degree = specification.get("degree", specification.get("stages"))
    shown = sorted(n for n, leg in pilot.runs.items() if n in pilot.compared or leg.failure)
    runs = [(n, pilot.runs[n]) for n in shown]
    nearest = min(pilot.compared, key=lambda n: abs(math.log(n / choice.n)))
    member = pilot.member(nearest) if pilot.q.ndim == 2 else None
    return Advice(
        h=h,
        steps=steps,
        degree=degree if isinstance(degree, int) else None,
        method=method,
        expected_error=choice.error,
        evidence=tuple(
            Evidence(pilot.length / n, pilot.error(n), leg.iterations, leg.seconds / abs(pilot.length))
            for n, leg in runs
        ),
        message=" ".join(_sentences(pilot, choice, method, steps, h, member)),
        warnings=choice.warnings,
        member=member,
    )


def _sentences(
    pilot: Pilot, choice: _Choice, method: Method, steps: int, h: float, member: int | None
) -> Iterator[str]:
    yield f"{steps} steps of {h:.6g} by {method.name}, for an expected error of {choice.error:.1g}."
    if pilot.whole:
        yield "The pilot runs covered the whole span."
    else:
        growth = "exponentially" if pilot.rate else f"like t^{pilot.growth:.1f}"
        yield f"The pilot runs covered {pilot.length:.4g} of {pilot.span:.4g}, where errors grew {growth}."
    if member is not None:
        yield f"Of {pilot.count} trajectories, number {member} (from 0) has the largest error."
    if not choice.tried:
        yield f"So small a step was not tried: the error is extrapolated by order {pilot.order}."
    failing = [n for n, leg in pilot.runs.items() if leg.failure]
    if failing:
        n = max(failing)
        yield f"The solver fails at a step size of {pilot.step(n):.3g}: {pilot.runs[n].failure}."
    useless = [n for n in pilot.compared if pilot.error(n) >= 1.0]
    if useless and len(useless) < len(pilot.compared):
        yield f"At a step size of {pilot.step(max(useless)):.3g} no digit is correct."
    if pilot.symplectic:
        yield "The method is symplectic only at this fixed step size."
