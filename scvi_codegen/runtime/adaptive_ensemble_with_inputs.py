"""Ensembles with inputs and adaptive step size: each trajectory has its own steps, final time and inputs.

Trajectories are bitwise equal to those of :meth:`Stepper.integrate`: steps end at all breakpoints.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StepFailedError
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.adaptive_ensemble import AdaptiveEnsemble, LaneStates
from scvi_codegen.runtime.ensemble_states import EnsembleParameters
from scvi_codegen.runtime.ensemble_trajectory import OK, EnsembleTrajectory, Span
from scvi_codegen.runtime.inputs import Array, columns_of_inputs
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.memory import Memory
from scvi_codegen.runtime.run_loop import record
from scvi_codegen.runtime.runs_with_inputs import (
    Input,
    breakpoints_until,
    first_inner_time,
    inputs_of_slice,
    parameters_at,
    prepared_segments,
)
from scvi_codegen.runtime.trajectory import Trajectory
from scvi_codegen.runtime.trajectory_with_inputs import DrivenTrajectory
from scvi_codegen.runtime.workers import StopCheck

__all__ = ["AdaptiveEnsembleWithInputs"]


class AdaptiveEnsembleWithInputs(AdaptiveEnsemble):
    """Ensemble with inputs and adaptive steps; arguments as of :class:`AdaptiveEnsemble`."""

    def __init__(
        self,
        stepper: Integrator,
        q: ArrayLike,
        p: ArrayLike,
        data: Mapping[str, Input],
        *,
        t_end: ArrayLike,
        tolerance: float | None = None,
        save_every: int = 1,
        t: float = 0.0,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
    ) -> None:
        self.data = data
        super().__init__(
            stepper,
            q,
            p,
            t_end=t_end,
            tolerance=tolerance,
            save_every=save_every,
            t=t,
            parameters=parameters,
            options=options,
        )
        for plan in self.plans:
            breakpoints_until(self.t0, plan.t_end, data)
        self.parameters[:, columns_of_inputs(stepper.interface)] = 0.0

    def part(self, part: slice) -> dict[str, object]:
        """Return keyword arguments that construct the ensemble of a slice of the trajectories."""
        found = super().part(part) | {"inputs": inputs_of_slice(self.data, part)}
        del found["t_eval"]
        return found

    def _values(self, j: int, t: float) -> Array:
        """Return the parameters of trajectory j for the pieces that contain t."""
        found: Array = parameters_at(self.stepper.parameters, self.parameters, self.data, t, slice(j, j + 1))[0]
        return found

    def _parameters_and_inputs(self, j: int) -> dict[str, Any]:
        own = {
            name: replace(each, pieces=each.pieces[:, j]) if each.pieces.ndim == 3 else each
            for name, each in self.data.items()
        }
        return super()._parameters_and_inputs(j) | {"inputs": own}

    def _first_parameters(self, j: int) -> Array:
        return self._values(j, first_inner_time(self.t0, self.plans[j].t_end))

    def _states(self, j: int, run: Memory, check_stop: StopCheck) -> tuple[LaneStates, str]:
        pieces: list[Trajectory] = []
        try:
            way = prepared_segments(run, self.data, self.plans[j].t_end, partial(self._values, j))
            pieces.extend(record(run, steps, save_every=self.save_every, progress=check_stop) for steps in way)
        except StepFailedError as failure:
            return DrivenTrajectory((*pieces, Trajectory.before(failure))), failure.status
        return DrivenTrajectory(tuple(pieces or [record(run, 0)])), OK

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories with the parameters of each piece; a breakpoint belongs to the earlier piece."""
        found = super().result()
        return replace(found, spans=tuple(span for j in range(len(self)) for span in self._spans(j, found)))

    def _spans(self, j: int, found: EnsembleTrajectory) -> Iterator[Span]:
        """Yield the rows of trajectory j in each piece and their parameters."""
        assert found.times is not None
        t, plan = found.times[:, j], self.plans[j].t_end
        forward = -1.0 if plan < self.t0 else 1.0
        ends = breakpoints_until(self.t0, plan, self.data) or [plan]
        last = np.searchsorted(forward * t[np.isfinite(t)], forward * np.array(ends), side="right").tolist()
        for (start, end), (first, until) in zip(pairwise([self.t0, *ends]), pairwise([0, *last]), strict=True):
            values = partial(parameters_at, self.stepper.parameters, self.parameters, self.data, (start + end) / 2)
            yield slice(first, until), slice(j, j + 1), values
