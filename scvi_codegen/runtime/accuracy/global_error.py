"""Global error of an adaptive run, estimated by runs of smaller local tolerances.

A run is compared with one whose local tolerance is a thousand times smaller, so that the difference is its error; three
times the largest difference is the estimate. While that exceeds the wanted error, a run of smaller tolerance is judged
in the same way. Where rounding dominates, all runs have errors of the same size, and one run with nearly the same error
is not rare: the run is compared with two others and a factor of twelve, or with three and a factor of four, for which
agreement by chance is equally improbable. The last runs, at round-off level, are compared with each other; what they do
not confirm stays unconfirmed. (R. D. Skeel, Thirteen ways to estimate global error, Numer. Math. 48 (1986) 1-20; E.
Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.4.)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, repeat
from operator import mul
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.runtime.accuracy.warning_switch import warnings_wanted, without_accuracy_warnings

Array = NDArray[np.float64]
Result = TypeVar("Result")

FIRST, RATIO = 1e-3, 1e-3
"""First local tolerance relative to the wanted error; next tolerance, and that of a comparison, relative to a run's."""
GAIN = 100.0
"""Factor by which ``RATIO`` reduces the error of nearly every run."""
ROUNDED, ROUNDED_OF_TAU, LEAST = 0.99e-12, 1e-10, 1e-17
"""Tolerances below which rounding may dominate errors, also with steps of tau, and from which the last runs are made.

Steps of tau are equal, so that many have smaller errors than the tolerance.
"""
FINER = 0.1
"""Ratio of the tolerances of a run whose error rounding may dominate, of its three comparisons, and of the next run."""
LAST = (0.0, 1e-18, 1e-19, 1e-20)
"""Tolerances of the last runs (0: the default, round-off level), which are compared with each other."""
LEAST_OF_TWO_WORDS, LAST_OF_TWO_WORDS = 1e-30, (0.0, 1e-30, 1e-29, 1e-28)
"""The same with states of two words, whose high words are compared; runs of smaller tolerances are equal."""
COARSER = 1e4
"""Factor of the tolerance of a comparison that fails, for a second attempt."""
SAFETY, SAFETY_OF_TWO, SAFETY_OF_ROUNDING = 3.0, 12.0, 4.0
"""Factors between the largest difference and the estimate; for two and three comparisons where rounding may dominate.

If the errors are independent normal numbers, those of two further runs are both within e / 12 of the error e of the run
in 8 of 10,000 cases, and those of three within e / 4 in as many.
"""
SMALLEST = 5.0 * float(np.finfo(float).eps)
"""Smallest estimate."""
LEAST_SAMPLES, STEPS_PER_SAMPLE, MOST_SAMPLES, MOST_NUMBERS = 16, 16, 512, 2**22
"""Numbers of states that are compared: least, per steps, most, and most times the number of coordinates."""
EARLY = 1.0 / 16.0
"""Part of the run whose largest state sets the least size that errors are relative to."""
ORDER = 10.0
"""Power of a step of tau that a local tolerance stands for: ``RATIO`` halves the steps of a time transformation."""
UNEVEN = 30.0
"""Ratio of the longest to the shortest step from which on a time transformation is recommended."""
SMALLEST_SQUARE, TINY = 1e-280, math.ulp(0.0)
"""Sums of squares below this, or above its inverse, are computed from scaled numbers; smallest positive number."""
LOST = 0.1
"""Estimate from which on runs are uncorrelated."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalError:
    """Differences between a run and others with smaller steps, and the estimate of its global error.

    Attributes:
        requested: requested bound of the relative global error.
        tolerance: local tolerance of the returned run, 0 for round-off.
        h: step of tau of a run in transformed time, else 0.
        t: (n,) times at which the runs were compared: at most 512 of the saved states, where the motion is fast.
        differences: (n,) the larger of ``|dq| / |q|`` and ``|dp| / |p|``. The norms are the largest up to that time, at
            least those of the first sixteenth of the run.
        safety: factor of the estimate: 3; where rounding may dominate the error, 12 for two comparisons, 4 for three.
        estimate: this factor times the largest difference, at least 1.1e-15 and the tolerance; meaningless above about
            0.1, where runs are uncorrelated.
        confirmed_until: last of the times up to which the factor times each difference is at most the requested error.
        runs: number of runs.
        precision: ``"double"`` or ``"double-double"``.
    """

    requested: float
    tolerance: float
    h: float
    t: Array
    differences: Array
    safety: float
    estimate: float
    confirmed_until: float
    runs: int
    precision: str = "double"

    @property
    def confirmed(self) -> bool:
        """Return whether the requested error is confirmed for the whole run."""
        return self.estimate <= self.requested

    @property
    def steps(self) -> dict[str, float | None]:
        """``h``, or ``tolerance`` (``None`` for round-off), as :meth:`Stepper.integrate` takes it for this run."""
        return {"h": self.h} if self.h else {"tolerance": self.tolerance or None}

    @property
    def digits(self) -> int:
        """Number of confirmed decimal digits of the whole run."""
        return max(0, math.floor(-math.log10(self.estimate))) if self.estimate < 1.0 else 0


class Confirmed:
    """Properties of a trajectory whose global error may have been estimated by a second run (``error=``)."""

    __slots__ = ()
    confirmation: GlobalError | None

    @property
    def global_error(self) -> float:
        """Estimated relative error of all states, by a second run with other steps; NaN without ``error=``."""
        return math.nan if self.confirmation is None else self.confirmation.estimate

    @property
    def confirmed_digits(self) -> int | None:
        """Number of decimal digits of all states that a second run confirms; ``None`` without ``error=``."""
        return None if self.confirmation is None else self.confirmation.digits

    @property
    def confirmed_until(self) -> float:
        """Time until which a second run confirms the error asked for; NaN without ``error=``."""
        return math.nan if self.confirmation is None else self.confirmation.confirmed_until


class ConfirmedEnsemble:
    """Properties of an ensemble, the same as of :class:`Confirmed` for each of k trajectories."""

    __slots__ = ()
    confirmations: tuple[GlobalError | None, ...]

    @property
    def global_error(self) -> Array:
        """(k,) estimated relative errors; NaN without ``error=`` and for trajectories that fail."""
        return np.array([math.nan if each is None else each.estimate for each in self.confirmations])

    @property
    def confirmed_digits(self) -> NDArray[np.int64]:
        """(k,) numbers of decimal digits of all states that a second run confirms; 0 where there is none."""
        return np.array([0 if each is None else each.digits for each in self.confirmations], dtype=np.int64)

    @property
    def confirmed_until(self) -> Array:
        """(k,) times until which a second run confirms the error asked for; NaN where there is none."""
        return np.array([math.nan if each is None else each.confirmed_until for each in self.confirmations])


def warn_of_unconfirmed(confirmations: Sequence[GlobalError | None]) -> None:
    """Issue one warning for the trajectories whose requested global error is not confirmed."""
    lost = [(j, each) for j, each in enumerate(confirmations) if each is not None and not each.confirmed]
    if lost:
        j, first = lost[0]
        warn(
            f"the global error {first.requested:g} is not confirmed for {len(lost)} of {len(confirmations)} "
            f"trajectories; for trajectory {j} it is until t = {first.confirmed_until:.6g} only. See "
            "confirmed_until of the result; end the runs there, or give a larger error",
            AccuracyWarning,
        )


def checked_error(error: Any, others: Mapping[str, Any]) -> float:
    """Return the requested global error as a number; raise StateError if combined with another step-size option."""
    wanted = checked_number(error, "the global error")
    if not 0.0 < wanted < 1.0:
        raise StateError(f"error={wanted:g} must be between 0 and 1: it bounds the relative global error")
    for name, value in others.items():
        if value is not None:
            raise StateError(
                f"error={wanted:g} and {name}={value!r} both determine the step size: error= requires adaptive steps; "
                f"omit {name} and give t_end"
            )
    return wanted


def confirmed_run(
    wanted: float,
    integrate: Callable[..., Result],
    again: Callable[..., Result] | None,
    start: float,
    step_of_tau: Callable[[float], float] | None,
    *,
    words: int = 1,
) -> Result:
    """Return the run whose global error is at most ``wanted``, or the most accurate one.

    Args:
        wanted: bound of the relative global error.
        integrate: function of ``tolerance`` or ``h`` that makes the returned run.
        again: that of the runs for comparison, which ends at ``t_end``; ``None`` if ``integrate`` saves all steps.
        start: initial time.
        step_of_tau: function that returns the largest step of tau for a tolerance, or ``None`` without it.
        words: number of words of states.

    Raises:
        StepFailedError: if the most accurate run fails.
    """
    with without_accuracy_warnings():
        trajectory, result = _Runs(wanted, integrate, again, start, step_of_tau, words).judged()
    trajectory.confirmation = result
    return cast(Result, trajectory)


def warn_of_unconfirmed_run(trajectory: Any) -> None:
    """Issue a warning for a run whose requested global error is not confirmed."""
    result: GlobalError = trajectory.confirmation
    if not result.confirmed and warnings_wanted():
        warn(
            f"the global error {result.requested:g} is confirmed until t = {result.confirmed_until:.6g} only: beyond "
            f"it, runs with other steps differ by up to about {result.estimate:.1e}. End the run there, or give a "
            f"larger error{_alternative(trajectory, result)}",
            AccuracyWarning,
        )


def _alternative(trajectory: Any, result: GlobalError) -> str:
    """Return the recommendation of a time transformation for uneven steps of a conservative motion."""
    lengths = abs(trajectory.step_sizes[:-1])
    lengths = lengths[np.isfinite(lengths)][:-1]  # t_end shortens the last step
    suitable = trajectory.plan.adaptive and trajectory.stepper.interface.conserves_energy and result.estimate < LOST
    if not suitable or not lengths.size or lengths.max() < UNEVEN * lengths.min():
        return ""
    return (
        f"; or try a time transformation (reparametrise), whose errors are often smaller in close encounters: the "
        f"longest step is {lengths.max() / lengths.min():.0f} times the shortest"
    )


class _Runs:
    """Runs of one motion by tolerance; arguments as of :func:`confirmed_run`."""

    def __init__(
        self,
        wanted: float,
        integrate: Callable[..., Any],
        again: Callable[..., Any] | None,
        start: float,
        step_of_tau: Callable[[float], float] | None,
        words: int,
    ) -> None:
        self.wanted, self.integrate, self.again, self.start = wanted, integrate, again, start
        self.first, self.h, self.count = min(wanted * FIRST, 0.1), 0.0, 0
        self.least, self.rounded, self.last = LEAST, ROUNDED, LAST
        if words > 1:
            self.least, self.rounded, self.last = LEAST_OF_TWO_WORDS, 0.0, LAST_OF_TWO_WORDS
        if step_of_tau is not None:
            self.rounded, self.first = ROUNDED_OF_TAU, max(self.first, LEAST)
            self.h = step_of_tau(self.first)
        elif self.first < self.rounded:  # the factor of the estimate is larger there
            self.first *= FINER
        self.made: dict[float, Any] = {}

    def steps(self, tolerance: float) -> dict[str, float | None]:
        if self.h:
            return {"h": self.h * ((tolerance or LEAST) / self.first) ** (1.0 / ORDER)}
        return {"tolerance": tolerance or None}

    def run(self, tolerance: float) -> Any:
        if tolerance not in self.made:
            self.count += 1
            self.made[tolerance] = self.integrate(**self.steps(tolerance))
        return self.made[tolerance]

    def other(self, tolerance: float, end: float) -> Any:
        """Return a run for comparison, to its last state if it fails."""
        try:
            if self.again is None:
                return self.run(tolerance)
            self.count += 1
            return self.again(**self.steps(tolerance), t_end=end)
        except StepFailedError as failure:
            if failure.trajectory is None:
                raise
            return failure.trajectory

    def judged(self) -> tuple[Any, GlobalError]:
        """Return the first run that is confirmed, and its estimate; otherwise the better of the last."""
        tolerance, rounded = self.first, self.rounded
        while tolerance > 2.0 * self.least:
            try:
                trajectory = self.run(tolerance)
            except StepFailedError:
                tolerance *= RATIO
                continue
            ratio, count = (FINER, 3) if tolerance < rounded else (RATIO, 1)
            smaller = list(accumulate(repeat(ratio, count), mul, initial=tolerance))
            result = self.estimated(trajectory, tolerance, smaller[1:])
            if result.confirmed:
                return trajectory, result
            if not result.estimate < 1.0:
                break
            powers = 1
            if self.again is not None or tolerance < rounded:  # else the next run was made for this comparison
                powers = math.ceil(math.log(result.estimate / self.wanted, GAIN) * math.log(RATIO, ratio))
            tolerance = list(accumulate(repeat(ratio, max(1, powers)), mul, initial=tolerance))[-1]
        found: list[tuple[Any, GlobalError]] = []
        for tolerance in self.last:
            try:
                trajectory = self.run(tolerance)
            except StepFailedError:
                if not found:
                    raise
                continue
            others = [each for each in self.last if each != tolerance]
            found.append((trajectory, self.estimated(trajectory, tolerance, others, last=True)))
            if found[-1][1].confirmed or found[-1][1].estimate > GAIN * self.wanted:
                break
        return min(found, key=lambda each: each[1].estimate)

    def estimated(self, trajectory: Any, tolerance: float, others: list[float], *, last: bool = False) -> GlobalError:
        """Return the estimate of the error of a run by others; the last runs are compared with all of them."""
        compared = _Samples(trajectory, self.start)
        safety = SAFETY if len(others) == 1 else SAFETY_OF_ROUNDING
        differences, largest = np.zeros(len(compared.t)), 0.0
        for number, each in enumerate(others if compared.end != self.start else ()):
            if number == 2 and SAFETY_OF_TWO * largest <= self.wanted:
                safety = SAFETY_OF_TWO
                break
            further = compared.differences(self.other(each, compared.end))
            if last and not np.isfinite(further).all():
                further = compared.differences(self.other((each or self.least) * COARSER, compared.end))
            differences = np.maximum(differences, further)
            largest = float(differences.max())
            if not last and safety * largest > self.wanted:
                break
        within = safety * differences <= self.wanted
        reached = len(within) if within.all() else int(np.argmin(within))
        return GlobalError(
            requested=self.wanted,
            tolerance=tolerance,
            h=float(self.steps(tolerance).get("h") or 0.0),
            t=compared.t,
            differences=differences,
            safety=safety,
            estimate=math.inf if math.isnan(largest) else max(safety * largest, SMALLEST, tolerance),
            confirmed_until=float(compared.t[reached - 1]) if reached else self.start,
            runs=self.count,
            precision="double-double" if self.last is LAST_OF_TWO_WORDS else "double",
        )


class _Samples:
    """States of a run for comparison with others.

    Attributes:
        t, states: (k,) times, and (2, k, m) positions and momenta: the last state, and from each of equal numbers of
            states the one where positions or momenta change fastest relative to their sizes, as an error in time has
            the largest effect there.
        sizes: (2, k) sizes that differences are relative to.
        end: last time.
    """

    def __init__(self, trajectory: Any, start: float) -> None:
        t, states = trajectory.t, np.array([trajectory.q, trajectory.p])
        self.end, steps = t.item(-1), len(t) - 1
        self.forward = math.copysign(1.0, self.end - start)
        norms = _norms(states)
        early = np.count_nonzero(abs(t - start) <= EARLY * abs(self.end - start))
        least = norms[:, :early].max(axis=1, initial=TINY)
        sizes = np.maximum.accumulate(np.maximum(norms, least[:, None]), axis=1)
        count = max(LEAST_SAMPLES, min(len(t) // STEPS_PER_SAMPLE, MOST_SAMPLES, MOST_NUMBERS // states.shape[2]))
        chosen: Any = slice(None)
        if count < steps:
            with np.errstate(all="ignore"):
                speeds = _norms(states[:, 1:] - states[:, :-1]) / sizes[:, 1:]
                speed = np.fmax(*speeds) / np.maximum(abs(t[1:] - t[:-1]), TINY)
            size = -(-steps // count)
            parts = np.full((-(-steps // size), size), -1.0)
            parts.ravel()[:steps] = speed
            fastest = np.arange(1, steps + 1, size) + parts.argmax(axis=1)
            chosen = [0, *fastest.tolist()]
            chosen += [steps] if chosen[-1] < steps else []
        self.t, self.states, self.sizes = t[chosen], states[:, chosen], sizes[:, chosen]

    def differences(self, other: Any) -> Array:
        """Return the relative differences to another run, infinite after its end."""
        ahead = self.forward * (self.t - other.t[-1])
        differences, some = np.full(len(self.t), np.inf), slice(None) if ahead[-1] <= 0.0 else ahead <= 0.0
        with suppress(StepFailedError), np.errstate(all="ignore"):  # a partial step
            if ahead[0] <= 0.0:
                states = np.array(other._states_at(self.t[some]))
                differences[some] = (_norms(states - self.states[:, some]) / self.sizes[:, some]).max(axis=0)
        return differences


def _norms(rows: Array) -> Array:
    """Return the norm of each row; rows whose squares may overflow or underflow are scaled."""
    squares = np.einsum("...j,...j->...", rows, rows)
    norms = np.sqrt(squares)
    extreme = (squares < SMALLEST_SQUARE) | (squares > 1.0 / SMALLEST_SQUARE)
    if extreme.any() and (some := rows[extreme]).any():
        units = abs(some).max(axis=1)
        with np.errstate(invalid="ignore"):
            scaled = some / np.where(units == 0.0, 1.0, units)[:, None]
            norms[extreme] = units * np.linalg.norm(scaled, axis=1)
    return np.asarray(norms)
