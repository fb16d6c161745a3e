"""Ensembles whose trajectories are integrated one by one: with steps or ends of their own, or not in SIMD lanes.

C integrates them one after the other, bitwise equal to single runs, or :meth:`Stepper.integrate` does: with inputs of
adaptive steps, output times, events, t_end in transformed time or a bound of the global error.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.arguments import empty_array
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.capacity import TOO_MANY_STATES, room_for_states, too_many_states
from scvi_codegen.codegen.native.options import FAILURES
from scvi_codegen.common.errors import (
    AccuracyWarning,
    EventError,
    MethodError,
    StateError,
    StepFailedError,
    of_trajectory,
    warn,
)
from scvi_codegen.common.thread_pool import StopCheck, run_jobs
from scvi_codegen.common.validation import LARGEST_COUNT
from scvi_codegen.runs.accuracy.global_error import GlobalError
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.driver.segments import breakpoints_until, inputs_of_slice
from scvi_codegen.runs.ensembles.batches import Rows, SuccessiveRuns
from scvi_codegen.runs.ensembles.ensemble import Ensemble
from scvi_codegen.runs.ensembles.lanes import CommonRuns
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import EVENT_FAILED, INTERRUPTED, OK, EnsembleTrajectory, SpanOfRows
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.nouns import Execution, Save
from scvi_codegen.runs.results.saved_states import ModeHistory
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.states.times import WHOLE, number_until
from scvi_codegen.runs.states.validation import Array, columns_of_inputs
from scvi_codegen.runs.states.words import unnamed
from scvi_codegen.runs.stepping.noise import DEFAULT_NOISE
from scvi_codegen.runs.stepping.step_plan import Adaptive, AdaptivePlans, Span, Steps
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings


class IndividualRuns:
    """Trajectories that are integrated one by one, each as by ``integrate``.

    Attributes:
        ensemble: the trajectories.
        t_eval: common output times, ``None`` where each trajectory has times of its own.
        most_states: largest number of states of a trajectory: arrays of all have the size of the longest one.
        ends: (k,) final times.
        successive: the trajectories as C integrates them in one call, ``None`` if ``integrate`` does.
        stored: states of completed trajectories, and the initial states.
        status, steps, fallback_steps, events: (k,) of each trajectory.
        messages: of the errors with which trajectories ended, by their numbers.
        plans: adaptive steps of each; with ``error=`` their tolerances differ.
        confirmations: with ``error=``, of each trajectory.
    """

    def __init__(self, ensemble: Ensemble) -> None:
        stepper, fixed, count = ensemble.stepper, ensemble.fixed, len(ensemble)
        self.ensemble, self.t_eval, self.ends = ensemble, ensemble.t_eval, ensemble.ends
        self.plans: Sequence[Adaptive] = ()
        if ensemble.plan is not None:
            self.plans = AdaptivePlans(self.ends, ensemble.plan)
        if fixed is not None:
            self.t_eval, self.ends = self._common_times(), np.full(count, fixed.times(tau=False)[-1])
            empty_array((len(fixed.numbers), count, 2 * stepper.dimension))  # rejects states beyond any memory
        self.confirmations = list[GlobalError | None]()
        if ensemble.settings.error is not None:
            self.plans, self.confirmations = list(self.plans), [None] * count
        numbers = stepper.interface.words * (1 + 2 * stepper.dimension)  # of a state
        self.most_states = math.inf if self.t_eval is not None else room_for_states() / (8 * numbers * max(count, 1))
        self.status = np.full(count, INTERRUPTED, dtype="<U32")
        self.steps, self.fallback_steps = np.zeros((2, count), np.int64)
        self.messages: dict[int, str] = {}
        self.events: list[tuple[Crossings, ...]] = [()] * count
        self.modes: list[ModeHistory | None] = [None] * count
        self.stored = [self._start()]
        self.successive = self._successive()

    def __len__(self) -> int:
        return len(self.ensemble)

    @property
    def length(self) -> int:
        """Final value of ``progress``: the number of trajectories, or of common steps."""
        fixed = self.ensemble.fixed
        return len(self) if fixed is None or self.ensemble.stepper.searched else fixed.steps

    def _common_times(self) -> Array | None:
        """Return the times of fixed steps, without terminal events and t_end in transformed time.

        Two words are saved as they are.
        """
        fixed, events = cast(CommonSteps, self.ensemble.fixed), self.ensemble.stepper.events
        if self.ensemble.stepper.in_tau or any(event.terminal for event in events) or (fixed.words > 1 and not events):
            return None
        return fixed.times(tau=False)

    def _start(self) -> Rows:
        """Return the initial states, row 0 of all trajectories, or no states if output times begin later."""
        ensemble, stepper, saved = self.ensemble, self.ensemble.stepper, len(self)
        if self.t_eval is not None and self.t_eval[0] != ensemble.t0:
            saved = 0
        numbers = np.zeros(len(self), np.int64)
        t = stepper._states.missing((saved,))
        t[:] = ensemble.t0
        actions, tau = (np.zeros(saved if summed else 0) for summed in (stepper.sums_action, stepper.in_tau))
        where = np.arange(len(self)), numbers, numbers + bool(saved)
        return Rows(*where, t, ensemble.q[:saved], ensemble.p[:saved], actions, tau)

    def _successive(self) -> SuccessiveRuns | None:
        """Return the trajectories that C integrates one after the other, ``None`` for other ensembles."""
        ensemble, stepper, t_eval, fixed = self.ensemble, self.ensemble.stepper, self.t_eval, self.ensemble.fixed
        if stepper.searched or not stepper.binding.reusable or self.confirmations:
            return None
        if ensemble.inputs and (fixed is None or stepper.interface.constraints):  # which single runs check for jumps
            return None
        if stepper.in_tau and (fixed is None or fixed.t_end is not None):
            return None
        if t_eval is None or fixed is not None:
            receive = partial(_receive, self.stored, 0)  # without self, so that no cycle keeps the memory
            return SuccessiveRuns(ensemble, receive, save_every=ensemble.save_every, most_states=self.most_states)
        later = t_eval[t_eval != ensemble.t0]
        if len(later) != 1 or len(t_eval) > 2 or (self.ends != later[0]).any():
            return None
        return SuccessiveRuns(ensemble, partial(_receive, self.stored, len(t_eval) - 2), save_every=LARGEST_COUNT)

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all trajectories with ``threads`` threads; an exception raised by ``progress`` stops them promptly.

        Afterwards, also after an exception, :meth:`result` returns what was computed.

        Args:
            progress: called with a part of :attr:`length`.
            threads: number of threads, by default one per core.
        """
        unit = self.length / len(self)
        report = None if progress is None else lambda done: progress(int(done * unit))
        if self.successive is None:
            run_jobs(len(self), self._integrate, progress=report, threads=threads)
            return
        try:
            self.successive.run(progress=report, threads=threads)
        finally:
            self.status, self.steps = self.successive.names, self.successive.done
            self.fallback_steps = self.successive.fallback_steps
            if self.ensemble.fixed is not None and not self.ensemble.stepper.in_tau:
                self.messages = self.ensemble.fixed.failures(self.status, self.steps)

    def _integrate(self, j: int, check_stop: StopCheck) -> None:
        """Integrate trajectory j as :meth:`Stepper.integrate` does; with ``error`` keep its confirmed local tolerance.

        One whose confirming runs fail has errors at round-off level.
        """
        ensemble, rows, status = self.ensemble, slice(None), OK
        initial, size, span, save, way = self._asked(j, check_stop)
        if ensemble.fixed is None and self.t_eval is not None:
            times = self.t_eval[np.abs(self.t_eval - ensemble.t0) <= abs(self.ends[j] - ensemble.t0)]
            rows = slice(None if times.size else 0)
            save = save._replace(t_eval=times if times.size else self.ends[j : j + 1])  # runs have at least one
        integrate = partial(ensemble.stepper._integrate, initial, span=span, save=save, way=way)
        with without_accuracy_warnings():
            if size.error is not None:
                with suppress(StateError, StepFailedError, EventError):
                    states = integrate(size=size)
                    self.confirmations[j], cast(list[Any], self.plans)[j] = states.confirmation, states.plan
                    self._store(j, states, rows, OK)
                    return
            try:
                states = integrate(size=size._replace(error=None))
            except (StepFailedError, EventError) as failure:
                if failure.trajectory is None:
                    with of_trajectory(j):
                        raise
                states, status = cast(Trajectory, failure.trajectory), getattr(failure, "status", EVENT_FAILED)
                self.messages[j] = str(failure)
            except StateError as failure:  # a sum of finite terms has overflowed
                self.status[j], self.messages[j] = "not finite", str(failure)
                return
        if ensemble.fixed is not None and self.t_eval is not None:
            rows = self._common_rows(states, ensemble.fixed.h)
        self._store(j, states, rows, status)

    def _asked(self, j: int, check_stop: StopCheck) -> tuple[Initial, Steps, Span, Save, Execution]:
        """Return what trajectory j is asked for, without its output times."""
        ensemble, stepper, parameters = self.ensemble, self.ensemble.stepper, self.ensemble.parameters[j]
        if stepper.interface.words == 1:
            of_inputs = columns_of_inputs(stepper.interface) if ensemble.inputs else ()
            values = zip(stepper.interface.parameters, parameters.tolist(), strict=True)
            parameters = {name: value for k, (name, value) in enumerate(values) if k not in of_inputs}
        size, span, noise = ensemble.settings.size, Span(t_end=float(self.ends[j])), DEFAULT_NOISE
        if ensemble.fixed is not None:
            size, span = Steps(h=ensemble.fixed.h), ensemble.fixed.span
        if stepper.interface.temperature is not None:
            noise = ensemble.noise._replace(trajectory=ensemble.noise.trajectory + j)
        save_every = 1 if ensemble.inputs and self.t_eval is not None else ensemble.save_every
        return (
            Initial(ensemble.q[j], ensemble.p[j], None, ensemble.t0, parameters, ensemble.settings.options),
            size,
            span,
            Save(save_every, progress=partial(self._check, check_stop)),
            Execution(inputs=inputs_of_slice(ensemble.inputs, j), noise=noise),
        )

    def _check(self, check_stop: StopCheck, steps: int) -> None:
        """Raise an error if another trajectory failed, or if a run has more states than :attr:`most_states`."""
        check_stop(steps)
        states = steps // self.ensemble.save_every
        if states > self.most_states:
            raise too_many_states(states, steps, math.nan)

    def _common_rows(self, states: Trajectory, h: float) -> Any:
        """Return the rows at the common times of fixed steps: the last states there, after changes by events."""
        times, common = (states.forward * np.asarray(t) for t in (states.t, self.t_eval))
        latest = common + WHOLE * abs(h)
        return np.searchsorted(times, latest[latest < times[-1] + 2 * WHOLE * abs(h)], side="right") - 1

    def _store(self, j: int, states: Trajectory, rows: Any, status: str) -> None:
        """Store rows of the states of trajectory j and how it ended."""
        t, q, p = states.t[rows], unnamed(states.q)[rows], unnamed(states.p)[rows]
        actions, tau = (values if values is None else values[rows] for values in (states.actions, states.tau))
        self.events[j], self.modes[j] = states.events, states.modes
        self._append(j, (t, q, p, status, states.steps), states.fallback_steps, actions, tau)

    def _append(
        self,
        j: int,
        trajectory: tuple[Array, Array, Array, str, int],
        fallback_steps: int,
        actions: Array | None,
        tau: Array | None,
    ) -> None:
        """Store the times, positions and momenta of trajectory j, its status and its numbers of steps."""
        t, q, p, status, self.steps[j] = trajectory
        self.status[j] = TOO_MANY_STATES if len(t) > self.most_states else status
        self.fallback_steps[j] = fallback_steps
        if actions is None:
            actions = np.full(len(t) if self.ensemble.stepper.sums_action else 0, np.nan)
        where = np.array([j]), np.zeros(1, np.int64), np.array([len(t)])
        self.stored.append(Rows(*where, t, q, p, actions, np.empty(0) if tau is None else tau))

    def keep(self, part: slice, trajectories: EnsembleTrajectory) -> None:
        """Store the results of a slice that was integrated elsewhere."""
        fallback_steps, along = cast(Array, trajectories.fallback_steps), (trajectories.actions, trajectories.tau)
        for k, trajectory in enumerate(trajectories.each()):
            actions, tau = (None if values is None else values[: len(trajectory[0]), k] for values in along)
            self._append(part.start + k, trajectory, int(fallback_steps[k]), actions, tau)
        self.messages |= {part.start + k: message for k, message in trajectories.messages.items()}
        if trajectories.events:
            self.events[part] = trajectories.events
        if trajectories.modes:
            self.modes[part] = trajectories.modes
        if self.confirmations:
            self.confirmations[part] = trajectories.confirmations
            cast(list[Any], self.plans)[part] = trajectories.plans

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories; those neither completed nor failed have the status ``"interrupted"``."""
        ensemble, stepper, fixed = self.ensemble, self.ensemble.stepper, self.ensemble.fixed
        states = self._all_states()
        index = self._places(states)

        def ordered(values: Array) -> Array:  # by rows and trajectories, NaN after their ends
            return values[index] if stepper._states.words > 1 else values.take(index, axis=0)

        tau = None
        if stepper.in_tau and fixed is not None:
            tau = ordered(states.tau) if self.successive is None else fixed.times(tau=True)
        t = self.t_eval if fixed is None else None
        if t is None:
            t = self._times(ordered(states.t))
        spans = self._spans(t) if fixed is None or self.t_eval is None else fixed.spans(ensemble.values_at)
        return EnsembleTrajectory(
            t=t,
            tau=tau,
            q=ordered(states.q),
            p=ordered(states.p),
            actions=ordered(states.actions) if stepper.sums_action else None,
            status=self.status,
            steps=self.steps,
            fallback_steps=self.fallback_steps,
            events=tuple(self.events) if stepper.events else (),
            modes=tuple(self.modes) if stepper.modes else (),
            messages=self.messages,
            h=None if fixed is None else fixed.h,
            plans=self.plans,
            confirmations=tuple(self.confirmations),
            parameters=ensemble.parameters,
            initial=(ensemble.t0, ensemble.q, ensemble.p),
            stepper=stepper,
            spans=tuple(spans) if ensemble.inputs else (),
        )

    def _all_states(self) -> Rows:
        """Return all states in the order in which they were stored, and NaN as the last row, of no trajectory."""
        missing, m, none = self.ensemble.stepper._states.missing, self.ensemble.q.shape[1], np.empty(0, np.int64)
        undefined = Rows(none, none, none, missing((1,)), *(missing((1, m)) for _ in "qp"), *np.full((2, 1), np.nan))
        states = Rows(*map(np.concatenate, zip(*self.stored, undefined, strict=True)))
        self.stored[:] = [Rows(*states[:3], *(values[:-1] for values in states[3:]))]  # frees the parts
        return states

    def _places(self, states: Rows) -> NDArray[np.intp]:
        """Return the (n, k) places of the rows of all trajectories among the stored states, -1 after their ends.

        Of a trajectory with too many states these are the first and the last one.
        """
        row, j = states.indices()
        places, full = np.arange(len(row)), self.status == TOO_MANY_STATES
        if full.any():
            last = np.zeros(len(self), np.int64)
            np.maximum.at(last, j, row)
            saved = ~full[j] | (row == 0) | (row == last[j])
            row, j, places = np.where(full[j], np.minimum(row, 1), row)[saved], j[saved], places[saved]
        rows = 1 + int(row.max()) if self.t_eval is None else len(self.t_eval)
        index = np.full((rows, len(self)), -1)
        index[row, j] = places  # the initial state of a run replaces that of the ensemble
        return index

    def _times(self, times: Array) -> Array:
        """Return the (n,) times of all trajectories where they are common, else the (n, k) times of each."""
        stepper = self.ensemble.stepper
        common = self.ensemble.fixed is not None and not stepper.in_tau
        if common and not any(event.terminal for event in stepper.events):
            complete = np.flatnonzero(np.isfinite(np.asarray(times)).all(axis=0))
            if complete.size:  # all may end before t_end
                return times[:, complete[0]]
        return times if self.t_eval is None else self.t_eval

    def _spans(self, t: Array) -> Iterator[SpanOfRows]:
        """Yield the rows of each trajectory, of states at the times t, in each piece of its inputs."""
        t0 = self.ensemble.t0
        for j, end_of_run in enumerate(self.ends.tolist()):
            times = t if t.ndim == 1 else t[:, j]
            forward = -1.0 if end_of_run < t0 else 1.0
            ends = breakpoints_until(t0, end_of_run, self.ensemble.inputs) or [end_of_run]
            last = number_until(times[np.isfinite(times)], ends, forward).tolist()
            for (start, end), (first, until) in zip(pairwise([t0, *ends]), pairwise([0, *last]), strict=True):
                yield slice(first, until), slice(j, j + 1), partial(self.ensemble.values_at, (start + end) / 2)

    def warn_of_too_many_states(self, trajectories: EnsembleTrajectory) -> None:
        """Issue a warning if trajectories ended because their states exceed the memory."""
        full = np.flatnonzero(trajectories.status == TOO_MANY_STATES)
        if not full.size:
            return
        j, others, (cause, remedy) = int(full[0]), len(full) - 1, FAILURES[TOO_MANY_STATES]
        more = f" (and {others} more)" if others else ""
        warn(
            f"trajectory {j}{more} ended at t = {trajectories.ends[0][j]:g}, after "
            f"{trajectories.steps[j]} steps: {cause}. The memory holds {int(self.most_states)} states of each of "
            f"{len(self)} trajectories. {remedy}",
            AccuracyWarning,
        )


def _receive(stored: list[Rows], shift: int, states: Rows) -> None:
    """Store copies of states that C has saved, whose rows begin elsewhere."""
    stored.append(states.copies(shift))


def runs_of(ensemble: Ensemble) -> CommonRuns | IndividualRuns:
    """Return the way in which the trajectories of an ensemble are integrated, before its first step."""
    stepper, settings = ensemble.stepper, ensemble.settings
    common = ensemble.fixed is not None and not settings.records_events(stepper)
    observation = None
    if settings.observe is not None:
        if not common:
            raise StateError(
                f"observe={settings.observe!r} requires a fixed step size: give h and steps, or observe each "
                "trajectory by integrate"
            )
        observation = EnsembleObservation(stepper, settings.observe, len(ensemble))
    binding = _binding_of_lanes(ensemble, observation) if common else None
    return IndividualRuns(ensemble) if binding is None else CommonRuns(ensemble, binding, observation)


def _binding_of_lanes(ensemble: Ensemble, observation: EnsembleObservation | None) -> Binding | None:
    """Return the library of trajectories in SIMD lanes, ``None`` for others.

    These are without the steps of the method, of constraints with inputs, which single runs check for jumps, of
    constraints whose actions are summed, of inputs in two words, and where a rule of Metropolis has no lanes.
    """
    stepper, interface, inputs = ensemble.stepper, ensemble.stepper.interface, ensemble.inputs
    has_inputs = bool(inputs and (interface.constraints or interface.words > 1))
    if observation is None and (has_inputs or (interface.constraints and stepper.sums_action)):
        return None
    binding: Binding | None = (
        observation.binding
        if observation is not None
        else (stepper._binding_in_single if ensemble.settings.precision == "single" else stepper._ensemble_binding)
    )
    if binding is None or not ensemble.noise.metropolis or binding.constant("HAS_METROPOLIS"):
        return binding
    if observation is None:
        return None
    raise MethodError(
        f"observe={observation.name!r} is not available with metropolis=True in ensembles of '{stepper.title}', whose "
        "rule of Metropolis has no SIMD lanes: observe each trajectory by integrate"
    )
