"""Pilot runs: integrations with several step sizes, each compared with the one of the smallest step.

A pilot run covers the whole span or a quarter, a sixteenth, ... of it, the longest part that a few thousand steps
resolve. Its length grows from a short one, and the step sizes with it, so that no step that is far too large is ever
trusted. Errors at the end of the span are extrapolated from the end of the pilot run by the growth observed: linear or
quadratic in time, or exponential if two runs from neighbouring states diverge exponentially (chaos).

Error means |q - q_exact| / |q - mean q| with Euclidean norms over all coordinates; the latter is the root mean square
over the later half of the pilot run, which does not depend on the origin. Several initial states are integrated
together, as an ensemble: each has its own error, growth and size, and the largest error counts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from fractions import Fraction
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.common.errors import StateError, StepFailedError, UnresolvedError
from scvi_codegen.methods import Method
from scvi_codegen.runs.accuracy.size import distances_from_mean, relative, relative_to_motion
from scvi_codegen.runs.ensembles.ensemble import momenta_of_each, start_of_ensemble
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
from scvi_codegen.runs.states.validation import Array, States
from scvi_codegen.runs.states.words import low_words, with_low
from scvi_codegen.runs.stepper import Stepper

Integrate = Callable[..., Any]

EPSILON = 2.0**-52
"""Rounding error of doubles; that of numbers of two words is its square."""
SAMPLES = 64
"""Number of states of each run that are compared."""
COUNTED = 256
"""Steps of the worst trajectory whose iterations are counted, as those of an ensemble are not reported one by one."""
MOST_NUMBERS, FEWEST_SAMPLES = 2**21, 8
"""Largest number of positions that are stored of a run of many trajectories, and the fewest states of each."""
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


class Trials:
    """Pilot runs of a single state, or of all states of an ensemble together.

    Attributes:
        q, p: (m,) positions and momenta, or (k, m) of an ensemble.
        together: whether they are those of an ensemble.
        count: number of trajectories.
    """

    def __init__(self, stepper: Stepper, q: States, state: Mapping[str, Any]) -> None:
        self.stepper, self.state = stepper, {**state, "velocity": None}
        t, parameters = state["t"], state["parameters"]
        q, p, velocity = stepper._states.start(q, state["p"], state["velocity"])
        self.together = stepper._states.axes(q) == 2
        if self.together:
            momenta = momenta_of_each(stepper, q, p, velocity, t, parameters)
            self.q, self.p, self.state["parameters"] = start_of_ensemble(stepper, q, momenta, t, parameters)
        else:
            start = stepper.start(q, p, velocity=velocity, t=t, parameters=parameters, h=1.0)  # checks the arguments
            self.q, self.p = start.q, start.p
        self.state["p"], self.count = self.p, len(self.q) if self.together else 1

    def _first(self) -> tuple[Array, dict[str, Any]]:
        """Return the positions of the first trajectory of an ensemble, and the other arguments of its run."""
        values = self.state["parameters"][0]
        parameters = values if self.stepper.interface.words > 1 else self.stepper.parameters_by_name(values)
        return self.q[0], {**self.state, "p": self.p[0], "parameters": parameters}

    def integrate(self, q: Array, *, h: float, steps: int, save_every: int) -> Any:
        """Integrate as :meth:`Stepper.integrate`, an ensemble in one call; iterations are those of one trajectory."""
        plan: dict[str, Any] = {"h": h, "steps": steps, "save_every": save_every}
        if not self.together:
            return self.stepper.integrate(q, **self.state, **plan)
        runs = self.stepper.integrate_ensemble(q, **self.state, **plan)
        failed, counted = np.flatnonzero(~runs.ok), min(steps, COUNTED)
        if len(failed):
            status, step = str(runs.status[failed[0]]), int(runs.steps[failed[0]])
            message = f"trajectory {failed[0]} failed: {status}"
            raise StepFailedError(message, status=status, step=step, t=float(runs.ends[0][failed[0]]), residual=0.0)
        q_of_one, state = self._first()
        alone = self.stepper.integrate(q_of_one, **state, h=h, steps=counted, save_every=counted)
        return _Together(runs, alone.iterations.sum() * (steps / counted))


class _Together(NamedTuple):
    """Saved states of an ensemble, and the number of iterations of one trajectory."""

    runs: EnsembleTrajectory
    iterations: Array

    @property
    def t(self) -> Array:
        """(n,) times of the saved states."""
        return self.runs.t

    @property
    def q(self) -> Array:
        """(n, k, m) saved positions."""
        return self.runs.q

    @property
    def velocity(self) -> Array:
        """(n, k, m) velocities."""
        return np.stack([self.runs[j].velocity for j in range(self.q.shape[1])], axis=1)


class PilotRun(NamedTuple):
    """Result of a run: (samples, k, m) positions at equal times, iterations per step, seconds, reason of failure."""

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
        integrate: ``Stepper.integrate``, or a function that does the same for many states, called with q, h, steps and
            save_every.
        method: method of the stepper.
        q: (m,) initial positions, or (k, m) of many trajectories.
        span: duration, not 0; negative to integrate backward.
        symplectic: True if steps preserve the symplectic form.
        target_error: error bound at the end of the span.
        most: largest number of steps of a run.
        words: number of doubles of each number of a state.

    Raises:
        StateError: if the motion is at rest.
        UnresolvedError: if the solution seems to end in a singularity, or no step size resolves it from the start.
    """
    pilot, first = None, 1
    for cuts in range(MAX_SHORTENINGS, -1, -1):
        longer = Pilot(integrate, method, q, span, span / SHORTENING**cuts, symplectic, words)
        longer.resolve(first, most // SEARCH)
        if not longer.resolved:
            break
        pilot, first = longer, max(1, longer.finest // SHORTENING)
    if pilot is None or longer.fails_below(pilot.step(pilot.finest) / SHORTENING):
        h = longer.step(longer.finest)
        raise UnresolvedError(
            f"no pilot run over t = {longer.length:.3g} is accurate, with step sizes down to {h:.3g}: the solution may "
            "end in a singularity or have a close encounter; use adaptive step size (t_end, --tolerance), or a shorter "
            "span"
        )
    if not pilot.whole:
        pilot.rates = pilot.divergence_rates(most // SEARCH)
    if pilot.at_rest:
        which = f"all {pilot.count} trajectories are" if pilot.count > 1 else "the motion is"
        raise StateError(
            f"{which} at rest over t = {pilot.length:.3g}: errors relative to its size are undefined; give an "
            "initial state that moves, or choose h below the shortest period"
        )
    pilot.complete(target_error, most)
    return pilot


class Pilot:
    """Runs over ``length``, the beginning of ``span``, each identified by its number n of steps.

    Errors of a trajectory are extrapolated exponentially with its rate of ``rates`` if that is not 0.
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
        self.integrate, self.q, self.span, self.length = integrate, q, span, length
        self.count = len(q) if q.ndim == 2 else 1
        self.rates = np.zeros(self.count)
        self.samples, self._errors_of = SAMPLES, dict[tuple[int, int], Array]()
        while self.samples > FEWEST_SAMPLES and self.samples * q.size > MOST_NUMBERS:
            self.samples //= 2
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
        """Exponent of the growth of errors in time, from the coarsest resolved runs, where truncation dominates.

        The median over all trajectories: over a short pilot run that of a single one depends on its phase.
        """
        return float(np.median([_power(self._errors(n)) for n in self._halved()[:3]]))

    @property
    def at_rest(self) -> bool:
        """True if all trajectories are at rest, where errors relative to the motion are undefined."""
        return not distances_from_mean(self.runs[self.good[-1]].q).any()

    @property
    def rate(self) -> float:
        """Exponential growth rate of errors, 0 if they do not grow exponentially."""
        return _largest(self.rates)

    def member(self, n: int) -> int:
        """Return the index of the trajectory that determines the error of the run with n steps."""
        return int(np.argmax(self._errors_at_end(n)))

    @property
    def floor_at_end(self) -> float:
        """Round-off level of the error at the end of the span, 0 if the runs do not reach it."""
        if self.rate:
            return float(_exploded(max(self.floor, self.epsilon), self.rate, self.span - self.length))
        return self.floor * float((self.span / self.length) ** ROUNDING)

    def fails_below(self, h: float) -> bool:
        """Return whether a run with a step size below h fails; one of several may succeed by chance."""
        return any(leg.failure and self.step(n) < h for n, leg in self.runs.items())

    def step(self, n: float) -> float:
        """Return the step size |h| of n steps."""
        return abs(self.length) / n

    def run(self, n: int) -> None:
        """Perform one more run, sampled as often as its number of steps allows."""
        began = time.perf_counter()
        try:
            trajectory = self.integrate(self.q, h=self.length / n, steps=n, save_every=n // math.gcd(n, self.samples))
        except StepFailedError as failure:
            self.runs[n] = PilotRun(np.empty((0, 0, 0)), 0.0, time.perf_counter() - began, failure.status)
        else:
            iterations = float(trajectory.iterations.sum()) / n
            seconds = time.perf_counter() - began
            q = trajectory.q if self.words == 1 else _at_equal_times(trajectory, self.length)
            self.runs[n] = PilotRun(q[1:].reshape(-1, self.count, q.shape[-1]), iterations, seconds)

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

    def divergence_rates(self, most: int) -> Array:
        """Return (k,) exponential growth rates of a perturbation of the initial positions, 0 if not exponential."""
        h = math.copysign(self.step(self.finest), self.span)
        steps = min(most, int(self.span / h))
        nudges = PERTURBATION * np.cos(np.arange(self.q.shape[-1]))

        def run(q: Array) -> Array:
            return np.asarray(self.integrate(q, h=h, steps=steps, save_every=1).q[1:].reshape(steps, self.count, -1))

        try:
            reference = run(self.q)
            sizes = distances_from_mean(reference)
            shifts = nudges * sizes[:, np.newaxis] / math.sqrt(self.q.shape[-1])
            shifted = run(self.q + shifts.reshape(self.q.shape))
        except StepFailedError:
            return np.zeros(self.count)
        differences = relative(np.linalg.norm(shifted - reference, axis=-1), sizes)
        rates = np.zeros(self.count)
        for j, difference in enumerate(differences.T):
            near = difference[: int(np.argmax(difference > RESOLVED)) or steps]
            # Exponential growth exp(r t): the mean of the second half over the second quarter gives r.
            power = float(_power(near))
            rates[j] = power * math.log(2.0) / abs(0.5 * h * len(near)) if power > EXPONENTIAL_POWER else 0.0
        return rates

    def error(self, n: int) -> float:
        """Return the expected error at the end of the span of the run with n steps; infinite if it failed."""
        return _largest(self._errors_at_end(n)) if n in self.compared else math.inf

    def final_quarter_error(self, n: int) -> float:
        """Return the root-mean-square error of the run with n steps in the last quarter of the pilot run."""
        return _largest(self._final_quarter(n))

    def _final_quarter(self, n: int) -> Array:
        """Return the (k,) root-mean-square errors in the last quarter of the pilot run."""
        errors = self._errors(n)
        return _rms(errors[-max(1, len(errors) // 4) :])

    def _errors_at_end(self, n: int) -> Array:
        """Return the (k,) expected errors at the end of the span of the run with n steps."""
        errors = self._errors(n)
        if self.whole:
            return np.asarray(np.maximum(errors[-1], self._final_quarter(n) / 3.0))  # it may cross zero at the end
        # Fit error(t) = a t + b t^2 to the mean errors of two windows; symplectic methods: b = 0.
        early, late = _windows(errors)
        ratio = self.span / self.length
        with np.errstate(invalid="ignore"):  # differences of infinite errors
            quadratic = np.maximum(0.0, (late / LATE - early / EARLY) / (LATE - EARLY))
            regular = np.maximum(0.0, late / LATE - quadratic * LATE) * ratio + quadratic * ratio**2
        if self.symplectic and self.growth < NEARLY_LINEAR:
            regular = late * ratio / LATE
        exploded = _exploded(self._final_quarter(n), self.rates, self.span - self.length)
        return np.asarray(np.where(self.rates > 0.0, exploded, regular))

    def _halved(self) -> list[int]:
        """Return the runs obtained by halving whose errors are small."""
        return [n for n in self.compared if n.bit_count() == 1 and self.final_quarter_error(n) < RESOLVED]

    def _errors(self, n: int) -> Array:
        """Return (samples, k) errors of a run relative to the finest run, by Richardson extrapolation.

        Those that overflow are infinite.
        """
        finest = self.good[-1]
        if (n, finest) in self._errors_of:
            return self._errors_of[n, finest]
        reference, positions = self.runs[finest].q, self.runs[n].q
        count = math.gcd(len(reference), len(positions))
        both = [q[len(q) // count - 1 :: len(q) // count] for q in (reference, positions)]
        errors = relative_to_motion(np.linalg.norm(both[1] - both[0], axis=-1), reference)
        # The reference has the error e_ref = (n/finest)^order e_n, so that |q_n - q_ref| = (1 - (n/finest)^order) e_n.
        errors = errors / (1.0 - (n / finest) ** self.order)
        self._errors_of[n, finest] = errors = np.where(np.isfinite(errors), errors, math.inf)
        return errors


def _largest(values: Array) -> float:
    """Return the largest value; infinity if one is NaN."""
    return float(np.where(np.isnan(values), math.inf, values).max())


def _at_equal_times(trajectory: Any, length: float) -> Array:
    """Return positions of two words at multiples of ``length / n``, from which times differ, as h is a double.

    The differences are roundings of doubles, so that their square is below two words.
    """
    t, n, velocity = trajectory.t, len(trajectory.t) - 1, np.asarray(trajectory.velocity)
    words = zip(np.asarray(t).tolist(), low_words(t).tolist(), strict=True)
    exact = (Fraction(high) + Fraction(low) - Fraction(float(t[0])) for high, low in words)
    late = np.array([float(time - k * Fraction(length) / n) for k, time in enumerate(exact)])
    moved = late.reshape(-1, *[1] * (velocity.ndim - 1)) * velocity
    result: Array = with_low(np.asarray(trajectory.q), low_words(trajectory.q) - moved)
    return result


def _exploded(size: Any, rate: Any, time: float) -> Any:
    return size * np.exp(np.minimum(rate * abs(time), 600.0))


def _windows(errors: Array) -> tuple[Array, Array]:
    """Return root mean squares over the second quarter and over the second half."""
    half, quarter = len(errors) // 2, len(errors) // 4
    return _rms(errors[quarter:half]), _rms(errors[half:])


def _power(errors: Array) -> Array:
    """Return the exponents of the growth in time of errors at equal intervals."""
    early, late = _windows(errors)
    grows = (early > 0.0) & (early <= late) & (late < math.inf)
    return np.asarray(np.log2(np.where(grows, late, 1.0) / np.where(grows, early, 1.0)))


def _rms(values: Array) -> Array:
    """Return root mean squares along the first axis, 0 of none."""
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)) if len(values) else np.zeros(values.shape[1:]))
