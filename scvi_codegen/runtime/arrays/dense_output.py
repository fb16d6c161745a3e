"""Dense output of runs over arrays: steps of the method from the saved state before each time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.arrays.interface import Numbers
from scvi_codegen.runtime.arrays.problem import ArrayProblem
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.dense_output import whole_steps, within

__all__ = ["Continuation", "states_between"]

State = Mapping[str, Numbers]


@dataclass(frozen=True, slots=True)
class Continuation:
    """Data for continuing a run from a saved state.

    Attributes:
        problem: the problem with the parameters from there on.
        h: fixed step size.
        plan: step plan for adaptive steps, else ``None``.
        options: solver options.
    """

    problem: ArrayProblem
    h: float
    plan: StepPlan | None
    options: SolverOptions | None

    @classmethod
    def of(cls, run: ArrayRun) -> Continuation:
        """Construct from the current state of a run."""
        return cls(run.problem, run.h, run.plan, run.options)

    def begin(self, t: float, q: State, p: State, *, h: float | None = None, t_end: float | None = None) -> ArrayRun:
        """Return a run from a state, with fixed steps h or with adaptive steps to t_end."""
        plan = replace(self.plan, t_end=t_end) if self.plan and t_end is not None else None
        length = 0.0 if plan else self.h if h is None else h
        return ArrayRun(self.problem, q, (p, "momenta"), h=length, t=t, plan=plan, options=self.options)


def states_between(
    continuations: tuple[Continuation, ...], t: Numbers, q: State, p: State, times: Numbers
) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
    """Return positions and momenta by name at (n,) times; raises as :meth:`ArrayTrajectory.at`."""
    flat = within(times.ravel(), t[0], t[-1])
    forward = math.copysign(1.0, t[-1] - t[0])
    left = np.searchsorted(forward * t, forward * flat, side="right") - 1
    states: list[tuple[dict[str, Numbers], dict[str, Numbers]]] = [({}, {})] * len(flat)
    for k in np.unique(left):
        start = ({name: each[k] for name, each in q.items()}, {name: each[k] for name, each in p.items()})
        numbers = np.flatnonzero(left == k)
        wanted = numbers[np.argsort(forward * flat[numbers], kind="stable")]
        for number, state in zip(wanted, _behind(continuations[k], float(t[k]), start, flat[wanted]), strict=True):
            states[number] = state
    return _shaped([state for state, _ in states], q, times.shape), _shaped(
        [state for _, state in states], p, times.shape
    )


def _shaped(states: Sequence[State], saved: State, shape: tuple[int, ...]) -> dict[str, Numbers]:
    """Return arrays by name, stacked to the shape of the times."""
    return {
        name: np.array([state[name] for state in states]).reshape((*shape, *values.shape[1:]))
        for name, values in saved.items()
    }


def _behind(
    departure: Continuation, t: float, start: tuple[State, State], times: NDArray[np.float64]
) -> Iterator[tuple[dict[str, Numbers], dict[str, Numbers]]]:
    """Yield the states at sorted times: whole steps and one partial step, or adaptive steps to each time."""
    if departure.plan is not None:
        for time in times:
            run = departure.begin(t, *start, t_end=float(time))
            while not run.arrived:
                run.advance(1)
            yield run.q, run.p
        return
    run = departure.begin(t, *start)
    for time, whole in zip(times, whole_steps(times - t, np.full(len(times), departure.h)), strict=True):
        run.advance(int(whole) - run.steps)
        rest, on_grid = float(time) - run.t, abs(float(time) - run.t) <= 4.0 * np.spacing(max(abs(t), abs(run.t)))
        part = run if on_grid else departure.begin(run.t, run.q, run.p, h=rest)
        part.advance(0 if on_grid else 1)
        yield part.q, part.p
