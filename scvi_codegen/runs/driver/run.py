"""Public class of a run in progress."""

import math
from collections.abc import Callable
from typing import Any, Self, cast

import numpy as np

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.validation import LARGEST_COUNT
from scvi_codegen.runs.accuracy.local_error import warn_of_inaccuracy
from scvi_codegen.runs.accuracy.warning_switch import warn_of_failed_check
from scvi_codegen.runs.driver.observation import Observation, Observe, Saver, saver_of
from scvi_codegen.runs.driver.run_loop import ShortRuns, integrate_short, record
from scvi_codegen.runs.results.descriptions import describe_run
from scvi_codegen.runs.states.attitude_history import AttitudeHistory
from scvi_codegen.runs.states.validation import Array, Parameters, States
from scvi_codegen.runs.states.words import scalar
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import FIRST_STEPS, Memory, alone
from scvi_codegen.runs.stepping.projection import constraint_values, multipliers
from scvi_codegen.runs.stepping.step_plan import Fixed, StepPlan, Until
from scvi_codegen.runs.trajectory import Trajectory

MOST_KEPT = 2**16
"""Largest number of doubles of workspace of a run that is kept for later calls."""


class Run(Memory, AttitudeHistory):
    """Run in progress: :class:`Memory` with recording of states."""

    def __init__(self, stepper: Integrator) -> None:
        super().__init__(stepper)
        self._untimed &= not stepper.changes_states

    def __repr__(self) -> str:
        return describe_run(self)

    @classmethod
    def _reused(cls, stepper: Integrator) -> Self:
        """Return a released run of the stepper, to be started, or a new one if all are in use."""
        try:
            run: Self = stepper._released_runs.pop()
        except IndexError:
            run, binding = cls(stepper), stepper.binding
            size = binding._workspace + FIRST_STEPS * len(run._q)
            is_plain = binding.reusable and not run._sums_action and stepper.interface.words == 1
            if is_plain and size <= MOST_KEPT:
                run._rows = ShortRuns(run)
        return run

    def _release(self) -> None:
        """Let :meth:`_reused` return this run; the caller drops it. Large memory is freed instead."""
        if self._rows is not None:
            self.stepper._released_runs.append(self)

    def __reduce__(self) -> tuple[Any, ...]:
        known = self.stepper.parameters_by_name(self._parameters)
        for name in self._unset_inputs:
            del known[f"{name}_0"]
        with self.alone():
            saved = self.snapshot
        return (_restored, (self.stepper, saved, known, self._options, self.plan, self.longest))

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
        trajectory = self._recorded(steps, save_every=save_every, progress=progress)
        try:
            warn_of_inaccuracy(trajectory, self, before=math.inf if self._leaving else before)
        except Exception as error:  # noqa: BLE001  (the run is complete)
            warn_of_failed_check(error)
        return trajectory

    def _advance_timed(self, steps: int, progress: Callable[[int], None] | None, stop: Callable[[], bool]) -> None:
        """Advance with the changes of the state by events."""
        if not self.stepper.changes_states:
            super()._advance_timed(steps, progress, stop)
        else:
            Observation(self, Saver(LARGEST_COUNT)).advance(steps, progress, stop)

    def _recorded(
        self,
        steps: int | None,
        save_every: int = 1,
        times: Array | None = None,
        progress: Callable[[int], None] | None = None,
        observe: Observe = None,
        stop: Callable[[], bool] | None = None,
    ) -> Trajectory:
        """Return the states as :meth:`record` does, or those at ``times``, without its warnings and its lock."""
        plan = self._plan
        if self.stepper.events or times is not None or observe is not None or isinstance(plan, Until):
            return Observation(self, saver_of(observe, times, save_every)).advance(
                steps, progress, stop or (lambda: False)
            )
        return record(self, steps, save_every=save_every, progress=progress, stop=stop)

    def _integrated(
        self,
        q: States,
        p: States | None,
        velocity: States | None,
        t: float,
        growth: int,
        steps: int | None,
        save_every: int,
        times: Array | None,
        progress: Callable[[int], None] | None,
        observe: Observe,
    ) -> Trajectory:
        """Start a run that is set up and record it as :meth:`_recorded`, a short one by one C call.

        The initial state is (q, p), or q and a velocity; the other is ``None``.
        """
        plan, stores_all = self._plan, times is None and observe is None and progress is None
        most = FIRST_STEPS if save_every == 1 else self._first_steps(save_every)
        fits = steps is None if self._h is None else steps is not None and steps <= most
        special = self._has_tau or self._unset_inputs or self.stepper.events or self._rows is None
        if fits and stores_all and not special and (isinstance(plan, Fixed) or t != plan.t_end):
            return integrate_short(self, q, p, velocity, t, steps, save_every, growth)
        if velocity is not None:
            p = self.stepper.initial_momentum(q, velocity, t, self._parameters)
        self._begin(q, cast(States, p), t, growth)
        return self._recorded(steps, save_every, times, progress, observe)

    @property
    def velocity(self) -> Array:
        """(m,) velocities."""
        return self.stepper.velocity(self.q, self.p, self._times[0], self._parameters)

    @property
    def energy(self) -> float:
        """Energy of the present state."""
        return scalar(self.stepper.energy(self.q, self.p, self._times[0], self._parameters))

    @property
    def energies(self) -> tuple[float, float, float]:
        """Kinetic, potential and total energy in double-double arithmetic; of run-time sizes only, else NaN, NaN, E."""
        now = self._q[np.newaxis], self._p[np.newaxis], self._times
        kinetic, potential, total = self.stepper._energy_parts(*now, self._parameters)[0].tolist()
        return kinetic, potential, total

    @property
    def momentum_maps(self) -> Array:
        """Conserved quantities of the present state, in the order of ``stepper.momentum_map_names``."""
        return self.stepper.momentum_maps(self.q, self.p, self._times[0], self._parameters)

    @property
    def multipliers(self) -> Any:
        """Lagrange multipliers of the present state; of run-time sizes an array over the loops of each constraint.

        Raises:
            MethodError: if the system has no constraints.
        """
        values = multipliers(self.stepper, self.q, self.p, self._times, self._parameters)
        return self.stepper.constraint_arrays(values[0])

    @property
    def constraint_values(self) -> tuple[Any, Any]:
        """Constraint residuals and their rates, in the form of :attr:`multipliers`; raises as these."""
        values = constraint_values(self.stepper, self.q, self.p, self._times, self._parameters)[:, 0]
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
