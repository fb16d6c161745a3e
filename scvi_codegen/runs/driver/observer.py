"""Contract of observers: they receive all states of a run chunk by chunk.

The driver (:mod:`scvi_codegen.runs.driver.observation`) cuts a chunk at the end of the run, by a terminal event or at
the final time, before the observer receives it.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.trajectory import Trajectory


@dataclass(frozen=True, slots=True)
class StateChunk:
    """Consecutive states of a run.

    Attributes:
        run: the run, at the last state unless that is within a step.
        states: the states; the first one is the last of the previous chunk, if there is one.
        numbers: (n,) numbers of the steps that end at the states, -1 within a step.
        iterations: (n,) numbers of solver iterations since the start.
        is_first: whether the chunk consists of the initial state.
        is_last: whether the run has ended.
        within_step: whether the last state is within a step, so that the run is at the one before.
    """

    run: Memory
    states: Trajectory
    numbers: NDArray[np.int64]
    iterations: NDArray[np.int64]
    is_first: bool
    is_last: bool
    within_step: bool


class Observer:
    """Observer of a run, as passed to ``integrate(observe=)``."""

    def most_steps(self, run: Memory) -> float:
        """Return the largest number of steps of the next chunk."""
        return math.inf

    def receive(self, chunk: StateChunk) -> None:
        """Receive the next states; those of the first chunk are the initial state alone."""
        raise NotImplementedError

    def result(self) -> ArrayLike:
        """Return ``observed`` of the trajectory."""
        raise NotImplementedError
