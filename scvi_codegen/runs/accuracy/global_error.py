"""Global error of an adaptive run, confirmed by runs that do not share its step sequence.

A run is compared with one whose local tolerance is a thousand times smaller, so that the difference is its error, and
whose steps end at other, irregular times, as steps that follow from the motion alone (free flight) are the same for all
tolerances; where formulas are not smooth, they also end where these jump or have a kink. Forces that are so narrow that
both pass over them are sought in short pieces (:mod:`.narrow_forces`), and limit the steps of further runs. Three times
the largest difference is the estimate. While that exceeds the wanted error, a run of smaller tolerance is judged in the
same way. Where rounding dominates, all runs have errors of the same size, and one run with nearly the same error is not
rare: the run is compared with two others and a factor of twelve, or with three and a factor of four, for which
agreement by chance is equally improbable. The last runs, at round-off level, are compared with each other; what they do
not confirm stays unconfirmed. (R. D. Skeel, Thirteen ways to estimate global error, Numer. Math. 48 (1986) 1-20; E.
Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.4.)
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import accumulate, chain, repeat
from operator import mul
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.runs.accuracy.narrow_forces import differences_in_pieces, longest_piece
from scvi_codegen.runs.accuracy.size import Motion, first_of_groups, momenta_of_velocities, relative, roundoff
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted, without_accuracy_warnings
from scvi_codegen.runs.stepping.projection import determined_coordinates
from scvi_codegen.runs.stepping.step_plan import Adaptive, absolute_tolerances

Array = NDArray[np.float64]

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
LAST = (None, 1e-18, 1e-19, 1e-20)
"""Tolerances of the last runs (``None``: the default, round-off level), which are compared with each other."""
ROUNDED_OF_TWO_WORDS, LEAST_OF_TWO_WORDS, LAST_OF_TWO_WORDS = 1e-26, 1e-30, (1e-30, 1e-29, 1e-28)
"""The same with states of two words."""
COARSER = 1e4
"""Factor of the tolerance of a comparison that fails, for a second attempt."""
SAFETY, SAFETIES_OF_ROUNDING = 3.0, (400.0, 12.0, 4.0)
"""Factors between the largest difference and the estimate; for one to three comparisons where rounding may dominate.

If the errors are independent normal numbers, that of a further run is within e / s of the error e of the run in
1 / (pi s) of the cases, for s = 400 in 8 of 10,000; those of two are both within e / 12, those of three within e / 4 in
as many.
"""
PARTS_AT_KINKS, LEAST_AT_KINKS = (math.inf, 0.0913, 0.0331, 0.0127, 0.00491), 1e-13
"""Largest steps relative to the run, one after the other, of formulas that are not smooth: free flight has the same
steps for all tolerances, one of which may end beyond a kink. The least tolerance of these runs, unless the first one is
smaller."""
MOST_EXAMINATIONS, FINER_PIECES = 2, 0.0625
"""Searches for narrow forces; ratio of their pieces, the second one where the first one succeeds."""
PART_OF_ERROR, ROUNDINGS = 0.01, 1024.0
"""Differences in pieces that count: parts of the wanted error, which later steps may enlarge; roundings."""
LEAST_STOPS, LONG, STRIDE, MOST_STOPS = 8, 64, 16, 32
"""Of a run for comparison, numbers of times at which steps end: least; see :func:`irregular_stops`; most of others."""
GOLDEN, MARGIN, IRREGULAR = 0.6180339887498949, 0.05, 0.8191725134
"""Golden ratio; part of a step at its ends that is not cut; ratio of steps of tau of runs for comparison."""
FURTHER, MANY = 300, 100_000
"""Runs end after so many times the steps of the first one in all, and so many more: what is confirmed then remains."""
LEAST_SAMPLES, STEPS_PER_SAMPLE, MOST_SAMPLES, MOST_NUMBERS = 16, 16, 512, 2**22
"""Numbers of states that are compared: least, per steps, most, and most times the number of coordinates."""
ORDER = 10.0
"""Power of a step of tau that a local tolerance stands for: ``RATIO`` halves the steps of a time transformation."""
UNEVEN = 30.0
"""Ratio of the longest to the shortest step from which on a time transformation is recommended."""
SLIGHT = 1e-12
"""Ratio to the largest position or momentum below which a change is no reason to compare a state."""
TINY = math.ulp(0.0)
"""Smallest positive number."""
LOST = 0.1
"""Estimate from which on runs are uncorrelated."""
NAMES_OF_PRECISIONS = {1: "double", 2: "double-double"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalError:
    """Differences between a run and others with smaller steps, and the estimate of its global error.

    Attributes:
        requested: requested bound of the relative global error.
        tolerance: local tolerance of the returned run; ``None`` for round-off.
        h: step of tau of a run in transformed time, else ``None``.
        t: (n,) times at which the runs were compared: at most 512 of the saved states, where the motion is fast.
        differences: (n,) the largest difference of a position relative to the range of that coordinate over the run, or
            of a momentum relative to its own or that of its velocity (:mod:`scvi_codegen.runs.accuracy.size`); not of
            coordinates that constraints determine from others at that time, where their positions differ by rounding.
        safety: factor of the estimate: 3; where rounding may dominate the error, 400 for one comparison (which confirms
            nothing), 12 for two, 4 for three.
        estimate: this factor times the largest difference, at least ten roundings and the tolerance; meaningless above
            about 0.1, where runs are uncorrelated.
        confirmed_until: last of the times up to which the factor times each difference is at most the requested error.
        runs: number of runs.
        precision: ``"double"`` or ``"double-double"``.
        max_step: largest step of the returned run, limited where the formulas are not smooth or forces are narrow.
    """

    requested: float
    tolerance: float | None
    h: float | None
    t: Array
    differences: Array
    safety: float
    estimate: float
    confirmed_until: float
    runs: int
    precision: str = "double"
    max_step: float = math.inf

    @property
    def confirmed(self) -> bool:
        """Return whether the requested error is confirmed for the whole run."""
        return self.estimate <= self.requested

    @property
    def steps(self) -> dict[str, float | None]:
        """``h``, or ``tolerance`` (``None``: round-off) and ``max_step``, of :meth:`Stepper.integrate` for this run."""
        if self.h is not None:
            return {"h": self.h}
        limit = {} if self.max_step == math.inf else {"max_step": self.max_step}
        return {"tolerance": self.tolerance, **limit}

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
        """Relative error of all states, by a second run with other steps; NaN without ``error=``."""
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

    def _of_each(self, name: str, missing: float) -> NDArray[Any]:
        return np.array([missing if result is None else getattr(result, name) for result in self.confirmations])

    @property
    def global_error(self) -> Array:
        """(k,) estimated relative errors; NaN without ``error=`` and for trajectories that fail."""
        return self._of_each("estimate", math.nan)

    @property
    def confirmed_digits(self) -> NDArray[np.int64]:
        """(k,) numbers of decimal digits of all states that a second run confirms; 0 where there is none."""
        return self._of_each("digits", 0).astype(np.int64)

    @property
    def confirmed_until(self) -> Array:
        """(k,) times until which a second run confirms the error asked for; NaN where there is none."""
        return self._of_each("confirmed_until", math.nan)


def warn_of_unconfirmed(confirmations: Sequence[GlobalError | None]) -> None:
    """Issue one warning for the trajectories whose requested global error is not confirmed."""
    lost = [(j, result) for j, result in enumerate(confirmations) if result is not None and not result.confirmed]
    if lost:
        j, first = lost[0]
        warn(
            f"the global error {first.requested:g} is not confirmed for {len(lost)} of {len(confirmations)} "
            f"trajectories; for trajectory {j} it is until t = {first.confirmed_until:.6g} only. See "
            "confirmed_until of the result; end the runs there, or give a larger error",
            AccuracyWarning,
        )


def checked_error(error: Any, others: Mapping[str, Any], stepper: Any = None) -> float:
    """Return the requested global error; raise StateError if it is unattainable or another option sets step sizes."""
    bound = checked_number(error, "the global error")
    if not 0.0 < bound < 1.0:
        raise StateError(f"error={bound:g} must be between 0 and 1: it bounds the relative global error")
    for name, value in others.items():
        if value is not None:
            raise StateError(
                f"error={bound:g} and {name}={value!r} both determine the step size: error= requires adaptive steps; "
                f"omit {name} and give t_end"
            )
    if stepper is not None:
        words = max(stepper.interface.words, 1 + (stepper._precise is not None))
        if bound < (least := smallest_estimate(words)):
            remedy = ", or precision='double-double'" if words == 1 else ""
            raise StateError(
                f"error={bound:g} is below {least:.1e}, the least error that {NAMES_OF_PRECISIONS[words]} arithmetic "
                f"confirms: give a larger error{remedy}"
            )
    return bound


def smallest_estimate(words: int) -> float:
    """Return the smallest estimate of an error of states of one or two words."""
    return 10.0 * roundoff(words)


def warn_of_unconfirmed_run(trajectory: Any) -> None:
    """Issue a warning for a run whose requested global error is not confirmed."""
    result: GlobalError = trajectory.confirmation
    if result.confirmed or not warnings_wanted():
        return
    warn(
        f"the global error {result.requested:g} is {_confirmed_part(result, float(trajectory.t[0]))}: runs with other "
        f"steps differ by up to about {result.estimate:.1e}. {_remedy(result, float(trajectory.t[0]))}"
        f"{_alternative(trajectory, result)}",
        AccuracyWarning,
    )


def _confirmed_part(result: GlobalError, start: float) -> str:
    if result.confirmed_until == start:
        return "confirmed at no time"
    return f"confirmed until t = {result.confirmed_until:.6g} only"


def _remedy(result: GlobalError, start: float) -> str:
    return "Give a larger error" if result.confirmed_until == start else "End the run there, or give a larger error"


def _alternative(trajectory: Any, result: GlobalError) -> str:
    """Return the recommendation of ends of steps at kinks, or of a time transformation for uneven steps.

    The latter is for conservative motions.
    """
    if trajectory.modes is not None and trajectory.modes.ambiguous:
        return "; but several motions of the contacts were consistent: others are as consistent as this one"
    latest = float(abs(trajectory.t).max())
    if math.ulp(latest) > result.requested * float(np.ptp(trajectory.t)):
        return f"; or begin at t = 0: at t = {latest:g} times are rounded by {math.ulp(latest):.1e}"
    if math.isinf(result.estimate):
        return f"; or use a method of higher order: others took more than {FURTHER} times the steps of the first run"
    if kinks := trajectory.stepper.interface.kinks:
        return (
            "; or give max_step=, a tenth of the shortest pulse or contact, or, without error=, events there "
            f"(sc.impact, sc.Event(.., then=)): the equations are not smooth where {kinks[0]} = 0"
        )
    lengths = abs(trajectory.step_sizes[:-1])
    lengths = lengths[np.isfinite(lengths)][:-1]  # t_end shortens the last step
    adaptive = isinstance(trajectory.plan, Adaptive)
    suitable = adaptive and trajectory.stepper.interface.conserves_energy and result.estimate < LOST
    if not suitable or not lengths.size or lengths.max() < UNEVEN * lengths.min():
        return ""
    return (
        f"; or try a time transformation (reparametrise), whose errors are often smaller in close encounters: the "
        f"longest step is {lengths.max() / lengths.min():.0f} times the shortest"
    )


Attempt: TypeAlias = tuple[Any, GlobalError]
"""Run, and the estimate of its error."""


class Runs:
    """Runs of one motion by tolerance, one of which is returned and confirmed by others.

    Args:
        motion: makes the runs (:class:`~scvi_codegen.runs.driver.bounded_motion.BoundedMotion`).
    """

    def __init__(self, motion: Any) -> None:
        self.motion, self.requested, self.interface = motion, motion.error, motion.stepper.interface
        self.start: float = checked_number(motion.initial.t, "the time t")
        self.words: int = self.interface.words
        self.first, self.count, self.most = min(self.requested * FIRST, 0.1), 0, math.inf
        self.taken: float = 0.0
        self.h: float | None = None
        self.least, self.rounded = LEAST, ROUNDED
        self.last: tuple[float | None, ...] = LAST
        self.failure: StepFailedError | None = None
        self.compared: Any = None
        if self.words > 1:
            self.least, self.rounded, self.last = LEAST_OF_TWO_WORDS, ROUNDED_OF_TWO_WORDS, LAST_OF_TWO_WORDS
        if not motion.smooth:  # errors are as random as those of rounding
            self.rounded = 1.0
        has_tau = motion.stepper._has_tau
        if has_tau:
            self.rounded, self.first = ROUNDED_OF_TAU, max(self.first, LEAST)
            self.h = motion.step_of_tau(self.first)
        elif self.first < self.rounded:  # the factor of the estimate is larger there
            self.first *= FINER
        self.parts = () if has_tau or not self.interface.kinks else PARTS_AT_KINKS
        self.is_examined = not (has_tau or self.interface.kinks or self.words > 1)
        self.examinations, self.largest = 0, math.inf

    @without_accuracy_warnings()
    def confirmed_run(self) -> Any:
        """Return the run whose global error is at most ``requested``, or the most accurate one.

        Raises:
            StepFailedError: if the most accurate run fails.
        """
        trajectory, result = self._judged()
        trajectory.confirmation = result
        return trajectory

    def _steps(self, tolerance: float | None, factor: float = 1.0) -> dict[str, float | None]:
        if self.h is None:
            return {"tolerance": tolerance}
        ratio = (LEAST if tolerance is None else tolerance) / self.first
        return {"h": factor * self.h * ratio ** (1.0 / ORDER)}

    def _run(self, tolerance: float | None, max_step: float = math.inf) -> Any:
        self.count += 1
        check = self._check_count if self.most < math.inf else None
        limit = {} if (max_step := min(max_step, self.largest)) == math.inf else {"max_step": max_step}
        trajectory = self.motion.run(check, **self._steps(tolerance), **limit)
        self.most = min(self.most, FURTHER * trajectory.steps + MANY)
        self.taken += trajectory.steps
        return trajectory

    def _other(self, tolerance: float | None, compared: "_Samples", number: int) -> Any:
        """Return a run for comparison, to its last state if it fails or takes too many steps."""
        self.count += 1
        stops = irregular_stops(compared.steps_of_run, number)
        limit = {} if self.largest == math.inf else {"max_step": IRREGULAR * self.largest}
        try:
            run = self.motion.compared_run(stops, self._check_count, **self._steps(tolerance, IRREGULAR), **limit)
        except StepFailedError as failure:
            if failure.trajectory is None:
                raise
            run = failure.trajectory
        self.taken += run.steps
        return run

    def _check_count(self, steps: int) -> None:
        if self.taken + steps > self.most:
            self.taken = self.most  # no further run begins
            raise _TooManyStepsError

    def _judged(self, passing: Attempt | None = None) -> Attempt:
        """Return the first run that is confirmed, and its estimate; otherwise the better one.

        Args:
            passing: the run before that passes over forces; it is lost if none of smaller steps can be made.
        """
        attempts: list[tuple[Attempt, _Samples]] = []
        for attempt in chain(self._limited() if self.parts else self._by_tolerance(), self._at_round_off()):
            if attempt[1].confirmed:
                return self._judged(attempt) if self._passes_over_forces(self.compared) else attempt
            attempts.append((attempt, self.compared))
        if not attempts and passing is not None:
            return passing[0], replace(passing[1], estimate=math.inf, confirmed_until=self.start)
        if self.failure is not None and not attempts:
            raise self.failure
        best, compared = min(attempts, key=lambda attempt: attempt[0][1].estimate)
        further = [best[0]] if len(best[0].t) == best[0].steps + 1 else []
        return self._judged(best) if self._passes_over_forces(compared, *further) else best

    def _passes_over_forces(self, samples: "_Samples", *further: Any) -> bool:
        """Return whether the farthest run, or a further one, passes over forces; runs have smaller steps then."""
        run = samples.farthest
        if not self.is_examined or self.examinations == MOST_EXAMINATIONS or run is None:
            return False
        size = longest_piece(run, self.motion.end - self.start) * FINER_PIECES**self.examinations
        self.examinations += 1
        apart = np.array([differences_in_pieces(compared, size) for compared in (run, *further)]).max(axis=0)
        apart[:, ~samples.independent.any(axis=0) & samples.is_rounding(apart[0]).any(axis=0)] = 0.0
        differences = relative(apart, samples.sizes(len(samples.t), apart)).max()
        end = samples.end
        rounding = samples.epsilon * max(1.0, max(abs(self.start), abs(end)) / abs(end - self.start))  # also of times
        if differences <= max(PART_OF_ERROR * self.requested, ROUNDINGS * rounding):
            return False
        self.largest = size
        return True

    def _by_tolerance(self) -> Iterator[Attempt]:
        """Yield runs of smaller and smaller tolerances, until errors are too large for an extrapolation."""
        tolerance, estimate = self.first, 0.0
        while tolerance > 2.0 * self.least and estimate < 1.0:
            powers, (ratio, smaller) = 1, self._smaller(tolerance)
            with self._suppressed_failure():
                trajectory = self._run(tolerance)
                result = self._estimated(trajectory, tolerance, smaller)
                yield trajectory, result
                estimate = result.estimate
                powers = max(1, math.ceil(math.log(min(estimate, 1.0) / self.requested, GAIN) * math.log(RATIO, ratio)))
            tolerance = list(accumulate(repeat(ratio, powers), mul, initial=tolerance))[-1]

    def _limited(self) -> Iterator[Attempt]:
        """Yield runs of smaller and smaller largest steps."""
        tolerance, last, longest = self.first, None, math.inf
        for part in self.parts:
            max_step = part * abs(self.motion.end - self.start)
            if (last, max_step >= longest) == (tolerance, True):
                continue  # the steps would be those of the run before
            last = tolerance
            with self._suppressed_failure():
                trajectory = self._run(tolerance, max_step)
                longest = float(np.abs(np.diff(trajectory.t)).max(initial=0.0))
                yield trajectory, self._estimated(trajectory, tolerance, self._smaller(tolerance)[1], max_step)
            tolerance = max(RATIO * tolerance, min(tolerance, LEAST_AT_KINKS))

    def _at_round_off(self) -> Iterator[Attempt]:
        """Yield the last runs, as long as their errors are not far above the wanted one."""
        for tolerance in self.last:
            with self._suppressed_failure():
                trajectory = self._run(tolerance)
                others = [other for other in self.last if other != tolerance]
                result = self._estimated(trajectory, tolerance, others, last=True)
                yield trajectory, result
                if result.estimate > GAIN * self.requested:
                    return

    @contextmanager
    def _suppressed_failure(self) -> Iterator[None]:
        """Go on after a run that fails, or takes too many steps."""
        try:
            yield
        except StepFailedError as failure:
            self.failure = failure
        except _TooManyStepsError:
            pass

    def _smaller(self, tolerance: float) -> tuple[float, list[float]]:
        """Return the tolerances of the runs that a run is compared with, and their ratio."""
        ratio, count = (FINER, 3) if tolerance < self.rounded else (RATIO, 1)
        return ratio, list(accumulate(repeat(ratio, count), mul, initial=tolerance))[1:]

    def _estimated(
        self,
        trajectory: Any,
        tolerance: float | None,
        others: Sequence[float | None],
        max_step: float = math.inf,
        *,
        last: bool = False,
    ) -> GlobalError:
        """Return the estimate of the error of a run by others; the last runs are compared with all of them."""
        self.compared = compared = _Samples(trajectory, self.start, self.interface)
        safety = SAFETY if len(others) == 1 else SAFETIES_OF_ROUNDING[-1]
        missed = 0.0 if trajectory.modes is None else trajectory.modes.missed
        floor = max(smallest_estimate(self.words), 0.0 if tolerance is None else tolerance, missed)
        for number, other in enumerate(others if compared.end != self.start else ()):
            if number == 2 and SAFETIES_OF_ROUNDING[1] * compared.largest() <= self.requested:
                safety = SAFETIES_OF_ROUNDING[1]
                break
            try:
                complete = compared.compare(self._other(other, compared, number))
                if last and not complete:
                    coarser = COARSER * (self.least if other is None else other)
                    compared.compare(self._other(coarser, compared, number))
            except _TooManyStepsError:
                compared.lose()
            if not last and safety * compared.largest() > self.requested:
                safety = SAFETY if len(others) == 1 else SAFETIES_OF_ROUNDING[number]
                break
        if trajectory.modes is not None and trajectory.modes.ambiguous:
            compared.lose()  # all runs chose the same one of several motions
        differences, reached = compared.relative(lambda errors: np.maximum(safety * errors, floor) <= self.requested)
        largest = float(differences.max(initial=0.0))
        return GlobalError(
            requested=self.requested,
            tolerance=tolerance,
            h=self._steps(tolerance).get("h"),
            max_step=min(max_step, self.largest),
            t=compared.t,
            differences=differences,
            safety=safety,
            estimate=math.inf if math.isnan(largest) else max(safety * largest, floor),
            confirmed_until=float(compared.t[reached - 1]) if reached else self.start,
            runs=self.count,
            precision=NAMES_OF_PRECISIONS[self.words],
        )


class _TooManyStepsError(Exception):
    """Raised if a run for comparison takes many more steps than the run that it is compared with."""


def irregular_stops(t: Array, number: int) -> list[float]:
    """Return times within the steps of a run at which another ends steps, so that it does not share their sequence.

    Steps that follow from the motion alone, as in free flight, are the same for all tolerances. At least
    ``LEAST_STOPS`` steps are cut, all that are longer than a ``LONG``-th of the run, and of others every
    ``STRIDE``-th, at fractions that are multiples of the golden ratio modulo 1.

    Args:
        t: (n,) ends of steps, or other times of the run, with the first and the last time of the run.
        number: of the comparison; each has other times.
    """
    sizes = np.diff(t)
    pieces = max(1, -(-LEAST_STOPS // max(1, len(sizes))))
    is_cut = abs(sizes) * LONG > abs(t[-1] - t[0])
    is_cut[number :: max(STRIDE, -(-len(sizes) // MOST_STOPS))] = True
    k = np.repeat(np.flatnonzero(is_cut), pieces)
    parts = (np.arange(1, len(k) + 1) * GOLDEN + number / 3.0) % 1.0
    stops = np.unique(t[k] + (MARGIN + (1.0 - 2.0 * MARGIN) * parts) * sizes[k])
    inner = stops[(stops != t[0]) & (stops != t[-1])]
    return [*(inner if t[-1] > t[0] else inner[::-1]).tolist(), float(t[-1])]


class _Samples:
    """States of a run for comparison with others.

    Attributes:
        t, states: (k,) times, and (2, k, m) positions and momenta: the last state, and from each of equal numbers of
            states the one where positions or momenta change fastest relative to their sizes, as an error in time has
            the largest effect there.
        kinetic: (k, m) momenta of velocities.
        independent: (k, m) whether constraints do not determine a coordinate, and its momentum, from others.
        errors: (2, k, m) largest differences from other runs, at least the rounding errors of the states; 0 of
            coordinates that constraints determine, where their positions differ by rounding.
        steps_of_run: (n,) initial time, and times of all saved states.
        end: last time.
        farthest: run with the largest difference.
    """

    def __init__(self, trajectory: Any, start: float, interface: Interface) -> None:
        t, states = np.asarray(trajectory.t), [trajectory.q, trajectory.p]
        self.start, self.end, steps = start, t.item(-1), len(t) - 1
        self.forward = math.copysign(1.0, self.end - start)
        self.steps_of_run = t if t[0] == start else np.insert(t, 0, start)
        m = trajectory.q.shape[1]
        count = max(LEAST_SAMPLES, min(len(t) // STEPS_PER_SAMPLE, MOST_SAMPLES, MOST_NUMBERS // m))
        rows: Any = slice(None)
        if count < steps:
            speed = np.zeros(steps)
            with np.errstate(all="ignore"):
                for columns in map(np.asarray, states):
                    largest = np.abs(columns).max(axis=0)
                    unit = np.maximum(largest, SLIGHT * largest.max() or 1.0)
                    speed = np.fmax(speed, np.abs(np.diff(columns / unit, axis=0)).max(axis=1))
                speed /= np.maximum(abs(np.diff(t)), TINY)
            size = -(-steps // count)
            parts = np.full((-(-steps // size), size), -1.0)
            parts.ravel()[:steps] = speed
            fastest = np.arange(1, steps + 1, size) + parts.argmax(axis=1)
            rows = [0, *fastest.tolist()]
            rows += [steps] if rows[-1] < steps else []
        if trajectory.modes is not None:  # momenta jump at impacts, a rounding earlier or later
            changed = {*trajectory.modes.t.tolist()} - {t[0], t[-1]}
            rows = [k for k in np.arange(len(t))[rows] if t[k] not in changed]
        self.t, self.states = t[rows], [vectors[rows] for vectors in states]
        self.epsilon, self.firsts = roundoff(interface.words), first_of_groups(interface, m)
        self.independent = np.ones(self.states[0].shape, bool)
        for row, t_row, q in zip(self.independent, self.t, self.states[0], strict=True):
            row[determined_coordinates(trajectory.stepper, np.asarray(q), float(t_row), trajectory.parameters)] = False
        self.errors = self.epsilon * self.independent * np.abs(np.array([np.asarray(x) for x in self.states]))
        self.motion: Motion | None = None
        self.farthest: Any = None
        q, p = self.states
        self.kinetic = momenta_of_velocities(trajectory.stepper, self.t, q, p, trajectory.parameters)
        plan = trajectory.plan
        self.absolute: Array | float = 0.0
        if isinstance(plan, Adaptive):
            self.absolute = absolute_tolerances(interface, m, plan.absolute_tolerance)

    def compare(self, other: Any) -> bool:
        """Compare with another run, whose differences are infinite after its end; return whether it is complete."""
        ahead = self.forward * (self.t - np.asarray(other.t)[-1])
        some = ahead <= 0.0
        differences = np.full(self.errors.shape, np.inf)
        with suppress(StepFailedError), np.errstate(all="ignore"):  # a partial step
            if some.any():
                states = other._states_at(self.t[some])
                differences[:, some] = [abs(x - y[some]) for x, y in zip(states, self.states, strict=True)]
        differences[:, ~self.independent & self.is_rounding(differences[0])] = 0.0
        before = self.largest()
        np.maximum(self.errors, differences, out=self.errors)
        self.motion = Motion(np.asarray(other.t), other.q, other.p, self.firsts, self.epsilon, self.absolute)
        if self.farthest is None or self.largest() > before:
            self.farthest = other
        return bool(np.isfinite(differences).all())

    def is_rounding(self, apart: Array) -> NDArray[np.bool_]:
        """Return (k, m) whether differences of positions are those of rounding, and not of another branch."""
        return np.asarray(apart <= ROUNDINGS * self.epsilon * np.abs(np.asarray(self.states[0])))

    def lose(self) -> None:
        """Record that a run for comparison has not ended."""
        self.errors[:, self.t != self.start] = np.inf

    def largest(self) -> float:
        """Return the largest error relative to the size of the whole motion."""
        return float(self.relative()[0].max(initial=0.0))

    def sizes(self, reached: int, errors: Array) -> Array:
        """Return (2, m) sizes of positions and momenta up to a sample, for errors of shape (2, m)."""
        assert self.motion is not None
        return self.motion.sizes(float(self.t[reached - 1]), errors, self.kinetic[:reached].max(axis=0))

    def relative(self, within: Callable[[Array], NDArray[np.bool_]] | None = None) -> tuple[Array, int]:
        """Return (k,) errors relative to the size of the motion, and up to which of them ``within`` is true.

        The size of an unconfirmed run is that up to the last confirmed time, as what follows is not known.
        """
        if self.motion is None:  # no run for comparison was necessary, or none has ended
            differences = np.where(np.isfinite(self.errors).all(axis=(0, 2)), 0.0, np.inf)
            return differences, len(self.t) if np.isfinite(differences).all() else int(np.argmax(differences))
        whole, reached = np.empty(0), len(self.t)
        while reached:
            errors = self.errors[:, :reached]
            sizes = self.sizes(reached, errors.max(axis=1))
            differences = relative(errors, sizes[:, None]).max(axis=(0, 2))
            whole = whole if whole.size else differences
            met = np.ones(reached, bool) if within is None else within(differences)
            if met.all():
                break
            reached = int(np.argmin(met))
        return whole, reached
