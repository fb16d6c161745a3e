"""Runs of one motion to a final time whose global error is bounded."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from scvi_codegen.runs.driver.largest_step import largest_step
from scvi_codegen.runs.states.layout import InitialData
from scvi_codegen.runs.stepping.step_plan import ErrorControl
from scvi_codegen.runs.trajectory import Trajectory


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

    def step_of_tau(self, tolerance: float) -> float:
        """Return the largest step of tau for a tolerance."""
        *state, t, parameters, options = self.initial
        momenta = self.stepper._initial_momenta(*state, t, parameters)
        motion = self.stepper, self.initial.q, momenta, self.end - t
        return largest_step(*motion, tolerance, t=t, parameters=parameters, options=options)

    def run(self, **steps: Any) -> Trajectory:
        """Return a run by these steps, and with further arguments of :meth:`Stepper.integrate`."""
        if "max_step" in steps and self.control.max_step is not None:
            steps["max_step"] = min(steps["max_step"], self.control.max_step)
        steps = self.control.named | steps | {"t_end": self.end, "check_growth": False}
        trajectory: Trajectory = self.stepper.integrate(
            **self.initial._asdict(), inputs=self.inputs, progress=self.progress, **steps
        )
        return trajectory
