"""Global error bound of adaptive runs, ``error=``: local tolerances are reduced until ``run.error`` is below it.

A run of the tolerance ``error / 100`` is judged by its global error (:mod:`.run_error`), which the next tolerance
follows from, as the error is proportional to it. Forces so narrow that the run and its judge pass over them are sought
in short pieces of its steps (:mod:`.narrow_forces`), and limit the steps of further runs. The last run has the accuracy
of round-off; what its error exceeds is confirmed until the time at which it does.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.option_table import OPTION, check_agreement
from scvi_codegen.common.errors import AccuracyWarning, ScviCodegenError, StateError, StepFailedError, warn
from scvi_codegen.runs.accuracy.narrow_forces import differences_in_pieces, longest_piece
from scvi_codegen.runs.accuracy.run_error import DEVIATIONS, ROUNDINGS, RunError, leave_out_rounding
from scvi_codegen.runs.accuracy.size import LOST, relative, roundoff
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted, without_accuracy_warnings
from scvi_codegen.runs.nouns import Execution, Save
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.stepping.step_plan import Span, Steps

Array = NDArray[np.float64]

PART_OF_STEP, GOAL = 0.01, 0.5
"""Parts of the bound: the error of a single step, which others add to, and the error that the next run aims at."""
LARGE_REDUCTION = 1e-3
"""Ratio of successive tolerances where the error is ``LOST``, and not proportional to them."""
MOST_RUNS, LEAST = 5, (1e-16, 1e-30)
"""Largest number of runs; tolerances of one and two words below which runs are at round-off."""
MOST_EXAMINATIONS, FINER_PIECES = 2, 0.0625
"""Searches for narrow forces; ratio of their pieces, the second one where the first one finds some."""
ROUNDINGS_OF_RESULT = 10.0
"""Smallest estimate in roundings."""
UNEVEN = 30.0
"""Ratio of the longest to the shortest step from which on a time transformation is recommended."""
NAMES_OF_PRECISIONS = {1: "double", 2: "double-double"}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GlobalError:
    """Bound of the global error of a run, and how far it is confirmed.

    Attributes:
        requested: requested bound of the relative global error.
        tolerance: local tolerance of the returned run; ``None`` for round-off.
        h: step of tau of a run in transformed time, else ``None``.
        estimate: largest relative error of the run, of first order, with its rounding errors, ``run.error.relative`` at
            the end, at least ten roundings; an order of magnitude only above 0.01, infinite where it is unknown.
        confirmed_until: last of the times up to which the error, relative to the size of the motion until then, is at
            most the requested one.
        runs: number of runs.
        precision: ``"double"`` or ``"double-double"``.
        max_step: largest step of the returned run, limited where forces are narrow.
        reason: why the error is unknown from ``confirmed_until`` on, else empty.
    """

    requested: float
    tolerance: float | None
    h: float | None
    estimate: float
    confirmed_until: float
    runs: int
    precision: str = "double"
    max_step: float = math.inf
    reason: str = ""

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
    """Properties of a trajectory whose global error was bounded (``error=``)."""

    __slots__ = ()
    confirmation: GlobalError | None

    @property
    def global_error(self) -> float:
        """Relative error of all states, of the run, :class:`GlobalError`; NaN without ``error=``."""
        return math.nan if self.confirmation is None else self.confirmation.estimate

    @property
    def confirmed_digits(self) -> int | None:
        """Number of decimal digits of all states that are confirmed; ``None`` without ``error=``."""
        return None if self.confirmation is None else self.confirmation.digits

    @property
    def confirmed_until(self) -> float:
        """Time until which the error asked for is confirmed; NaN without ``error=``."""
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
        """(k,) numbers of decimal digits of all states that are confirmed; 0 where there is none."""
        return self._of_each("digits", 0).astype(np.int64)

    @property
    def confirmed_until(self) -> Array:
        """(k,) times until which the error asked for is confirmed; NaN where there is none."""
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


def checked_error(steps: Steps, span: Span, stepper: Any) -> Steps:
    """Return the steps with the checked error; StateError if it is unattainable or another option sets step sizes."""
    check_agreement({"error": steps.error, "h": steps.h, "steps": span.steps, "tolerance": steps.tolerance})
    bound: float = OPTION["error"].checked(steps.error)
    words = max(stepper.interface.words, 1 + (stepper._precise is not None))
    if bound < (least := smallest_estimate(words)):
        remedy = ", or precision='double-double'" if words == 1 else ""
        raise StateError(
            f"{OPTION['error']} = {bound:g} is below {least:.1e}, the least error that {NAMES_OF_PRECISIONS[words]} "
            f"arithmetic confirms: give a larger one{remedy}"
        )
    return steps._replace(error=bound)


def smallest_estimate(words: int) -> float:
    """Return the smallest estimate of an error of states of one or two words."""
    return ROUNDINGS_OF_RESULT * roundoff(words)


def warn_of_unconfirmed_run(trajectory: Any) -> None:
    """Issue a warning for a run whose requested global error is not confirmed."""
    result: GlobalError = trajectory.confirmation
    if result.confirmed or not warnings_wanted():
        return
    at_start = result.confirmed_until == float(trajectory.t[0])
    until = "at no time" if at_start else f"until t = {result.confirmed_until:.6g} only"
    why = f" ({result.reason})" if result.reason else f": that of the run is up to about {result.estimate:.1e}"
    ways = ["end the run there"] * (not at_start) + ["give a larger error"] * (not result.reason)  # else it is unknown
    remedy = (", or ".join(ways) + _alternative(trajectory, result)).removeprefix("; or ")
    remedy = f" {remedy[:1].upper()}{remedy[1:]}" if remedy else ""
    if (trajectory.stepper.origin or trajectory.stepper)._finer is None:  # loaded: no bound is confirmed
        remedy = " A package has a model.toml: load_model(..).stepper()"
    warn(f"the global error {result.requested:g} is confirmed {until}{why}.{remedy}", AccuracyWarning)


def _alternative(trajectory: Any, result: GlobalError) -> str:
    """Return a further remedy: for kinks, times far from 0, or by a time transformation of conservative motions."""
    latest = float(abs(trajectory.t).max())
    if math.ulp(latest) > result.requested * float(np.ptp(trajectory.t)):
        return f"; or begin at t = 0: at t = {latest:g} times are rounded by {math.ulp(latest):.1e}"
    if kinks := trajectory.stepper.interface.kinks:
        return (
            "; or give max_step=, a tenth of the shortest pulse or contact, or, without error=, events there "
            f"(sc.impact, sc.Event(.., then=)): the equations are not smooth where {kinks[0]} = 0"
        )
    lengths = abs(trajectory.step_sizes[:-1])
    lengths = lengths[np.isfinite(lengths)][:-1]  # t_end shortens the last step
    suitable = result.h is None and trajectory.stepper.interface.conserves_energy and result.estimate < LOST
    if not suitable or not lengths.size or lengths.max() < UNEVEN * lengths.min():
        return ""
    return (
        f"; or try a time transformation (reparametrise), whose errors are often smaller in close encounters: the "
        f"longest step is {lengths.max() / lengths.min():.0f} times the shortest"
    )


def _is_better(one: GlobalError, other: GlobalError, start: float) -> bool:
    """Return whether one result is better: of two without digits at the end, that which is confirmed for longer."""
    if min(one.estimate, other.estimate) < LOST:
        return one.estimate <= other.estimate
    return abs(one.confirmed_until - start) >= abs(other.confirmed_until - start)


class Runs:
    """Runs of one motion by one stepper that differ in their steps, one of which is returned with its global error.

    Args:
        initial, end: initial data and final time.
        asked: the error, and absolute tolerance, largest and first step of all runs.
        save: states of the returned run to save; ``progress`` is called in each run.
        inputs: validated inputs by name, or ``None``.
    """

    def __init__(self, stepper: Any, initial: Initial, asked: Steps, end: float, save: Save, inputs: Any) -> None:
        self.stepper, self.initial, self.asked, self.end = stepper, initial, asked, end
        self.save, self.inputs = save, inputs
        self.requested, interface = cast(float, asked.error), stepper.interface
        self.words, self.has_tau = interface.words, stepper._has_tau
        self.is_examined = not (self.has_tau or interface.kinks or self.words > 1)
        self.examinations, self.largest, self.count = 0, math.inf, 0

    @without_accuracy_warnings()
    def confirmed_run(self) -> Any:
        """Return the run whose global error is at most ``requested``, or the most accurate one.

        Raises:
            StepFailedError: if all runs fail.
        """
        tolerance: float | None = PART_OF_STEP * self.requested
        best, failure, run = None, None, None
        while self.count < MOST_RUNS:
            is_last = self.count == MOST_RUNS - 1
            tolerance = None if is_last or tolerance is None or tolerance < LEAST[self.words - 1] else tolerance
            try:
                run = self._run(tolerance)
            except StepFailedError as failed:
                failure, result, run = failed, None, None
            else:
                result = run.confirmation
                if result.confirmed and self._passes_over_forces(run):
                    run.confirmation = replace(result, estimate=math.inf, confirmed_until=float(run.t[0]))
                    best = run if best is None else best
                    continue
                if best is None or _is_better(result, best.confirmation, float(run.t[0])):
                    best = run
            if tolerance is None or (result is not None and (result.confirmed or result.reason)):
                break
            tolerance = None if self._is_rounded(run) else tolerance * self._reduction(result)
        if best is None:
            assert failure is not None  # of the last run
            raise failure
        best.confirmation = replace(best.confirmation, runs=self.count)
        return self._with_output(best)

    def _is_rounded(self, run: Any) -> bool:
        """Return whether the rounding errors of a run alone exceed the bound, which no tolerance reduces."""
        if run is None or (error := run._error) is None:
            return False
        rounding = np.nanmax(np.array([error.rounding_q, error.rounding_p]), axis=1)
        return bool(DEVIATIONS * relative(rounding, error.sizes).max() > self.requested)

    def _reduction(self, result: GlobalError | None) -> float:
        """Return the ratio of the next tolerance to that of a run, or of one that failed."""
        if result is None or not result.estimate < LOST:
            return LARGE_REDUCTION
        return float(GOAL * self.requested / result.estimate)

    def _steps(self, tolerance: float | None) -> dict[str, float | None]:
        if self.has_tau:
            least = roundoff(self.words) if tolerance is None else tolerance
            return {"h": self.stepper._step_of_tau(self.initial, self.end, least)}
        limit = {} if self.largest == math.inf else {"max_step": self.largest}
        return {"tolerance": tolerance, **limit}

    def _integrated(self, save: Save, **steps: Any) -> Any:
        """Return a run by these steps that saves these states."""
        if "max_step" in steps and self.asked.max_step is not None:
            steps["max_step"] = min(steps["max_step"], self.asked.max_step)
        size, way = self.asked._replace(error=None, **steps), Execution(inputs=self.inputs, check_growth=False)
        return self.stepper._integrate(self.initial, size, Span(t_end=self.end), save, way)

    def _run(self, tolerance: float | None) -> Any:
        """Return a run with all states and its confirmation."""
        steps = self._steps(tolerance)
        run = self._integrated(Save(progress=self.save.progress), **steps)
        self.count += 1
        h, floor, start = steps.get("h"), smallest_estimate(self.words), float(run.t[0])
        estimate, until, reason = math.inf, start, ""
        try:
            error = run.error
        except ScviCodegenError as refused:
            reason = str(refused)
        else:
            missed = 0.0 if run.modes is None else run.modes.missed
            floor = max(floor, missed)
            estimate = max(float(error.relative[-1]), floor)
            until, reason = self._confirmed_until(error, floor), error.reason
        run.confirmation = GlobalError(
            requested=self.requested,
            tolerance=tolerance,
            h=h,
            estimate=estimate,
            confirmed_until=until,
            runs=self.count,
            precision=NAMES_OF_PRECISIONS[self.words],
            max_step=self.largest,
            reason=reason,
        )
        return run

    def _confirmed_until(self, error: RunError, floor: float) -> float:
        """Return the time up to which errors are at most ``requested`` parts of the motion until then.

        The size of a motion that is not confirmed is that up to the last confirmed time, as what follows is not known.
        """
        relative, rows = error.relative, len(error.t)
        while rows > 1:
            met = np.maximum(relative, floor) <= self.requested
            if met.all():
                break
            rows = int(np.argmin(met))
            relative = error.relative_until(rows)[1] if rows else relative
        return float(error.t[max(rows - 1, 0)])

    def _passes_over_forces(self, run: Any) -> bool:
        """Return whether a run passes over forces, which its steps in pieces meet; further runs have smaller steps."""
        if not self.is_examined or self.examinations == MOST_EXAMINATIONS or self.count == MOST_RUNS:
            return False
        start, end = float(run.t[0]), float(run.t[-1])
        size = longest_piece(run, self.end - start) * FINER_PIECES**self.examinations
        self.examinations += 1
        rounding = roundoff(1) * max(1.0, max(abs(start), abs(end)) / abs(end - start))  # also of times
        bound = max(PART_OF_STEP * self.requested, ROUNDINGS * rounding)
        apart = differences_in_pieces(run, size, bound)
        if not apart.any():
            return False
        entries = relative(apart, run.error.sizes)[..., None]
        leave_out_rounding(run, apart[..., None], entries)
        if entries.max() <= bound:
            return False
        self.largest = size
        return True

    def _with_output(self, run: Any) -> Any:
        """Return the states of a run that were asked for, with its confirmation."""
        if self.save.save_every == 1 and self.save.t_eval is None:
            return run
        result = replace(run.confirmation, runs=self.count + 1)
        saved = self._integrated(self.save, **result.steps)
        saved.confirmation = result
        return saved
