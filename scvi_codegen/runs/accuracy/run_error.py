"""Global error of a run, with its sign: local errors against a finer method, transported by its tangent map.

For the saved states x_k of a run, the steps phi of a finer method from each of them, and delta_0 = 0,

    delta_{k+1} = Dphi(x_k) delta_k + (x_{k+1} - phi(x_k))

is the error of x_{k+1}, up to terms of the order of delta^2 and the error of phi (E. Hairer, S. P. Norsett, G. Wanner,
Solving Ordinary Differential Equations I, II.4; R. D. Skeel, Thirteen ways to estimate global error, Numer. Math. 48
(1986) 1-20). It holds for any sequence of states: phi is one step where all states are saved, else a run at round-off
from one state to the next, over events, so that no interval ends at one. The differences need no derivatives and are
those of intervals shared by threads; the derivatives are those of the run's own method along the curves of phi. Further
vectors rho transport samples of the rounding errors of the states, u |x| with a random sign for each step of the run.
"""

from __future__ import annotations

import math
import sys
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.ir.variants import Derivatives
from scvi_codegen.common.errors import MethodError, ScviCodegenError, StateError
from scvi_codegen.common.representation import with_uncertainty
from scvi_codegen.common.thread_pool import run_jobs
from scvi_codegen.runs.accuracy.size import (
    LOST,
    RESOLVED,
    first_of_groups,
    momenta_of_velocities,
    neighbouring,
    relative,
    roundoff,
    sizes_of_motion,
)
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.results.dense_output import parameters_set_until
from scvi_codegen.runs.results.joining import concatenated
from scvi_codegen.runs.results.output import ALL_STATES
from scvi_codegen.runs.results.recomputation import motion_by_reactions, steps_after
from scvi_codegen.runs.results.saved_states import Array, SavedStates, times_of_changes
from scvi_codegen.runs.states.rotations import members_of
from scvi_codegen.runs.states.words import low_words, with_low
from scvi_codegen.runs.stepping.features import refusal, require
from scvi_codegen.runs.stepping.projection import determined_coordinates, projected
from scvi_codegen.runs.stepping.step_derivatives import Defects, Starts
from scvi_codegen.runs.stepping.step_plan import Adaptive, absolute_tolerances, ending_at

SAMPLES, DEVIATIONS = 3, 6.0
"""Samples of transported rounding errors, and how many times their root mean square a bound contains.

Along the direction that grows all are multiples of one vector by normal numbers: the ratio of another one to the root
mean square of k is Student's t with k degrees of freedom, above 6 in 0.9 % for k = 3, above 4 in 16 % for k = 1.
"""
ROUNDINGS = 1024.0
"""Errors of coordinates that constraints determine, and differences, below so many roundings are those of rounding."""
MOST_STEPS, PARTS_AT_ONCE = 8192, 16
"""Number of steps of one call of C, several times as long as the start of the threads that share such calls; calls
whose curves are in memory."""
LEFT = 1e-6
"""Relative change of transported errors that the iterations of all steps together leave, as it compounds.

A pericentre enlarges it: with 1e-3 errors of an orbit of eccentricity 0.99 are 5 to 13 times too large, with 1e-6 .2 %.
"""
CONVERGED = 1e-4
"""Defects relative to the change of momenta in a step, d, below which the finer method resolves it.

Errors of orders r and R of one motion are d and about d^(R/r): a tenth of the defect where d is 10^(-r / (R - r)), and
R - r is a quarter of r or more (``finer_method``).
"""
PART_OF_DEFECT = 1e-4
"""Of defects, which iterations of the finer method leave where no differences of its steps are taken."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunError:
    """Errors of the states of a run, ``computed - exact``, and the rounding errors that they may contain.

    Attributes:
        t: (n,) times of the states.
        q, p: (n, m) errors of positions and momenta with their signs; absolute values if ``signed`` is false. NaN at
            events that change the state, and where they are unknown.
        rounding_q, rounding_p: (n, m) standard deviations of transported rounding errors, from three samples.
        relative: (n,) largest (abs(error) + 6 rounding) / size up to each state, of all positions and momenta.
            Sizes are the ranges of the coordinates over the run (:mod:`scvi_codegen.runs.accuracy.size`).
        signed: false for errors by comparison with a run of a finer method.
        reason: why the errors are unknown from some time on, else empty.
        sizes: (2, m) sizes of positions and momenta that ``relative`` refers to.
        proportional: number of rows up to which terms of the order of squares of errors are below a tenth of these;
            later ones are lost, ``relative`` is 0.1 or more.
    """

    t: Array
    q: Array
    p: Array
    rounding_q: Array
    rounding_p: Array
    relative: Array
    signed: bool = True
    reason: str = ""
    sizes: Array = field(default_factory=lambda: np.empty(0), repr=False)
    proportional: int = sys.maxsize
    _run: Any = field(repr=False)

    def relative_until(self, rows: int) -> tuple[Array, Array]:
        """Return (2, m) sizes of the first ``rows`` states and (rows,) running maxima of relative errors."""
        bounds = np.array([part[:rows].T for part in self.bounds])
        return _relative(self._run, bounds, self.reason, self.proportional)

    def roundings(self, sizes: Array) -> Array:
        """Return the (n,) largest bounds of rounding errors relative to (2, m) sizes, 0 where they are unknown."""
        deviations = DEVIATIONS * np.stack([self.rounding_q, self.rounding_p], axis=1)
        return np.asarray(np.nan_to_num(relative(deviations, sizes).max(axis=(1, 2))))

    @property
    def lost(self) -> float | None:
        """First time at which ``relative`` is 0.1 or more, an order of magnitude only; ``None`` if there is none."""
        beyond = np.flatnonzero(~(self.relative < LOST))
        return float(self.t[beyond[0]]) if len(beyond) else None

    @property
    def arrays(self) -> dict[str, Array]:
        """The four (n, m) arrays by their names in files."""
        rounding = {"q_rounding": self.rounding_q, "p_rounding": self.rounding_p}
        return {"q_error": self.q, "p_error": self.p, **rounding}

    @property
    def bounds(self) -> tuple[Array, Array]:
        """(n, m) bounds of the absolute errors of positions and of momenta: abs(error) + 6 rounding."""
        pairs = (self.q, self.rounding_q), (self.p, self.rounding_p)
        q, p = (np.abs(error) + DEVIATIONS * np.abs(rounding) for error, rounding in pairs)
        return q, p

    def __str__(self) -> str:
        """Return the last state whose errors are known, with the uncertain digits in parentheses."""
        known = np.flatnonzero(np.isfinite(self.q).all(axis=1))
        k, interface = int(known[-1]) if len(known) else 0, self._run.stepper.interface
        names = interface.coordinates, interface.momentum_columns
        values, bounds = (np.asarray(self._run.q)[k], np.asarray(self._run.p)[k]), [part[k] for part in self.bounds]
        size = f"relative error {self.relative[k]:.1e}" if self.relative[k] != 0.0 else "no error"
        lines = [f"t = {float(self.t[k]):g}: {size}"]
        for group in zip(names, values, bounds, strict=True):
            lines += [f"{name} = {with_uncertainty(*of)}" for name, *of in zip(*group, strict=True)]
        if self.lost is not None:
            lines.append(f"no meaningful digits from t = {self.lost:g}")
        return "\n".join([*lines, self.reason] if self.reason else lines)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CorrectedStates:
    """States of a run minus their errors, on the constraints and with unit quaternions; NaN where errors are.

    Attributes:
        t: (n,) times.
        q, p, velocity: (n, m) positions, momenta and velocities.
    """

    t: Array
    q: Array
    p: Array
    velocity: Array


class WithErrors:
    """Properties of a trajectory whose global error is estimated at first access."""

    __slots__ = ()
    _error: RunError | None

    @property
    def error(self: Any) -> RunError:
        """Global errors of states since :attr:`initial`, with their signs (:class:`RunError`), made at first access.

        One step of a finer method and products with the Jacobian of the step for each step, about five times the cost
        of the run and 0.3 ms, more with constraints; a finer method is compiled once.
        docs/steps.md lists which runs have signs, which are compared with a finer run, and which are refused.

        Raises:
            MethodError, StateError: for runs whose error is not defined or not known, with the reason.
        """
        known: RunError | None = getattr(self, "_error", None)
        if known is None:
            known = error_of(self)
            self._error = known
        return known

    @property
    def corrected(self: Any) -> CorrectedStates:
        """States minus their errors, usually more accurate than the states by several digits.

        They are NaN at events and from ``run.error.lost`` on, where the states have no meaningful digits: errors above
        the motion are no correction. ``error=`` or a smaller tolerance postpone that time.

        Raises:
            StateError: if the errors have no sign.
        """
        return corrected_states(self, self.error)


@without_accuracy_warnings()
def error_of(run: Any) -> RunError:
    """Return the global error of a run; raises as :attr:`WithErrors.error`."""
    if run.observed is not None:
        raise refusal("run_error", "with observe")
    stepper = run.stepper
    require(stepper, "run_error")
    if run.modes is not None and run.modes.ambiguous:
        raise StateError(
            "the error is undefined: several motions of the contacts were consistent, and the run is one; reduce the "
            "friction, or change the geometry"
        )
    finer = finer_of(stepper)
    if _is_compared(stepper, finer):
        return _compared(run, finer)
    finer = finer.with_events(stepper.changing_events)
    return _Replay(run, finer).error()


def finer_of(stepper: Any) -> Any:
    """Return the stepper of the finer method, compiled once; MethodError if the system is not known."""
    make = (stepper.origin or stepper)._finer
    if make is None:
        raise MethodError(
            f"the error of runs of {stepper.title} requires its system, to compile a finer method: compile the stepper "
            "from the system instead of loading it"
        )
    finer = make()
    return finer if stepper.problem is None else finer._bound_to(stepper.problem)


def _is_compared(stepper: Any, finer: Any) -> bool:
    """Return whether errors are differences from a finer run: without a signed replay of single steps.

    These are steps of tau of a transformed system, double-double arithmetic, arrays of run-time sizes, and kinks that
    steps do not locate.
    """
    interface = stepper.interface
    unlocated = len(interface.kinks) > len(interface.modes) or finer.interface.mode_names != interface.mode_names
    return bool(stepper.in_tau or interface.words > 1 or stepper.origin is not None or unlocated)


def _iterating(stepper: Any, finer: Any) -> Any:
    """Return which of the steppers of a method and of the finer one finds derivatives of steps by iterations, or None.

    Newton's method, which solves constraints and rotations, factorises the equations of each step for them.
    """
    if stepper.constraints or stepper.interface.rotations:
        return None
    own = [] if stepper.interface.time_transformation is not None or stepper._lacks(Derivatives()) else [stepper]
    return next((of for of in (*own, finer) if of.tangent.constant("VECTORS_ITERATED")), None)


def _described(run: Any, errors: Array, rounding: Array, **others: Any) -> RunError:
    """Return the error of a run from (2, m, n) errors and rounding errors of positions and of momenta."""
    reason, proportional = others.get("reason", ""), others.get("proportional", sys.maxsize)
    sizes, relative_errors = _relative(run, np.abs(errors) + DEVIATIONS * rounding, reason, proportional)
    return RunError(
        t=np.asarray(run.t),
        q=errors[0].T,
        p=errors[1].T,
        rounding_q=rounding[0].T,
        rounding_p=rounding[1].T,
        relative=relative_errors,
        sizes=sizes,
        _run=run,
        **others,
    )


def _relative(run: Any, bounds: Array, reason: str, proportional: int) -> tuple[Array, Array]:
    """Return sizes and running maxima for (2, m, n) bounds of the errors of n states, NaN where they are unknown."""
    largest, last = bounds.max(axis=2), bounds.shape[2]
    if np.isnan(largest).any():
        is_known = ~np.isnan(bounds).any(axis=(0, 1))
        bounds, last = np.where(is_known, bounds, 0.0), int(np.flatnonzero(is_known)[-1]) + 1 if is_known.any() else 0
        largest = bounds.max(axis=2)
    sizes = sizes_of(run, bounds.shape[2], largest)
    entries = relative(bounds, sizes[:, :, None])
    leave_out_rounding(run, bounds, entries)
    parts = entries.max(axis=(0, 1))
    if reason:  # unknown from the last known state on
        parts[last:] = np.inf
    parts[proportional:] = np.maximum(parts[proportional:], LOST)
    return sizes, np.asarray(np.maximum.accumulate(parts))


def leave_out_rounding(run: Any, bounds: Array, entries: Array) -> None:
    """Set relative errors (2, m, n) to 0 of coordinates that constraints determine, where they are those of rounding.

    The height of a rod that swings by 1e-7 has no digits, as the constraint gives it up to rounding.
    """
    if not run.stepper.interface.constraints:
        return
    epsilon = roundoff(run.stepper.interface.words)
    tiny = bounds[0] <= ROUNDINGS * epsilon * np.abs(np.asarray(run.q)[: bounds.shape[2]].T)
    parts, so_far = np.where(tiny, entries, 0.0).max(axis=(0, 1)), np.where(tiny, 0.0, entries).max(initial=0.0)
    for k in np.flatnonzero(parts > so_far).tolist():
        if parts[k] > so_far:  # a new maximum
            determined = np.zeros(tiny.shape[0], bool)
            q, t = np.asarray(run.q[k]), float(run.t[k])
            determined[determined_coordinates(run.stepper, q, t, run.parameters_on_sides(t))] = True
            entries[:, tiny[:, k] & determined, k] = 0.0
            so_far = max(so_far, entries[:, :, k].max())


def sizes_of(run: Any, rows: int, errors: Array) -> Array:
    """Return (2, m) sizes of positions and momenta of the first ``rows`` states of a run, for errors (2, m)."""
    interface, plan, m = run.stepper.interface, run.plan, run.stepper.dimension
    absolute: Array | float = 0.0
    if isinstance(plan, Adaptive) and plan.absolute_tolerance != ():
        absolute = absolute_tolerances(interface, m, plan.absolute_tolerance)
    t, q, p = (np.asarray(column)[:rows] for column in (run.t, run.q, run.p))
    kinetic, firsts = momenta_of_velocities(run.stepper, t, q, p, run.parameters), first_of_groups(interface, m)
    by_reactions = motion_by_reactions(run, t, q, p)
    q, p = (np.ascontiguousarray(column.T) for column in (q, p))
    return sizes_of_motion(q, p, errors, kinetic, by_reactions, firsts, roundoff(interface.words), absolute)


class _Replay:
    """Replay of a run from its saved states.

    The derivatives of single steps are those of the run's own method or of the finer one, found by iterations: both
    differ by derivatives of the local error, which times delta is below terms of the order of delta^2. Where iterations
    do not converge they are differences of steps of the finer method from neighbouring states.

    Args:
        run: trajectory.
        finer: stepper of the finer method, with the events of the run that change the state.
    """

    def __init__(self, run: Any, finer: Any) -> None:
        self.run, self.finer, self.m = run, finer, run.stepper.dimension
        self.linear = _iterating(run.stepper, finer)
        self.u, self.calls, self.left = roundoff(1), 0, LEFT / max(1, run.steps)
        self.steps = max(1.0, run.steps / max(1, len(run) - 1))  # mean number between two states
        self.now = np.zeros((1 + SAMPLES, 2 * self.m))
        self.states = np.concatenate([np.asarray(run.q).T, np.asarray(run.p).T])
        self.size = np.ptp(self.states, axis=1)
        self.results = np.full((2, 2 * self.m, len(run)), np.nan)  # errors and rounding errors
        self.resolved = np.zeros(len(run), bool)  # whether a state is the end of a step that the finer method resolves

    def error(self) -> RunError:
        """Return the error of the run: lost from the row on from which it is not proportional to those before."""
        reason = self._replayed()
        vectors = self.results.reshape(2, 2, self.m, -1)
        result = _described(self.run, *vectors, reason=reason)
        if result.relative[-1] <= math.sqrt(roundoff(1)) or not self.is_smooth:
            return result
        rows = self.rows_proportional(self.results[0], result.relative)
        return result if rows == len(self.run) else _described(self.run, *vectors, reason=reason, proportional=rows)

    def _replayed(self) -> str:
        """Find errors and rounding errors of all states, NaN where unknown; return the reason for that."""
        first, (t, q, p) = 0, self.run.initial
        try:
            self._by_run(self.run, t, q, p, 0, steps=self.steps)
            self._store(0)
            for piece in self.run._runs:
                self._along(piece, first)
                first += len(piece) - 1
        except (ScviCodegenError, FloatingPointError) as failure:
            lost = not np.isnan(self.results[0, 0, 0]) and not np.abs(self.now[0]).max() <= np.abs(self.states).max()
            return f"errors are lost: {failure}" if lost else str(failure)
        return ""

    def _store(self, row: int) -> None:
        """Store the present vectors as those of a row; squares may overflow."""
        deviations = np.hypot.reduce(self.now[1:], axis=0) / math.sqrt(SAMPLES)
        self.results[:, :, row] = self.now[0], deviations

    @property
    def is_smooth(self) -> bool:
        """Return whether states that are moved by their errors are states of the same equations."""
        stepper = self.run.stepper
        changes = stepper.changes_states or stepper.interface.kinks or stepper.interface.modes
        return not (changes or stepper.constraints or stepper.interface.rotations or len(self.run._runs) > 1)

    def rows_proportional(self, errors: Array, so_far: Array) -> int:
        """Return the number of first rows whose errors (2m, n) follow from those before also without linearisation.

        delta' = x' - Phi(x - delta) for the flow Phi. A step that the finer method resolves is shorter than the scale
        of the forces, so that terms of the order of delta^2 are small beside delta where delta is small beside the
        motion in the step. Of other rows, until errors so far are ``LOST``, the first one at which the formula differs
        by more than a tenth is found by bisection, as errors grow.
        """
        states = self.states.T
        before = lengths(errors.T[:-1], self.size)
        with np.errstate(all="ignore"):
            parts = before / lengths(np.diff(states, axis=0), self.size)
        doubtful = (math.sqrt(roundoff(1)) < so_far[1:]) & (so_far[1:] < LOST) & (before > 0.0)
        rows = 1 + np.flatnonzero(doubtful & ~(self.resolved[1:] & (parts < LOST)))

        def is_nonlinear(row: int) -> bool:
            return not self._is_proportional(row, states, errors)

        checked = (*rows[np.argmax(parts[rows - 1]) :][:1].tolist(), *rows[-1:].tolist()) if len(rows) else ()
        lost = [row for row in checked if is_nonlinear(row)]
        if not lost:
            return len(states)
        first = rows[: np.searchsorted(rows, min(lost))].tolist()
        return int([*first, min(lost)][bisect_left(first, True, key=is_nonlinear)])

    def _is_proportional(self, row: int, states: Array, errors: Array) -> bool:
        """Return whether the error of a row follows from that before, up to a tenth."""
        t, end = map(float, self.run.t[row - 1 : row + 1])
        start, parameters = states[row - 1] - errors[:, row - 1], parameters_set_until(self.run, t)
        try:
            run = self.finer._run(*np.split(start, 2), plan=Adaptive(end), t=t, parameters=parameters)
            moved = self._state(run._recorded(None, ALL_STATES), -1)
        except ScviCodegenError:
            return False
        apart = np.abs(states[row] - moved - errors[:, row])
        return bool(relative(apart, self.size).max() <= LOST * relative(np.abs(errors[:, row]), self.size).max())

    def _along(self, piece: Any, first: int) -> None:
        """Find the errors of the states of a part of the run, which begins at the row ``first``."""
        special = times_of_changes(piece)
        rows = _rows_between(piece, special)
        single = self._single_steps(piece, rows, special)
        for begin, end in _alike(single):
            if single[begin]:
                self._by_steps(piece, int(rows[begin]), int(rows[end]), first)
                continue
            for k, stop in pairwise(rows[begin : end + 1].tolist()):
                start = float(piece.t[k]), piece.q[k], piece.p[k]
                self._by_run(piece, *start, stop, steps=self.steps * (stop - k))
                self._store(first + stop)

    def _single_steps(self, piece: Any, rows: NDArray[np.intp], special: Array) -> NDArray[np.bool_]:
        """Return (rows - 1,) whether the interval after a row is one step of the run in one mode."""
        with np.errstate(invalid="ignore"):
            single = np.abs(np.diff(piece.stepped)) < 1.5 * np.abs(piece.step_sizes[:-1])
        if not len(special):
            return np.asarray(single)
        begin, end = rows[:-1], rows[1:]
        single = single[begin] & (end == begin + 1)
        passed = [np.searchsorted(piece.forward * special, piece.forward * piece.t[of]) for of in (begin, end)]
        return np.asarray(single & (passed[0] == passed[1]))

    def _by_steps(self, piece: SavedStates, begin: int, end: int, first: int) -> None:
        """Transport the errors over single steps between two rows of a part that begins at the row ``first``."""
        t, h = np.ascontiguousarray(piece.t[begin:end]), np.ascontiguousarray(steps_after(piece, begin, end))
        q, p = (np.ascontiguousarray(np.asarray(column)[begin : end + 1]) for column in (piece.q, piece.p))
        starts, parameters = Starts(t, h, q, p), piece.parameters_on_sides(float(piece.t[begin]))
        for k, (part, defects) in enumerate(self._defects(starts, parameters)):
            resolved, row = defects.parts > 0, begin + k * MOST_STEPS
            for start, stop in _alike(resolved):
                if resolved[start]:
                    rows = slice(first + row + start + 1, first + row + stop + 1)
                    self.resolved[rows] = True
                    results = self.results[:, :, rows]
                    self._transport(part.part(start, stop), defects.part(start, stop), results, parameters)
                    continue
                for j in range(row + start, row + stop):
                    self._by_run(piece, float(piece.t[j]), piece.q[j], piece.p[j], j + 1, steps=1.0)
                    self._store(first + j + 1)

    def _defects(self, starts: Starts, parameters: Array) -> Iterator[tuple[Starts, Defects]]:
        """Yield parts of the steps and their defects, ``PARTS_AT_ONCE`` of which are in memory and shared by threads.

        Steps are resolved where the error of the finer method's step is a tenth of the defect, or of rounding.
        """
        parts = [starts.part(k, k + MOST_STEPS) for k in range(0, len(starts.h), MOST_STEPS)]
        limits, defects = self._limits(PART_OF_DEFECT), dict[int, Defects]()

        def find(k: int, _: object = None) -> None:
            defects[k] = self.finer._defects(here[k], parameters, self.size, limits)

        for first in range(0, len(parts), PARTS_AT_ONCE):
            here = parts[first : first + PARTS_AT_ONCE]
            if len(here) == 1:
                find(0)
            else:
                run_jobs(len(here), find, progress=None, threads=None)
            yield from ((part, defects[k]) for k, part in enumerate(here))

    def _limits(self, left: float) -> Array:
        return np.array([CONVERGED, LOST, RESOLVED * self.u, left])

    def _transport(
        self, starts: Starts, defects: Defects, results: Array, parameters: Array, steps: float = 1.0
    ) -> None:
        """Transport the errors over n steps of a method, each of so many steps of the run, into (2, 2m, n) results."""
        rounding, first, length = math.sqrt(steps) * self.u, 0, len(starts.h) if self.linear is None else 1
        while first < len(starts.h):
            if self.linear is not None:
                self.calls += 1
                rest = [of.part(first, len(starts.h)) for of in (starts, defects)]
                into = self.now, results[:, :, first:], parameters
                first += self.linear._transport_errors(*rest, *into, self.left / steps, rounding, self.calls)
            if first < len(starts.h):
                self.calls += 1
                part = starts.part(first, first + length)
                exact = self.finer._defects(part, parameters, self.size, self._limits(0.0))
                into = self.now, results[:, :, first:], parameters
                self.finer._transport_by_differences(part, exact, *into, self.size, rounding, self.calls)
                first, length = first + length, 2 * length  # so that calls are few where iterations fail again

    def _by_run(self, piece: Any, t: float, q: Array, p: Array, end: int, *, steps: float) -> None:
        """Transport the errors to a row by a run of the finer method at round-off, over the events in between."""
        stop = float(piece.t[end])
        if stop == t:
            return
        plan, parameters = ending_at(Adaptive(stop), stop), parameters_set_until(piece, t)
        run = self.finer._run(np.asarray(q), np.asarray(p), plan=plan, t=t, parameters=parameters)
        fine = run._recorded(None, ALL_STATES)
        parts = list[tuple[Starts, Defects]]()
        if not (len(times_of_changes(fine)) or (fine.modes is not None and len(fine.modes.t))):
            h, sides = steps_after(fine, 0, len(fine) - 1), fine.parameters_on_sides(t)
            times, h, x, y = (np.ascontiguousarray(of) for of in (fine.t, h, fine.q, fine.p))
            parts = [*self._defects(Starts(times, h, x, y), sides)]  # of rounding, as states have no low words
        if parts and all(defects.parts.all() for _, defects in parts):
            for part, defects in parts:
                results = np.empty((2, 2 * self.m, len(part.h)))  # of the states in between
                self._transport(part, defects, results, sides, steps / len(h))
        else:
            self.now = np.ascontiguousarray(fine.tangent(self.now.T)[-1].T)
            self.calls += 1
            normal = np.random.default_rng(self.calls).standard_normal((SAMPLES, 2 * self.m))
            self.now[1:] += math.sqrt(steps) * self.u * normal * np.abs(self._state(piece, end))
        self.now[0] += self._state(piece, end) - self._state(fine, -1)

    @staticmethod
    def _state(states: Any, k: Any) -> Array:
        return np.concatenate([np.asarray(states.q)[k], np.asarray(states.p)[k]], axis=-1)


def lengths(vectors: Array, sizes: Array) -> Array:
    """Return (n,) lengths of (n, k) vectors, parts of the sizes (k,)."""
    parts = relative(vectors, sizes)
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", parts, parts)))


def _alike(flags: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first and the last + 1 of flags in a row that are equal."""
    changes = [] if flags.all() else (np.flatnonzero(flags[1:] != flags[:-1]) + 1).tolist()
    return pairwise([0, *changes, len(flags)] if len(flags) else ())


def _rows_between(states: Any, special: Array) -> NDArray[np.intp]:
    """Return the rows of the first state and of those at none of the times ``special``."""
    t, kept = np.asarray(states.t), np.ones(len(states), bool)
    if len(special):
        near = 2.0 * RESOLVED * roundoff(1) * max(np.abs(t).max(), np.abs(special).max())
        order = np.sort(special)
        after = np.minimum(np.searchsorted(order, t), len(order) - 1)
        apart = np.minimum(np.abs(order[after] - t), np.abs(order[np.maximum(after - 1, 0)] - t))
        kept = apart > near
        kept[0] = True
    return np.flatnonzero(kept)


def _compared(run: Any, finer: Any) -> RunError:
    """Return the differences of a run from one of the finer method at round-off, without signs.

    Rounding errors are estimated by the difference of a second one whose initial state is rounded differently, once for
    each step of the run as independent ones.
    """
    finer = finer.with_events(run.stepper.changing_events)
    exact, rounded = _states_of(run, finer, np.asarray), _states_of(run, finer, neighbouring)
    growth = math.sqrt(max(1.0, run.steps))
    errors = [np.abs(np.asarray(x - y)).T for x, y in zip((run.q, run.p), exact, strict=True)]
    rounding = [growth * np.abs(np.asarray(x - y)).T for x, y in zip(exact, rounded, strict=True)]
    return _described(run, np.array(errors), np.array(rounding), signed=False)


def _states_of(run: Any, finer: Any, begin: Callable[[Any], Any]) -> tuple[Any, Any]:
    """Return (n, m) positions and momenta of the finer run at the times of a run, from ``begin`` of its start."""
    two_words, parts = finer.interface.words > 1, list[Any]()
    t, *state = run.initial
    start = [x if two_words else begin(x) for x in state]
    if two_words and begin is neighbouring:
        start = [with_low(np.asarray(x), low_words(x) + roundoff(2) * np.asarray(x)) for x in start]
    for piece in run._runs:
        end = float(piece.t[-1])
        control = Adaptive(end, float(finer.binding.function("smallest_tolerance")()) if two_words else None)
        plan = ending_at(piece.plan, end) if run.stepper.in_tau else control
        fine = finer._run(*start, plan=plan, t=t, parameters=piece.parameters)._recorded(None, ALL_STATES)
        parts.append(fine._states_at(piece.t))
        t, start = piece.t[-1], [x[-1] for x in parts[-1]]
    q, p = (concatenated(list(of)) for of in zip(*parts, strict=True))
    return q, p


def corrected_states(run: Any, error: RunError) -> CorrectedStates:
    """Return the states of a run minus their errors; raises as :attr:`WithErrors.corrected`."""
    if not error.signed:
        raise StateError("corrected requires errors with signs, but those of this run are by comparison: use run.error")
    stepper, q, p = run.stepper, np.asarray(run.q) - error.q, np.asarray(run.p) - error.p
    q[~(error.relative < LOST)] = p[~(error.relative < LOST)] = np.nan
    for member in members_of(stepper.dimension, stepper.interface.rotations):
        if member.kind != "spin":  # unit quaternions and directions: p is tangent to their sphere
            unit = q[:, member.columns] / np.linalg.norm(q[:, member.columns], axis=1, keepdims=True)
            along = np.sum(unit * p[:, member.columns], axis=1, keepdims=True)
            q[:, member.columns], p[:, member.columns] = unit, p[:, member.columns] - along * unit
    velocity = np.full_like(q, np.nan)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)).tolist():
        parameters = run.parameters_on_sides(float(run.t[k]))
        q[k], p[k], _ = projected(stepper, q[k], p[k], float(run.t[k]), parameters)
        velocity[k] = stepper.velocity(q[k], p[k], float(run.t[k]), parameters)
    return CorrectedStates(
        t=np.asarray(run.t), q=stepper.named(q), p=stepper.named(p), velocity=stepper.named(velocity)
    )
