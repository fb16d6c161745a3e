"""Runs of one motion to a final time whose global error is bounded: the returned run, and runs for comparison."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.runs.accuracy.size import neighbouring
from scvi_codegen.runs.driver.largest_step import largest_step
from scvi_codegen.runs.driver.segments import InputSegments
from scvi_codegen.runs.states.layout import InitialData
from scvi_codegen.runs.states.validation import coordinate_shapes
from scvi_codegen.runs.stepping.step_plan import ErrorControl
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Event


@dataclass(frozen=True, kw_only=True, eq=False)
class BoundedMotion:
    """Motion by one stepper, whose runs differ in their steps: ``h`` of tau, or ``tolerance`` and ``max_step``.

    Attributes:
        stepper: of the returned run.
        error: bound of the relative global error.
        initial, end: initial data and final time.
        control: absolute tolerance, largest and first step of all runs.
        inputs: validated inputs by name, or ``None``.
        output: ``save_every`` and ``t_eval`` of the returned run.
        progress: called with the number of completed steps of each run, or ``None``.
    """

    stepper: Any
    error: float
    initial: InitialData
    end: float
    control: ErrorControl
    inputs: Mapping[str, Any] | None
    output: Mapping[str, Any]
    progress: Callable[[int], None] | None

    @cached_property
    def compared(self) -> Any:
        """Stepper of runs for comparison, without events; its steps end where the equations are not smooth."""
        interface = self.stepper.interface
        if len(interface.kinks) > len(interface.modes) and not self.stepper._has_tau and interface.words == 1:
            name = interface.coordinates[0]
            if interface.layout.coordinates:
                array, shape = coordinate_shapes(interface)[0]
                name = f"{array}[{', '.join('0' * len(shape))}]"
            with suppress(ScviCodegenError):
                by_pieces = self.stepper.with_events([Event(kink, then={name: name}) for kink in interface.kinks])
                _ = by_pieces.binding
                return by_pieces
        return self.stepper.with_events(())

    @property
    def smooth(self) -> bool:
        """True if the equations are smooth along each step of runs for comparison."""
        return bool(self.compared.searched) or not self.stepper.interface.kinks

    def step_of_tau(self, tolerance: float) -> float:
        """Return the largest step of tau for a tolerance."""
        *state, t, parameters, options = self.initial
        momenta = self.stepper._initial_momenta(*state, t, parameters)
        motion = self.stepper, self.initial.q, momenta, self.end - t
        return largest_step(*motion, tolerance, t=t, parameters=parameters, options=options)

    def run(self, check: Callable[[int], None] | None, **steps: Any) -> Trajectory:
        """Return a run by these steps; ``check`` is called as ``progress`` is."""
        calls = [call for call in (self.progress, check) if call is not None]
        progress = (lambda count: [call(count) for call in calls]) if calls else None
        if "max_step" in steps and self.control.max_step is not None:
            steps["max_step"] = min(steps["max_step"], self.control.max_step)
        steps = self.control.named | steps | {**self.output, "t_end": self.end}
        trajectory: Trajectory = self.stepper.integrate(
            **self.initial._asdict(), inputs=self.inputs, progress=progress, **steps
        )
        return trajectory

    def compared_run(self, stops: Sequence[float], progress: Callable[[int], None], **steps: Any) -> Trajectory:
        """Return a run for comparison whose adaptive steps end at all times ``stops``, or one by a step of tau.

        In double the initial state of adaptive steps is rounded differently: the next number above or below each one.
        """
        stepper, initial = self.compared, self.initial
        if self.stepper._has_tau:
            steps = self.control.named | steps | {"t_end": stops[-1]}
            of_tau: Trajectory = stepper.integrate(**initial._asdict(), inputs=self.inputs, progress=progress, **steps)
            return of_tau
        segments = InputSegments(stepper, self.inputs or {}, initial.parameters, initial.t, stops[-1])
        run = stepper._started(
            initial._replace(parameters=segments.first), self.control._replace(**steps).to(stops[-1])
        )
        if stepper.interface.words == 1:
            q, p = neighbouring(run.q), neighbouring(run.p)
            beside = InitialData(q, p, None, run.t, run._parameters, run.options)
            run._begin(*stepper._consistent_state(beside), run.t)
        return segments.record_with_stops(run, stops, progress)
