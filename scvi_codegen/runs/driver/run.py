"""Public class of a run in progress."""

import math
from collections.abc import Callable
from typing import Any, Self, cast

import numpy as np

from scvi_codegen.codegen.native.binding import BY_VELOCITY, IN_DOUBT
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.validation import LARGEST_COUNT
from scvi_codegen.runs.accuracy.growth import measures_growth, warn_of_error_growth
from scvi_codegen.runs.accuracy.local_error import warn_of_inaccuracy
from scvi_codegen.runs.accuracy.warning_switch import warn_of_failed_check
from scvi_codegen.runs.driver.observation import Observation, Saver, saver_of
from scvi_codegen.runs.driver.run_loop import ShortRuns, plain_trajectory, record
from scvi_codegen.runs.nouns import ALL_STATES, Save
from scvi_codegen.runs.results.quantities import describe_run
from scvi_codegen.runs.results.recorded import OfMethod
from scvi_codegen.runs.states.attitude_history import AttitudeHistory
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.states.validation import Array, Parameters, States
from scvi_codegen.runs.states.words import scalar
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory, alone
from scvi_codegen.runs.stepping.noise import BathReport, Noise, report_of
from scvi_codegen.runs.stepping.projection import constraint_values, multipliers
from scvi_codegen.runs.stepping.state_functions import neither_or_both
from scvi_codegen.runs.stepping.step_plan import Fixed, StepPlan, Until
from scvi_codegen.runs.trajectory import Trajectory

MOST_KEPT = 2**16
"""Largest number of doubles of workspace of a run that is kept for later calls."""


class Run(Memory, AttitudeHistory, OfMethod):
    """Run in progress: :class:`Memory` with recording of states."""

    def __init__(self, stepper: Integrator) -> None:
        super().__init__(stepper)
        self._untimed &= not stepper.divides_steps
        self._remarks: int = True  # whether there may be a warning of the last run by `_integrated`

    def __repr__(self) -> str:
        return describe_run(self)

    @classmethod
    def _reusable(cls, stepper: Integrator) -> Self:
        """Return a run to be started that has memory for short runs, if later calls may use it again."""
        run, binding = cls(stepper), stepper.binding
        size = binding._workspace + run._first_saved * len(run._q)
        is_plain = binding.reusable and not run._sums_action and stepper.interface.words == 1
        if is_plain and size <= MOST_KEPT:
            run._rows = ShortRuns(run)
        return run

    def __reduce__(self) -> tuple[Any, ...]:
        parameters = self.stepper.parameters_by_name(self.parameters)
        for name in self._unset_inputs:
            del parameters[f"{name}_0"]
        with self.alone():
            saved = self.snapshot
        return (_restored, (self.stepper, saved, parameters, self._options, self.plan, self.longest))

    @alone
    def record(
        self, steps: int | None = None, *, save_every: int = 1, progress: Callable[[int], None] | None = None
    ) -> Trajectory:
        """Advance by ``steps``; save the present state and those whose step number is a multiple of ``save_every``.

        Adaptive steps end at the target time, whose state is saved as well; ``steps`` may then be omitted. Events of
        the stepper are recorded; a terminal event ends the run before the step that contains it. An
        :class:`~scvi_codegen.AccuracyWarning` is issued when a step is first too large. The warning is suppressed for
        the first 16 steps of a run started at q = 0, p = 0, where a relative error is undefined.

        Raises:
            StepFailedError: if a step fails; ``trajectory`` has the saved states, the run is left before that step.
            EventError: if an event function is not finite.
        """
        before = 0.0 if self._leaving else self.step_error
        trajectory = self._recorded(steps, Save(save_every, progress=progress))
        try:
            warn_of_inaccuracy(trajectory, self, before=math.inf if self._leaving else before)
        except Exception as error:  # noqa: BLE001  (the run is complete)
            warn_of_failed_check(error)
        return trajectory

    def _advance_timed(self, steps: int, progress: Callable[[int], None] | None, stop: Callable[[], bool]) -> None:
        """Advance with the changes of the state by events."""
        if not self.stepper.divides_steps:
            super()._advance_timed(steps, progress, stop)
        else:
            Observation(self, Saver(LARGEST_COUNT)).advance(steps, progress, stop)

    def _recorded(
        self, steps: int | None, save: Save = ALL_STATES, stop: Callable[[], bool] | None = None
    ) -> Trajectory:
        """Return the states as :meth:`record` does, without its warnings and its lock."""
        is_observed = save.t_eval is not None or save.observe is not None
        if self.stepper.searched or is_observed or isinstance(self._plan, Until):
            return Observation(self, saver_of(save)).advance(steps, save.progress, stop or (lambda: False))
        return record(self, steps, save_every=save.save_every, progress=save.progress, stop=stop)

    def _integrated(self, initial: Initial, begins_by: int, growth: bool, steps: int | None, save: Save) -> Trajectory:
        """Start a run that is set up and record it: by one C call if it ends within its number of states.

        ``begins_by``: its value in C; ``growth``: whether the run carries its error.
        """
        plan, h, save_every, short = self._plan, self._h, save.save_every, self._rows
        most = self._first_saved * save_every
        most = most if most < self._longest_first else self._longest_first  # without a call
        fits = steps is None if h is None else steps is not None and steps <= most
        special = self._takes_noise or short is None or self._has_tau or self._unset_inputs or self.stepper.searched
        is_plain = save.t_eval is save.observe is save.progress is None
        self._remarks = True
        if special or not (fits and is_plain and (isinstance(plan, Fixed) or initial.t != plan.t_end)):
            self._start_from(initial, begins_by, growth)
            return self._recorded(steps, save)
        q, p, velocity, t, _, _ = initial
        if velocity is None:
            short.begin(t, q, p)
        else:
            short.begin(t, q, velocity, "velocity")
        if (growth, begins_by) != short.way:
            short.way = short.call.measures_growth, short.call.begins_by = growth, begins_by
        if plan is not short.plan:
            short.set_plan(plan)
        size = most if steps is None else steps
        status = short.integrate(size, save_every)
        if status == IN_DOUBT:
            short.begin(t, *cast(Any, self.stepper)._consistent_state(initial, self._plan))
            short.way = growth, 0
            short.call.begins_by = 0
            status = short.integrate(size, save_every)
        error, error_t, first, last, stored, done, rejected, fallbacks, remarks = short.results()
        if status or (steps is None and done == size):
            return record(self, steps, save_every=save_every, filled=1 + stored, status=status)
        if h is None:
            self._ends = first, last
        self._remarks = remarks or short.has_mesh
        states, sizes = short.recorded(1 + stored, h, save_every)
        return plain_trajectory(self, states, sizes, done, error, error_t, rejected, fallbacks)

    def _start_from(self, initial: Initial, begins_by: int, growth: bool) -> None:
        """Start a run that is set up, as the initial state is given."""
        q, p = cast(Any, self.stepper)._consistent_state(initial, self._plan) if begins_by else initial[:2]
        self._begin(q, cast(States, p), initial.t, growth=growth)

    @property
    def bath(self) -> BathReport | None:
        """Seed of the noise, heat and acceptance of a run in a heat bath; else ``None``."""
        return report_of(self._memory)

    @property
    def velocity(self) -> Array:
        """(m,) velocities."""
        return self.stepper.velocity(self.q, self.p, self._times[0], self._parameters_in_modes)

    @property
    def energy(self) -> float:
        """Energy of the present state."""
        return scalar(self.stepper.energy(self.q, self.p, self._times[0], self._parameters_in_modes))

    @property
    def energies(self) -> tuple[float, float, float]:
        """Kinetic, potential and total energy in double-double arithmetic; of run-time sizes only, else NaN, NaN, E."""
        now = self._q[np.newaxis], self._p[np.newaxis], self._times
        kinetic, potential, total = self.stepper._energy_parts(*now, self._parameters_in_modes)[0].tolist()
        return kinetic, potential, total

    @property
    def momentum_maps(self) -> Array:
        """Conserved quantities of the present state, in the order of ``stepper.momentum_map_names``."""
        return self.stepper.momentum_maps(self.q, self.p, self._times[0], self._parameters_in_modes)

    @property
    def multipliers(self) -> Any:
        """Lagrange multipliers of the present state; of run-time sizes an array over the loops of each constraint.

        Raises:
            MethodError: if the system has no constraints.
        """
        values = multipliers(self.stepper, self.q, self.p, self._times, self._parameters_in_modes)
        return self.stepper.constraint_arrays(values[0])

    @property
    def constraint_values(self) -> tuple[Any, Any]:
        """Constraint residuals and their rates, in the form of :attr:`multipliers`; raises as these."""
        values = constraint_values(self.stepper, self.q, self.p, self._times, self._parameters_in_modes)[:, 0]
        return self.stepper.constraint_arrays(values[0]), self.stepper.constraint_arrays(values[1])


def _restored(
    stepper: Integrator,
    saved: bytes,
    parameters: Parameters,
    options: SolverOptions | None,
    plan: StepPlan | None,
    longest: float = 0.0,
) -> Run:
    run = Run.restored(stepper, saved, parameters=parameters, options=options, plan=plan)
    run.longest = longest
    return run


def integrated(
    stepper: Any,
    initial: Initial,
    plan: StepPlan,
    steps: int | None,
    save: Save,
    segments: Any,
    check_growth: bool | None,
    noise: Noise,
) -> Trajectory:
    """Return a run of validated steps, ``None`` to the target time, with its warnings.

    Args:
        save: states to save.
        segments: of inputs, :class:`~scvi_codegen.runs.driver.segments.InputSegments` or ``None``.
    """
    by_velocity, begins_by = initial.velocity is not None, stepper._begins_by
    if (initial.p is not None) == by_velocity:
        raise neither_or_both(initial.p)
    if begins_by is not None and segments is None:
        begins_by |= BY_VELOCITY * by_velocity
    else:
        q, p = stepper._consistent_state(initial, plan)
        initial, begins_by = initial._replace(q=q, p=p, velocity=None), 0
    try:
        run: Run = stepper._released_runs.pop()
    except IndexError:  # all are in use
        run = Run._reusable(stepper)
    run._set_up(plan, initial)
    run._noise = noise
    growth = not (run._h is not None and not check_growth) and measures_growth(stepper, plan, check_growth)
    if segments is None:
        trajectory = run._integrated(initial, begins_by, growth, steps, save)
    else:
        run._start_from(initial, begins_by, growth)
        run._remarks = True
        trajectory = segments.record(run, save.save_every, save.progress)
    if run._remarks:
        _warn(trajectory, run, segments, growth, check_growth is True)
    if run._rows is not None:  # large memory is freed instead
        stepper._released_runs.append(run)
    return trajectory


def _warn(trajectory: Trajectory, run: Run, segments: Any, growth: bool, requested: bool) -> None:
    """Issue the warnings of a run; those of inaccurate segments are issued one by one."""
    try:
        if segments is None:
            warn_of_inaccuracy(trajectory, run)
        if growth:
            warn_of_error_growth(run, float(trajectory.t[-1]), requested=requested)
    except Exception as failure:  # noqa: BLE001  (the run is complete)
        warn_of_failed_check(failure)
