"""Common fixed steps of an ensemble, in segments of equal steps between the breakpoints of inputs."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property, lru_cache, partial
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.arguments import empty_array
from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.driver.segments import Input, Segment, planned_segments, time_after_steps
from scvi_codegen.runs.ensembles.result import INTERRUPTED, OK, SpanOfRows, failure_after
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import exact_sum, with_low
from scvi_codegen.runs.stepping.step_plan import Span


class StepChunk(NamedTuple):
    """Chunk of steps for one call into C, and the segment that begins with it, or ``None``."""

    steps: int
    save_every: int
    entered: Segment | None = None


class FixedSegments(NamedTuple):
    """Fixed steps in segments: numbers of steps, strides of saved states, step sizes, middle times, ends (or NaN)."""

    steps: NDArray[np.int64]
    save_every: NDArray[np.int64]
    h: Array
    middle: Array
    end: Array


class CommonSteps:
    """Fixed steps that all trajectories share, and the states that are saved.

    Args:
        t0, h: initial time and step size.
        save_every: steps between saved states.
        steps, t_end: number of steps, or final time, with a shorter step before each breakpoint and at the end.
        inputs: validated inputs, with ``t_end``.
        words: of numbers of states; of two, the last step ends at ``t_end`` to both words.

    Attributes:
        segments: segments of equal steps.
        ends: number of steps up to the end of each segment.
        numbers: step numbers of the saved states: every ``save_every``-th and the last, with inputs ends of segments.
        has_inputs: whether parameters change along the runs.
    """

    def __init__(
        self,
        t0: float,
        h: float,
        save_every: int,
        steps: int | None = None,
        t_end: float | None = None,
        inputs: Mapping[str, Input] | None = None,
        words: int = 1,
    ) -> None:
        self.t0, self.h, self.t_end, self.save_every = t0, checked_step(h), t_end, save_every
        self.has_inputs = bool(inputs)
        count = 0 if t_end is not None else checked_count(steps, "steps", least=0)
        self.segments = [Segment(count, self.h, (float(t0), getattr(t0, "low", 0.0)), t0)]
        if t_end is not None:
            self.segments = planned_segments(t0, t_end, self.h, inputs or {}, words=words) or self.segments
        ends = list(accumulate(segment.steps for segment in self.segments))
        self.steps = ends[-1]
        empty_array((self.steps // save_every + 1,))  # rejects numbers of states beyond any memory
        multiples = np.arange(0, self.steps + 1, save_every)
        at_ends = ends if inputs else ends[-1:]
        self.numbers = multiples if t_end is None else np.union1d(multiples, at_ends)
        last = self.segments[-1]
        if words > 1 and t_end is not None and last.end is None and last.steps > 0:  # h is a double: ends at t_end
            start = time_after_steps(last.start, last.h, last.steps - 1)
            self.segments[-1:] = last._replace(steps=last.steps - 1), Segment(1, last.h, start, last.middle, t_end)
        self.words, self.ends = words, list(accumulate(segment.steps for segment in self.segments))

    @property
    def span(self) -> Span:
        """Their number, or the final time."""
        return Span(self.steps) if self.t_end is None else Span(t_end=self.t_end)

    def row(self, step: int) -> int:
        """Return the index of the first saved state after ``step`` steps."""
        return int(self.numbers.searchsorted(step, side="right"))

    def chunks(self, begin: int, size: int) -> Iterator[StepChunk]:
        """Split steps at breakpoints; the last step of a segment is separate if the output stride skips its state."""
        end, step = begin + size, begin
        while step < end:
            k = bisect_right(self.ends, step)
            last, entering = self.ends[k], self.t_end is not None and step == self._first(k)
            odd = last % self.save_every != 0 and self.numbers[self.row(last) - 1] == last
            until = min(end, last - 1 if odd and step < last - 1 else last)
            save_every = last if odd and until == last else self.save_every
            yield StepChunk(until - step, save_every, self.segments[k] if entering else None)
            step = until

    @cached_property
    def fixed_segments(self) -> FixedSegments:
        """Chunks of all steps, as C takes them."""
        segment, rows = self.segments[0], []
        for chunk in self.chunks(0, self.steps):
            segment = chunk.entered or segment
            end = np.nan if segment.end is None else segment.end
            rows.append((chunk.steps, chunk.save_every, segment.h, segment.middle, end))
        columns = zip(*rows or [(0, 1, self.h, self.t0, np.nan)], strict=True)
        return FixedSegments(*map(np.array, columns))

    def at(self, step: int) -> tuple[Segment, tuple[float, float]]:
        """Return the segment and the double-double time after ``step`` steps."""
        k = min(bisect_right(self.ends, step), len(self.ends) - 1)
        segment = self.segments[k]
        return segment, time_after_steps(segment.start, segment.h, step - self._first(k))

    def _first(self, k: int) -> int:
        """Return the number of steps before segment k."""
        return self.ends[k] - self.segments[k].steps

    @cached_property
    def t(self) -> Array:
        """Times of the saved states."""
        return self.times(tau=False)

    def times(self, *, tau: bool) -> Array:
        """Return the (n,) times of the saved states, of one or two words; tau from 0 in transformed time."""
        columns = [(*segment.start, segment.h, self._first(k)) for k, segment in enumerate(self.segments)]
        start, low, h, first = columns[0]  # of all states, or of each
        if len(columns) > 1:
            start, low, h, first = np.repeat(np.array(columns).T, np.diff([0, *map(self.row, self.ends)]), axis=1)
        high, rest = times_after(0.0 * start if tau else start, h, self.numbers - first)
        rest += 0.0 if tau else low
        times, lows = exact_sum(high, rest)
        for end, segment in zip(self.ends, self.segments, strict=True):
            if self.words > 1 and segment.end is not None:
                times[self.row(end) - 1], lows[self.row(end) - 1] = segment.end, 0.0
        return with_low(times, lows) if self.words > 1 else np.asarray(times)

    def spans(self, values_at: Callable[..., Array]) -> Iterator[SpanOfRows]:
        """Yield the saved states of each segment, of all trajectories; a breakpoint belongs to the earlier one."""
        first = 0
        for end, segment in zip(self.ends, self.segments, strict=True):
            yield slice(first, self.row(end)), slice(None), partial(values_at, segment.middle)
            first = self.row(end)

    def failures(self, status: NDArray[np.str_], done: NDArray[np.int64]) -> dict[int, str]:
        """Return why trajectories failed, by their numbers, which ended after ``done`` steps."""
        failed = np.flatnonzero((status != OK) & (status != INTERRUPTED)).tolist()
        steps = {j: int(done[j]) for j in failed}
        return {j: failure_after(self.at(n)[1][0], n, str(status[j])) for j, n in steps.items()}


FEW_STEPS = 1000
"""Largest number of steps that are kept."""
_kept_steps = lru_cache(maxsize=16)(CommonSteps)


def common_steps(
    t0: float,
    h: float,
    save_every: int,
    steps: int | None,
    t_end: float | None,
    inputs: Mapping[str, Input],
    words: int,
) -> CommonSteps:
    """Return common steps; a few of one size, in one word and without inputs, are kept for later ensembles."""
    if isinstance(steps, int) and steps <= FEW_STEPS and t_end is None and not inputs and words == 1:
        return _kept_steps(t0, float(h), save_every, steps)
    return CommonSteps(t0, h, save_every, steps, t_end, inputs, words)
