"""Global error of a run, with its sign: beside its states, those of a finer method.

For the saved states x_k of a run and the steps phi of a finer method, which have the sizes of those of the run,

    y_{k+1} = phi(y_k),    delta_k = x_k - y_k,    y_0 = x_0

is the error of x_k, up to that of phi (E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I,
II.4). As delta_{k+1} = x_{k+1} - phi(x_k - delta_k) it follows from any sequence of states: phi is one step where all
states are saved, else a run at round-off from one state to the next, over events, so that no interval ends at one.
Samples rho of rounding errors are transported by the derivatives of steps. Sums have low words, forces are those at
rounded positions: rho' = D phi (rho + d) - d + r, d = .42 u |q| and r = u |x' - x| with random signs; in steps that
constraints, events or Newton's method take, rho' = D phi rho + u |x|.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.ir.variants import Derivatives
from scvi_codegen.common.errors import MethodError, ScviCodegenError, StateError, StepFailedError
from scvi_codegen.common.representation import with_uncertainty
from scvi_codegen.runs.accuracy.size import (
    LOST,
    RESOLVED,
    first_of_groups,
    momenta_of_velocities,
    relative,
    roundoff,
    sizes_of_motion,
)
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.results.dense_output import parameters_set_until
from scvi_codegen.runs.results.joining import concatenated
from scvi_codegen.runs.results.recomputation import motion_by_reactions, steps_after
from scvi_codegen.runs.results.saved_states import Array, SavedStates, times_of_changes
from scvi_codegen.runs.states.rotations import members_of
from scvi_codegen.runs.states.words import sum_of
from scvi_codegen.runs.stepping.features import refusal, require
from scvi_codegen.runs.stepping.projection import determined_coordinates, projected
from scvi_codegen.runs.stepping.step_derivatives import Curves, Starts
from scvi_codegen.runs.stepping.step_plan import Adaptive, absolute_tolerances, ending_at

SAMPLES, DEVIATIONS = 3, 6.0
"""Samples of transported rounding errors, and how many times their root mean square a bound contains.

Along the direction that grows all are multiples of one vector by normal numbers: the ratio of another one to the root
mean square of k is Student's t with k degrees of freedom, above 6 in 0.9 % for k = 3, above 4 in 16 % for k = 1.
"""
ROUNDINGS = 1024.0
"""Errors of coordinates that constraints determine, and differences, below so many roundings are those of rounding."""
MOST_STEPS, PIECES = 8192, 16
"""Number of steps of one call of C, whose curves are in memory; times at which compared runs are rounded."""
LEFT = 1e-6
"""Relative change of transported errors that the iterations of all steps together leave, as it compounds."""
CONVERGED = 1e-4
"""Changes of errors relative to the change of momenta in a step, d, below which the finer method resolves it.

Errors of orders r and R of one motion are d and about d^(R/r): a tenth of the first where d is 10^(-r / (R - r)), and
R - r is a quarter of r or more (``finer_method``). Iterations of the finer method leave a tenth of it, ``LOST``.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunError:
    """Errors of the states of a run, ``computed - exact``, and the rounding errors that they may contain.

    Attributes:
        t: (n,) times of the states.
        q, p: (n, m) errors of positions and momenta with their signs. NaN at events that change the state, and where
            they are unknown.
        rounding_q, rounding_p: (n, m) standard deviations of transported rounding errors, from three samples.
        relative: (n,) largest (abs(error) + 6 rounding) / size up to each state, of all positions and momenta.
            Sizes are the ranges of the coordinates over the run (:mod:`scvi_codegen.runs.accuracy.size`).
        reason: why the errors are unknown from some time on, else empty.
        sizes: (2, m) sizes of positions and momenta that ``relative`` refers to.
    """

    t: Array
    q: Array
    p: Array
    rounding_q: Array
    rounding_p: Array
    relative: Array
    reason: str = ""
    sizes: Array = field(default_factory=lambda: np.empty(0), repr=False)
    _run: Any = field(repr=False)

    def relative_until(self, rows: int) -> tuple[Array, Array]:
        """Return (2, m) sizes of the first ``rows`` states and (rows,) running maxima of relative errors."""
        bounds = np.array([part[:rows].T for part in self.bounds])
        return _relative(self._run, bounds, self.reason)

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
        of the run and 0.3 ms; a finer method is compiled once. docs/theory/steps.md lists which runs are refused.

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


def _described(run: Any, errors: Array, rounding: Array, reason: str = "") -> RunError:
    """Return the error of a run from (2, m, n) errors and rounding errors of positions and of momenta."""
    sizes, relative_errors = _relative(run, np.abs(errors) + DEVIATIONS * rounding, reason)
    return RunError(
        t=np.asarray(run.t),
        q=errors[0].T,
        p=errors[1].T,
        rounding_q=rounding[0].T,
        rounding_p=rounding[1].T,
        relative=relative_errors,
        reason=reason,
        sizes=sizes,
        _run=run,
    )


def _relative(run: Any, bounds: Array, reason: str) -> tuple[Array, Array]:
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
    return sizes, np.asarray(np.maximum.accumulate(parts))


def leave_out_rounding(run: Any, bounds: Array, entries: Array) -> None:
    """Set relative errors (2, m, n) to 0 of coordinates that constraints determine, where they are those of rounding.

    The height of a rod that swings by 1e-7 has no digits, as the constraint gives it up to rounding. They are those of
    the state at which errors of rounding are the largest, if these exceed others.
    """
    if not run.stepper.interface.constraints:
        return
    epsilon = roundoff(run.stepper.interface.words)
    tiny = bounds[0] <= ROUNDINGS * epsilon * np.abs(np.asarray(run.q)[: bounds.shape[2]].T)
    parts = np.where(tiny, entries, 0.0).max(axis=(0, 1))
    k = int(np.argmax(parts))
    if parts[k] > np.where(tiny, 0.0, entries).max(initial=0.0):
        determined = np.zeros(tiny.shape[0], bool)
        q, t = np.asarray(run.q[k]), float(run.t[k])
        determined[determined_coordinates(run.stepper, q, t, run.parameters_on_sides(t))] = True
        entries[:, tiny & determined[:, None]] = 0.0


def sizes_of(run: Any, rows: int, errors: Array) -> Array:
    """Return (2, m) sizes of positions and momenta of the first ``rows`` states of a run, for errors (2, m)."""
    interface, plan, m = run.stepper.interface, run.plan, run.stepper.dimension
    absolute: Array | float = 0.0
    if isinstance(plan, Adaptive) and plan.absolute_tolerance != ():
        absolute = absolute_tolerances(interface, m, plan.absolute_tolerance)
    t, q, p = (np.asarray(column)[:rows] for column in (run.t, run.q, run.p))
    of_q, of_p = np.ascontiguousarray(q.T), np.ascontiguousarray(p.T)
    kinetic, firsts = momenta_of_velocities(run.stepper, t, q, p, run.parameters), first_of_groups(interface, m)
    by_reactions = motion_by_reactions(run, t[:1], q[:1], p[:1])
    if not (np.ptp(of_q, axis=1) > math.sqrt(roundoff(1)) * by_reactions[0]).all():  # may be rounding of these
        by_reactions = motion_by_reactions(run, t, q, p)
    return sizes_of_motion(of_q, of_p, errors, kinetic, by_reactions, firsts, roundoff(interface.words), absolute)


class _Replay:
    """Replay of a run from its saved states.

    The derivatives of single steps are those of the run's own method or of the finer one, found by iterations, or where
    these do not converge by differences of its steps from neighbouring states: rounding errors are estimated, so that
    it does not matter which.

    Args:
        run: trajectory.
        finer: stepper of the finer method, with the events of the run that change the state.
    """

    def __init__(self, run: Any, finer: Any) -> None:
        self.run, self.finer, self.m = run, finer, run.stepper.dimension
        self.linear, self.along_finer = _iterating(run.stepper, finer), bool(run.stepper.interface.time_transformation)
        self.u, self.calls, self.left = roundoff(1), 0, LEFT / max(1, run.steps)
        self.steps = max(1.0, run.steps / max(1, len(run) - 1))  # mean number between two states
        self.now, self.samples = np.zeros(2 * self.m), np.zeros((SAMPLES, 2 * self.m))  # at the present state
        self.size = np.ptp(np.concatenate([np.asarray(run.q).T, np.asarray(run.p).T]), axis=1)
        self.results = np.full((2, 2 * self.m, len(run)), np.nan)  # errors and rounding errors

    def error(self) -> RunError:
        """Return the error of the run."""
        reason = self._replayed()
        errors, rounding = self.results.reshape(2, 2, self.m, -1)
        if not reason and len(self.run) > 1 and np.isnan(errors[0, 0, 1:]).all():
            reason = "errors are unknown: events change all states after the first (max_step= saves others)"
        return _described(self.run, errors, rounding, reason)

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
            largest = np.abs(np.concatenate([np.asarray(self.run.q), np.asarray(self.run.p)], axis=1)).max(axis=0)
            lost = not np.isnan(self.results[0, 0, 0]) and not np.abs(self.now).max() <= largest.max()
            return f"errors are lost: {failure}" if lost else str(failure)
        return ""

    def _store(self, row: int) -> None:
        """Store the present errors as those of a row; squares may overflow."""
        self.results[:, :, row] = self.now, np.hypot.reduce(self.samples, axis=0) / math.sqrt(SAMPLES)

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
        """Find errors over single steps between two rows of a part that begins at the row ``first``.

        A step that no number of parts of the finer one resolves, or no difference, is one run of it.
        """
        t, h = np.ascontiguousarray(piece.t[begin:end]), np.ascontiguousarray(steps_after(piece, begin, end))
        q, p = (np.ascontiguousarray(np.asarray(column)[begin : end + 1]) for column in (piece.q, piece.p))
        starts, parameters = Starts(t, h, q, p), piece.parameters_on_sides(float(piece.t[begin]))
        k, limits = 0, np.array([CONVERGED, LOST, RESOLVED * self.u, LOST * CONVERGED])
        while k < len(h):
            part, row = starts.part(k, k + MOST_STEPS), first + begin + k + 1
            results = self.results[:, :, row : row + len(part.h)]
            steps, curves = self.finer._errors(part, parameters, self.size, limits, self.now, results[0])
            if steps:
                part = part.part(0, steps)
                along, errors = Starts(part.t, part.h, part.q.copy(), part.p.copy()), results[0, :, :steps].T
                for states, columns in ((along.q, slice(self.m)), (along.p, slice(self.m, None))):
                    states[0] -= self.now[columns]
                    states[1:] -= errors[:, columns]
                steps = self._transport(along, along if self.along_finer else part, curves, results[1], parameters)
                self.now = errors[steps - 1].copy() if steps else self.now
            k += steps
            if steps < len(results[0, 0]):
                self._by_run(piece, float(t[k]), q[k], p[k], begin + k + 1, steps=1.0)
                self._store(row + steps)
                k += 1

    def _transport(
        self,
        along: Starts,
        starts: Starts,
        curves: Curves | None,
        deviations: Array,
        parameters: Array,
        steps: float = 1.0,
    ) -> int:
        """Transport rounding errors over n steps, into (2m, n) deviations; return the number of steps.

        These are fewer where a step from a neighbouring state is not solved, as where a slip is about to stop.

        Iterations find the derivatives along the finer method, whose curves begin at its own states: along points that
        combine a state of the run with forces of another one, the products of derivatives grow.

        Args:
            along: steps of the finer method.
            starts: those of the run, where iterations fail; of the finer method if there are no ``curves``.
            curves: of the finer method.
            steps: number of steps of the run for each.
        """
        rounding, first, length = math.sqrt(steps) * self.u, 0, len(starts.h) if self.linear is None else 1
        kept = Curves(np.empty((len(starts.h), self.m, 0)), np.empty(0)) if curves is None else curves
        own = self.finer if curves is None or self.along_finer else self.run.stepper
        while first < len(starts.h):
            if self.linear is not None:
                self.calls += 1
                into = self.samples, deviations[:, first:], parameters
                values, rest = kept.values[first:], along.part(first, len(starts.h))
                first += self.linear._transport_roundings(
                    rest, Curves(values, kept.abscissae), *into, self.left / steps, rounding, self.calls
                )
            if first < len(starts.h):
                self.calls += 1
                part, into = starts.part(first, first + length), (self.samples, deviations[:, first:], parameters)
                try:
                    own._transport_by_differences(part, *into, self.size, rounding, self.calls)
                except StepFailedError:
                    if length == 1:
                        return first
                    length = 1
                    continue
                first, length = first + length, 2 * length  # so that calls are few where iterations fail again
        return len(starts.h)

    def _by_run(self, piece: Any, t: float, q: Array, p: Array, end: int, *, steps: float) -> None:
        """Find the errors of a row by a run of the finer method at round-off, over the events in between.

        It begins at the state minus its error; where events change states or modes, at the state, whose modes are
        known, and the error is transported by the derivatives.
        """
        stop = float(piece.t[end])
        if stop == t:
            return
        interface, state = self.finer.interface, np.concatenate([np.asarray(q), np.asarray(p)])
        changes = self.finer.changes_states or interface.kinks or interface.modes or interface.contacts
        start = np.split(state if changes else state - self.now, 2)
        plan, parameters = ending_at(Adaptive(stop), stop), parameters_set_until(piece, t)
        fine = self.finer._run(*start, plan=plan, t=t, parameters=parameters)._recorded(None)
        after = self._state(piece, end)
        if changes:
            is_on_constraints = self.finer.constraints or interface.contacts  # rounded states are not
            at_start = 0.0 if is_on_constraints else 0.5
            self._round(state, at_start * steps)
            image = fine.tangent(np.vstack([self.now, self.samples]).T)[-1].T
            self.now, self.samples = image[0] + (after - self._state(fine, -1)), np.ascontiguousarray(image[1:])
            self._round(after, (1.0 - at_start) * steps)
            return
        h, sides = steps_after(fine, 0, len(fine) - 1), fine.parameters_on_sides(t)
        times, h, x, y = (np.ascontiguousarray(of) for of in (fine.t, h, fine.q, fine.p))
        taken, deviations = Starts(times, h, x, y), np.empty((2 * self.m, len(h)))
        if self._transport(taken, taken, None, deviations, sides, steps / len(h)) < len(h):
            raise StateError("the steps of a finer method from neighbouring states were not solved")
        self.now = after - self._state(fine, -1)

    def _round(self, state: Array, steps: float) -> None:
        """Add the rounding errors of a state in so many steps to the samples."""
        self.calls += 1
        normal = np.random.default_rng(self.calls).standard_normal(self.samples.shape)
        self.samples += math.sqrt(steps) * self.u * normal * np.abs(state)

    @staticmethod
    def _state(states: Any, k: Any) -> Array:
        return np.concatenate([np.asarray(states.q)[k], np.asarray(states.p)[k]], axis=-1)


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
    """Return the differences of a run from one of the finer method at round-off.

    Samples of rounding errors are differences of runs whose states are rounded in between: of fixed steps in tau at
    ``PIECES`` random times, else one whose initial state is, as a restart at a kink would be another motion.
    """
    finer = finer.with_events(run.stepper.changing_events)
    exact, *samples = (_states_of(run, finer, seed) for seed in range(1 + (SAMPLES if run.stepper.in_tau else 1)))
    errors = [np.asarray(x - y).T for x, y in zip((run.q, run.p), exact, strict=True)]
    apart = [np.array([np.asarray(x - y).T for x, y in zip(of, exact, strict=True)]) for of in samples]
    return _described(run, np.array(errors), np.sqrt(np.mean(np.square(apart), axis=0)))


def _states_of(run: Any, finer: Any, seed: int) -> tuple[Any, Any]:
    """Return (n, m) positions and momenta of the finer run at the times of a run; with a ``seed`` above 0 rounded."""
    words, random, parts = finer.interface.words, np.random.default_rng(seed), list[Any]()
    tolerance = float(finer.binding.function("smallest_tolerance")()) if words > 1 else None
    t, *start = run.initial
    for piece in run._runs:
        parameters = piece.parameters
        if seed and run.stepper.in_tau:  # the energy of the start is a parameter, rounded as its terms
            parameters, size = (
                parameters.copy(),
                0.5 * abs(np.dot(start[1], run.stepper.velocity(*start, float(t), parameters))),
            )
            parameters[run.stepper.interface.energy_index] += roundoff(words) * size * random.standard_normal()
        rows = _rows_between(piece, times_of_changes(piece))
        count = min(PIECES, len(rows)) if seed and run.stepper.in_tau else 0
        inside = random.choice(rows, count, replace=False)
        breaks = np.unique([0, *inside.tolist(), len(piece) - 1]) if len(piece) > 1 else [0, 0]
        for first, last in pairwise(breaks):
            if seed:
                rounding = math.sqrt(max(1, run.steps) / (len(breaks) - 1)) * roundoff(words)
                start = [sum_of(x, rounding * random.standard_normal(x.shape[-1]) * np.asarray(x)) for x in start]
            stop = float(piece.t[last])
            plan = ending_at(piece.plan if run.stepper.in_tau else Adaptive(stop, tolerance), stop)
            fine = finer._run(*start, plan=plan, t=t, parameters=parameters)._recorded(None)
            parts.append(fine._states_at(piece.t[first : last + 1]))
            t, start = piece.t[last], [x[-1] for x in parts[-1]]
    q, p = (concatenated(list(of)) for of in zip(*parts, strict=True))
    return q, p


def corrected_states(run: Any, error: RunError) -> CorrectedStates:
    """Return the states of a run minus their errors; raises as :attr:`WithErrors.corrected`."""
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
