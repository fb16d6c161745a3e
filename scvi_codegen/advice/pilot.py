"""Pilot runs: integrations with several step sizes, each compared with the one of the smallest step.

A pilot run covers the whole span or a quarter, a sixteenth, ... of it, the longest part that a few thousand steps
resolve. Its length grows from a short one, and the step sizes with it, so that no step that is far too large is ever
trusted. Errors at the end of the span are extrapolated from the end of the pilot run by the growth observed: linear or
quadratic in time, or exponential if two runs from neighbouring states diverge exponentially (chaos).

Error means |q - q_exact| / |q| with Euclidean norms over all coordinates; |q| is the root mean square over the later
half of the pilot run.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.methods import Method
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.core.words import low_words, with_low
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

Integrate = Callable[..., Trajectory]

EPSILON = 2.0**-52
"""Rounding error of doubles; that of numbers of two words is its square."""
SAMPLES = 64
"""Number of states of each run that are compared."""
RESOLVED, ROUNDOFF_LEVEL = 0.01, 1e-9
"""Bounds of the asymptotic regime: larger errors follow no power of h, smaller ones are round-off (of doubles)."""
SHORTENING, MAX_SHORTENINGS = 4, 20
"""Factor by which pilot runs are shortened, and the largest number of times."""
SEARCH = 16
"""Ratio of the steps that a run may have to those used to find the length of the pilot run."""
EXPONENTIAL_POWER, NEARLY_LINEAR, ROUNDING = 2.5, 1.35, 1.5
"""Powers of time: distances growing faster than the first are exponential; errors of a symplectic method slower than
the second are linear; the third is the growth of position errors by random-walk energy errors."""
PERTURBATION = 1e-9
"""Relative perturbation of the initial positions, whose growth indicates chaos."""
EARLY, LATE = 0.38, 0.76
"""Times, relative to the pilot run, at which a linearly growing error has its root mean square over the second
quarter and over the second half."""


class PilotRun(NamedTuple):
    """Result of a run: (samples, m) positions at equal intervals, iterations per step, seconds, reason of failure."""

    q: Array
    iterations: float
    seconds: float
    failure: str = ""


def run_pilot(
    integrate: Integrate,
    method: Method,
    q: Array,
    span: float,
    *,
    symplectic: bool,
    target_error: float,
    most: int,
    words: int = 1,
) -> Pilot:
    """Return pilot runs over the longest part of the span that can be resolved, with steps down to the error bound.

    Args:
        integrate: ``Stepper.integrate``, called with q, h, steps and every.
        method: method of the stepper.
        q: (m,) initial positions.
        span: duration, not 0; negative to integrate backward.
        symplectic: True if steps preserve the symplectic form.
        target_error: error bound at the end of the span.
        most: largest number of steps of a run.
        words: number of doubles of each number of a state.

    Raises:
        StateError: if the solution seems to end in a singularity, or no step size resolves it from the start.
    """
    pilot, first = None, 1
    for cuts in range(MAX_SHORTENINGS, -1, -1):
        longer = Pilot(integrate, method, q, span, span / SHORTENING**cuts, symplectic, words)
        longer.resolve(first, most // SEARCH)
        if not longer.resolved:
            break
        pilot, first = longer, max(1, longer.finest // SHORTENING)
    h, failure = longer.step(longer.finest), longer.runs[longer.finest].failure
    if pilot is None or (failure and SHORTENING * h < pilot.step(pilot.finest)):
        raise StateError(
            f"no pilot run over t = {longer.length:.3g} succeeds, with step sizes down to {h:.3g}: the solution may "
            "end in a singularity or have a close encounter; use adaptive step size (t_end, --tolerance), or a shorter "
            "span"
        )
    if not pilot.whole:
        pilot.rate = pilot.divergence_rate(most // SEARCH)
    pilot.complete(target_error, most)
    return pilot


class Pilot:
    """Runs over ``length``, the beginning of ``span``, each identified by its number n of steps.

    Errors are extrapolated exponentially with ``rate`` if it is not 0.
    """

    def __init__(
        self,
        integrate: Integrate,
        method: Method,
        q: Array,
        span: float,
        length: float,
        symplectic: bool,
        words: int = 1,
    ) -> None:
        self.integrate, self.q, self.span, self.length, self.rate = integrate, q, span, length, 0.0
        self.order, self.symplectic, self.words = method.order or 1, symplectic, words
        self.epsilon = EPSILON**words
        self.runs: dict[int, PilotRun] = {}

    @property
    def whole(self) -> bool:
        """True if the runs cover the span, so that nothing is extrapolated in time."""
        return self.length == self.span

    @property
    def good(self) -> list[int]:
        """Numbers of steps of the runs without a failure, largest step size first."""
        return sorted(n for n, leg in self.runs.items() if not leg.failure)

    @property
    def compared(self) -> list[int]:
        """All successful runs but the finest, with which they are compared."""
        return self.good[:-1]

    @property
    def finest(self) -> int:
        """Number of steps of the run with the smallest step, successful or not."""
        return max(self.runs)

    @property
    def resolved(self) -> bool:
        """True if the errors of the two finest judged runs are small and decrease."""
        if len(self.compared) < 2:
            return False
        coarse, fine = map(self.final_quarter_error, self.compared[-2:])
        return coarse < RESOLVED and fine <= max(coarse, self._roundoff_level)

    @property
    def _roundoff_level(self) -> float:
        return ROUNDOFF_LEVEL * (self.epsilon / EPSILON)

    @property
    def floor(self) -> float:
        """Round-off level of the error, 0 if the runs do not reach it."""
        errors = [self.final_quarter_error(n) for n in self._halved()][-3:]
        falls = max(0.5, 2.0 ** (-0.3 * self.order))
        levelled = [fine > coarse * falls for coarse, fine in pairwise(errors)]
        shown = levelled == [True, True] or (levelled[-1:] == [True] and errors[-1] < self._roundoff_level)
        return errors[-1] if shown else 0.0

    @property
    def growth(self) -> float:
        """Exponent of the growth of errors in time, from the coarsest resolved runs, where truncation dominates."""
        return float(np.median([_power(self._errors(n)) for n in self._halved()[:3]]))

    @property
    def floor_at_end(self) -> float:
        """Round-off level of the error at the end of the span, 0 if the runs do not reach it."""
        if self.rate:
            return self._exploded(max(self.floor, self.epsilon))
        return self.floor * float((self.span / self.length) ** ROUNDING)

    def step(self, n: float) -> float:
        """Return the step size |h| of n steps."""
        return abs(self.length) / n

    def run(self, n: int) -> None:
        """Perform one more run, sampled as often as its number of steps allows."""
        began = time.perf_counter()
        try:
            trajectory = self.integrate(self.q, h=self.length / n, steps=n, save_every=n // math.gcd(n, SAMPLES))
        except StepFailedError as failure:
            self.runs[n] = PilotRun(np.empty((0, 0)), 0.0, time.perf_counter() - began, failure.status)
        else:
            iterations = float(trajectory.iterations.sum()) / n
            seconds = time.perf_counter() - began
            q = trajectory.q if self.words == 1 else _at_equal_times(trajectory, self.length)
            self.runs[n] = PilotRun(q[1:], iterations, seconds)

    def resolve(self, n: int, most: int) -> None:
        """Halve the step size, starting with n steps, until errors are small."""
        while not self.resolved and n <= most:
            self.run(n)
            n *= 2

    def complete(self, target_error: float, most: int) -> None:
        """Add smaller steps until the bound is met, round-off or cost ends it; larger ones until no digit is right."""
        while self.error(self.compared[-1]) > target_error and not self.floor and 2 * self.finest <= most:
            self.run(2 * self.finest)
        while min(self.runs) > 1 and self.error(min(self.runs)) < 1.0:
            self.run(min(self.runs) // 2)

    def divergence_rate(self, most: int) -> float:
        """Return the exponential growth rate of a perturbation of the initial positions, 0 if not exponential."""
        h = math.copysign(self.step(self.finest), self.span)
        steps = min(most, int(self.span / h))
        nudged = self.q + PERTURBATION * np.cos(np.arange(len(self.q))) * (_rms(self.q) or 1.0)
        try:
            one, other = (self.integrate(q, h=h, steps=steps, save_every=1).q[1:] for q in (self.q, nudged))
        except StepFailedError:
            return 0.0
        difference = np.linalg.norm(other - one, axis=1) / (_rms(np.linalg.norm(one, axis=1)) or 1.0)
        near = difference[: int(np.argmax(difference > RESOLVED)) or steps]
        # Exponential growth exp(r t): the mean of the second half over the second quarter gives r.
        power = _power(near)
        return power * math.log(2.0) / abs(0.5 * h * len(near)) if power > EXPONENTIAL_POWER else 0.0

    def error(self, n: int) -> float:
        """Return the expected error at the end of the span of the run with n steps; infinite if it failed."""
        if n not in self.compared:
            return math.inf
        if self.whole:
            return max(
                float(self._errors(n)[-1]), self.final_quarter_error(n) / 3.0
            )  # the error may cross zero at the end
        if self.rate:
            return self._exploded(self.final_quarter_error(n))
        # Fit error(t) = a t + b t^2 to the mean errors of two windows; symplectic methods: b = 0.
        early, late = _windows(self._errors(n))
        ratio = self.span / self.length
        if self.symplectic and self.growth < NEARLY_LINEAR:
            return late * ratio / LATE
        quadratic = max(0.0, (late / LATE - early / EARLY) / (LATE - EARLY))
        return max(0.0, late / LATE - quadratic * LATE) * ratio + quadratic * ratio**2

    def final_quarter_error(self, n: int) -> float:
        """Return the root-mean-square error of the run with n steps in the last quarter of the pilot run."""
        errors = self._errors(n)
        return _rms(errors[-max(1, len(errors) // 4) :])

    def _halved(self) -> list[int]:
        """Return the runs obtained by halving whose errors are small."""
        return [n for n in self.compared if n.bit_count() == 1 and self.final_quarter_error(n) < RESOLVED]

    def _errors(self, n: int) -> Array:
        """Return the errors of a run at its samples relative to the finest run, by Richardson extrapolation."""
        finest = self.good[-1]
        reference, positions = self.runs[finest].q, self.runs[n].q
        size = _rms(np.linalg.norm(reference[len(reference) // 2 :], axis=1)) or 1.0
        count = math.gcd(len(reference), len(positions))
        both = [q[len(q) // count - 1 :: len(q) // count] for q in (reference, positions)]
        errors: Array = np.linalg.norm(both[1] - both[0], axis=1) / size
        # The reference has the error e_ref = (n/finest)^order e_n, so that |q_n - q_ref| = (1 - (n/finest)^order) e_n.
        return errors / (1.0 - (n / finest) ** self.order)

    def _exploded(self, size: float) -> float:
        return size * math.exp(min(self.rate * abs(self.span - self.length), 600.0))


def _at_equal_times(trajectory: Trajectory, length: float) -> Array:
    """Return positions of two words at multiples of ``length / n``, from which times differ, as h is a double.

    The differences are roundings of doubles, so that their square is below two words.
    """
    t, n = trajectory.t, len(trajectory) - 1
    words = zip(np.asarray(t).tolist(), low_words(t).tolist(), strict=True)
    exact = (Fraction(high) + Fraction(low) - Fraction(float(t[0])) for high, low in words)
    late = np.array([float(each - k * Fraction(length) / n) for k, each in enumerate(exact)])
    moved = late[:, np.newaxis] * np.asarray(trajectory.velocity)
    result: Array = with_low(np.asarray(trajectory.q), low_words(trajectory.q) - moved)
    return result


def _windows(errors: Array) -> tuple[float, float]:
    """Return root mean squares over the second quarter and over the second half."""
    half, quarter = len(errors) // 2, len(errors) // 4
    return _rms(errors[quarter:half]), _rms(errors[half:])


def _power(errors: Array) -> float:
    """Return the exponent of the growth in time of errors at equal intervals."""
    early, late = _windows(errors)
    return math.log2(late / early) if 0.0 < early <= late else 0.0


def _rms(values: Array) -> float:
    return math.sqrt(float(np.mean(np.square(values)))) if len(values) else 0.0
