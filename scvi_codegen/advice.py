"""Which step (and which degree) for a wanted error: a short pilot run answers, with its evidence.

The pilot covers the whole span, or its first part if that is long, with steps that are halved until two runs agree well
enough; each run is judged by the finest one. Between the two steps that enclose the wanted error a few more are run, so
that the step advised was tried, not only fitted. What the pilot does not cover is extrapolated: in time by the growth
seen in it, in h (for methods of low order, whose step would be too small to try) by the order of the method. Two runs
from nearly the same state tell whether the motion is chaotic.

Error means |q - q_exact| / |q| at the end of the span, with Euclidean norms over all coordinates; |q| is the root mean
square over the later half of the pilot.
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
SAMPLES, SAMPLES_OF_WHOLE = 64, 16
"""States of each pilot run that are compared; few if the pilot covers the span and shows the end itself."""
PILOT_LENGTH = 1024
"""In steps that are right to ``LOCAL_AGREEMENT``, each by itself."""
LOCAL_AGREEMENT = 0.01
HEADROOM = 4.0
"""The coarsest pilot run has steps that much longer still."""
MOST_HALVINGS = 100
SHORTER = 8.0
SHORTEST = 4.0
"""A pilot whose errors are too large to learn from is cut to an eighth, down to so many of those steps."""
MOST_TRIALS = 8
ROUND_OFF_GROWTH = 1.5
"""Random changes of the energy at every step move the positions in proportion to this power of time."""
QUADRATIC = 2.4
"""Power of time above which an extrapolation is not certain."""
NUDGE = 1e-9
"""Relative change of the initial positions whose growth tells chaos."""
LONGEST_PROBE = 8192.0
CHAOS = 1e3
"""Growth of that change, for each step of the scale of the motion, above which it is exponential."""
LOST = 1e-2
"""Relative distance of two motions that have nothing in common any more."""
NEARLY_LINEAR = 1.35
EARLY, LATE = 0.38, 0.76
"""Times, in parts of the pilot, at which a steadily growing error has its root mean square over the second quarter and
over the second half."""
RESOLVED = 0.05
"""Errors above are not yet proportional to a power of the step."""
ORDER_MARGIN = 0.3
FEWEST_STEPS, MOST_NUMBERS = 2**13, 2**21
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
            choice = _Choice(_pilot(start, candidate, length, target / SAFETY), target)
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

    def states(self, h: float, steps: int, every: int, q: Array | None = None) -> tuple[Array, float, float]:
        """(n, m) positions after each ``every`` steps, iterations a step, seconds. Raises StepFailedError."""
        began = time.perf_counter()
        q = self.q if q is None else q
        run = self.stepper.start(q, self.p, h=h, t=self.t, parameters=self.parameters, options=self.options)
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

    @property
    def most_steps(self) -> int:
        """The length of any pilot run."""
        return max(FEWEST_STEPS, MOST_NUMBERS // max(8, self.stepper.dimension))

    def rate_of_parting(self, span: float, scale: float) -> float:
        """Rate of the exponential growth of a small change of the initial positions, 0 if it does not grow so."""
        length = math.copysign(min(abs(span), scale * min(LONGEST_PROBE, self.most_steps / 4.0)), span)
        steps = math.ceil(4.0 * abs(length / scale))
        every = max(1, steps // SAMPLES)
        pattern = 1.0 + np.cos(1.0 + np.arange(len(self.q)))
        nudged = self.q + NUDGE * pattern * (float(np.linalg.norm(self.q)) or 1.0) / math.sqrt(len(self.q))
        try:
            first, second = (self.states(length / steps, steps, every, q)[0] for q in (self.q, nudged))
        except StepFailedError:
            return 0.0
        size = _rms(np.linalg.norm(first, axis=1)) or 1.0
        apart = np.linalg.norm(second - first, axis=1) / size
        lost = np.flatnonzero(apart > LOST)
        end = int(lost[0]) if len(lost) else len(apart) - 1
        units = (end + 1) * every / 4.0
        if apart[end] < NUDGE * CHAOS * units:
            return 0.0
        return math.log(apart[end] / NUDGE) / (units * scale)

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
    """One pilot run: positions at equal distances, the last at the end, or the word for the failure of a step."""

    q: Array | None
    iterations: float
    seconds: float
    failure: str = ""


class _Pilot:
    """Pilot runs of one method, each known by its number n of steps."""

    def __init__(
        self, start: _Start, method: Method, *, span: float, length: float, scale: float, goal: float, rate: float
    ) -> None:
        self.start, self.method, self.span, self.length, self.goal = start, method, span, length, goal
        self.rate = 0.0 if length == span else rate
        self.order = float(method.order or 1)
        self.whole = length == span
        self.samples = max(4, min(SAMPLES_OF_WHOLE if self.whole else SAMPLES, int(abs(length) / scale / 4.0)))
        self.legs: dict[int, _Leg] = {}
        self._descend(self.samples * max(1, round(abs(length) / (HEADROOM * scale * self.samples))))
        self.floor = self._level()
        self.power = self._growth()

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
        """Whether the motion is chaotic, and that matters because errors are extrapolated in time."""
        return self.rate > 0.0

    def step_of(self, n: float) -> float:
        """Step size of the run with n steps."""
        return self.length / n

    def run(self, n: int) -> None:
        """One more, sampled as often as its number of steps allows."""
        try:
            q, iterations, seconds = self.start.states(self.step_of(n), n, n // math.gcd(n, self.samples))
            self.legs[n] = _Leg(q=q, iterations=iterations, seconds=seconds)
        except StepFailedError as failure:
            self.legs[n] = _Leg(q=None, iterations=0.0, seconds=0.0, failure=failure.status)

    def error(self, n: int) -> float:
        """Expected at the end of the span of the run with n steps."""
        if n not in self.judged:
            return math.inf
        if self.whole:
            return self._late(n)
        early, late = self._windows(n)
        ratio = self.span / self.length
        if self.exponential:
            return self._exploded(late)
        if self.method.symplectic and self.power < NEARLY_LINEAR:
            return late * ratio / LATE
        quadratic = max(0.0, (late / LATE - early / EARLY) / (LATE - EARLY))
        linear = max(0.0, late / LATE - quadratic * LATE)
        return linear * ratio + quadratic * ratio**2

    def floor_at_end(self) -> float:
        """What rounding makes of any step, 0 if the runs do not show it."""
        if self.exponential:
            return self._exploded(max(self.floor, 2.0**-52))
        return self._rounded(self.floor)

    def horizon(self, n: int) -> float:
        """Length of time for which a run meets the goal."""
        errors = self._errors(n)
        beyond = np.flatnonzero(errors > self.goal)
        if len(beyond):
            return abs(self.length) * float(beyond[0]) / len(errors)
        if not self.exponential:
            return abs(self.length)
        return abs(self.length) + math.log(self.goal / max(self._late(n), 2.0**-52)) / self.rate

    def resolved(self, n: int) -> bool:
        """Whether a run is good enough for its error to follow the order of the method."""
        return n in self.judged and self._late(n) < RESOLVED

    def _descend(self, n: int) -> None:
        """Halve the steps until two runs agree, or rounding or the cost ends it."""
        most = self.start.most_steps
        while n <= most or not self.legs:
            self.run(n)
            if self.legs[n].q is not None and len(self.good) > 2:
                before, last = (self._late(k) for k in self.judged[-2:])
                if (before >= last and self._rounded(last) <= 0.5 * self.goal) or self._level() > 0.0:
                    return
            n *= 2
        if len(self.good) < 3:
            words = [leg.failure for leg in self.legs.values() if leg.failure] or ["too many steps"]
            raise StateError(
                f"no run over {self.length:g} succeeds, with steps down to {self.step_of(max(self.legs)):g} "
                f"({words[-1]}): the motion may end in a singularity; try a shorter span"
            )

    def _level(self) -> float:
        """Error of the pilot at which shorter steps no longer help, 0 if the runs do not show it."""
        level = 0.0
        for n in self.judged:
            longer = [k for k in self.judged if 1.8 * k <= n]
            if longer and self._late(longer[-1]) < RESOLVED:
                last, least = self._late(n), min(self._late(k) for k in self.judged if k >= n)
                levelled = last > self._late(longer[-1]) * max(0.5, 2.0 ** (-0.3 * self.order))
                level = max(level, last) if levelled and last <= 4.0 * least else level
        return level

    def _errors(self, n: int) -> Array:
        """Errors of a run at its samples by the finest one, relative to the size of the motion."""
        finest = self.good[-1]
        reference, positions = self.legs[finest].q, self.legs[n].q
        assert reference is not None  # only good runs are asked for
        assert positions is not None
        size = _rms(np.linalg.norm(reference[len(reference) // 2 :], axis=1)) or 1.0
        missing = 1.0 - (n / finest) ** self.order  # the finest is not exact either
        common = reference[len(reference) // len(positions) - 1 :: len(reference) // len(positions)]
        errors: Array = np.linalg.norm(positions - common, axis=1) / (size * missing)
        return errors

    def _late(self, n: int) -> float:
        """Error of a run at the end of the pilot."""
        errors = self._errors(n)
        late = _rms(errors[-max(1, len(errors) // 4) :])
        return max(late / 3.0, float(errors[-1])) if self.whole else late

    def _windows(self, n: int) -> tuple[float, float]:
        """Errors of a run in the second quarter and in the second half of the pilot."""
        errors = self._errors(n)
        half, quarter = len(errors) // 2, len(errors) // 4
        return _rms(errors[quarter:half]), _rms(errors[half:])

    def _rounded(self, size: float) -> float:
        """An error of the pilot at the end of the span, if it is due to rounding."""
        return size if self.whole else size * (self.span / self.length) ** ROUND_OFF_GROWTH

    def _exploded(self, size: float) -> float:
        return size * math.exp(min(self.rate * abs(self.span - self.length), 600.0))

    def _growth(self) -> float:
        """Power of time with which errors grow, of the finest runs that show more than rounding and are not lost."""
        telling = [n for n in self.judged if 8.0 * self.floor < self._late(n) < RESOLVED][-3:]
        windows = [self._windows(n) for n in telling]
        powers = [math.log2(late / early) for early, late in windows if early > 0.0]
        return float(np.median(powers)) if powers else 1.0


def _pilot(start: _Start, method: Method, span: float, goal: float) -> _Pilot:
    """Over the whole span or a part of it, short enough that errors are seen before they are as large as the motion."""
    scale = abs(start.longest_step(span))
    length = math.copysign(min(abs(span), PILOT_LENGTH * scale), span)
    rate = start.rate_of_parting(span, scale)
    while True:
        pilot = _Pilot(start, method, span=span, length=length, scale=scale, goal=goal, rate=rate)
        if pilot.resolved(pilot.judged[-1]) or abs(length) < SHORTER * SHORTEST * scale:
            return pilot
        length /= SHORTER


class _Choice:
    """The step that a pilot speaks for."""

    def __init__(self, pilot: _Pilot, tolerance: float) -> None:
        self.pilot, self.tolerance = pilot, tolerance
        self.warnings: list[str] = []
        self.tried = True
        possible = pilot.floor_at_end() < (tolerance if pilot.exponential else RESOLVED)
        found = (self._enclosed() or self._extrapolated()) if possible else None
        self.number, self.error = found or self._hopeless()
        self._warn_of_the_end()
        h = pilot.step_of(self.number)
        self.steps = max(1, math.ceil(pilot.span / h * (1.0 - 1e-12)))

    @property
    def goal(self) -> float:
        """The error aimed at."""
        return max(self.tolerance / SAFETY, 2.0 * self.pilot.floor_at_end())

    def _enclosed(self) -> tuple[float, float] | None:
        """The longest step that meets the goal as all shorter ones do, by trying steps between."""
        pilot = self.pilot
        for trial in range(MOST_TRIALS):
            fits = self._fitting()
            if not fits:
                return None
            best = fits[0]
            coarser = [n for n in pilot.legs if n < best]
            if not coarser or pilot.error(best) > self.goal / 3.0 or best <= 1.03 * max(coarser):
                break
            between = self._between(max(coarser), best) if trial % 2 == 0 else math.sqrt(max(coarser) * best)
            unit = 1 if pilot.whole else pilot.samples
            number = min(math.ceil(between / unit) * unit, best - unit)
            if number <= max(coarser):
                break
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
        if not pilot.resolved(fine) or not 0.0 < errors[1] < errors[0]:
            return None
        order = math.log(errors[0] / errors[1]) / math.log(fine / coarse)
        if abs(order - pilot.order) > ORDER_MARGIN * pilot.order:
            return None
        self.tried = False
        return (fine * (errors[1] / self.goal) ** (1.0 / pilot.order), self.goal)

    def _hopeless(self) -> tuple[float, float]:
        """No step meets the goal: the longest that keeps to it for about as long as any."""
        pilot = self.pilot
        horizons = {n: pilot.horizon(n) for n in pilot.judged}
        longest = max(horizons.values())
        number = next(n for n in pilot.judged if horizons[n] >= 0.9 * longest > 0.0 or n == pilot.judged[-1])
        if pilot.exponential and pilot.floor_at_end() > self.tolerance:
            self.warnings.append(
                f"the tolerance cannot be met: nearby motions part by a factor of 10 every "
                f"{math.log(10.0) / pilot.rate:.3g} units of time (chaos), so rounding alone spoils it"
            )
        elif pilot.floor_at_end() < self.tolerance / SAFETY:
            self.warnings.append(
                f"the tolerance cannot be promised: the errors of runs with steps down to "
                f"{abs(pilot.step_of(pilot.good[-1])):.3g} do not follow the order of the method yet"
            )
        if horizons[number] < abs(pilot.span):
            self.warnings.append(f"the step given keeps to it for about {horizons[number]:.3g} units of time")
        return float(number), min(1.0, max(pilot.error(number), pilot.floor_at_end()))

    def _warn_of_the_end(self) -> None:
        pilot, floor = self.pilot, self.pilot.floor_at_end()
        if not pilot.whole and not pilot.exponential and pilot.power > QUADRATIC:
            self.warnings.append(
                f"errors grew like t^{pilot.power:.1f} in the pilot runs, which cannot be relied upon to go on so"
            )
        if floor > self.tolerance / SAFETY and not pilot.exponential:
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
