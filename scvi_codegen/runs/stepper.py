"""Compiled integrator for users: :class:`Integrator` with runs, trajectories and ensembles.

``step`` is a pure function. A *run* (:meth:`Stepper.start`, used by :meth:`Stepper.integrate`) has memory: a predictor
that extrapolates the previous step, and compensation terms of the state. The whole memory is one plain C struct;
:meth:`Run.checkpoint` returns its bytes and :meth:`Stepper.from_checkpoint` continues from them bitwise equally.
Neither SymPy nor Jinja is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial, wraps
from math import isfinite
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.binding import BY_VELOCITY, ON_CONSTRAINTS, Binding, with_calls
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.codegen.variants import Variant
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.common.once import Once
from scvi_codegen.common.validation import ArgumentType, checked_count, checks_arguments, of
from scvi_codegen.runs.accuracy.global_error import Runs, checked_error, warn_of_unconfirmed_run
from scvi_codegen.runs.accuracy.growth import measures_growth, warn_of_error_growth
from scvi_codegen.runs.accuracy.local_error import warn_of_inaccuracy
from scvi_codegen.runs.accuracy.warning_switch import warn_of_failed_check
from scvi_codegen.runs.driver.bounded_motion import BoundedMotion
from scvi_codegen.runs.driver.observation import Observe
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.driver.segments import InputSegments, checked_inputs, final_time
from scvi_codegen.runs.ensembles.ensemble import Ensemble, EnsembleSettings, settings_in
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
from scvi_codegen.runs.events.contacts import in_first_modes
from scvi_codegen.runs.events.refinement import WithEventsInDouble, constantly
from scvi_codegen.runs.forwarding import Forwarded, OfSteppers
from scvi_codegen.runs.results.dense_output import check_has_end, times_of_run
from scvi_codegen.runs.results.output import ALL_STATES, Output
from scvi_codegen.runs.states.layout import InitialData
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.validation import Array, Parameters, States, check_step_given, flat_state
from scvi_codegen.runs.states.words import check_doubles, hashed
from scvi_codegen.runs.stepping.array_interface import RunSizes, interface_of_sizes, shapes_of_call, sizes_of_run
from scvi_codegen.runs.stepping.compiled_method import Variants
from scvi_codegen.runs.stepping.features import check_together, require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.noise import DEFAULT_NOISE, Noise, with_sequences
from scvi_codegen.runs.stepping.projection import consistent, constraint_values, multipliers, projected
from scvi_codegen.runs.stepping.saving import read_checkpoint
from scvi_codegen.runs.stepping.state_functions import neither_or_both
from scvi_codegen.runs.stepping.step_plan import (
    Adaptive,
    ErrorControl,
    Fixed,
    FixedSteps,
    KindOfSteps,
    StepPlan,
    Until,
    check_max_step,
    checked_plan,
    duration_of,
    planned_steps,
)
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Event, EventLike
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED

if TYPE_CHECKING:
    from scvi_codegen.runs.products import Products

Called = TypeVar("Called", bound=Callable[..., Any])


class Stepper(WithEventsInDouble, OfSteppers, Integrator):
    """Compiled integrator of one system: :class:`Integrator` with integrations, runs, ensembles and projections."""

    KIND: ClassVar[ArgumentType]
    """Kind of an argument that is a stepper, for ``checks_arguments``."""
    _trajectory_type = Trajectory
    _precise: Callable[[], Stepper | None] | None = None
    """Function that returns the stepper in double-double if there is one, for ``error=`` with precision="auto"."""
    _finer: Callable[[], Any] | None = None
    """Function that returns the stepper of a finer method, for ``run.error``; ``None`` without the system."""

    def _copy(self, events: tuple[Event, ...], source: Source | None = None) -> Self:
        copy = super()._copy(events, source)
        copy._precise, copy._doubles, copy._finer = self._precise, self._doubles, self._finer
        return copy

    def __reduce__(self) -> tuple[Any, ...]:
        if self.origin is not None:
            return (_rebuild_bound, (self.origin, self.problem, self.events))
        variants = self._variants if self._reason is None else Variants()
        made = partial(
            type(self),
            variants=variants,
            flags=self.flags,
            events=self.events,
            reason=self._reason,
            looser=self._looser,
        )
        further: dict[str, Any] = {} if self._finer is None else {"_finer": self._finer}
        if self._doubles is not None and self.events:
            further["_doubles"] = constantly(self._doubles())
        return made, (self._plain, self.interface), further

    @checks_arguments(StateError)
    def integrate(
        self,
        q: States,
        p: States | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        velocity: States | None = None,
        h: float | None = None,
        steps: int | None = None,
        t_end: float | None = None,
        tolerance: float | None = None,
        absolute_tolerance: float | Mapping[str, float] | None = None,
        max_step: float | None = None,
        first_step: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        t_eval: ArrayLike | None = None,
        observe: Observe = None,
        events: EventLike | Sequence[EventLike] | None = None,
        error: float | None = None,
        check_growth: bool | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        threads: int | None = None,
        action: bool = False,
        seed: int = 0,
        metropolis: bool = False,
    ) -> Trajectory:
        """Integrate ``steps`` steps of h, or to t_end, and save every ``save_every``-th state and the initial one.

        Args:
            q, p: (m,) initial positions and momenta.
            inputs: of a system with inputs, by name: ``(t, values)``, interpolated linearly; ``(t, values, kind)`` with
                ``"constant"`` (zero-order hold), ``"linear"`` or ``"cubic"`` (SciPy's spline); a ``CubicSpline`` or
                ``PPoly`` of degree 3 at most; a number; or :class:`~scvi_codegen.ColouredNoise`. Steps end at the
                breakpoints, which preserves the order; states there are saved. Without them inputs need values among
                the parameters.
            velocity: (m,) initial velocities, instead of p.
            h: fixed step size, negative to integrate backward; step of tau in transformed time
                (:func:`~scvi_codegen.reparametrise`).
            steps: number of steps.
            t_end: final time, instead of ``steps``. Without h steps are adaptive and the last ends there exactly. With
                h (also in transformed time and with ``time_transformation``, :func:`~scvi_codegen.compile_stepper`) the
                last step is shorter unless t_end - t is a multiple of h (within 1e-9).
            tolerance: largest error of an adaptive step, relative to the motion of each coordinate in it; by default
                round-off.
            absolute_tolerance: size below which errors of a coordinate do not matter, 0 by default: the error of a
                step is at most ``tolerance * max(motion, absolute_tolerance)``. A number, or numbers by name of
                coordinate, array or rotation (an angle in radians).
            max_step: largest size of an adaptive step; by default not limited.
            first_step: size of the first adaptive step, which is reduced if its error is too large; by default
                determined by trials.
            save_every: steps between saved states; the state at t_end is also saved.
            t: initial time.
            parameters, options: as in :meth:`step`; in transformed time the energy defaults to that of (q, p).
            progress: called with the number of completed steps.
            t_eval: (n,) output times, sorted in the direction of the run, instead of ``save_every``; see
                :meth:`Trajectory.at`. Not with inputs.
            observe: function of the run that returns the data to save instead of the states, a number or an array of
                constant shape, in ``observed`` of the trajectory; or an observer of all states
                (:class:`~scvi_codegen.runs.driver.observation.Observer`) or its name, whose result is saved there:
                ``"extremes"``, the smallest and largest positions and momenta. Not with inputs.
            events: zero crossings to record in ``events`` of the trajectory; a terminal one ends the run, others may
                change the state (:func:`~scvi_codegen.impact`), which is saved as a further state. One or several
                :class:`~scvi_codegen.systems.event.Event` or functions of (q, v, p, t) as text or SymPy
                expression, compiled once with the integrator. By default those of :func:`compile_stepper`.
            error: instead of a tolerance, bound of the relative global error of all saved states up to t_end. Local
                tolerances are reduced until a second run, with other steps and a perturbed initial state, confirms
                the bound: ``global_error``, ``confirmed_digits`` and ``confirmed_until`` of the trajectory. If double
                precision does not suffice (chaotic motion), an :class:`~scvi_codegen.AccuracyWarning` reports the
                time until which the bound is confirmed.
            check_growth: by default adaptive runs with a tolerance below 1e-4 warn if the motion amplifies the errors
                of the steps, by a tangent vector that C carries along the run (of most Lagrangian systems without
                constraints and rotations): above 10,000 tolerances, 1e-10 or 1e-2 of the range of a position.
                ``True``: with every tolerance and with fixed steps, or :class:`MethodError` where there is no such
                vector; ``False``: no check.
            tables, threads: of arrays of run-time sizes: (rows, columns) whole numbers by name, (rows,) for a single
                column; and the number of threads per step, by default one, with bitwise equal results. Threads pay off
                if a step takes longer than some tens of microseconds; they are started by each call of C. The shapes
                of the arrays determine the sizes, and without p and velocity the initial velocity is 0.
            action: sum the action along the run, for :meth:`Trajectory.action`, which otherwise computes the steps
                again. Runs with events that change the state ignore this; arrays of run-time sizes are compiled with
                the sizes of the call.
            seed: with a bath or coloured noise, key of the noise, a whole number, by default 0. Noise is a function
                of the seed, the trajectory, the number of the step and the coordinate.
            metropolis: accept or reject each step, so that averages have no error of the step size.

        Returns:
            A :class:`Trajectory` of steps // save_every + 1 states, fewer if an event ended it; with inputs states
            at breakpoints are additional, and ``pieces`` are the trajectories between them. An
            :class:`~scvi_codegen.AccuracyWarning` reports the worst step if it is too large for the motion.

        Raises:
            StateError: if a shape, name or number is invalid, or inputs do not cover the run.
            EventError: if an event function has an unknown symbol or is not finite.
            StepFailedError: if a step fails; its ``trajectory`` contains the states before.
        """
        if type(save_every) is not int or save_every != 1:
            save_every = checked_count(save_every, "save_every", least=1)
        stepper: Stepper = self if events is None and not action else self._for_run(events, action=action)
        interface = self.interface
        noise = Noise.checked(stepper, seed, metropolis, inputs=inputs) if seed != 0 or metropolis else DEFAULT_NOISE
        if not (inputs is None and t_eval is None and observe is None and tables is None and threads is None):
            self._check_not_of_run(tables, threads)
            stride = None if save_every == 1 else save_every
            check_together(inputs=inputs, t_eval=t_eval, observe=observe, save_every=stride, error=error)
            check_has_end(t_eval, t, h, t_end)
            if inputs is not None:
                end = partial(final_time, t, h, steps, t_end)
                inputs = checked_inputs(interface, with_sequences(interface.inputs, inputs, seed, t=t, h=h, end=end))
        if interface.rotations or interface.variables:
            q, p, velocity = self._states.start(q, p, velocity)
        if error is not None:
            require(stepper, "error")
            motion = BoundedMotion(
                stepper=stepper,
                error=checked_error(error, {"h": h, "steps": steps, "tolerance": tolerance}, self),
                initial=InitialData(q, p, velocity, t, parameters, options),
                end=checked_number(t_end, "the time t_end"),
                control=ErrorControl(None, absolute_tolerance, max_step, first_step),
                inputs=inputs,
                output={"save_every": save_every, "t_eval": t_eval},
                progress=progress,
            )
            return stepper._bounded(motion)
        t = t if type(t) is float and isfinite(t) else self._states.time(t)
        begin = 0.0 if h is None or t_end is None else hashed(t)  # one plan for all times where they do not matter
        schedule = h, steps, t_end, tolerance, absolute_tolerance, max_step, first_step, save_every, begin
        try:
            stepper, plan, count = stepper._planned(*schedule)
        except TypeError:  # of an argument that is not hashable, as an array
            stepper, plan, count = stepper._planned.__wrapped__(*schedule)
        if max_step is not None:
            check_max_step(plan, t, interface.words)
        segments, output = None, ALL_STATES
        if inputs is not None:
            segments = InputSegments(stepper, inputs, parameters, t, final_time(t, h, steps, t_end))
            plan, parameters = segments.plan(plan), segments.first
        if not (save_every == 1 and t_eval is None and observe is None and progress is None):
            times = None if t_eval is None else stepper._output_times(t_eval, t, plan, count)
            output = Output(save_every, times, observe, progress)
        initial = tuple.__new__(InitialData, (q, p, velocity, t, parameters, options))  # without a call of Python
        return stepper._integrated(initial, plan, count, output, segments, check_growth, noise)

    def _integrated(
        self,
        initial: InitialData,
        plan: StepPlan,
        steps: int | None,
        output: Output,
        segments: InputSegments | None,
        check_growth: bool | None,
        noise: Noise,
    ) -> Trajectory:
        """Return a run of validated steps, ``None`` to the target time, with its warnings; ``segments``: of inputs."""
        by_velocity, begins_by = initial.velocity is not None, self._begins_by
        if (initial.p is not None) == by_velocity:
            raise neither_or_both(initial.p)
        if begins_by is not None and segments is None:
            begins_by |= BY_VELOCITY * by_velocity
        else:
            q, p = self._consistent_state(initial, plan)
            initial, begins_by = initial._replace(q=q, p=p, velocity=None), 0
        fixed = isinstance(plan, FixedSteps)
        growth = not (fixed and not check_growth) and measures_growth(self, plan, check_growth)
        try:
            run: Run = self._released_runs.pop()
        except IndexError:  # all are in use
            run = Run._reusable(self)
        run._set_up(plan, initial)
        run._noise = noise
        if segments is None:
            trajectory = run._integrated(initial, begins_by, growth, steps, output)
        else:
            run._start_from(initial, begins_by, growth)
            trajectory = segments.record(run, output.save_every, output.progress)
        try:
            if segments is None:
                warn_of_inaccuracy(trajectory, run)
            if growth:
                warn_of_error_growth(run, float(trajectory.t[-1]), requested=check_growth is True)
        except Exception as failure:  # noqa: BLE001  (the run is complete)
            warn_of_failed_check(failure)
        if run._rows is not None:  # large memory is freed instead
            self._released_runs.append(run)
        return trajectory

    def _for_run(self, events: EventLike | Sequence[EventLike] | None, *, action: bool) -> Self:
        """Return the stepper of runs with these events, ``None`` for its own, that sum the action if requested."""
        stepper = self if events is None else self.with_events(events)
        if action:
            require(stepper, "action")
            return stepper.acting
        return stepper

    def _at_tolerance(self, tolerance: float | None) -> Self:
        """Return the stepper of adaptive runs of a tolerance, whose degree follows it unless the method was named."""
        if self._looser is None or tolerance is None:
            return self
        from scvi_codegen.methods import LOOSE  # here, because it imports mpmath, which packages do without

        if tolerance < LOOSE:
            return self
        stepper = self._looser()
        if self.events:
            stepper = stepper.with_events(self.events)
        return stepper.acting if self.sums_action else stepper

    def _bounded(self, motion: BoundedMotion) -> Trajectory:
        """Return the run whose relative global error is confirmed to be bounded, in double-double if double fails."""
        trajectory: Trajectory = Runs(motion).confirmed_run()
        assert trajectory.confirmation is not None  # by confirmed_run
        if not (trajectory.confirmation.confirmed or self._has_tau) and (precise := self._in_double_double) is not None:
            return precise._bounded(replace(motion, stepper=precise))
        warn_of_unconfirmed_run(trajectory)
        return trajectory

    @property
    def _in_double_double(self) -> Stepper | None:
        """The stepper in double-double of one with precision="auto"; ``None`` if there is none with its events."""
        precise = None if self._precise is None or self.changes_states else self._precise()
        return precise and precise.with_events(self.events)

    @property
    def _has_tau(self) -> bool:
        """Return whether steps are steps of tau, by a transformed system or the reversible controller."""
        return self.in_tau or self.interface.time_transformation is not None

    @checks_arguments(StateError)
    def start(
        self,
        q: States,
        p: States | None = None,
        *,
        velocity: States | None = None,
        h: float | None = None,
        t: float = 0.0,
        t_end: float | None = None,
        tolerance: float | None = None,
        absolute_tolerance: float | Mapping[str, float] | None = None,
        max_step: float | None = None,
        first_step: float | None = None,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        threads: int | None = None,
        seed: int = 0,
        metropolis: bool = False,
    ) -> Run:
        """Return a run from (q, p), or q and a velocity, at t, with fixed steps h or adaptive steps to t_end.

        The other arguments are those of :meth:`integrate`.
        """
        self._check_not_of_run(tables, threads)
        initial = InitialData(*self._states.start(q, p, velocity), t, parameters, options)
        control = ErrorControl(tolerance, absolute_tolerance, max_step, first_step)
        return self._started(initial, self._plan(h, t_end, control), Noise.checked(self, seed, metropolis))

    def _started(self, initial: InitialData, plan: StepPlan, noise: Noise = DEFAULT_NOISE) -> Run:
        """Return a run at its start, on the constraints."""
        stepper = self._at_tolerance(plan.tolerance) if isinstance(plan, Adaptive) else self
        (q, p), (*_, t, parameters, options) = stepper._consistent_state(initial, plan), initial
        return Run.started(stepper, q, p, plan=plan, t=t, parameters=parameters, options=options, noise=noise)

    def _consistent_state(self, initial: InitialData, plan: StepPlan) -> tuple[States, States]:
        """Return (q, p), or q and the momenta of a velocity, on the constraints."""
        q, p, velocity, t, parameters, _ = initial
        p = self._initial_momenta(q, p, velocity, t, parameters)
        if self.interface.contacts:
            return in_first_modes(self, q, p, t, parameters, duration_of(plan, t))
        if not self.interface.constraints:
            return q, p
        return consistent(self, q, p, t, parameters)

    @property
    def products(self) -> Products:
        """What a product on top of the :mod:`scvi_codegen.api` does with the stepper."""
        from scvi_codegen.runs.products import Products

        return Products(self)

    @cached_property
    def _begins_by(self) -> int | None:
        """How a C call begins a run by momenta; ``None`` if the state is always converted before."""
        interface = self.interface
        layout = interface.layout
        if self.in_tau or (layout.coordinates and (layout.momenta or interface.constraints)):
            return None
        return ON_CONSTRAINTS if interface.constraints else 0

    def _run(self, q: Array, p: Array, **arguments: Any) -> Run:
        return Run.started(self, q, p, **arguments)

    def _plan(self, h: float | None, t_end: float | None, control: ErrorControl) -> StepPlan:
        return checked_plan(self._kind_of_steps, h, t_end, control)

    @property
    def _kind_of_steps(self) -> KindOfSteps:
        interface = self.interface
        return KindOfSteps(interface.time_transformation, self.in_tau, interface.words, interface.has_unseen_growth)

    @cached_property
    def _planned(self) -> Any:
        """Function :meth:`_with_plan`, with what it returned before."""
        return lru_cache(maxsize=64, typed=True)(self._with_plan)

    def _with_plan(self, *schedule: Any) -> tuple[Self, StepPlan, int | None]:
        """Return the stepper, the plan and the number of steps of the arguments of :func:`planned_steps`."""
        plan, count = planned_steps(self._kind_of_steps, *schedule)
        return (self._at_tolerance(plan.tolerance) if isinstance(plan, Adaptive) else self), plan, count

    def _output_times(self, t_eval: ArrayLike, t: float, plan: StepPlan, steps: int | None) -> Array:
        require(self, "t_eval")
        if self.interface.words > 1:
            check_doubles(t_eval=t_eval)
        if steps is None:
            return times_of_run(t_eval, t, cast(Until, plan).t_end)
        if self.in_tau:
            raise StateError("t_eval requires t_end instead of steps in transformed time")
        end = times_after(t, cast(Fixed, plan).h, checked_count(steps, "steps", least=0))[0]
        return times_of_run(t_eval, t, float(end))

    def from_checkpoint(
        self,
        saved: bytes,
        *,
        t_end: float | None = None,
        tolerance: float | None = None,
        absolute_tolerance: float | Mapping[str, float] | None = None,
        max_step: float | None = None,
        h: float | None = None,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        threads: int | None = None,
    ) -> Run:
        """Restore a run saved by :meth:`Run.checkpoint`; it continues bitwise equally if ``t_end`` is passed again.

        ``h`` is required with a time transformation and not allowed otherwise. A checkpoint contains the parameters,
        which ``parameters`` changes, the tolerances and the largest size of adaptive steps, which are changed likewise,
        and the tables of arrays of run-time sizes; ``threads`` is the number of threads per step.

        Raises:
            StateError: if the bytes are damaged (their checksum differs) or belong to another integrator.
        """
        transformed = self.interface.time_transformation is not None
        if h is not None and not transformed:
            raise StateError("omit h: the saved run contains its step size")
        control = ErrorControl(tolerance, absolute_tolerance, max_step)
        plan = self._plan(h, t_end, control) if t_end is not None or transformed else None
        if self._reason is not None:
            raise StateError(f"restore this run by with_sizes(...).from_checkpoint(saved): {self._reason}")
        if not self.interface.layout.coordinates:
            self._check_not_of_run(None, threads)
        stepper: Any
        stepper, state, by_name, own = read_checkpoint(
            saved, self.origin or self, threads=threads, adaptive=t_end is not None
        )
        if isinstance(plan, Adaptive):
            plan = ErrorControl(**own._asdict() | control.named).to(plan.t_end)
        if parameters is None or isinstance(parameters, Mapping):
            parameters = by_name | dict(parameters or {})
        return Run.restored(stepper, state, parameters=parameters, options=options, plan=plan)

    @checks_arguments(StateError)
    def integrate_ensemble(
        self,
        q: States,
        p: States | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        velocity: States | None = None,
        h: float | None = None,
        steps: int | None = None,
        t_end: ArrayLike | None = None,
        tolerance: float | None = None,
        absolute_tolerance: float | Mapping[str, float] | None = None,
        max_step: float | None = None,
        first_step: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        t_eval: ArrayLike | None = None,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
        threads: int | None = None,
        error: float | None = None,
        action: bool = False,
        observe: str | None = None,
        seed: int = 0,
        metropolis: bool = False,
        precision: str = "double",
    ) -> EnsembleTrajectory:
        """Run k trajectories on all cores, with common fixed steps (SIMD lanes) or with adaptive steps for each.

        Args:
            q, p: (k, m) initial positions and momenta.
            inputs: of a system with inputs, as of :meth:`integrate`, common to all trajectories, or values of shape
                (k, n), one row per trajectory; k constants. Fixed steps are common, end at all breakpoints and lead to
                one t_end.
            velocity: (k, m) initial velocities, instead of p; of arrays of run-time sizes by default 0.
            h, steps, save_every, t, options, progress: as in :meth:`integrate`.
            t_end: final time; with h the last step is shorter unless h divides the time. Without h and steps: final
                time, or (k,) final times, of adaptive steps; every ``save_every``-th state and the last state of each
                trajectory are saved, with their times in ``times``, and ``progress`` is called with the number of
                completed trajectories.
            tolerance, absolute_tolerance, max_step, first_step: of adaptive steps, as in :meth:`integrate`.
            t_eval: (n,) times at which states are saved instead; NaN after the end of a trajectory.
            parameters: values by name, one number or k each; or an array (k, number of parameters).
            threads: number of threads, by default one per core.
            error: as of :meth:`integrate`, a bound of the relative global error of each trajectory, with a local
                tolerance of its own: ``global_error``, ``confirmed_digits`` and ``confirmed_until`` of the result.
            action: as of :meth:`integrate`.
            observe: what to record of the states after all fixed steps, saved or not, in ``observed`` of the result:
                ``"extremes"`` of q and p, of the ``"energy"``, or numbers of ``"events"`` of the stepper
                (:meth:`with_events`), changes of sign between successive states. Requires SIMD lanes, no inputs.
            seed, metropolis: as of :meth:`integrate`; trajectory k has stream k of the noise.
            precision: ``"double"``, or ``"single"`` for twice as many trajectories in SIMD lanes: fixed steps in
                float32 with compensated sums, so that states have some 45 bits, and are float64. The step size,
                parameters, constants and the time in forces are rounded to 24 bits (docs/ensembles.md). A trajectory
                whose step fails is continued in double precision.

        Returns:
            An :class:`EnsembleTrajectory`; states equal those of :meth:`integrate` to round-off. A trajectory that
            fails has NaN after the failure and the reason in ``status``; the others are unaffected.

        Raises:
            StateError: if a shape, name or number is invalid.
            MethodError: if the method has no trajectories in SIMD lanes, for ``observe`` and single precision.
        """
        settings = EnsembleSettings(*settings_in(locals()))
        runs = self.products.ensemble_runs(q, p, settings, velocity=velocity, action=action)
        runs.run(progress=progress, threads=threads)
        return self.products.ensemble_result(runs)

    def _ensemble(
        self,
        q: States,
        p: States | None,
        settings: EnsembleSettings,
        *,
        velocity: States | None = None,
        action: bool = False,
    ) -> Ensemble:
        """Return the ensemble of :meth:`integrate_ensemble`, with the same arguments."""
        q, p, velocity = self._states.start(q, p, velocity)
        if settings.error is not None:
            require(self, "error")
            steps = {"h": settings.h, "steps": settings.steps, "tolerance": settings.tolerance}
            settings = replace(settings, error=checked_error(settings.error, steps, self))
        stepper = self._for_run(None, action=action)
        if settings.h is None:
            stepper = stepper._at_tolerance(settings.control.checked().get("tolerance"))
        return Ensemble.of(stepper, q, p, settings, velocity=velocity)

    def project(
        self,
        q: States,
        p: States | None = None,
        *,
        velocity: States | None = None,
        t: float = 0.0,
        parameters: Parameters = None,
    ) -> tuple[Array, Array]:
        """Return the nearest state (q, p) on the constraint manifold, in the metric of the mass matrix.

        Without p and velocity the initial velocity is 0.

        Raises:
            MethodError: if the system has no constraints.
            StateError: if the iteration fails, or if the constraints are linearly dependent there.
        """
        momenta = self._initial_momenta(
            q, p, np.zeros(self.dimension) if p is velocity is None else velocity, t, parameters
        )
        q1, p1, _ = projected(self, q, momenta, t, parameters)
        return self.named(q1), self.named(p1)

    def multipliers(self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None) -> Array:
        """Return the Lagrange multipliers lambda of the constraint forces G^T lambda at states: (c,), or (n, c).

        They satisfy d/dt L_v = L_q + f + G^T lambda with G = g_q, or g_v for a velocity constraint; for ``x**2 + y**2 =
        l**2`` the tension of the rod is -2 l lambda. They depend on the state alone and are as accurate as the state.
        """
        check_step_given(self.interface, parameters)
        values = multipliers(self, q, p, t, parameters)
        return values[0] if self._states.is_one(q) else values

    def constraint_values(
        self, q: ArrayLike, p: ArrayLike, t: ArrayLike = 0.0, parameters: Parameters = None
    ) -> tuple[Array, Array]:
        """Return the constraint residuals g and their rates g_q v + g_t: (c,) each, or (n, c).

        For a velocity constraint only the rate is defined; its g is 0 if it does not restrict positions.
        """
        g, rate = constraint_values(self, q, p, t, parameters)
        return (g[0], rate[0]) if self._states.is_one(q) else (g, rate)


class UnavailableError(MethodError, AttributeError):
    """Error of an attribute that requires known sizes; ``hasattr`` is false."""


def _bound(method: Called, *, at_rest: bool = False) -> Called:
    """Return a method of steppers of run-time sizes that binds a stepper to its arrays and calls the method of this.

    It has the further argument ``tables``. The first argument is a position; ``at_rest``: without p and velocity the
    initial velocity is 0.
    """

    @wraps(method)
    def call(self: StepperOfRunTimeSizes, q: Any, *arguments: Any, **named: Any) -> Any:
        return self._call_bound(method, at_rest, q, arguments, **named)

    return cast(Called, call)


def _bound_path(method: Called) -> Called:
    """Return the method ``path``; the positions that determine the sizes are q0, or of closed paths the first."""

    @wraps(method)
    def call(self: StepperOfRunTimeSizes, q0: Any = None, *arguments: Any, **named: Any) -> Any:
        start = named.get("start")
        if q0 is not None or start is None:
            return self._call_bound(method, False, q0, arguments, **named)
        if callable(start):
            first = start(named.get("t", 0.0))
        else:
            first = {name: x[0] for name, x in start.items()} if isinstance(start, Mapping) else start[0]
        return self.bind(first, named.get("parameters"))[0].path(None, *arguments, **named)

    return cast(Called, call)


class StepperOfRunTimeSizes(Stepper):
    """Stepper of arrays whose sizes each call determines: its methods bind a stepper to the arrays of the call."""

    run_time_sizes = True
    _last: tuple[Hashable, Stepper | None] = None, None
    _latest: tuple[Hashable, Stepper] | None = None

    integrate = _bound(Stepper.integrate, at_rest=True)
    start = _bound(Stepper.start, at_rest=True)
    project = _bound(Stepper.project, at_rest=True)
    integrate_ensemble = _bound(Stepper.integrate_ensemble, at_rest=True)
    _ensemble = _bound(Stepper._ensemble, at_rest=True)
    chaos_indicators_ensemble: Any = Forwarded("steppers", "chaos_indicators_ensemble", partial(_bound, at_rest=True))
    path: Any = Forwarded("steppers", "path", _bound_path)
    multipliers, constraint_values = _bound(Stepper.multipliers), _bound(Stepper.constraint_values)
    step, step_positions = _bound(Stepper.step), _bound(Stepper.step_positions)
    discrete_lagrangian = _bound(Stepper.discrete_lagrangian)
    discrete_legendre_minus = _bound(Stepper.discrete_legendre_minus)
    discrete_legendre_plus = _bound(Stepper.discrete_legendre_plus)
    work_and_impulses, rates = _bound(Stepper.work_and_impulses), _bound(Stepper.rates)
    energy, momentum_maps = _bound(Stepper.energy), _bound(Stepper.momentum_maps)
    momentum, velocity = _bound(Stepper.momentum), _bound(Stepper.velocity)
    initial_momentum = _bound(Stepper.initial_momentum)
    jacobian, sensitivity = _bound(Stepper.jacobian), _bound(Stepper.sensitivity)
    jvp, vjp = _bound(Stepper.jvp), _bound(Stepper.vjp)

    def _call_bound(
        self,
        method: Callable[..., Any],
        at_rest: bool,
        q: Any,
        arguments: tuple[Any, ...],
        *,
        parameters: Any = None,
        tables: Mapping[str, ArrayLike] | None = None,
        **named: Any,
    ) -> Any:
        """Call a method of the stepper that is bound to the arrays of the call."""
        if method in (Stepper.integrate_ensemble, Stepper._ensemble):
            operations = {"observe": "observe_ensemble", "precision": "single"}
            for argument, operation in operations.items():
                if named.get(argument) not in (None, "double"):
                    require(self, operation)
        threads = named.pop("threads", None) if method in PER_STEP else None
        stepper = self if named.get("events") is None else self.with_events(named.pop("events"))
        bound, state = stepper.bind(q, parameters, tables, threads)
        if len(arguments) == 1 and arguments[0] is None:  # p=None by position
            arguments = ()
        if at_rest and not arguments and named.get("p") is None and named.get("velocity") is None:
            layout = self.interface.layout
            general = layout.momentum_formulas or (self._reason is not None and not layout.momenta)
            spins = any(rotation.startswith("spin") for rotation in bound.interface.rotations)
            if not (spins or bound.interface.variables):  # their state has momenta of its own
                positions, *_ = bound._states.start(state, None, None)
                named["velocity" if general else "p"] = np.zeros(np.shape(positions))
        return method(bound, state, *arguments, parameters=parameters, **named)

    def bind(
        self, q: Any, parameters: Any = None, tables: Mapping[str, ArrayLike] | None = None, threads: int | None = None
    ) -> tuple[Any, Any]:
        """See :meth:`CompiledMethod.bind`."""
        shapes, (last, bound) = None if tables is not None else shapes_of_call(q, parameters, threads), self._last
        if shapes is None or shapes != last or bound is None:
            problem = sizes_of_run(self.interface, q, parameters, tables, threads)
            if self._reason is None:
                bound = self._bound_to(problem)
            elif problem.threads > 1:
                raise MethodError(f"omit threads: this system is compiled with the sizes of each call. {self._reason}")
            else:
                bound = self.with_sizes(problem.sizes, tables=problem.places)
            self._last = shapes, bound
        if self.events:
            bound = bound.with_events(self.events)
        if (type(q) is np.ndarray and q.ndim == 1) or bound.interface.rotations or bound.interface.variables:
            return bound, q
        return bound, flat_state(bound.interface, q, "q")

    def _bound_to(self, problem: RunSizes) -> Stepper:
        """Return the stepper bound to these sizes and tables; the latest one is kept for later calls."""
        if self._latest is None or self._latest[0] != problem.key:

            def make(variant: Variant) -> Source | None:
                stepper = bound.known if variant.of_known_sizes else self
                return stepper._variants[variant]

            interface = interface_of_sizes(self.interface, problem.sizes)
            looser = None if self._looser is None else Once(lambda: cast(Any, self._looser)()._bound_to(problem))
            further: dict[str, Any] = {"variants": Variants(make=make), "flags": self.flags, "looser": looser}
            bound = Stepper(self._plain, interface, origin=self, problem=problem, **further)
            self._latest = problem.key, bound
        return self._latest[1]

    def _load(self) -> None:
        """Load nothing: bound steppers load the library."""

    def __getattr__(self, name: str) -> Any:
        if name in ("binding", "dimension"):  # of which the properties raised this error
            raise self._unavailable(name)
        raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")

    def _unavailable(self, name: str) -> UnavailableError:
        return UnavailableError(f"{name} is not available for {self!r}: {SIZES_REQUIRED}")

    @property
    def binding(self) -> Binding:
        """Unavailable: bound steppers have one."""
        raise self._unavailable("binding")

    @property
    def dimension(self) -> int:
        """Unavailable: it depends on the sizes."""
        raise self._unavailable("dimension")

    @property
    def known(self) -> Self:
        """Unavailable: a stepper of these sizes is required."""
        raise MethodError(f"{self!r} requires sizes here: pass stepper.with_sizes(..). {SIZES_REQUIRED}")

    def _compile(self) -> None:
        if self._reason is None:
            building.load(with_calls(self.source), flags=self.flags)

    @property
    def _has_error_estimate(self) -> bool:
        """True if the method has adaptive steps; also if that follows from the sizes."""
        return self._reason is not None or "advance_to" in self.source.contents.functions


PER_STEP = (Stepper.integrate, Stepper.start)
"""Methods whose ``threads`` are those of each step."""


def _rebuild_bound(origin: StepperOfRunTimeSizes, problem: RunSizes, events: tuple[Event, ...]) -> Stepper:
    return origin._bound_to(problem)._copy(events)


Stepper.KIND = of("a compiled stepper", Stepper)
"""Type check of steppers."""
