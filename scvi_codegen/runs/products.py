"""What products of :mod:`scvi_codegen.extras` do with a stepper, besides its public integrations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import TangentVectors
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.announcements import tell
from scvi_codegen.codegen.native.binding import Binding
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.representation import with_uncertainty
from scvi_codegen.common.thread_pool import run_jobs
from scvi_codegen.runs.accuracy.global_error import warn_of_unconfirmed
from scvi_codegen.runs.accuracy.local_error import warn_of_energy_errors
from scvi_codegen.runs.accuracy.resolution import warn_of_unresolved_members
from scvi_codegen.runs.accuracy.size import LOST, RESOLVED
from scvi_codegen.runs.accuracy.warning_switch import warn_of_failed_check, warnings_wanted
from scvi_codegen.runs.derivatives.actions import actions_of_steps
from scvi_codegen.runs.driver.segments import Input, checked_inputs, parameters_of
from scvi_codegen.runs.ensembles.ensemble import Ensemble, EnsembleSettings, momenta_of_each, start_of_ensemble
from scvi_codegen.runs.ensembles.individual import IndividualRuns, runs_of
from scvi_codegen.runs.ensembles.lanes import CommonRuns, LaneRuns
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory
from scvi_codegen.runs.ensembles.schedule import CommonSteps
from scvi_codegen.runs.events.saltation import check_sides
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.states.reduction import Reduction
from scvi_codegen.runs.states.rotation_quantities import observable_derivatives, observable_names, observables
from scvi_codegen.runs.states.rotations import Member, members_of
from scvi_codegen.runs.states.validation import (
    Array,
    Parameters,
    States,
    check_inputs_given,
    check_step_given,
    columns_of_inputs,
)
from scvi_codegen.runs.stepping.array_interface import RunArrays, check_accesses, read_arrays
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.projection import linearised
from scvi_codegen.runs.stepping.step_derivatives import Starts
from scvi_codegen.runs.stepping.step_plan import StepPlan, Steps
from scvi_codegen.systems.event import Event

if TYPE_CHECKING:
    from scvi_codegen.codegen.rendering.events import EventFormulas
    from scvi_codegen.runs.driver.run import Run


class Products:
    """Checks, reduced states, inputs and blocks of ensembles of a stepper, ``stepper.products``.

    Attributes:
        states: layout of states: ``start``, ``positions`` and ``vector`` read those by name, ``axes`` counts axes.
        parameters: returns the (k,) parameters of values by name, the others by default; StateError for wrong ones.
        propagate: propagates tangent vectors along steps, ``propagate(starts, vectors, parameters, options)``: of the
            (n + 1, count, tangents) variations the image of row i under step i of n is added to row i + 1, with
            ``transpose=True`` that of row i + 1 to row i. StepFailedError if a step fails.
    """

    def __init__(self, stepper: Any) -> None:
        self.stepper = stepper
        self.states, self.parameters, self.propagate = stepper._states, stepper._parameters, stepper._propagate

    RESOLVED = RESOLVED
    """Number of roundings of the largest value from which a difference counts as resolved."""

    LOST = LOST
    """Relative error from which on a state has no meaningful digits."""

    def require(self, operation: str, *together: str) -> None:
        """Raise the refusal of an operation, or of one together with others; warn once of kinks.

        ``scvi_codegen.runs.stepping.features`` lists the operations. MethodError names the remedy.
        """
        require(self.stepper, operation, *together)

    def check_given(self, parameters: Parameters, *, step: bool = False) -> None:
        """Raise StateError if an input has no value; of a single ``step`` ContactError for unknown modes, too."""
        (check_step_given if step else check_inputs_given)(self.stepper.interface, parameters)

    @staticmethod
    def announce(message: str) -> None:
        """Announce a message now, e.g. the expected duration of a computation."""
        tell(message)

    @staticmethod
    def warnings_wanted() -> bool:
        """Return whether an AccuracyWarning would be seen."""
        return warnings_wanted()

    @staticmethod
    def with_uncertainty(value: float, error: float) -> str:
        """Return a value with the uncertain digits of its error, ``0.512345(12)`` for 0.512345 +- 0.000012."""
        return with_uncertainty(value, error)

    @property
    def reduction(self) -> Reduction:
        """Maps between tangent vectors (.., 2m) of (q, p) and those of the space reduced by norms of quaternions."""
        return Reduction(self.stepper.interface)

    @cached_property
    def members(self) -> tuple[Member, ...]:
        """Rotations, directions and spins with the columns of their coordinates."""
        return members_of(self.stepper.dimension, self.stepper.interface.rotations)

    @property
    def finer(self) -> Any:
        """Stepper of the finer method of ``run.error``, compiled once; MethodError without the system."""
        from scvi_codegen.runs.accuracy.run_error import finer_of

        return finer_of(self.stepper)

    def start(
        self, q: States, p: States | None, velocity: States | None, t: float, parameters: Parameters
    ) -> tuple[Array, Array]:
        """Return (2m,) positions and momenta, and the (k,) parameters, of a state by p or by velocity.

        Raises:
            StateError: for wrong shapes, names and numbers, and unless exactly one of p and velocity is passed.
        """
        values = self.parameters(parameters)
        q, p, velocity = self.states.start(q, p, velocity)
        momenta = self.stepper._initial_momenta(q, p, velocity, t, values)
        return np.concatenate(self.states.pair(q, momenta)), values

    @property
    def tangents(self) -> int:
        """Number of variables of a step that tangent vectors have: (q, p), parameters, t and h."""
        return self.stepper._input_size  # type: ignore[no-any-return]

    def run_by(
        self,
        plan: StepPlan,
        q: States,
        p: States,
        *,
        t: float,
        parameters: Parameters,
        options: SolverOptions | None = None,
    ) -> Run:
        """Return a run from (q, p) at t by steps of a plan, such as ``Fixed(h)``; raises as :meth:`Stepper.start`."""
        run: Run = self.stepper._started(Initial(q, p, None, t, parameters, options), plan)
        return run

    def largest_step(self, max_step: float | None) -> float:
        """Return the largest size of adaptive steps, infinity for ``None``; StateError unless it is positive."""
        return float(Steps(max_step=max_step).checked().get("max_step", math.inf))

    def library(self, source: Source, flags: Sequence[str] = ()) -> building.Library:
        """Return a source of its steps, compiled once with these flags, too: ``path``, ``ffi`` and ``lib``."""
        return building.load(source, flags=(*self.stepper.flags, *flags))

    def compiled(self, source: Source) -> Binding:
        """Return the functions of a source of its steps."""
        return Binding(self.library(source), source.prefix)

    def fingerprint(self, source: Source, flags: Sequence[str] = ()) -> str:
        """Return what identifies :meth:`library` on this machine."""
        return building.fingerprint(source, flags=(*self.stepper.flags, *flags))

    @staticmethod
    def with_headers(source: Source, text: str, headers: Sequence[str], declarations: str, *, second: bool) -> Source:
        """Return a source with ``text`` and headers of ``support/frameworks``; see ``program_source.with_flow``."""
        from scvi_codegen.codegen.rendering.program_source import with_flow  # imports SymPy

        return with_flow(source, text, headers, declarations, second=second)

    def constraint_jacobian(self, q: Array, t: float, parameters: Array) -> Array:
        """Return (c, m) derivatives of the constraints by positions, by velocities if they are nonholonomic."""
        return linearised(self.stepper, t, parameters)(q)[1]

    def check_sides(self, states: Array, t: Sequence[float], h: float, parameters: Array) -> None:
        """Raise StateError if states (n, 2m) at n times rest at a kink beside which steps of h differ."""
        check_sides(self.stepper, states, t, h, parameters)

    def actions(self, starts: Starts, parameters: Array, options: SolverOptions | None) -> Array:
        """Return the (n,) actions of n steps without forces and constraints."""
        return actions_of_steps(self.stepper, starts, parameters, options)[0]

    def inputs_of(self, inputs: Mapping[str, Any] | None) -> dict[str, Input]:
        """Return inputs of :meth:`Stepper.integrate` as piecewise cubic functions of time with their breakpoints."""
        return checked_inputs(self.stepper.interface, inputs)

    @property
    def input_columns(self) -> list[int]:
        """Indices of the parameters of inputs: coefficients by power, and the breakpoint they refer to."""
        return columns_of_inputs(self.stepper.interface)

    def parameters_at(self, t: float, parameters: Parameters, inputs: Mapping[str, Input]) -> Array:
        """Return the (k,) parameters at a time, those of inputs by their pieces."""
        return parameters_of(self.stepper, parameters, inputs)(t)

    def run_arrays(
        self, q: Any, parameters: Mapping[str, ArrayLike] | None, tables: Mapping[str, ArrayLike] | None
    ) -> RunArrays:
        """Return sizes, state, fields and tables of arrays of run-time sizes; StateError if they do not agree."""
        return read_arrays(self.stepper.interface, q, parameters, tables)

    def check_accesses(self, sizes: Mapping[str, int], tables: Mapping[str, Any]) -> None:
        """Raise StateError if an access leaves its array, or an index its table, for these sizes and tables."""
        check_accesses(self.stepper.interface.layout, sizes, tables)

    def event_formulas(self, events: Sequence[Event]) -> EventFormulas:
        """Return the functions of events, and the formulas of their changes of the state."""
        from scvi_codegen.codegen.rendering.events import EventFormulas  # imports SymPy

        return EventFormulas(self.stepper.interface, events)

    @staticmethod
    def in_threads(
        count: int,
        job: Callable[[int, Callable[[int], None]], None],
        *,
        progress: Callable[[int], None] | None,
        threads: int | None,
    ) -> None:
        """Call ``job(k, check_stop)`` for k < count in threads.

        Errors and Ctrl-C stop all: ``check_stop(done)``, which jobs call, raises then.
        """
        run_jobs(count, job, progress=progress, threads=threads)

    @property
    def observable_names(self) -> tuple[str, ...]:
        """Names of the entries of rotations, directions and spins, and of their angular momenta."""
        return observable_names(self.stepper.interface)

    def observables(self, states: Array) -> tuple[Array, Array]:
        """Return the (n, k) values of ``observable_names`` at states (n, 2m), and (n, k, 2m) derivatives."""
        return observables(self.stepper.interface, states), observable_derivatives(self.stepper.interface, states)

    def ensemble_start(
        self, q: States, p: States | None, velocity: States | None, *, t: float, parameters: Parameters
    ) -> tuple[Array, Array, Array]:
        """Return (k, m) positions and momenta on constraints, and the parameters, of k states with p or velocity."""
        momenta = momenta_of_each(self.stepper, q, p, velocity, t, parameters)
        return start_of_ensemble(self.stepper, q, momenta, t, parameters)

    def ensemble_runs(
        self,
        q: States,
        p: States | None,
        settings: EnsembleSettings | Mapping[str, Any],
        *,
        velocity: States | None = None,
        action: bool = False,
    ) -> CommonRuns | IndividualRuns:
        """Return the trajectories of ``integrate_ensemble`` before their first step, to be advanced by blocks.

        Args:
            q, p, velocity, action: as of ``integrate_ensemble``.
            settings: its other arguments by name, or those of a block, ``runs.ensemble.settings_of(part)``.
        """
        settings = EnsembleSettings(**settings) if isinstance(settings, Mapping) else settings
        ensemble = self.stepper._ensemble(q, p, settings, velocity=velocity, action=action)
        return runs_of(ensemble)

    def ensemble_result(self, runs: CommonRuns | IndividualRuns) -> EnsembleTrajectory:
        """Return the trajectories of an ensemble that was integrated; issue warnings of inaccurate ones."""
        trajectories = runs.result()
        if isinstance(runs, IndividualRuns):
            runs.warn_of_too_many_states(trajectories)
        try:
            if isinstance(runs, IndividualRuns):
                warn_of_unconfirmed(trajectories.confirmations)
                warn_of_energy_errors(trajectories, None if runs.successive is None else runs.successive.energies)
            warn_of_unresolved_members(trajectories)
        except Exception as error:  # noqa: BLE001  (the runs are complete)
            warn_of_failed_check(error)
        return trajectories

    def tangent_lanes(
        self,
        q: Array,
        p: Array,
        growth: Array,
        saved: Array,
        *,
        h: float,
        t: float,
        steps: int,
        save_every: int,
        parameters: Array,
        options: SolverOptions | None,
    ) -> LaneRuns | None:
        """Return runs in SIMD lanes with k tangent vectors, ``None`` if the system has none.

        Args:
            q, p: (n, m (1 + k)) positions and momenta, followed by those of the vectors, one after another.
            growth: initial growth, as of ``templates/support/run/tangent_growth.h``.
            saved: (saved states, n, quantities, k) for the growth at saved states.
            h, t, steps, save_every, parameters, options: of the steps.
        """
        source = self.stepper._variants[TangentVectors(saved.shape[-1])]
        if source is None:
            return None
        binding = self.compiled(source)
        plan, settings = CommonSteps(t, h, save_every, steps), EnsembleSettings(options=options)
        start: dict[str, Any] = {"t0": plan.t0, "q": q, "p": p, "parameters": np.asarray(parameters)}
        ensemble = Ensemble(stepper=self.stepper, settings=settings, **start, fixed=plan)
        return LaneRuns(binding, ensemble, {"positions": saved, "growth": growth})
