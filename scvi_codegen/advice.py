"""Which step (and which degree) for a wanted error: a short pilot run answers, with its evidence.

The pilot covers the whole span, or its first part if that is long, with steps that are halved until two runs agree well
enough; each run is judged by the finest one. Between the two steps that enclose the wanted error a few more are run, so
the step advised was tried, not only fitted. What the pilot does not cover is extrapolated: in time by the growth seen in
it, in h (for methods of low order, whose step would be too small to try) by the order of the method.

Error means |q - q_exact| / |q| at the end of the span, Euclidean norms over all coordinates; |q| is the root mean square
over the later half of the pilot.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.arguments import checked_number
from scvi_codegen.binding import SolverOptions
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import MethodError, StateError, StepFailedError
from scvi_codegen.methods import ARGUMENTS, Method, method_from_specification
from scvi_codegen.stepper import Stepper
from scvi_codegen.system import LagrangianSystem

__all__ = ["Advice", "Evidence", "advise"]

Array = NDArray[np.float64]

DEGREES = (2, 4, 6, 8, 10, 12)
SAFETY = 2.0
"""The error aimed at is the tolerance divided by this."""
SAMPLES = 32
"""States of each pilot run that are compared."""
PILOT_LENGTH = 512
"""In steps that are right to ``LOCAL_AGREEMENT``, each by itself."""
LOCAL_AGREEMENT = 0.01
HEADROOM = 4.0
"""The coarsest pilot run has steps that much longer still."""
MOST_HALVINGS = 100
MOST_TRIALS = 5
ROUND_OFF_GROWTH = 1.5
"""Random changes of the energy at every step move the positions in proportion to this power of time."""
EXPONENTIAL = 2.3
"""Power of time above which errors are taken to grow exponentially."""
NEARLY_LINEAR = 1.35
EARLY, LATE = 0.38, 0.76
"""Times, in parts of the pilot, at which a steadily growing error has its root mean square over the second quarter and
over the second half."""
RESOLVED = 0.05
"""Errors above are not yet proportional to a power of the step."""
ORDER_MARGIN = 0.3
FEWEST_STEPS, MOST_NUMBERS = 2**13, 2**20
"""A pilot run may always have the first number of steps, and as many as make the second with the coordinates."""
TIMINGS, TIMING_SECONDS = 3, 0.1


class Evidence(NamedTuple):
    """One pilot run.

    Attributes:
        h: its step size.
        error: estimate of the error at the end of the span; infinite where a step failed.
        seconds: time taken for a unit of time of the motion.
    """

    h: float
    error: float
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Advice:
    """A step size and why.

    Attributes:
        h: step size, ``span / steps``; negative for a span backward.
        steps: number of steps.
        degree: degree or number of stages of ``method``, ``None`` if it has none.
        method: the method advised: that asked about, or the one of the best degree.
        expected_error: of the positions at the end, relative to their size.
        evidence: the pilot runs of ``method``, the longest steps first.
        message: the advice in a few sentences.
        warnings: what may not be as wished; empty if all is well.
    """

    h: float
    steps: int
    degree: int | None
    method: Method
    expected_error: float
    evidence: tuple[Evidence, ...]
    message: str
    warnings: tuple[str, ...]


def advise(
    system: LagrangianSystem,
    method: Method,
    q: ArrayLike,
    p: ArrayLike,
    span: float,
    tolerance: float,
    *,
    parameters: Mapping[str, float] | Sequence[float] | None = None,
    t: float = 0.0,
    degree: bool = False,
    solver: str = "auto",
    options: SolverOptions | None = None,
) -> Advice:
    """The largest step with which the positions at the end of a run are as right as wished.

    The step is one number for the whole run: a symplectic method whose step follows the motion is symplectic no longer,
    and its energy drifts. Motions with rare violent moments (a close encounter) therefore need the small step of these
    moments all the time; a pilot that ends before them does not know of them.

    Args:
        system: what moves.
        method: how its motion is discretised.
        q, p: (m,) initial positions and momenta.
        span: length of time of the run, negative to go back.
        tolerance: wanted error |q - q_exact| / |q| at the end; half of it is aimed at.
        parameters: by name (others keep their defaults) or all in order.
        t: initial time.
        degree: choose the degree (or number of stages) among 2, 4, ..., 12 too, the one predicted to be fastest.
        solver, options: of the stage equations, as of ``compile_stepper`` and of the run.

    Returns:
        The advice. It has warnings if the tolerance cannot be met (round-off, chaos), or if that is not certain.

    Raises:
        StateError: on wrong shapes, names or numbers, or if every pilot run fails.
        MethodError: if the degree is to be chosen of a method that has none.
        BuildError: without a C compiler.
    """
    target = checked_number(tolerance, "the tolerance")
    if target <= 0.0:
        raise StateError(f"the tolerance must be positive, not {tolerance!r}")
    length = checked_number(span, "the span")
    if length == 0.0:
        raise StateError("the span is 0")
    found: list[tuple[float, Advice]] = []
    failure: StateError | None = None
    for candidate in _candidates(method) if degree else [method]:
        stepper = compile_stepper(system, candidate, solver=solver)
        start = _Start(stepper, q, p, t, parameters, options)
        try:
            choice = _Choice(_Pilot(start, candidate, length, target / SAFETY), target)
        except StateError as error:
            failure = error
            continue
        found.append((choice.cost() if degree else 0.0, choice.advice()))
    if not found:
        assert failure is not None  # there is at least one candidate
        raise failure
    return min(found, key=lambda pair: _preference(pair, target))[1]


def _preference(found: tuple[float, Advice], target: float) -> tuple[float, float]:
    """What meets the tolerance by cost, then what does not by error."""
    cost, advice = found
    return (0.0, cost) if advice.expected_error <= target else (advice.expected_error, cost)


def _candidates(method: Method) -> list[Method]:
    """The method with each degree."""
    specification = dict(method.specification())
    sized = [name for name in ("degree", "stages") if name in ARGUMENTS[str(specification["method"])]]
    if not sized:
        raise MethodError(f"{method.name} has no degree to choose")
    if specification.get("quadrature") == f"gauss-legendre:{specification.get('degree')}":
        del specification["quadrature"]  # the default of its degree: each degree has its own
    return [method_from_specification(specification | {sized[0]: number}) for number in DEGREES]


def _degree(method: Method) -> int | None:
    specification = method.specification()
    number = specification.get("degree", specification.get("stages"))
    return number if isinstance(number, int) else None


class _Start:
    """A stepper and an initial state."""

    def __init__(
        self,
        stepper: Stepper,
        q: ArrayLike,
        p: ArrayLike,
        t: float,
        parameters: Mapping[str, float] | Sequence[float] | None,
        options: SolverOptions | None,
    ) -> None:
        self.stepper = stepper
        run = stepper.start(q, p, h=1.0, t=t, parameters=parameters)  # checks all of them
        self.q, self.p, self.t = run.q, run.p, run.t
        self.parameters, self.options = parameters, options

    def states(self, h: float, steps: int, every: int) -> tuple[Array, float, float]:
        """(n, m) positions after each ``every`` steps, iterations a step, seconds. Raises StepFailedError."""
        began = time.perf_counter()
        run = self.stepper.start(self.q, self.p, h=h, t=self.t, parameters=self.parameters, options=self.options)
        trajectory = run.record(steps, every=every)
        seconds = time.perf_counter() - began
        return trajectory.q[1:], float(trajectory.iterations.sum()) / steps, seconds

    def longest_step(self, span: float) -> float:
        """The longest of span, span / 2, span / 4, ... that one step and two of half the size agree upon, and again.

        This is the time scale |q| / |v| or |p| / |force| of the beginning, whichever is shorter, times what the method
        makes of it.
        """
        h, agreed = span, False
        for _ in range(MOST_HALVINGS):
            if self._agrees(h):
                if agreed:
                    return 2.0 * h
                agreed = True
            else:
                agreed = False
            h /= 2.0
        raise StateError(f"no step from {span:g} down to {h:g} gets away from the initial state")

    def _agrees(self, h: float) -> bool:
        once, twice = self._end(h, 1), self._end(h / 2.0, 2)
        if once is None or twice is None:
            return False
        start = np.stack([self.q, self.p])
        moved, apart = (np.linalg.norm(x, axis=1) for x in (twice - start, once - twice))
        dust = 1e-12 * np.linalg.norm(start, axis=1)
        return bool((apart <= LOCAL_AGREEMENT * moved + dust).all())

    def _end(self, h: float, steps: int) -> Array | None:
        """(2, m) q and p after some steps, ``None`` if one fails."""
        run = self.stepper.start(self.q, self.p, h=h, t=self.t, parameters=self.parameters, options=self.options)
        try:
            run.record(steps, every=steps)
        except StepFailedError:
            return None
        return np.stack([run.q, run.p])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Leg:
    """One pilot run: positions (samples, m), or the word for the failure of a step."""

    q: Array | None
    iterations: float
    seconds: float
    failure: str = ""


class _Pilot:
    """Pilot runs of one method; each is known by its number n of steps between two samples."""

    def __init__(self, start: _Start, method: Method, span: float, goal: float) -> None:
        self.start, self.method, self.span, self.goal = start, method, span, goal
        self.order = float(method.order or 1)
        scale = abs(start.longest_step(span))
        self.length = math.copysign(min(abs(span), PILOT_LENGTH * scale), span)
        self.whole = self.length == span
        self.samples = max(4, min(SAMPLES, int(abs(self.length) / scale / 4.0)))
        self.legs: dict[int, _Leg] = {}
        self.floored = False
        self._descend(max(1, round(abs(self.length) / (HEADROOM * scale * self.samples))))
        self.floor = self._late(self.good[-2]) if self.floored else 0.0
        self.power = self._power()

    @property
    def good(self) -> list[int]:
        """Runs without a failure, the longest steps first."""
        return sorted(n for n, leg in self.legs.items() if leg.q is not None)

    @property
    def judged(self) -> list[int]:
        """All of them but the finest, by which they are judged."""
        return self.good[:-1]

    @property
    def exponential(self) -> bool:
        """Whether errors grow so fast that no power of time describes it."""
        return self.power > EXPONENTIAL

    def step_of(self, n: float) -> float:
        """Step size of the run with n steps between two samples."""
        return self.length / (n * self.samples)

    def run(self, n: int) -> None:
        """One more."""
        try:
            q, iterations, seconds = self.start.states(self.step_of(n), n * self.samples, n)
            self.legs[n] = _Leg(q=q, iterations=iterations, seconds=seconds)
        except StepFailedError as failure:
            self.legs[n] = _Leg(q=None, iterations=0.0, seconds=0.0, failure=failure.status)

    def error(self, n: int) -> float:
        """Expected at the end of the span of the run with n steps between two samples."""
        if n not in self.judged:
            return math.inf
        if self.whole:
            return self._late(n)
        early, late = self._windows(n)
        ratio = self.span / self.length
        if self.exponential:
            return late * math.exp(min(self.rate(n) * abs(self.span - self.length), 600.0))
        if self.method.symplectic and self.power < NEARLY_LINEAR:
            return late * ratio / LATE
        quadratic = max(0.0, (late / LATE - early / EARLY) / (LATE - EARLY))
        linear = max(0.0, late / LATE - quadratic * LATE)
        return linear * ratio + quadratic * ratio**2

    def floor_at_end(self) -> float:
        """What rounding makes of any step, 0 if the runs do not show it."""
        return self._rounded(self.floor)

    def rate(self, n: int) -> float:
        """Of the exponential growth of the errors of a run."""
        early, late = self._windows(n)
        return math.log(late / early) / (abs(self.length) * (LATE - EARLY))

    def horizon(self) -> float:
        """Length of time after which the finest two runs are further apart than the goal."""
        errors = self._errors(self.judged[-1])
        beyond = np.flatnonzero(errors > self.goal)
        return abs(self.length) * float(beyond[0] if len(beyond) else len(errors)) / len(errors)

    def resolved(self, n: int) -> bool:
        """Whether a run is good enough for its error to follow the order of the method."""
        return n in self.judged and self._late(n) < RESOLVED

    def _descend(self, n: int) -> None:
        """Halve the steps until two runs agree, or rounding or the cost ends it."""
        most = max(FEWEST_STEPS, MOST_NUMBERS // max(8, self.start.stepper.dimension)) // self.samples
        while not self.floored and (n <= most or not self.legs):
            self.run(n)
            if self.legs[n].q is not None and len(self.good) > 2:
                before, last = (self._late(k) for k in self.judged[-2:])
                if before >= last and self._rounded(last) <= self.goal:
                    return
                self.floored = before < RESOLVED and last > before * max(0.5, 2.0 ** (-0.3 * self.order))
            n *= 2
        if len(self.good) < 3:
            words = [leg.failure for leg in self.legs.values() if leg.failure] or ["too many steps"]
            raise StateError(
                f"no run over {self.length:g} succeeds, with steps down to {self.step_of(max(self.legs)):g} "
                f"({words[-1]}): the motion may end in a singularity; try a shorter span"
            )

    def _errors(self, n: int) -> Array:
        """(samples,) errors of a run by the finest one, relative to the size of the motion."""
        finest = self.good[-1]
        reference, positions = self.legs[finest].q, self.legs[n].q
        assert reference is not None  # only good runs are asked for
        assert positions is not None
        size = _rms(np.linalg.norm(reference[len(reference) // 2 :], axis=1)) or 1.0
        missing = 1.0 - (n / finest) ** self.order  # the finest is not exact either
        errors: Array = np.linalg.norm(positions - reference, axis=1) / (size * missing)
        return errors

    def _late(self, n: int) -> float:
        """Error of a run at the end of the pilot."""
        errors = self._errors(n)
        late = _rms(errors[-max(1, len(errors) // 4) :])
        return max(late, float(errors[-1])) if self.whole else late

    def _windows(self, n: int) -> tuple[float, float]:
        """Errors of a run in the second quarter and in the second half of the pilot."""
        errors = self._errors(n)
        half, quarter = len(errors) // 2, len(errors) // 4
        return _rms(errors[quarter:half]), _rms(errors[half:])

    def _rounded(self, size: float) -> float:
        """An error of the pilot at the end of the span, if it is due to rounding."""
        return size if self.whole else size * (self.span / self.length) ** ROUND_OFF_GROWTH

    def _power(self) -> float:
        """Power of time with which errors grow, of runs that show more than rounding and are not lost."""
        telling = [n for n in self.judged if 8.0 * self.floor < self._late(n) < RESOLVED][-3:]
        windows = [self._windows(n) for n in telling]
        powers = [math.log2(late / early) for early, late in windows if early > 0.0]
        return float(np.median(powers)) if powers else 1.0


class _Choice:
    """The step that a pilot speaks for."""

    def __init__(self, pilot: _Pilot, tolerance: float) -> None:
        self.pilot, self.tolerance = pilot, tolerance
        self.goal = max(tolerance / SAFETY, 2.0 * pilot.floor_at_end())
        self.warnings: list[str] = []
        self.tried = True
        self.number, self.error = self._enclosed() or self._extrapolated() or self._hopeless()
        self._warn_of_rounding()
        h = pilot.step_of(self.number)
        self.steps = max(1, math.ceil(pilot.span / h * (1.0 - 1e-12)))

    def _enclosed(self) -> tuple[float, float] | None:
        """The longest step that meets the goal as all shorter ones do, by trying steps between."""
        pilot = self.pilot
        for _ in range(MOST_TRIALS):
            fits = self._fitting()
            if not fits:
                return None
            best = fits[0]
            coarser = [n for n in pilot.legs if n < best]
            if not coarser or pilot.error(best) > self.goal / 3.0 or best <= 1.05 * max(coarser):
                break
            between = self._between(max(coarser), best)
            number = min(math.ceil(between), best - 1)
            if number <= max(coarser):
                return (between, min(self.goal, pilot.error(max(coarser))))
            pilot.run(number)
        fits = self._fitting()
        return (float(fits[0]), pilot.error(fits[0])) if fits else None

    def _fitting(self) -> list[int]:
        """Runs that meet the goal, the longest steps first, as far as no shorter step misses it."""
        fits: list[int] = []
        for n in reversed(self.pilot.judged):
            if self.pilot.error(n) > self.goal:
                break
            fits.insert(0, n)
        return fits

    def _between(self, coarse: int, fine: int) -> float:
        """Where a power law between two runs meets the goal, nearly."""
        errors = [self.pilot.error(n) for n in (coarse, fine)]
        if not math.isfinite(errors[0]) or not 0.0 < errors[1] < errors[0]:
            return math.sqrt(coarse * fine)
        part = math.log(errors[0] / (0.7 * self.goal)) / math.log(errors[0] / errors[1])
        return float(coarse * (fine / coarse) ** min(max(part, 0.1), 1.0))

    def _extrapolated(self) -> tuple[float, float] | None:
        """By the order of the method, from the finest runs."""
        pilot = self.pilot
        coarse, fine = pilot.judged[-2:]
        errors = pilot.error(coarse), pilot.error(fine)
        if pilot.exponential or not pilot.resolved(fine) or not 0.0 < errors[1] < errors[0]:
            return None
        order = math.log(errors[0] / errors[1]) / math.log(fine / coarse)
        if abs(order - pilot.order) > ORDER_MARGIN * pilot.order:
            return None
        self.tried = False
        return (fine * (errors[1] / self.goal) ** (1.0 / pilot.order), self.goal)

    def _hopeless(self) -> tuple[float, float]:
        """No step meets the goal: the longest that is about as good as any."""
        pilot = self.pilot
        least = min(pilot.error(n) for n in pilot.judged)
        number = next(n for n in pilot.judged if pilot.error(n) <= 4.0 * least)
        if pilot.exponential or pilot.whole:
            self.warnings.append(
                f"the tolerance cannot be met: nearby motions part too fast. Runs with different steps agree to "
                f"{pilot.goal:.1g} for about {pilot.horizon():.3g} units of time only; the motion may be chaotic"
            )
        else:
            self.warnings.append(
                f"the tolerance cannot be promised: the errors of runs with steps down to "
                f"{pilot.step_of(pilot.good[-1]):.3g} do not follow the order of the method yet"
            )
        return float(number), min(1.0, pilot.error(number))

    def _warn_of_rounding(self) -> None:
        floor = self.pilot.floor_at_end()
        if floor > self.tolerance / SAFETY:
            self.warnings.append(f"rounding alone leaves an error of about {floor:.1g} at the end, whatever the step")

    def cost(self) -> float:
        """Seconds for a unit of time, predicted."""
        pilot = self.pilot
        number = min(pilot.good, key=lambda n: abs(math.log(n / self.number)))
        seconds = [pilot.legs[number].seconds]
        while len(seconds) < TIMINGS and sum(seconds) < TIMING_SECONDS:
            pilot.run(number)
            seconds.append(pilot.legs[number].seconds)
        return min(seconds) / abs(pilot.length) * self.number / number

    def advice(self) -> Advice:
        """All of it, in numbers and words."""
        pilot = self.pilot
        h = pilot.span / self.steps
        runs = [n for n in sorted(pilot.legs) if n != pilot.good[-1]]
        evidence = tuple(
            Evidence(pilot.step_of(n), pilot.error(n), pilot.legs[n].seconds / abs(pilot.length)) for n in runs
        )
        return Advice(
            h=h,
            steps=self.steps,
            degree=_degree(pilot.method),
            method=pilot.method,
            expected_error=self.error,
            evidence=evidence,
            message=" ".join(self._sentences(h)),
            warnings=tuple(self.warnings),
        )

    def _sentences(self, h: float) -> Iterator[str]:
        pilot = self.pilot
        yield f"{self.steps} steps of {h:.6g} by {pilot.method.name}, for an expected error of {self.error:.1g}."
        if pilot.whole:
            yield "The pilot runs covered the whole span."
        else:
            growth = "exponentially" if pilot.exponential else f"like t^{pilot.power:.1f}"
            yield f"The pilot runs covered {pilot.length:.4g} of {pilot.span:.4g}, where errors grew {growth}."
        if not self.tried:
            yield f"So short a step was not tried: the error follows order {pilot.order:g}."
        yield from self._limits()
        if pilot.method.symplectic:
            yield "The step is to stay fixed, which keeps the method symplectic."

    def _limits(self) -> Iterator[str]:
        """Where steps are far too large, or cost more than shorter ones."""
        pilot = self.pilot
        failing = [n for n, leg in pilot.legs.items() if leg.q is None]
        if failing:
            word = pilot.legs[max(failing)].failure
            yield f"A step of {abs(pilot.step_of(max(failing))):.3g} is far too large for the solver: {word}."
        useless = [n for n in pilot.judged if pilot.error(n) >= 1.0]
        if useless and len(useless) < len(pilot.judged):
            yield f"With a step of {abs(pilot.step_of(max(useless))):.3g} no digit is right."
        finer = [n for n in pilot.good if n >= 1.9 * self.number]
        near = [n for n in pilot.good if 0.9 * self.number <= n <= 1.1 * self.number]
        if finer and near:
            here, there = pilot.legs[near[0]].iterations * near[0], pilot.legs[finer[0]].iterations * finer[0]
            if here > there:
                yield "Steps of half the size would need no more iterations in all: this one contracts slowly."


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values))))
