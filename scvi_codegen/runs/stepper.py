"""Compiled integrator for users: :class:`Integrator` with runs, trajectories and ensembles.

``step`` is a pure function. A *run* (:meth:`Stepper.start`, used by :meth:`Stepper.integrate`) has memory: a predictor
that extrapolates the previous step, and compensation terms of the state. The whole memory is one plain C struct;
:meth:`Run.checkpoint` returns its bytes and :meth:`Stepper.from_checkpoint` continues from them bitwise equally.
Neither SymPy nor Jinja is imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import BY_STEPS
from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.binding import ON_CONSTRAINTS
from scvi_codegen.codegen.native.option_table import LOCATED, OPTION
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import MethodError, StateError
from scvi_codegen.common.once import constantly
from scvi_codegen.common.validation import LARGEST_COUNT, ArgumentType, checked_count, checks_arguments, of
from scvi_codegen.runs.forwarding import OfSteppers
from scvi_codegen.runs.nouns import ALL_STATES, PLAIN, PLAIN_BUT_GROWTH, Execution, Save
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.validation import Array, Parameters, States, check_step_given
from scvi_codegen.runs.states.words import check_doubles, hashed
from scvi_codegen.runs.stepping.compiled_method import Variants
from scvi_codegen.runs.stepping.features import check_strict_energy, check_together, require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.noise import DEFAULT_NOISE, Noise, with_sequences
from scvi_codegen.runs.stepping.projection import consistent, constraint_values, multipliers, projected
from scvi_codegen.runs.stepping.step_plan import (
    Adaptive,
    Fixed,
    Span,
    StepPlan,
    Steps,
    Until,
    checked_plan,
    duration_of,
    planned_steps,
)
from scvi_codegen.systems.event import Event, EventLike

if TYPE_CHECKING:
    from scvi_codegen.runs.driver.observation import Observe
    from scvi_codegen.runs.driver.run import Run
    from scvi_codegen.runs.ensembles.ensemble import Ensemble, EnsembleSettings
    from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
    from scvi_codegen.runs.events.functions import EventFunctions
    from scvi_codegen.runs.products import Products
    from scvi_codegen.runs.trajectory import Trajectory

Called = TypeVar("Called", bound=Callable[..., Any])


class Stepper(OfSteppers, Integrator):
    """Compiled integrator of one system: :class:`Integrator` with integrations, runs, ensembles and projections."""

    KIND: ClassVar[ArgumentType]
    """Kind of an argument that is a stepper, for ``checks_arguments``."""
    _precise: Callable[[], Stepper | None] | None = None
    """Function that returns the stepper in double-double if there is one, for ``error=`` with precision="auto"."""
    _doubles: Callable[[], Stepper] | None = None
    """Function that returns the integrator in double, without events, of one in double-double."""
    _finer: Callable[[], Any] | None = None
    """Function that returns the stepper of a finer method, for ``run.error``; ``None`` without the system."""

    def _copy(self, events: tuple[Event, ...], source: Source | None = None) -> Self:
        copy = super()._copy(events, source)
        copy._precise, copy._doubles, copy._finer = self._precise, self._doubles, self._finer
        copy.by_steps, copy.strict_energy = self.by_steps, self.strict_energy
        return copy

    @property
    def _in_double(self) -> Stepper:
        """The integrator in double with the same events, which locates those of one in double-double."""
        if self._doubles is None:
            raise MethodError(
                "events= with precision='double-double' require the integrator in double, which a stepper that was "
                "loaded or pickled without events lacks: compile the system"
            )
        return self._doubles().with_events(self.events)

    def _compile(self) -> None:
        super()._compile()
        if self.events and self._doubles is not None:
            self._in_double._compile()
            _ = self._event_functions

    @cached_property
    def _event_functions(self) -> EventFunctions:
        """The functions of the events in 40 digits."""
        from scvi_codegen.runs.events.functions import EventFunctions

        return EventFunctions(self, self.events)

    def __reduce__(self) -> tuple[Any, ...]:
        if self.origin is not None:
            return cast(Any, self.origin)._rebuilt, (self.problem, self.events)
        variants = self._variants if self._reason is None else Variants()
        made = partial(
            type(self),
            variants=variants,
            flags=self.flags,
            events=self.events,
            reason=self._reason,
            looser=self._looser,
        )
        further: dict[str, Any] = {"by_steps": self.by_steps, "strict_energy": self.strict_energy}
        if self._finer is not None:
            further["_finer"] = self._finer
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
        transitions: str | None = None,
        strict_energy: bool = False,
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
            transitions: of contacts, ``"located"`` or ``"by steps"`` of a fixed size h without transitions, by svi:1,
                for feet and piles (docs/contacts.md); by default those that the stepper was compiled for.
            strict_energy: by steps, shrink all velocities together where a step would raise the energy, those of bodies
                that touch nothing, too; rises of the others are of the order h^3.

        Returns:
            A :class:`Trajectory` of steps // save_every + 1 states, fewer if an event ended it; with inputs states
            at breakpoints are additional, and ``pieces`` are the trajectories between them. An
            :class:`~scvi_codegen.AccuracyWarning` reports the worst step if it is too large for the motion.

        Raises:
            StateError: if a shape, name or number is invalid, or inputs do not cover the run.
            EventError: if an event function has an unknown symbol or is not finite.
            StepFailedError: if a step fails; its ``trajectory`` contains the states before.
        """
        noise = Noise(seed, 0, metropolis) if seed != 0 or metropolis else DEFAULT_NOISE
        others = inputs, events, tables, threads, action, transitions, strict_energy, noise
        new = tuple.__new__  # nouns without calls of Python
        is_plain = check_growth is None and others == PLAIN_BUT_GROWTH
        saves_all = (
            t_eval is None and observe is None and progress is None and type(save_every) is int and save_every == 1
        )
        return self._integrate(
            new(Initial, (q, p, velocity, t, parameters, options)),
            new(Steps, (tolerance, absolute_tolerance, max_step, first_step, h, error)),
            new(Span, (steps, t_end)),
            ALL_STATES if saves_all else new(Save, (save_every, t_eval, observe, progress)),
            PLAIN if is_plain else new(Execution, (check_growth, *others)),
        )

    def _integrate(self, initial: Initial, size: Steps, span: Span, save: Save, way: Execution = PLAIN) -> Trajectory:
        """Return a run of :meth:`integrate`: the door of all runs that are asked for by nouns."""
        stepper, inputs, noise, t = self, way.inputs or None, DEFAULT_NOISE, initial.t
        if type(every := save.save_every) is not int or every < 1 or every > LARGEST_COUNT:
            save = save._replace(save_every=(every := checked_count(every, "save_every", least=1)))
        if way is not PLAIN and way[1:] != PLAIN_BUT_GROWTH:
            self._check_not_of_run(way.tables, way.threads)
            stepper = self._for_run(way)
            noise = way.noise.checked(stepper, inputs)
        if not (inputs is None and save.t_eval is None and save.observe is None):
            inputs = stepper._checked_together(initial, size, span, save, inputs, noise.seed)
        if self.interface.rotations or self.interface.variables:
            q, p, velocity = self._states.start(*initial[:3])
            initial = initial._replace(q=q, p=p, velocity=velocity)
        if size.error is not None:
            return stepper._bounded(initial, size, span, save, inputs)
        if type(t) is not float or t - t != 0.0:  # not finite
            initial = initial._replace(t=(t := self._states.time(t)))
        begin = 0.0 if span.t_end is None or (size.h is size.max_step is None) else hashed(t)  # one plan for all times
        try:
            stepper, plan, count = stepper._planned(*size, *span, every, begin)
        except TypeError:  # of an argument that is not hashable, as an array
            stepper, plan, count = stepper._planned.__wrapped__(*size, *span, every, begin)
        segments = None
        if inputs is not None:
            from scvi_codegen.runs.driver.segments import InputSegments, final_time

            end = final_time(t, size.h, *span)
            segments = InputSegments(stepper, inputs, initial.parameters, t, end)
            plan, initial = segments.plan(plan), initial._replace(parameters=segments.first)
        if save.t_eval is not None:
            save = save._replace(t_eval=stepper._output_times(save.t_eval, t, plan, count))
        trajectory: Trajectory = stepper._integrated(initial, plan, count, save, segments, way.check_growth, noise)
        return trajectory

    def _checked_together(
        self, initial: Initial, size: Steps, span: Span, save: Save, inputs: Mapping[str, Any] | None, seed: int
    ) -> Mapping[str, Any] | None:
        """Return checked inputs; raise an error for what they, output times or an observer exclude."""
        from scvi_codegen.runs.driver.segments import checked_inputs, final_time
        from scvi_codegen.runs.results.dense_output import check_has_end

        (save_every, t_eval, observe, _), (h, t) = save, (size.h, initial.t)
        stride = None if save_every == 1 else save_every
        check_together(inputs=inputs, t_eval=t_eval, observe=observe, save_every=stride, error=size.error)
        check_has_end(t_eval, t, h, span.t_end)
        if inputs is None:
            return None
        names, end = self.interface.inputs, partial(final_time, t, h, *span)
        return checked_inputs(self.interface, with_sequences(names, inputs, seed, t=t, h=h, end=end))

    @cached_property
    def _integrated(self) -> Callable[..., Trajectory]:
        """Function :func:`~scvi_codegen.runs.driver.run.integrated` of this stepper: a run with its warnings."""
        from scvi_codegen.runs.driver.run import integrated

        return partial(integrated, self)

    def _for_run(self, way: Execution) -> Self:
        """Return the stepper of runs with these events, ``None`` for its own, that sum the action if requested."""
        stepper = self.with_events(way.events).by_transitions(way.transitions, strict_energy=way.strict_energy)
        if not way.action:
            return stepper
        require(stepper, "action")
        return stepper.acting

    def by_transitions(self, transitions: str | None = None, *, strict_energy: bool = False) -> Self:
        """Return the stepper whose runs locate transitions of contacts, ``"located"``, or take steps, ``"by steps"``.

        The latter raise no energy if ``strict_energy``; both are those of :meth:`integrate`.

        Raises:
            MethodError: if the stepper has no steps of contacts, as those of other methods than svi:1, or these alone.
        """
        if strict_energy:
            return self.by_transitions(transitions)._with_strict_energy()
        if transitions is None:
            return self
        steps = OPTION["transitions"].checked(transitions) == BY_STEPS
        if self.by_steps and not steps:
            raise MethodError(f"transitions='{LOCATED}' is not available with a stepper by steps: compile another")
        return self.with_steps_of_contacts if steps else self

    def _with_strict_energy(self) -> Self:
        """Return the stepper by steps none of which may raise energy."""
        check_strict_energy(self.interface, by_steps=self.by_steps)
        stepper = self._copy(self.events)
        stepper.strict_energy = True
        return stepper

    def _at_tolerance(self, tolerance: float | None) -> Self:
        """Return the stepper of adaptive runs of a tolerance, whose degree follows it unless the method was named."""
        if self._looser is None or tolerance is None:
            return self
        from scvi_codegen.methods import LOOSE  # here, because it imports mpmath, which packages do without

        if tolerance < LOOSE:
            return self
        stepper = self._looser().with_events(self.events)
        return stepper.acting if self.sums_action else stepper

    def _bounded(self, initial: Initial, size: Steps, span: Span, save: Save, inputs: Any) -> Trajectory:
        """Return the run whose relative global error is confirmed to be bounded, in double-double if double fails."""
        from scvi_codegen.runs.accuracy.global_error import Runs, checked_error, warn_of_unconfirmed_run

        require(self, "error")
        size, end = checked_error(size, span, self), checked_number(span.t_end, "t_end")
        trajectory: Trajectory = Runs(self, initial, size, end, save, inputs).confirmed_run()
        assert trajectory.confirmation is not None  # by confirmed_run
        if not (trajectory.confirmation.confirmed or self._has_tau) and (precise := self._in_double_double) is not None:
            return precise._bounded(initial, size, span, save, inputs)
        warn_of_unconfirmed_run(trajectory)
        return trajectory

    def _step_of_tau(self, initial: Initial, end: float, tolerance: float) -> float:
        """Return the largest step of tau for a tolerance."""
        from scvi_codegen.runs.driver.largest_step import largest_step

        q, p, velocity, t, parameters, options = initial
        momenta = self._initial_momenta(q, p, velocity, t, parameters)
        return largest_step(self, q, momenta, end - t, tolerance, t=t, parameters=parameters, options=options)

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
        initial = Initial(*self._states.start(q, p, velocity), t, parameters, options)
        plan = checked_plan(self.interface, Steps(tolerance, absolute_tolerance, max_step, first_step, h), t_end)
        return self._started(initial, plan, Noise(seed, 0, metropolis).checked(self))

    def _started(self, initial: Initial, plan: StepPlan, noise: Noise = DEFAULT_NOISE) -> Run:
        """Return a run at its start, on the constraints."""
        from scvi_codegen.runs.driver.run import Run

        stepper = self._at_tolerance(plan.tolerance) if isinstance(plan, Adaptive) else self
        (q, p), (*_, t, parameters, options) = stepper._consistent_state(initial, plan), initial
        return Run.started(stepper, q, p, plan=plan, t=t, parameters=parameters, options=options, noise=noise)

    def _consistent_state(self, initial: Initial, plan: StepPlan) -> tuple[States, States]:
        """Return (q, p), or q and the momenta of a velocity, on the constraints."""
        q, p, velocity, t, parameters, _ = initial
        p = self._initial_momenta(q, p, velocity, t, parameters)
        if self.interface.contacts and not self.by_steps:
            from scvi_codegen.runs.events.contacts import in_first_modes

            return in_first_modes(self, q, p, t, parameters, duration_of(plan, t))
        if not self.interface.imposed:
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
        from scvi_codegen.runs.driver.run import Run

        return Run.started(self, q, p, **arguments)

    @cached_property
    def _planned(self) -> Any:
        """Function :meth:`_with_plan`, with what it returned before for arguments of the same types."""
        return lru_cache(maxsize=64, typed=True)(self._with_plan)

    def _with_plan(self, *numbers: Any) -> tuple[Self, StepPlan, int | None]:
        """Return the stepper, the plan and the number of steps of :func:`planned_steps`, whose nouns are spread."""
        size, (steps, t_end, *rest) = Steps(*numbers[: len(Steps._fields)]), numbers[len(Steps._fields) :]
        plan, count = planned_steps(self.interface, size, Span(steps, t_end), *rest)
        return (self._at_tolerance(plan.tolerance) if isinstance(plan, Adaptive) else self), plan, count

    def _output_times(self, t_eval: ArrayLike, t: float, plan: StepPlan, steps: int | None) -> Array:
        from scvi_codegen.runs.results.dense_output import times_of_run

        require(self, "t_eval")
        check_doubles(self.interface.words, t_eval=t_eval)
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
        from scvi_codegen.runs.driver.run import Run
        from scvi_codegen.runs.stepping.saving import read_checkpoint

        transformed = self.interface.time_transformation is not None
        if h is not None and not transformed:
            raise StateError("omit h: the saved run contains its step size")
        control = Steps(tolerance, absolute_tolerance, max_step, h=h)
        plan = checked_plan(self.interface, control, t_end) if t_end is not None or transformed else None
        if self._reason is not None:
            raise StateError(f"restore this run by with_sizes(...).from_checkpoint(saved): {self._reason}")
        if not self.interface.layout.coordinates:
            self._check_not_of_run(None, threads)
        stepper: Any
        stepper, state, by_name, own = read_checkpoint(
            saved, self.origin or self, threads=threads, adaptive=t_end is not None
        )
        if isinstance(plan, Adaptive):
            plan = Steps(**own._asdict() | control.named).to(plan.t_end)
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
        transitions: str | None = None,
        strict_energy: bool = False,
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
            transitions, strict_energy: of contacts, as of :meth:`integrate`.

        Returns:
            An :class:`EnsembleTrajectory`; states equal those of :meth:`integrate` to round-off. A trajectory that
            fails has NaN after the failure and the reason in ``status``; the others are unaffected.

        Raises:
            StateError: if a shape, name or number is invalid.
            MethodError: if the method has no trajectories in SIMD lanes, for ``observe`` and single precision.
        """
        from scvi_codegen.runs.ensembles.ensemble import EnsembleSettings, settings_in

        settings = EnsembleSettings(*settings_in(locals()))
        stepper = self.by_transitions(transitions, strict_energy=strict_energy)
        runs = stepper.products.ensemble_runs(q, p, settings, velocity=velocity, action=action)
        runs.run(progress=progress, threads=threads)
        return stepper.products.ensemble_result(runs)

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
        from scvi_codegen.runs.ensembles.ensemble import Ensemble

        q, p, velocity = self._states.start(q, p, velocity)
        if settings.error is not None:
            from scvi_codegen.runs.accuracy.global_error import checked_error

            require(self, "error")
            size = checked_error(settings.size, Span(settings.steps), self)
            settings = replace(settings, error=size.error)
        stepper = self._for_run(Execution(action=action))
        if settings.h is None:
            stepper = stepper._at_tolerance(settings.size.checked().get("tolerance"))
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
        require(self, "project")
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


Stepper.KIND = of("a compiled stepper", Stepper)
"""Type check of steppers."""
