"""Ensembles with adaptive step size: each trajectory has its own steps and final time; threads share the work.

Trajectories are computed by the single integrator, so results are bitwise equal to those of :meth:`Stepper.integrate`
for any number of threads. C runs without the GIL.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native.arguments import checked_number, real_array
from scvi_codegen.native.options import SolverOptions, checked_options
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, States, columns_of_inputs
from scvi_codegen.runtime.ensemble.initial_states import EnsembleParameters, start_of_ensemble
from scvi_codegen.runtime.ensemble.result import INTERRUPTED, OK, EnsembleTrajectory, Span
from scvi_codegen.runtime.ensemble.thread_pool import StopCheck, run_jobs
from scvi_codegen.runtime.inputs.segments import (
    Input,
    breakpoints_until,
    first_inner_time,
    inputs_of_slice,
    parameters_at,
    prepared_segments,
)
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings
from scvi_codegen.runtime.run.global_error import GlobalError
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.observation import Observation
from scvi_codegen.runtime.run.run_loop import record
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.dense_output import times_of_run
from scvi_codegen.runtime.trajectory.joining import joined
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.validation import checked_count


class LaneStates(Protocol):
    """Saved states of one trajectory."""

    @property
    def t(self) -> Array:
        """(n,) times."""

    @property
    def q(self) -> Array:
        """(n, m) positions."""

    @property
    def p(self) -> Array:
        """(n, m) momenta."""


class SavedLane(NamedTuple):
    """Saved states of one trajectory, its status and its number of steps."""

    t: Array
    q: Array
    p: Array
    status: str
    steps: int


class AdaptiveEnsemble:
    """Ensemble integration with adaptive steps; arguments as of ``integrate_ensemble``."""

    def __init__(
        self,
        stepper: Integrator,
        q: States,
        p: States,
        *,
        t_end: ArrayLike,
        inputs: Mapping[str, Input] | None = None,
        tolerance: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        t_eval: ArrayLike | None = None,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
    ) -> None:
        if stepper.interface.energy_parameter:
            raise StateError("adaptive steps are unavailable in transformed time: give h and steps (fixed step in tau)")
        self.stepper, self.options, self.inputs = stepper._adaptive(), checked_options(options), inputs or {}
        self.t0, self.save_every = checked_number(t, "the time t"), checked_count(save_every, "save_every", least=1)
        self.q, self.p, self.parameters = start_of_ensemble(stepper, q, p, self.t0, parameters)
        self.plans = self._plans(t_end, tolerance)
        self.t_eval = None
        if t_eval is not None:
            if self.save_every != 1:
                raise StateError(f"give either t_eval or save_every={save_every}, not both")
            farthest = max((plan.t_end for plan in self.plans), key=lambda end: abs(end - self.t0))
            self.t_eval = times_of_run(t_eval, self.t0, farthest)
        for plan in self.plans if inputs else ():
            breakpoints_until(self.t0, plan.t_end, self.inputs)
        if inputs:
            self.parameters[:, columns_of_inputs(stepper.interface)] = 0.0
        self.saved: dict[int, SavedLane] = {}
        self.confirmations: list[GlobalError | None] = []

    def _plans(self, t_end: ArrayLike, tolerance: float | None) -> list[StepPlan]:
        """Return the step plan of each trajectory; all must run forward or all backward."""
        ends = real_array(t_end, "t_end")
        if ends.shape not in ((), (len(self.q),)):
            raise StateError(f"t_end must be one time or {len(self.q)} times, not of shape {ends.shape}")
        plans = [StepPlan.checked(None, float(end), tolerance) for end in np.broadcast_to(ends, len(self.q))]
        signs = {np.sign(plan.t_end - self.t0) for plan in plans} - {0.0}
        if len(signs) > 1:
            raise StateError(f"t_end lies on both sides of t = {self.t0:g}: split the ensemble into two")
        return plans

    def __len__(self) -> int:
        return len(self.q)

    @property
    def length(self) -> int:
        """Final value of ``progress``: the number of trajectories."""
        return len(self)

    def part(self, part: slice) -> dict[str, object]:
        """Return keyword arguments that construct the ensemble of a slice of the trajectories."""
        return {
            "q": self.q[part],
            "p": self.p[part],
            "t_end": [plan.t_end for plan in self.plans[part]],
            "inputs": inputs_of_slice(self.inputs, part) or None,
            "tolerance": self.plans[0].tolerance or None,
            "save_every": self.save_every,
            "t": self.t0,
            "t_eval": self.t_eval,
            "parameters": self.parameters[part],
            "options": self.options,
        }

    def confirm(self, stepper: Any, wanted: float, *, threads: int | None = None) -> None:
        """Choose the local tolerance of each trajectory for a global error, as ``stepper.integrate(error=)`` does.

        The trajectories are bitwise those of the confirmed runs. One whose runs fail has errors at round-off level.
        """
        self.confirmations = [None] * len(self)

        def confirm_one(j: int, check_stop: StopCheck) -> None:
            arguments: dict[str, Any] = {
                "t": self.t0,
                "t_end": self.plans[j].t_end,
                "save_every": self.save_every,
                "options": self.options,
            }
            arguments |= {"error": wanted, "progress": check_stop, **self._parameters_and_inputs(j)}
            with without_accuracy_warnings(), suppress(StateError, StepFailedError):
                self.confirmations[j] = stepper.integrate(self.q[j], self.p[j], **arguments).confirmation

        run_jobs(len(self), confirm_one, progress=None, threads=threads)
        self.plans = [
            plan if confirmation is None else replace(plan, tolerance=confirmation.tolerance)
            for plan, confirmation in zip(self.plans, self.confirmations, strict=True)
        ]

    def _parameters_and_inputs(self, j: int) -> dict[str, Any]:
        """Return the arguments ``parameters`` and ``inputs`` of a single run of trajectory j."""
        of_inputs = columns_of_inputs(self.stepper.interface) if self.inputs else ()
        values = zip(self.stepper.parameters, self.parameters[j].tolist(), strict=True)
        inputs = {
            name: replace(each, pieces=each.pieces[:, j]) if each.pieces.ndim == 3 else each
            for name, each in self.inputs.items()
        }
        return {
            "parameters": {name: x for k, (name, x) in enumerate(values) if k not in of_inputs},
            "inputs": inputs or None,
        }

    def run(self, *, progress: Callable[[int], None] | None = None, threads: int | None = None) -> None:
        """Integrate all trajectories with ``threads`` threads; an exception raised by ``progress`` stops them promptly.

        Afterwards, also after an exception, :meth:`result` returns the completed trajectories.

        Args:
            progress: called with the number of completed trajectories.
            threads: number of threads, by default one per core.
        """

        def advance(j: int, check_stop: StopCheck) -> None:
            self.saved[j] = self._trajectory(j, check_stop)

        run_jobs(len(self), advance, progress=progress, threads=threads)

    def _trajectory(self, j: int, check_stop: StopCheck) -> SavedLane:
        try:
            run = Memory.started(
                self.stepper,
                self.q[j],
                self.p[j],
                plan=self.plans[j],
                t=self.t0,
                parameters=self._values(j, first_inner_time(self.t0, self.plans[j].t_end)),
                options=self.options,
            )
            states, status = self._states(j, run, check_stop)
        except StateError:  # a sum of finite terms has overflowed
            return SavedLane(np.array([self.t0]), self.q[[j]], self.p[[j]], "not finite", 0)
        return SavedLane(states.t, states.q, states.p, status, run.steps)

    def _values(self, j: int, t: float) -> Array:
        """Return the parameters of trajectory j for the pieces of the inputs that contain t."""
        values: Array = parameters_at(self.stepper.parameters, self.parameters, self.inputs, t, slice(j, j + 1))[0]
        return values

    def _states(self, j: int, run: Memory, check_stop: StopCheck) -> tuple[LaneStates, str]:
        """Return the saved states of trajectory j and its status."""
        pieces: list[Trajectory] = []
        try:
            if self.t_eval is not None:
                reached = np.abs(self.t_eval - self.t0) <= abs(self.plans[j].t_end - self.t0)
                return Observation(run, times=self.t_eval[reached]).advance(None, check_stop), OK
            if not self.inputs:
                return record(run, None, save_every=self.save_every, progress=check_stop), OK
            segments = prepared_segments(run, self.inputs, self.plans[j].t_end, partial(self._values, j))
            pieces.extend(record(run, steps, save_every=self.save_every, progress=check_stop) for steps in segments)
        except StepFailedError as failure:
            last = Trajectory.before(failure)
            return joined([*pieces, last]), failure.status
        return joined(pieces or [record(run, 0)]), OK

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories; incomplete ones are ``"interrupted"`` after their initial state."""
        lanes = [self.saved.get(j) or self._unfinished(j) for j in range(len(self))]
        if self.t_eval is None:
            t, times, rows = self._by_number(lanes)
        else:
            t, times = self.t_eval, None
            rows = [slice(0, len(each.t)) for each in lanes]
        q, p = np.full((2, len(t), len(self), self.stepper.dimension), np.nan)
        for j, (each, row) in enumerate(zip(lanes, rows, strict=True)):
            q[row, j], p[row, j] = each.q, each.p
        return EnsembleTrajectory(
            t=t,
            times=times,
            q=q,
            p=p,
            status=np.array([each.status for each in lanes], dtype="<U32"),
            steps=np.array([each.steps for each in lanes], dtype=np.int64),
            h=0.0,
            plans=tuple(self.plans),
            confirmations=tuple(self.confirmations),
            parameters=self.parameters,
            stepper=self.stepper,
            spans=tuple(span for j in range(len(self)) for span in self._spans(j, times)),
        )

    def _spans(self, j: int, times: Array | None) -> Iterator[Span]:
        """Yield the rows of trajectory j in each piece of the inputs and their parameters."""
        if times is None or not self.inputs:
            return
        t = times[:, j]
        plan = self.plans[j].t_end
        forward = -1.0 if plan < self.t0 else 1.0
        ends = breakpoints_until(self.t0, plan, self.inputs) or [plan]
        last = np.searchsorted(forward * t[np.isfinite(t)], forward * np.array(ends), side="right").tolist()
        for (start, end), (first, until) in zip(pairwise([self.t0, *ends]), pairwise([0, *last]), strict=True):
            values = partial(parameters_at, self.stepper.parameters, self.parameters, self.inputs, (start + end) / 2)
            yield slice(first, until), slice(j, j + 1), values

    def _by_number(self, lanes: list[SavedLane]) -> tuple[Array, Array, list[slice]]:
        """Return row numbers, (n, k) times padded with NaN, and the rows of each trajectory."""
        rows = [slice(0, len(each.t)) for each in lanes]
        count = max(row.stop for row in rows)
        times = np.full((count, len(lanes)), np.nan)
        for j, (each, row) in enumerate(zip(lanes, rows, strict=True)):
            times[row, j] = each.t
        return np.arange(count, dtype=float), times, rows

    def _unfinished(self, j: int) -> SavedLane:
        first = slice(0, 1 if self.t_eval is None else 0)
        return SavedLane(np.array([self.t0])[first], self.q[[j]][first], self.p[[j]][first], INTERRUPTED, 0)

    def keep(self, part: slice, trajectories: EnsembleTrajectory) -> None:
        """Store the results of a slice that was integrated elsewhere."""
        for j, each in zip(range(part.start, part.stop), trajectories.each(), strict=True):
            self.saved[j] = SavedLane(*each)
