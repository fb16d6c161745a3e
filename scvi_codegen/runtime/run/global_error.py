"""Global error of an adaptive run, estimated by a second run and controlled by the local tolerance.

A run with a small local tolerance is compared with runs of other steps: their tolerances are 30 and 300 times larger,
and they begin in states changed in the last place. The differences are dominated by the errors of the others; the
largest, times a safety factor, is the estimate for the first run, which is returned. While the estimate exceeds the
wanted error, the tolerances are tightened; the last runs are as accurate as binary64 allows, and what they do not
confirm stays unconfirmed. Where rounding dominates, all runs have errors of the same size, and there are three others:
one run with nearly the same error is not rare, three are. (R. D. Skeel, Thirteen ways to estimate global error, Numer.
Math. 48 (1986) 1-20; E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.4.)
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.runtime.run.accuracy import warnings_wanted, without_accuracy_warnings

Array = NDArray[np.float64]
Result = TypeVar("Result")

FIRST = 1e-4
"""First local tolerance relative to the wanted error."""
TRUNCATED, ROUNDED = (300.0, 30.0), (300.0, 30.0, 100.0)
"""Tolerances of the other runs relative to that of the returned one, where steps or where rounding dominates errors."""
DOMINATED, LEAST = 1e-12, 1e-17
"""Tolerances of the returned run below which rounding may dominate, and below which the last runs are made."""
FINEST, LAST, RELAXED = 1e-20, (0.0, 1e-18, 1e-19), (1e-14, 1e-15, 1e-16)
"""Tolerances of the last runs (0: round-off): of the returned one and the others; of the others if that one fails."""
LARGEST_CUT, MARGIN = 1e-4, 0.1
"""Tolerances are reduced by no more than this factor at once; part of the wanted error that is aimed at."""
SAFETY = 5.0
"""Factor between the largest difference and the estimate."""
NUDGE = 2.0**-52
"""Relative change of the initial states of the other runs: the last place."""
MOST_SAMPLES, MOST_NUMBERS = 512, 2**22
"""Times at which two runs are compared: their number, and that times the number of coordinates."""
EARLY = 1.0 / 16.0
"""Part of the run whose largest state sets the least size that errors are relative to."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalError:
    """Differences between a run and others with different steps, and the estimate of its global error.

    Attributes:
        requested: requested bound of the relative global error.
        tolerance: local tolerance of the returned run, 0 for round-off.
        t: (n,) times at which the runs were compared: at most 512 of the saved states.
        differences: (n,) the larger of ``|dq| / |q|`` and ``|dp| / |p|``. The norms are the largest up to that time, at
            least those of the first sixteenth of the run.
        estimate: five times the largest difference, at least the unit round-off; meaningless above about 0.1, where the
            runs are uncorrelated.
        confirmed_until: last time up to which five times each difference is at most the requested error.
        runs: number of runs.
    """

    requested: float
    tolerance: float
    t: Array
    differences: Array
    estimate: float
    confirmed_until: float
    runs: int

    @property
    def confirmed(self) -> bool:
        """Return whether the requested error is confirmed for the whole run."""
        return self.estimate <= max(self.requested, float(np.finfo(float).eps))

    @property
    def local_tolerance(self) -> float | None:
        """``tolerance`` as :meth:`Stepper.integrate` takes it: ``None`` for round-off."""
        return self.tolerance or None

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


def checked_error(error: Any, others: Mapping[str, Any], *, has_tau: bool = False) -> float:
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
    if has_tau:
        raise StateError(
            f"error={wanted:g} requires adaptive steps, but a time transformation has fixed steps in tau: omit error "
            "and compare with a run of half the step size"
        )
    return wanted


def _nudged(values: Any, number: int) -> Any:
    """Return an initial vector, or several by name, perturbed by one to three last places, differently for each run."""
    if values is None:
        return None
    if isinstance(values, Mapping):
        return {name: _nudged(each, number) for name, each in values.items()}
    numbers = np.array(values, dtype=float)
    signs = np.sign(np.cos(np.arange(numbers.size) + 2.0 * number)).reshape(numbers.shape)
    return numbers * (1.0 + (number + 1) * NUDGE * signs)


def confirmed_run(
    wanted: float,
    integrate: Callable[..., Result],
    again: Callable[..., Result],
    state: tuple[Any, Any, Any],
    common: Mapping[str, Any],
    output_arguments: Mapping[str, Any],
) -> Result:
    """Return the run whose global error is at most ``wanted``, or the most accurate one with a warning.

    Args:
        wanted: bound of the relative global error.
        integrate: function that makes the returned run.
        again: function that makes the runs for comparison, without events.
        state: q, and p or the velocity.
        common: arguments of both, including the initial time ``t``.
        output_arguments: arguments of the returned run only: its end and its output options.

    Raises:
        StepFailedError: if the most accurate run fails.
    """
    q, p, velocity = state
    start = checked_number(common["t"], "the time t")

    def tight(tolerance: float) -> Result:
        return integrate(q, p, velocity=velocity, tolerance=tolerance or None, **common, **output_arguments)

    def other(tolerance: float, number: int, end: float) -> Result:
        nearby, moving = _nudged(p, number), _nudged(velocity, number)
        return again(_nudged(q, number), nearby, velocity=moving, tolerance=tolerance or None, t_end=end, **common)

    tolerance, runs = wanted * FIRST, 0
    with without_accuracy_warnings():
        while True:
            last, runs = tolerance < LEAST, runs + 1
            trajectory, tolerance, others = _accurate(tight, tolerance, last=last)
            result = None
            for number, each in enumerate(others if trajectory is not None else ()):
                compared = _compared(partial(other, each, number), trajectory, start)
                result, runs = _estimated(wanted, tolerance, compared, result, start, runs + 1), runs + 1
                if not (result.confirmed or last):
                    break
            if result is not None and (result.confirmed or last):
                break
            excess = math.inf if result is None else result.estimate / wanted
            tolerance *= max(min(MARGIN, MARGIN / excess), LARGEST_CUT)
    if not result.confirmed and warnings_wanted():
        until = f"confirmed until t = {result.confirmed_until:.6g} only"
        warn(
            f"the global error {wanted:g} is {until}: beyond it, runs with other steps and initial states perturbed in "
            f"the last place differ by up to about {result.estimate:.1e}. End the run there, or give a larger error",
            AccuracyWarning,
        )
    return cast(Result, replace(cast(Any, trajectory), confirmation=result))


def _accurate(
    run: Callable[[float], Result], tolerance: float, *, last: bool
) -> tuple[Result | None, float, tuple[float, ...]]:
    """Return a run, its tolerance (which may differ from the requested one) and the tolerances of the other runs.

    ``None`` if the run fails while smaller tolerances remain.
    """
    others = LAST if last else tuple(tolerance * each for each in (ROUNDED if tolerance < DOMINATED else TRUNCATED))
    tolerance = FINEST if last else tolerance
    try:
        return run(tolerance), tolerance, others
    except StepFailedError:
        return (run(0.0), 0.0, RELAXED) if last else (None, tolerance, ())


def _compared(run: Callable[[float], Any], trajectory: Any, start: float) -> tuple[Array, Array]:
    """Return times, and the relative differences of the returned run and another one that ends at the last time."""
    q, p = np.asarray(trajectory.q), np.asarray(trajectory.p)
    most = max(2, min(MOST_SAMPLES, MOST_NUMBERS // q.shape[1]))
    chosen = np.unique(np.linspace(0, len(trajectory.t) - 1, most).astype(int))
    t, q, p = trajectory.t[chosen], q[chosen], p[chosen]
    end = float(t[-1])
    if end == start:
        return t, np.zeros(len(t))
    try:
        first = run(end)
    except StepFailedError as failure:
        if failure.trajectory is None:
            raise
        first = failure.trajectory
    forward = math.copysign(1.0, end - start)
    reached = (forward * (t - first.t[-1]) <= 0.0) & (forward * (t - first.t[0]) >= 0.0)
    differences = np.full(len(t), np.inf)
    if reached.any():
        moved = first.at(t[reached])
        early = abs(t - start) <= EARLY * abs(end - start)
        parts = [_relative(a, b[reached], _sizes(b, early)[reached]) for a, b in zip(moved, (q, p), strict=True)]
        differences[reached] = np.maximum(*parts)
    return t, differences


def _sizes(states: Array, early: NDArray[np.bool_]) -> Array:
    """Return the largest norm up to each state, at least that of the early states."""
    norms = _norms(states)
    return np.maximum.accumulate(np.maximum(norms, norms[early].max(initial=0.0)))


def _norms(rows: Array) -> Array:
    """Return the norm of each row, scaled so that squares neither overflow nor underflow."""
    units = abs(rows).max(axis=1, initial=0.0)
    with np.errstate(invalid="ignore"):
        return np.asarray(units * np.linalg.norm(rows / np.where(units == 0.0, 1.0, units)[:, None], axis=1))


def _relative(one: Array, other: Array, sizes: Array) -> Array:
    apart = _norms(one - other)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(apart == 0.0, 0.0, apart / sizes)


def _estimated(
    wanted: float, tolerance: float, compared: tuple[Array, Array], before: GlobalError | None, start: float, runs: int
) -> GlobalError:
    """Return the error estimate from these differences and those of earlier comparisons."""
    t, differences = compared
    if before is not None:
        differences = np.maximum(differences, before.differences)
    largest = float(differences.max(initial=0.0))
    within = SAFETY * differences <= wanted
    reached = len(within) if within.all() else int(np.argmin(within))
    return GlobalError(
        requested=wanted,
        tolerance=tolerance,
        t=t,
        differences=differences,
        estimate=math.inf if math.isnan(largest) else max(SAFETY * largest, float(np.finfo(float).eps)),
        confirmed_until=float(t[reached - 1]) if reached else start,
        runs=runs,
    )
