"""Ensembles: many trajectories with common fixed steps, or each with adaptive steps of its own.

With common fixed steps trajectories are SIMD lanes (:mod:`scvi_codegen.runs.ensembles.lanes`). Others are computed by
the single integrator, so they are bitwise equal to those of :meth:`Stepper.integrate`, which computes trajectories with
inputs, output times, changes by events or a bound of the global error. C integrates many
trajectories in one call (:mod:`scvi_codegen.runs.ensembles.batches`), without the GIL, so threads share the work;
results are bitwise equal for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.native.capacity import TOO_MANY_STATES, room_for_states, too_many_states
from scvi_codegen.codegen.native.options import FAILURES, SolverOptions, checked_options
from scvi_codegen.common.errors import AccuracyWarning, EventError, StateError, StepFailedError, warn
from scvi_codegen.common.validation import LARGEST_COUNT, checked_count
from scvi_codegen.runs.accuracy.global_error import GlobalError
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.driver.segments import (
    Input,
    breakpoints_until,
    checked_inputs,
    final_time,
    first_inner_time,
    inputs_of_slice,
    parameters_at,
)
from scvi_codegen.runs.ensembles.batches import FULL, Rows, SuccessiveRuns
from scvi_codegen.runs.ensembles.device import DeviceEnsemble, DeviceRuns, check_device, on_processor
from scvi_codegen.runs.ensembles.initial_states import momenta_of_each, start_of_ensemble
from scvi_codegen.runs.ensembles.lanes import CommonRuns
from scvi_codegen.runs.ensembles.observation import EnsembleObservation
from scvi_codegen.runs.ensembles.result import EVENT_FAILED, INTERRUPTED, OK, EnsembleTrajectory, Span
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.ensembles.thread_pool import StopCheck, run_jobs
from scvi_codegen.runs.results.dense_output import times_of_run
from scvi_codegen.runs.states.times import WHOLE
from scvi_codegen.runs.states.validation import (
    Array,
    EnsembleParameters,
    States,
    check_left_to_inputs,
    columns_of_inputs,
)
from scvi_codegen.runs.states.words import check_doubles, hashed, stacked
from scvi_codegen.runs.stepping.features import check_together, require
from scvi_codegen.runs.stepping.step_plan import (
    Adaptive,
    AdaptivePlans,
    ErrorControl,
    KindOfSteps,
    Until,
    check_max_step,
    planned_steps,
)
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings


class SavedLane(NamedTuple):
    """Saved states of one trajectory, its status, numbers of steps and of those solved by Newton's method, and events.

    ``actions`` are those up to each state of runs that sum the action, ``tau`` its values in transformed time.
    """

    t: Array
    q: Array
    p: Array
    status: str
    steps: int
    fallback_steps: int = 0
    events: tuple[Crossings, ...] = ()
    actions: Array | None = None
    tau: Array | None = None

    @classmethod
    def of(cls, states: Trajectory, rows: Any = slice(None), status: str = OK) -> SavedLane:
        """Return rows of the states of a single run."""
        actions = None if states.actions is None else states.actions[rows]
        tau = None if states.tau is None else states.tau[rows]
        about = status, states.steps, states.fallback_steps, states.events, actions, tau
        return cls(states.t[rows], states.q[rows], states.p[rows], *about)

    def limited(self, most: float) -> SavedLane:
        """Return the first and the last state alone of a trajectory with more than ``most`` states, or too many."""
        if len(self.t) <= most and self.status != TOO_MANY_STATES:
            return self
        ends = slice(None, None, max(len(self.t) - 1, 1))
        actions, tau = (None if values is None else values[ends] for values in (self.actions, self.tau))
        about = self.steps, self.fallback_steps, self.events, actions, tau
        return SavedLane(self.t[ends], self.q[ends], self.p[ends], TOO_MANY_STATES, *about)


@dataclass(slots=True, kw_only=True)
class EnsembleSettings:
    """Arguments of ``integrate_ensemble`` but the initial state, for one stepper."""

    inputs: Mapping[str, Any] | None = None
    h: float | None = None
    steps: int | None = None
    t_end: ArrayLike | None = None
    tolerance: float | None = None
    absolute_tolerance: float | Mapping[str, float] | None = None
    max_step: float | None = None
    first_step: float | None = None
    save_every: int = 1
    t: float = 0.0
    t_eval: ArrayLike | None = None
    parameters: EnsembleParameters = None
    options: SolverOptions | None = None
    error: float | None = None
    device: str | None = None
    observe: str | None = None

    @property
    def control(self) -> ErrorControl:
        """Arguments of adaptive steps."""
        return ErrorControl(self.tolerance, self.absolute_tolerance, self.max_step, self.first_step)

    def check(self, stepper: Any) -> None:
        """Raise an error for arguments that exclude each other, or that the stepper excludes."""
        check_device(self.device, self.h, error=self.error, t_eval=self.t_eval)
        if self.observe is not None:
            check_together(observe=self.observe, inputs=self.inputs, error=self.error, t_eval=self.t_eval)
            require(stepper, "observe_ensemble")
        if self.device is not None:
            require(stepper, "device")
        if self.records_events(stepper):
            check_together(events=stepper.events, device=self.device, observe_ensemble=self.observe)
            require(stepper, "ensemble_events")

    def records_events(self, stepper: Any) -> bool:
        """Return whether trajectories record the events of the stepper, which may be counted instead."""
        return bool(stepper.events) and self.observe != "events"

    def steps_or_end(self, t: float, words: int) -> tuple[int | None, ArrayLike | None]:
        """Return the number of common steps or the final time; with adaptive steps the final time or times.

        Raises:
            StateError: for missing or contradictory arguments.
        """
        h, t_end = self.h, self.t_end
        check_together(inputs=self.inputs, t_eval=self.t_eval)
        if words > 1:
            check_doubles(t_end=t_end, t_eval=self.t_eval)
        if h is not None and self.t_eval is not None:
            raise StateError("t_eval requires adaptive steps: give t_end without h and steps")
        if h is not None and t_end is not None and np.ndim(t_end):
            raise StateError("with h all trajectories have one t_end: give one number, or omit h (adaptive step size)")
        first = None if t_end is None else float(real_array(t_end, "t_end").flat[0])
        planned_steps(KindOfSteps(), h, self.steps, first, *self.control, 1, hashed(t))
        if h is None or (self.inputs is None and first is None):
            return self.steps, t_end
        return None, final_time(t, h, self.steps, first)


class Ensemble:
    """Integration of many trajectories.

    Args:
        stepper: the compiled integrator.
        q, p, velocity: (k, m) initial state, of which p or the velocity is ``None``.
        settings: other arguments of ``integrate_ensemble``, see :class:`EnsembleSettings`.

    Raises:
        StateError: if a shape, name or number is invalid, or the stepper has a time transformation.

    Attributes:
        inputs: validated inputs.
        start: (k, m) initial positions and momenta.
        common: the trajectories with common steps, ``None`` with adaptive steps.
        plans: step plan of each trajectory that is integrated by itself.
        saved: completed trajectories of these.
    """

    def __init__(
        self, stepper: Any, q: States, p: States | None, *, velocity: States | None = None, **settings: Any
    ) -> None:
        asked = EnsembleSettings(**settings)
        asked.check(stepper)
        self.stepper, self.control, self.observe, self.error = stepper, asked.control, asked.observe, asked.error
        self.t0 = stepper._states.time(asked.t)
        steps, t_end = asked.steps_or_end(self.t0, stepper._states.words)
        require(stepper, "ensembles")
        parameters = asked.parameters
        if asked.device is not None:
            q, p, velocity, parameters = (on_processor(part) for part in (q, p, velocity, parameters))
        if asked.h is None:
            require(stepper, "adaptive")
        self.options, self.inputs = checked_options(asked.options), dict[str, Input]()
        if asked.inputs is not None:
            parameters = self._with_inputs(asked.inputs, len(stepper._states.members(q, "q")), parameters, t_end)
        momenta = momenta_of_each(stepper, q, p, velocity, self.t0, parameters)
        self.save_every = checked_count(asked.save_every, "save_every", least=1)
        self.fixed = None if asked.h is None else self._common_steps(asked.h, steps, cast(Any, t_end))
        self._begin(q, momenta, parameters)
        self.values_at = partial(parameters_at, stepper.parameters, self.parameters, self.inputs)
        self.common: CommonRuns | DeviceRuns | None = None
        self.plans: Sequence[Until | Adaptive] = ()
        self.saved: dict[int, SavedLane] = {}
        self.confirmations = list[GlobalError | None]()
        self.t_eval: Array | None = None
        self.ends = np.empty(0)
        ends_in_time = self.fixed is not None and self.fixed.t_end is not None and stepper.in_tau  # after own steps
        self.singly = asked.records_events(stepper) or self._changes_two_words() or ends_in_time
        if self.fixed is None or self.singly:
            self.plans = self._plans(self.fixed, cast(ArrayLike, t_end), self.control)
            self.plans = self.plans if self.error is None else list(self.plans)
            self.confirmations = [None] * (0 if self.error is None else len(self))
            self.t_eval = self._output_times(self.fixed, asked.t_eval)
        if self.inputs:
            self.parameters[:, columns_of_inputs(stepper.interface)] = 0.0
        if self.fixed is not None and not self.singly:
            kind = CommonRuns if asked.device is None else DeviceRuns
            observation = None if self.observe is None else EnsembleObservation(stepper, self.observe, len(self))
            arguments = stepper, self.options, self.start, self.parameters, self.values_at, self.fixed, observation
            self.common = kind(*arguments)
        elif self.observe is not None:
            raise StateError(
                f"observe={self.observe!r} requires a fixed step size: give h and steps, or observe each trajectory by "
                "integrate"
            )
        self.states: list[Rows] = []
        self.successive = self._successive()

    def _with_inputs(self, inputs: Mapping[str, Any], count: int, parameters: Any, t_end: Any) -> Array:
        """Set the inputs; return the (k, number of parameters) values at the start, those of inputs included."""
        stepper = self.stepper
        self.inputs = checked_inputs(stepper.interface, inputs, count)
        check_left_to_inputs(stepper.interface, parameters)
        inside = first_inner_time(self.t0, float(real_array(0.0 if t_end is None else t_end, "t_end").flat[0]))
        values = stepper._states.parameters_of_each(parameters, count)
        return parameters_at(stepper.parameters, values, self.inputs, inside)

    def _common_steps(self, h: float, steps: int | None, t_end: float | None) -> CommonSteps:
        """Return the fixed steps of all trajectories."""
        words = self.stepper._states.words
        return CommonSteps(
            self.t0, h, steps=steps, t_end=t_end, inputs=self.inputs, save_every=self.save_every, words=words
        )

    def _begin(self, q: States, p: States, parameters: EnsembleParameters) -> None:
        """Set the initial states and parameters; in transformed time the energies are those of the states."""
        stepper = self.stepper
        *start, self.parameters = start_of_ensemble(stepper, q, p, self.t0, parameters)
        self.start = start[0], start[1]
        if not stepper._has_energy(parameters):
            energy = stepper.interface.energy_index
            for values, position, momentum in zip(self.parameters, *self.start, strict=True):
                values[energy] = stepper.energy(position, momentum, 0.0, values)

    def _changes_two_words(self) -> bool:
        """Return whether fixed steps in two words are those of single runs: with inputs, and without SIMD lanes."""
        stepper = self.stepper
        fixed_in_two_words = self.fixed is not None and stepper._states.words > 1
        return fixed_in_two_words and (bool(self.inputs) or stepper.ensemble is None)

    def _successive(self) -> SuccessiveRuns | None:
        """Return the trajectories that C integrates one after the other, ``None`` for other ensembles."""
        stepper = self.stepper
        if self.common is not None:
            return None
        if self.inputs or stepper.events or stepper.in_tau or not stepper.binding.reusable:
            return None
        ends = self.ends
        if self.error is not None or not (self.t_eval is None or self._saves_ends(ends)):
            return None
        return SuccessiveRuns(
            stepper,
            self.options,
            self.start,
            self.parameters,
            self.t0,
            ends if self.fixed is None else self.fixed.fixed_segments(),
            plan=self.plans[0] if isinstance(self.plans[0], Adaptive) else None,
            save_every=self.save_every if self.t_eval is None else LARGEST_COUNT,
            most_states=self.most_states,
            receive=partial(_append_copies, self.states),  # without self, so that no cycle keeps the memory
        )

    def _saves_ends(self, ends: Array) -> bool:
        """Return whether the output times are the common end of all trajectories, with or without their start."""
        times = set() if self.t_eval is None else {*self.t_eval.tolist()} - {self.t0}
        return len(times) == 1 and bool((ends == times.pop()).all())

    def _plans(self, fixed: CommonSteps | None, t_end: ArrayLike, control: ErrorControl) -> Sequence[Until | Adaptive]:
        """Return the step plan of each trajectory; all must run forward or all backward."""
        if fixed is not None:
            return (Until(fixed.h, float(fixed.times(tau=False)[-1])),) * len(self)
        ends = real_array(t_end, "t_end")
        self.ends = np.full(len(self), ends) if not ends.ndim else ends
        if ends.shape not in ((), (len(self),)):
            raise StateError(f"t_end must be one time or {len(self)} times, not of shape {ends.shape}")
        worst = int(np.argmin(np.isfinite(ends)))  # the first one that is not finite
        plan = control.to(float(ends.flat[worst]))
        if (ends > self.t0).any() and (ends < self.t0).any():
            raise StateError(f"t_end lies on both sides of t = {self.t0:g}: split the ensemble into two")
        check_max_step(
            replace(plan, t_end=float(ends.flat[np.abs(ends).argmax()])), self.t0, self.stepper.interface.words
        )
        if not ends.ndim:
            return (plan,) * len(self)
        return AdaptivePlans(ends, plan)

    def _output_times(self, fixed: CommonSteps | None, t_eval: ArrayLike | None) -> Array | None:
        """Return the validated output times; raise ``StateError`` if inputs do not cover a run."""
        if fixed is not None:  # terminal events end runs at times of their own; two words are saved as they are
            events = self.stepper.events
            own = self.stepper.in_tau or any(event.terminal for event in events) or (fixed.words > 1 and not events)
            return None if own else fixed.times(tau=False)
        for plan in self.plans if self.inputs else ():
            breakpoints_until(self.t0, plan.t_end, self.inputs)
        if t_eval is None:
            return None
        check_together(t_eval=t_eval, save_every=None if self.save_every == 1 else self.save_every)
        return times_of_run(t_eval, self.t0, float(self.ends[np.abs(self.ends - self.t0).argmax()]))

    def __len__(self) -> int:
        return len(self.start[0])

    @cached_property
    def most_states(self) -> float:
        """Largest number of states of a trajectory: arrays of all have the size of the longest one."""
        numbers = self.stepper.interface.words * (1 + 2 * self.stepper.dimension)  # of a state
        return math.inf if self.t_eval is not None else room_for_states() / (8 * numbers * max(len(self), 1))

    @property
    def length(self) -> int:
        """Final value of ``progress``: the number of common steps, or of trajectories with adaptive steps."""
        return len(self) if self.common is None else self.common.steps.steps

    def part(self, part: slice) -> dict[str, object]:
        """Return keyword arguments that construct the ensemble of a slice of the trajectories."""
        arguments: dict[str, object] = {
            "q": self.start[0][part],
            "p": self.start[1][part],
            "inputs": inputs_of_slice(self.inputs, part) or None,
            "save_every": self.save_every,
            "t": self.t0,
            "parameters": self.parameters[part],
            "options": self.options,
            "observe": self.observe,
            "error": self.error,
        }
        if self.common is None:
            ends = [plan.t_end for plan in self.plans[part]]
            if self.fixed is not None:
                return arguments | self._fixed_steps()
            return arguments | {"t_end": ends, "t_eval": self.t_eval} | self.control.named
        return arguments | self._fixed_steps()

    def _fixed_steps(self) -> dict[str, Any]:
        fixed = self.fixed or cast(CommonRuns, self.common).steps
        return {"h": fixed.h} | ({"steps": fixed.steps} if fixed.t_end is None else {"t_end": fixed.t_end})

    def keep(self, part: slice, trajectories: EnsembleTrajectory) -> None:
        """Store the results of a slice that was integrated elsewhere."""
        if self.common is None:
            fallbacks, actions = cast(Array, trajectories.fallback_steps).tolist(), trajectories.actions
            for k, each in enumerate(trajectories.each()):
                events = trajectories.events[k] if trajectories.events else ()
                count = len(each[0])
                sums = None if actions is None else actions[:count, k]
                tau = None if trajectories.tau is None else trajectories.tau[:count, k]
                self.saved[part.start + k] = SavedLane(*each, fallbacks[k], events, sums, tau)
            if self.error is not None:
                self.confirmations[part] = trajectories.confirmations
                cast(list[Until | Adaptive], self.plans)[part] = trajectories.plans
            return
        common = cast(CommonRuns, self.common)
        common.q[:, part], common.p[:, part] = trajectories.q, trajectories.p
        common.status[part], common.done[part] = trajectories.status, trajectories.steps
        common.fallback_steps[part] = cast(Array, trajectories.fallback_steps)
        if common.times is not None:
            common.times[:, part] = trajectories.t
        if common.actions is not None:
            common.actions[:, part] = trajectories.actions
        if common.observation is not None:
            common.observation.keep(part, cast(Array, trajectories.observed))

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all trajectories with ``threads`` threads; an exception raised by ``progress`` stops them promptly.

        Afterwards, also after an exception, :meth:`result` returns what was computed.

        Args:
            progress: called with the number of completed steps or trajectories, see :attr:`length`.
            threads: number of threads, by default one per core.
        """
        if self.successive is not None:
            report = None if progress is None else lambda done: progress(int(done))
            self.successive.run(progress=report, threads=threads)
            return
        if self.common is not None:
            self.common.run(progress=progress, threads=threads)
            return

        def advance(j: int, check_stop: StopCheck) -> None:
            self.saved[j] = self._trajectory(j, check_stop)

        run_jobs(len(self), advance, progress=progress, threads=threads)

    def _trajectory(self, j: int, check_stop: StopCheck) -> SavedLane:
        """Return trajectory j as :meth:`Stepper.integrate` does; with ``error`` its confirmed local tolerance is kept.

        One whose confirming runs fail has errors at round-off level.
        """
        plan, (q, p), status = self.plans[j], (each[j] for each in self.start), OK
        of_inputs = columns_of_inputs(self.stepper.interface) if self.inputs else ()
        values = zip(self.stepper.parameters, self.parameters[j].tolist(), strict=True)
        arguments: dict[str, Any] = {
            "parameters": {name: x for k, (name, x) in enumerate(values) if k not in of_inputs},
            "inputs": inputs_of_slice(self.inputs, j) or None,
        } | {
            "t": self.t0,
            "save_every": 1 if self.inputs and self.t_eval is not None else self.save_every,
            "options": self.options,
            "progress": partial(self._check, check_stop),
        }
        if self.stepper.interface.words > 1:
            arguments["parameters"] = self.parameters[j]
        steps: dict[str, Any] = {"t_end": plan.t_end, **self.control.named}
        none = False
        if self.fixed is not None:
            steps = self._fixed_steps()
        elif self.t_eval is not None:
            times = self.t_eval[np.abs(self.t_eval - self.t0) <= abs(plan.t_end - self.t0)]
            none = not times.size  # before the end; runs have at least one
            arguments["t_eval"] = np.array([plan.t_end]) if none else times
        integrate: Callable[..., Trajectory] = self.stepper.integrate
        with without_accuracy_warnings():
            if self.error is not None:
                with suppress(StateError, StepFailedError):
                    states = integrate(q, p, error=self.error, **steps, **arguments)
                    self.confirmations[j], cast(list[Any], self.plans)[j] = states.confirmation, states.plan
                    return SavedLane.of(states, slice(0 if none else None))
            try:
                states = integrate(q, p, **steps, **arguments)
            except StepFailedError as failure:
                states, status = Trajectory.before(failure), failure.status
            except EventError as failure:
                if failure.trajectory is None:
                    raise
                states, status = cast(Trajectory, failure.trajectory), EVENT_FAILED
            except StateError:  # a sum of finite terms has overflowed
                return self._unfinished(j)._replace(status="not finite")
        return SavedLane.of(states, slice(0) if none else self._common_rows(states), status)

    def _check(self, check_stop: StopCheck, steps: int) -> None:
        """Raise an error if another trajectory failed, or if a run has more states than :attr:`most_states`."""
        check_stop(steps)
        if steps // self.save_every > self.most_states:
            raise too_many_states(steps // self.save_every, steps, math.nan)

    def _common_rows(self, states: Trajectory) -> Any:
        """Return the rows at the common times of fixed steps: the last states there, after changes by events."""
        if self.fixed is None or self.t_eval is None:
            return slice(None)
        times, common = (states.forward * np.asarray(each) for each in (states.t, self.t_eval))
        latest = common + WHOLE * abs(self.fixed.h)
        return np.searchsorted(times, latest[latest < times[-1] + 2 * WHOLE * abs(self.fixed.h)], side="right") - 1

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories; those neither completed nor failed have the status ``"interrupted"``."""
        if self.common is None:
            return self._adaptive_result()
        common, fixed = self.common, self.common.steps
        q, p = common.states()
        spans: tuple[Span, ...] = ()
        if self.inputs:
            spans = tuple((rows, slice(None), partial(self.values_at, each.middle)) for rows, each in fixed.spans())
        return EnsembleTrajectory(
            t=fixed.times(tau=False) if common.times is None else common.times,
            tau=None if common.times is None else fixed.times(tau=True),
            actions=common.actions,
            fallback_steps=common.fallback_steps,
            observed=None if common.observation is None else common.observation.result(),
            q=q,
            p=p,
            status=self._status(common),
            steps=common.done,
            h=fixed.h,
            parameters=self.parameters,
            stepper=self.stepper,
            spans=spans,
        )

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

    def device_result(self) -> DeviceEnsemble:
        """Return the trajectories of a GPU, whose states stay in its memory."""
        common = cast(DeviceRuns, self.common)
        return DeviceEnsemble(
            t=common.steps.times(tau=False),
            observed=None if common.observation is None else common.observation.result(),
            q=common.q,
            p=common.p,
            status=self._status(common),
            steps=common.done,
            h=common.steps.h,
            parameters=self.parameters,
            stepper=self.stepper,
            _to_host=self.result,
        )

    def _status(self, common: CommonRuns | DeviceRuns) -> NDArray[np.str_]:
        unfinished = common.done < common.steps.steps
        if not unfinished.any():
            return common.status
        return np.where(unfinished & (common.status == OK), INTERRUPTED, common.status)

    def _adaptive_result(self) -> EnsembleTrajectory:
        if self.successive is not None and not self.saved:
            return self._successive_result(self.successive)
        lanes = [(self.saved.get(j) or self._unfinished(j)).limited(self.most_states) for j in range(len(self))]
        count = max(len(each.t) for each in lanes) if self.t_eval is None else len(self.t_eval)
        missing, shape = self.stepper._states.missing, (count, len(self), self.stepper.dimension)
        times, q, p = missing(shape[:2]), missing(shape), missing(shape)
        tau = np.full(shape[:2], np.nan) if self.stepper.in_tau else None
        actions = np.full(shape[:2], np.nan) if self.stepper.sums_action else None
        for j, each in enumerate(lanes):
            row = slice(0, len(each.t))
            times[row, j], q[row, j], p[row, j] = each.t, each.q, each.p
            if tau is not None:
                tau[row, j] = 0.0 if each.tau is None else each.tau
            if actions is not None and each.actions is not None:
                actions[row, j] = each.actions
        status = np.array([each.status for each in lanes], dtype="<U32")
        steps = np.array([each.steps for each in lanes], dtype=np.int64)
        fallbacks = np.array([each.fallback_steps for each in lanes], dtype=np.int64)
        whole = self._trajectories(self._common_times(times), q, p, status, steps, fallbacks)
        return replace(whole, tau=tau, actions=actions, events=tuple(each.events for each in lanes))

    def _common_times(self, times: Array) -> Array:
        """Return the (n,) times of all trajectories where they are common, else the (n, k) times of each."""
        common = self.fixed is not None and not self.stepper.in_tau
        if common and not any(event.terminal for event in self.stepper.events):
            complete = np.flatnonzero(np.isfinite(np.asarray(times)).all(axis=0))
            if complete.size:  # all may end before t_end
                return times[:, complete[0]]
        return times if self.t_eval is None else self.t_eval

    def _successive_result(self, work: SuccessiveRuns) -> EnsembleTrajectory:
        count, layout, full = len(self), self.stepper._states, work.status == FULL
        stored = np.where(full, np.minimum(work.stored, 1), work.stored)  # the last state of those with too many
        rows = 1 + int(stored.max())
        index = np.full((rows, count), -1)  # of the states in the order in which C stored them; the last row is NaN
        index[0], first = np.arange(count), count
        for row, trajectory in (each.indices() for each in self.states):
            place = np.where(full[trajectory], np.where(row == work.stored[trajectory], 1, rows), row)
            wanted = place < rows
            index[place[wanted], trajectory[wanted]] = first + np.flatnonzero(wanted)
            first += len(row)

        def ordered(name: str, first: Array) -> Array:
            """Return the rows of all trajectories, NaN after their ends."""
            shape = 1, *first.shape[1:]
            last = np.full(shape, np.nan) if name == "actions" else layout.missing(shape)
            whole = np.concatenate([first, *(getattr(each, name) for each in self.states), last])
            return cast(Array, whole[index] if layout.words > 1 else whole.take(index, axis=0))

        q, p = ordered("q", self.start[0]), ordered("p", self.start[1])
        if self.t_eval is None:
            start = layout.missing((count,))
            start[:] = self.t0
            times = self._common_times(ordered("t", start))
            whole = self._trajectories(times, q, p, work.names, work.done, work.fallback_steps)
            sums = self.stepper.sums_action
            return replace(whole, actions=ordered("actions", np.zeros(count))) if sums else whole
        at = np.where(self.t_eval == self.t0, 0, 1)
        none = layout.missing((1, *q.shape[1:]))  # if no trajectory reached the end
        q, p = (np.concatenate([each, none])[at] for each in (q, p))
        return self._trajectories(self.t_eval, q, p, work.names, work.done, work.fallback_steps)

    def _trajectories(
        self,
        t: Array,
        q: Array,
        p: Array,
        status: NDArray[np.str_],
        steps: NDArray[np.int64],
        fallback_steps: NDArray[np.int64],
    ) -> EnsembleTrajectory:
        return EnsembleTrajectory(
            t=t,
            q=q,
            p=p,
            status=status,
            steps=steps,
            fallback_steps=fallback_steps,
            h=self.plans[0].h if isinstance(self.plans[0], Until) else None,
            plans=() if isinstance(self.plans[0], Until) else cast(Sequence[Adaptive], self.plans),
            confirmations=tuple(self.confirmations),
            parameters=self.parameters,
            stepper=self.stepper,
            spans=tuple(self._spans(t)) if self.inputs else (),
        )

    def _spans(self, t: Array) -> Iterator[Span]:
        """Yield the rows of each trajectory, of states at the times t, in each piece of its inputs."""
        for j, plan in enumerate(self.plans):
            at, end_of_run = t if t.ndim == 1 else t[:, j], plan.t_end
            forward = -1.0 if end_of_run < self.t0 else 1.0
            ends = breakpoints_until(self.t0, end_of_run, self.inputs) or [end_of_run]
            last = np.searchsorted(forward * at[np.isfinite(at)], forward * np.array(ends), side="right").tolist()
            for (start, end), (first, until) in zip(pairwise([self.t0, *ends]), pairwise([0, *last]), strict=True):
                yield slice(first, until), slice(j, j + 1), partial(self.values_at, (start + end) / 2)

    def _unfinished(self, j: int) -> SavedLane:
        first = slice(0, 1 if self.t_eval is None else 0)
        return SavedLane(
            stacked([self.t0])[first], self.start[0][[j]][first], self.start[1][[j]][first], INTERRUPTED, 0
        )


def _append_copies(stored: list[Rows], states: Rows) -> None:
    stored.append(states.copies())
