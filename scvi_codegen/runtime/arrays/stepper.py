"""Compiled integrator of an array system."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import MethodError, StateError
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import TUNED_FLAGS, load
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.rendering.kernels.loop_nests import MOST_THREADS
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.runtime.arrays.constraints import consistent, project
from scvi_codegen.runtime.arrays.interface import Numbers, RunArrays, read_arrays
from scvi_codegen.runtime.arrays.problem import ArrayProblem
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.arrays.run_time_sizes import RunTimeSizes
from scvi_codegen.runtime.arrays.trajectory import ArrayRecord, ArrayTrajectory
from scvi_codegen.runtime.core.compiled_method import Variants
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import check_inputs_given, check_left_to_inputs, inputs_not_given
from scvi_codegen.runtime.events.event import EventLike, as_events
from scvi_codegen.runtime.inputs.segments import (
    advance_to,
    checked_inputs,
    final_time,
    first_inner_time,
    parameters_at,
    planned_segments,
    prepared_segments,
)
from scvi_codegen.runtime.run.accuracy import FIXED_STEP_REMEDY, GROSS_ERROR, warn_of_energies, warn_of_large_steps
from scvi_codegen.runtime.run.error_growth import GrowthCheck
from scvi_codegen.runtime.run.global_error import checked_error, confirmed_run
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import steps_to
from scvi_codegen.validation.argument_types import FUNCTION, MAPPING, checks_arguments
from scvi_codegen.validation.counts import checked_count

__all__ = ["ArrayStepper"]


class ArrayStepper(RunTimeSizes):
    """Compiled integrator of an array system, for any number of coordinates.

    Args:
        variants: source with adaptive steps, ``"controlled"``.

    Attributes:
        source: the C source.
        interface: names and shapes.
        flags: flags of the C compiler.
    """

    COUNTERPART = Stepper

    def __init__(
        self,
        source: Source,
        interface: Interface,
        *,
        variants: Variants | None = None,
        flags: tuple[str, ...] = TUNED_FLAGS,
    ) -> None:
        self.source, self.interface, self.flags = source, interface, flags
        self._variants = Variants() if variants is None else variants

    def __reduce__(self) -> tuple[Any, ...]:
        return (_rebuild, (self.source, self.interface, self._variants, self.flags))

    def __repr__(self) -> str:
        return clipped(f"ArrayStepper({self.interface.title})", LONGEST)

    @property
    def momentum_map_names(self) -> tuple[str, ...]:
        """Names of the conserved quantities: translations and rotations of whole arrays."""
        return tuple(each.name for each in self.interface.layout.maps)

    @cached_property
    def _binding(self) -> Binding:
        return Binding(load(self.source, flags=self.flags), self.interface.prefix, origin=(self, "_binding"))

    @cached_property
    def _controlled(self) -> Binding:
        """Binding of the library with adaptive steps."""
        source = self._variants["controlled"]
        if source is None:
            raise MethodError(
                f"adaptive steps are unavailable for {self.interface.method} and this system: the error estimate "
                "requires forces at two or more stages, or velocities that vary along a step; give h and steps (fixed "
                "step size)"
            )
        return Binding(load(source, flags=self.flags), self.interface.prefix, origin=(self, "_controlled"))

    def prepare(self, *, adaptive: bool = True) -> None:
        """Compile now what the first run would compile; with ``adaptive`` also the variant that ``t_end=`` needs."""
        variants = (self.source, self._variants["controlled"] if adaptive else None)
        for source in filter(None, variants):
            load(source, flags=self.flags)

    @checks_arguments(StateError, parameters=MAPPING, tables=MAPPING)
    def start(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        h: float | None = None,
        t: float = 0.0,
        t_end: float | None = None,
        tolerance: float | None = None,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        options: SolverOptions | None = None,
        threads: int | None = None,
    ) -> ArrayRun:
        """Return a run with fixed steps h, or with adaptive steps to t_end; arguments as of :meth:`integrate`.

        Raises:
            StateError: if a name, shape or number is invalid, or an index would leave its array.
            MethodError: if the method has no adaptive steps.
        """
        plan, binding = _plan(h, t_end, tolerance), self._binding if t_end is None else self._controlled
        arrays, moving = self._given(q, p, velocity, parameters, tables)
        length = 0.0 if h is None else checked_step(h)
        run = ArrayRun(
            ArrayProblem(self.interface, binding, arrays, inputs_not_given(self.interface, parameters)),
            arrays.state,
            moving,
            h=length,
            t=checked_number(t, "t"),
            plan=plan,
            options=options,
            threads=self._threads(threads),
        )
        if self.interface.layout.constraints:
            consistent(run)
        return run

    def _threads(self, threads: int | None) -> int:
        """Return the number of threads; systems with constraints use one."""
        count = checked_count(1 if threads is None else threads, "threads", least=1, most=MOST_THREADS)
        if count > 1 and self.interface.layout.constraints:
            raise MethodError("systems with constraints use one thread: omit threads")
        return count

    def project(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
    ) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
        """Return the nearest state (q, p) on the constraint manifold by array name, in the metric of the masses.

        Raises:
            MethodError: if the system has no constraints.
            StateError: if the projection fails, or if the constraints are linearly dependent there.
        """
        if not self.interface.layout.constraints:
            raise MethodError(f"'{self.interface.system}' has no constraints")
        arrays, moving = self._given(q, p, velocity, parameters, tables)
        problem = ArrayProblem(self.interface, self._binding, arrays)
        run = ArrayRun(problem, arrays.state, moving, h=0.0, t=checked_number(t, "t"))
        project(run)
        return run.q, run.p

    def _given(self, q: Any, p: Any, velocity: Any, parameters: Any, tables: Any) -> tuple[RunArrays, tuple[Any, str]]:
        """Return the validated arrays of a run, and its initial momenta or velocities with their kind."""
        if velocity is not None and self.interface.layout.momenta:
            raise StateError("the system is defined by a Hamiltonian: give momenta p instead of velocity")
        if p is not None and velocity is not None:
            raise StateError("give either p or velocity, not both")
        moving = (p, "momenta") if velocity is None else (velocity, "velocities")
        return read_arrays(self.interface, q, parameters, tables), moving

    def from_checkpoint(
        self,
        saved: bytes,
        *,
        t_end: float | None = None,
        tolerance: float | None = None,
        options: SolverOptions | None = None,
        threads: int | None = None,
    ) -> ArrayRun:
        """Restore a run from :meth:`ArrayRun.checkpoint`; it continues bitwise equally if ``t_end`` is passed again.

        Raises:
            StateError: if the bytes are no saved run or belong to another integrator.
        """
        plan = None if t_end is None else StepPlan.checked(t_end, tolerance)
        binding = self._controlled if plan else self._binding
        return ArrayRun.restored(self.interface, binding, saved, options, plan, self._threads(threads))

    @checks_arguments(
        StateError, parameters=MAPPING, tables=MAPPING, inputs=MAPPING, observe=FUNCTION, progress=FUNCTION
    )
    def integrate(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        inputs: Mapping[str, Any] | None = None,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        h: float | None = None,
        steps: int | None = None,
        t_end: float | None = None,
        tolerance: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        observe: Callable[[ArrayRun], ArrayLike] | None = None,
        options: SolverOptions | None = None,
        threads: int | None = None,
        progress: Callable[[int], None] | None = None,
        events: EventLike | Sequence[EventLike] | None = None,
        error: float | None = None,
        check_growth: bool | None = None,
    ) -> ArrayTrajectory:
        """Integrate ``steps`` steps of h, or to t_end, and save every ``save_every``-th state and the initial one.

        Args:
            q: initial positions: an array of the declared shape, or several by name; their shapes determine the sizes.
            p, velocity: initial momenta or velocities, in the same form; by default 0.
            inputs: of a system with inputs, by name, as of :meth:`Stepper.integrate`; steps end at their breakpoints.
            h: fixed step size, negative to integrate backward.
            steps, save_every: number of steps, and steps between saved states.
            t_end: final time, instead of ``steps``. Without h steps are adaptive and the last ends there exactly; with
                h the last step is shorter unless t_end - t is a multiple of h (within 1e-9).
            tolerance: relative error of an adaptive step with respect to the largest coordinate; by default round-off.
            t: initial time.
            parameters: scalars and arrays by name; others have their defaults.
            tables: (rows, columns) whole numbers by name; (rows,) suffices for a single column.
            observe: function of the run that returns the data to save instead of the whole state, a number or an array
                of constant shape; the run's ``t``, ``q``, ``p``, ``velocity``, ``energy`` are the current ones.
            options: convergence criterion of the solver.
            threads: number of threads per step, by default one; results are bitwise equal. Threads pay off if a step
                takes longer than some tens of microseconds; they are started again at every saved state.
            progress: called with the number of completed steps.
            events: zero crossings to detect, stored in ``events`` of the trajectory; a terminal one ends the run. One
                or several :class:`~scvi_codegen.Event` or functions, ``"q[0] - 1"``, ``"sum(i in N, q[i]**2) - 5"``,
                of coordinates, velocities, momenta, parameters and t.
            error, check_growth: as of :meth:`Stepper.integrate`; error needs all states, without ``observe``.

        Returns:
            :class:`ArrayTrajectory` of steps // save_every + 1 states, plus that at t_end or at a terminal event.

        Raises:
            StateError: if a name, shape or number is invalid, an index would leave its array, an observation is not
                real or changes its shape, or inputs do not cover the run.
            EventError: if an event function is invalid or not finite.
            MethodError: if the method has no adaptive steps.
            StepFailedError: if a step fails; its ``trajectory`` contains the states before.
        """
        save_every = checked_count(save_every, "save_every", least=1)
        data = None if inputs is None else checked_inputs(self.interface, inputs)
        if data is None:
            check_inputs_given(self.interface, parameters)
            count = _step_count(h, steps, t, t_end)
        else:
            check_left_to_inputs(self.interface, parameters)
            end = final_time(t, h, steps, t_end)
        shared_arguments: dict[str, Any] = {"t": t, "parameters": parameters, "tables": tables}
        shared_arguments |= {"options": options, "threads": threads}
        if error is not None:
            return confirmed_run(
                checked_error(error, {"h": h, "steps": steps, "tolerance": tolerance, "observe": observe}),
                partial(self.integrate, events=events),
                self.integrate,
                (q, p, velocity),
                shared_arguments | {"inputs": inputs},
                {"t_end": t_end, "save_every": save_every, "progress": progress},
            )
        to = t_end if h is None else None
        run = self.start(q, p, velocity=velocity, h=h, t_end=to, tolerance=tolerance, **shared_arguments)
        record = ArrayRecord(run, observe, as_events(events))
        if data is None:
            check = GrowthCheck(run, check_growth)
            if h is None or t_end is None:
                record.follow(count, save_every, progress=progress)
                return _with_warnings(record, check)
            segments: Iterable[int | None] = _planned_segments(run, t_end, h)
        else:
            values = partial(parameters_at, self.interface.parameters, np.array(run.problem.arrays.numbers), data)
            run.update(parameters=values(first_inner_time(t, end)))
            check = GrowthCheck(run, check_growth, lambda time: advance_to(run, data, time, values))
            segments = prepared_segments(run, data, end, values)
        record.take(keep=True)
        for steps in segments:
            until = np.inf if steps is None else run.steps + steps
            record.continue_recording(until, save_every, progress=progress, to_end=True)
            if record.search and record.search.ended:
                break
        return _with_warnings(record, check)


def _step_count(h: float | None, steps: int | None, t: float, t_end: float | None) -> float:
    """Return the number of steps of a run without inputs, infinity for one to t_end.

    Raises:
        StateError: unless the arguments determine the run.
    """
    if h is not None and t_end is not None:
        if steps is not None:
            raise StateError(f"give either steps={steps} or t_end={t_end:g} with h, not both")
        steps_to(t, t_end, h)  # raises if h has the wrong sign
    elif h is not None and steps is None:
        raise StateError("h requires steps or t_end (fixed step size); give t_end without h for adaptive steps")
    if h is None and steps is not None:
        raise StateError("steps requires h (fixed step size); give t_end alone for adaptive steps")
    return np.inf if steps is None else checked_count(steps, "steps", least=0)


def _planned_segments(run: ArrayRun, t_end: float, h: float) -> Iterator[int]:
    """Set the step size of the run for each segment of equal steps to t_end, and yield its number of steps."""
    for part in planned_segments(run.t, t_end, h, {}):
        run.update(h=part.h)
        yield part.steps


def _plan(h: float | None, t_end: float | None, tolerance: float | None) -> StepPlan | None:
    """Return the step plan of adaptive steps, ``None`` for fixed steps."""
    if (h is None) == (t_end is None):
        raise StateError(
            f"give either h (fixed step size) or t_end (adaptive step size); got {'neither' if h is None else 'both'}"
        )
    if t_end is not None:
        return StepPlan.checked(t_end, tolerance)
    if tolerance is not None:
        raise StateError("tolerance requires adaptive steps: give t_end without h and steps")
    return None


def _with_warnings(record: ArrayRecord, check: GrowthCheck) -> ArrayTrajectory:
    """Return the trajectory, after warnings about its step size, its energy and its error growth."""
    trajectory = record.trajectory()
    check.warn(trajectory)
    warn_of_large_steps(trajectory, remedy="")
    if record.run.interface.conserves_energy:
        _warn_of_energy_error(trajectory)
    return trajectory


def _warn_of_energy_error(trajectory: ArrayTrajectory) -> None:
    """Warn of an energy error of adaptive runs, and of fixed-step runs without an error estimate.

    For a Hamiltonian the kinetic part, which sets the scale, is 0.
    """
    (first, last), size = trajectory.energies[[0, -1], 2], 2.0 * trajectory.energies[[0, -1], 0].max()
    if trajectory.plan is not None:
        warn_of_energies(first, last, size)
    elif np.isnan(trajectory.step_error):
        warn_of_energies(first, last, size, tolerable=GROSS_ERROR, why=FIXED_STEP_REMEDY)


def _rebuild(source: Source, interface: Interface, variants: Variants, flags: tuple[str, ...]) -> ArrayStepper:
    return ArrayStepper(source, interface, variants=variants, flags=flags)
