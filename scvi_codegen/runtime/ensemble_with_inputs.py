"""Ensembles with inputs and fixed step size: common steps and breakpoints, inputs shared or one per trajectory.

SIMD lanes continue across breakpoints with the parameters of the next pieces; sums remain compensated.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.ensemble import Change, Ensemble, StepChunk
from scvi_codegen.runtime.ensemble_states import (
    EnsembleParameters,
)
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory
from scvi_codegen.runtime.inputs import Array, columns_of_inputs
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.runs_with_inputs import (
    Input,
    Segment,
    inputs_of_slice,
    parameters_at,
    planned_segments,
    time_after_steps,
)
from scvi_codegen.validation.counts import checked_count

__all__ = ["EnsembleWithInputs"]


class EnsembleWithInputs(Ensemble):
    """Ensemble with inputs, integrated from t to t_end; arguments as of :class:`Ensemble`.

    Attributes:
        segments: segments of equal steps from t to t_end.
        ends: number of steps up to the end of each segment.
        numbers: step numbers of the saved states.
    """

    def __init__(
        self,
        stepper: Integrator,
        q: ArrayLike,
        p: ArrayLike,
        data: Mapping[str, Input],
        *,
        h: float,
        t_end: float,
        save_every: int = 1,
        t: float = 0.0,
        parameters: EnsembleParameters = None,
        options: SolverOptions | None = None,
    ) -> None:
        self.data, self.t_end = data, checked_number(t_end, "t_end")
        self.segments = planned_segments(
            checked_number(t, "the time t"), checked_number(t_end, "t_end"), checked_step(h), data
        )
        self.ends = list(accumulate(segment.steps for segment in self.segments))
        steps, save_every = (
            sum(segment.steps for segment in self.segments),
            checked_count(save_every, "save_every", least=1),
        )
        self.numbers = sorted({*range(0, steps + 1, save_every), *self.ends})
        super().__init__(
            stepper, q, p, h=h, steps=steps, save_every=save_every, t=t, parameters=parameters, options=options
        )
        self.parameters[:, columns_of_inputs(stepper.interface)] = 0.0

    def part(self, part: slice) -> dict[str, object]:
        """Return keyword arguments that construct the ensemble of a slice of the trajectories."""
        found = super().part(part) | {"inputs": inputs_of_slice(self.data, part), "t_end": self.t_end}
        del found["steps"]
        return found

    def row(self, step: int) -> int:
        """Return the index of the first saved state after ``step`` steps."""
        return bisect_right(self.numbers, step)

    def step_chunks(self, begin: int, size: int) -> Iterator[StepChunk]:
        """Split steps at breakpoints; the last step of a segment is separate if the output stride skips its state."""
        end, step = begin + size, begin
        while step < end:
            k = bisect_right(self.ends, step)
            last, entering = self.ends[k], step == self._first(k)
            odd = last % self.save_every != 0
            until = min(end, last - 1 if odd and step < last - 1 else last)
            save_every = last if odd and until == last else self.save_every
            yield StepChunk(until - step, save_every, self._change(self.segments[k]) if entering else None)
            step = until

    def step_data(self, step: int, j: int) -> tuple[float, tuple[float, float], Array]:
        """Return h, the time and the parameters of trajectory j after ``step`` steps."""
        if not self.segments:
            return super().step_data(step, j)
        k = min(bisect_right(self.ends, step), len(self.ends) - 1)
        segment = self.segments[k]
        now = time_after_steps(segment.start, segment.h, step - self._first(k))
        return segment.h, now, self._change(segment).parameters(slice(j, j + 1))[0]

    def _first(self, k: int) -> int:
        """Return the number of steps before segment k."""
        return self.ends[k] - self.segments[k].steps

    def _change(self, segment: Segment) -> Change:
        return Change(
            segment.h, partial(parameters_at, self.stepper.parameters, self.parameters, self.data, segment.middle)
        )

    def saved_times(self) -> Array:
        """Return the (n,) times of the saved states."""
        after = [bisect_left(self.ends, step) for step in self.numbers[1:]]
        times = [
            time_after_steps(self.segments[k].start, self.segments[k].h, step - self._first(k))[0]
            for step, k in zip(self.numbers[1:], after, strict=True)
        ]
        return np.array([self.t0, *times])

    def result(self) -> EnsembleTrajectory:
        """Return the trajectories with the parameters of each piece; a breakpoint belongs to the earlier piece."""
        last = [bisect_right(self.numbers, end) for end in self.ends]
        spans = [
            (slice(first, end), slice(None), self._change(segment).parameters)
            for first, end, segment in zip([0, *last], last, self.segments, strict=False)
        ]
        return replace(super().result(), spans=tuple(spans))
