"""An integration under way, as users hold it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.accuracy import warn_of_long_steps, warn_of_lost_energy
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.inputs import Parameters
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.memory import Memory
from scvi_codegen.runtime.observation import Observation
from scvi_codegen.runtime.one_thread import alone
from scvi_codegen.runtime.portions import record
from scvi_codegen.runtime.standing import stands
from scvi_codegen.runtime.trajectory import Trajectory

__all__ = ["Run"]


class Run(Memory):
    """An integration under way: :class:`Memory`, and the recording of its states."""

    def __repr__(self) -> str:
        interface = self.stepper.interface
        tau = bool(interface.energy_parameter)
        return stands(interface.title, interface.solver, self, tau=tau, awaited=self._awaited)

    def __reduce__(self) -> tuple[Any, ...]:
        known = dict(zip(self.stepper.parameters, self._parameters.tolist(), strict=True))
        for name in self._awaited:
            del known[f"{name}_0"]
        return (_restored, (self.stepper, self.save(), known, self._options, self.goal, self.longest))

    @alone
    def record(
        self, steps: int | None = None, *, save_every: int = 1, progress: Callable[[int], None] | None = None
    ) -> Trajectory:
        """Advance by ``steps`` and keep the present state and each whose step number is a multiple of ``save_every``.

        Where steps choose their length, by no more than lead to the goal, whose state is kept, too; all of them where
        ``steps`` is left out.

        The events of the stepper, if it has any, are recorded; a terminal one ends the run before the step it is in.

        An :class:`~scvi_codegen.AccuracyWarning` says when a step is first found to be too long for the motion, but not
        while one that began at the origin is leaving it, for 16 steps at most: it has no size yet.

        Raises:
            StepFailedError: with the states kept so far as ``trajectory``; the run stands before the failing step.
            EventError: where an event function is not finite.
        """
        before = 0.0 if self.leaving else self.step_error[0]
        if self.stepper.events:
            trajectory = Observation(self, save_every=save_every).advance(steps, progress)
        else:
            trajectory = record(self, steps, save_every=save_every, progress=progress)
        if not self.leaving:
            warn_of_long_steps(trajectory, before=before)
        warn_of_lost_energy(trajectory)
        return trajectory


def _restored(
    stepper: Integrator,
    saved: bytes,
    parameters: Parameters,
    options: SolverOptions | None,
    goal: Goal | None,
    longest: float = 0.0,
) -> Run:
    run = Run.restored(stepper, saved, parameters=parameters, options=options, goal=goal)
    run.longest = longest
    return run
