"""Step sequence of a periodic orbit: where its steps end, relative to the period.

An adaptive run along the guess determines the sequence. It is frozen while Newton's method iterates, so that the
computed map is smooth and its derivatives are exact, and determined again from the orbit that was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.api.states import Array
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.runs.stepper import Stepper

LEAST_STEPS = 8
"""Least number of steps of a search in a period: two may end at turning points only."""


@dataclass(frozen=True, eq=False)
class StepSequence:
    """Ends of consecutive steps as fractions of the period.

    Attributes:
        ends: (n + 1,) ascending, from 0 to 1, or to 1/2 of the computed half of a symmetric orbit.
        tolerance: that of the adaptive run from which they are; ``None`` of equal steps.
    """

    ends: Array
    tolerance: float | None = None

    @classmethod
    def equal(cls, count: int, end: float = 1.0) -> StepSequence:
        """Return the sequence of equal steps, of a part of the period if ``end`` is smaller."""
        return cls(end * np.arange(count + 1) / count)

    @classmethod
    def adaptive(
        cls,
        stepper: Stepper,
        start: Array,
        period: float,
        tolerance: float,
        max_step: float,
        t: float,
        parameters: Array,
        options: SolverOptions | None,
        end: float,
    ) -> StepSequence:
        """Return the sequence of adaptive steps along a guess, half a period forward and half a period backward.

        Both halves stay closer to the orbit than a whole period in one direction. Steps are no longer than an eighth of
        the period: their ends show the sizes of positions and momenta. Runs with events that change the
        state, and across kinks, go forward only, and their steps end at no event, whose time varies with the start.

        Args:
            stepper: the compiled stepper.
            start, period: (2m,) state and period of the guess.
            tolerance: that of the local error; 0 for round-off.
            max_step, t, parameters, options: as of :class:`OrbitSearch`.
            end: 1/2 for half a period, forward only.
        """

        def ends_of(duration: float) -> Array:
            run = stepper.integrate(
                *np.split(start, 2),
                t_end=t + duration,
                tolerance=tolerance or None,
                max_step=min(max_step, period / LEAST_STEPS),
                t=t,
                parameters=parameters,
                options=options,
                check_growth=False,
            )
            times, counts = np.unique(np.asarray(run.t), return_counts=True)
            at_kinks = np.isin(times, [time for ends in run.transitions for time in ends.t])
            ends = np.abs(times - t)[((counts == 1) & ~at_kinks) | (times == t)] / period
            return np.sort(ends)

        with without_accuracy_warnings():
            if stepper.divides_steps or end < 1.0:
                ends = ends_of(end * period)
            else:
                ends = np.concatenate([ends_of(0.5 * period), 1.0 - ends_of(-0.5 * period)[-2::-1]])
        ends[0], ends[-1] = 0.0, end
        return cls(ends, tolerance)

    def __len__(self) -> int:
        return len(self.ends) - 1

    @cached_property
    def widths(self) -> Array:
        """(n,) step sizes relative to the period."""
        return np.full(len(self), self.ends[-1] / len(self)) if self.tolerance is None else np.diff(self.ends)

    @property
    def middle(self) -> int:
        """Number of the step that begins nearest to half a period."""
        return len(self) // 2 if self.tolerance is None else int(np.abs(self.ends - 0.5).argmin())

    @property
    def reversed(self) -> StepSequence:
        """Sequence of the same steps backward in time."""
        return StepSequence(1.0 - self.ends[::-1], self.tolerance)

    @property
    def half(self) -> StepSequence:
        """The first half of an even number of steps."""
        return StepSequence(self.ends[: len(self) // 2 + 1], self.tolerance)

    @property
    def mirrored(self) -> StepSequence:
        """Sequence of half a period, followed by its mirror image."""
        return StepSequence(np.append(self.ends, 1.0 - self.ends[-2::-1]), self.tolerance)
