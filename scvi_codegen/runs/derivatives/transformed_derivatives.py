"""Derivatives of runs in transformed time: initial states on an energy surface, and ends at a fixed time.

Each step has derivatives with respect to the energy of the run, and derivatives of its physical time. The energy is
that of the first state and varies with it. If a run ends at t_end or at an event, the size of its last step in tau is
determined by that time: with w the derivative of the end with respect to this size and w_t that of the time, a
variation v of the end becomes v - w v_t / w_t (implicit function theorem). The initial time shifts all times and
nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.step_derivatives import Starts

T = -2
"""Index of t among the variables (q, p, parameters, t, h)."""


@dataclass(frozen=True)
class PhysicalTime:
    """Run without time transformation: the maps below are identities."""

    states: SavedStates

    def initial_tangents(self, tangents: Array) -> Array:
        """Return (k, variables) variations of the variables of the first step, from those of the initial data."""
        return tangents

    def final_tangents(self, vectors: Array, now: Array, tangents: Array) -> tuple[Array, Array]:
        """Return (n, outputs, k) variations of all states and (k, variables) at the end, from those of the steps."""
        return vectors, now

    def step_cotangents(self, seeds: Array) -> Array:
        """Return (n, k, variables) cotangents of ends from those of states: transpose of :meth:`final_tangents`."""
        return seeds

    def initial_cotangents(self, derivatives: Array, seeds: Array) -> Array:
        """Return (k, variables) cotangents of the initial data: the transpose of :meth:`initial_tangents`."""
        return derivatives


@dataclass(frozen=True)
class TransformedTime(PhysicalTime):
    """Run in transformed time.

    Attributes:
        end_time_fixed: whether the time of the last state is fixed, by t_end or a terminal event.
        repeated: whether the last state repeats the one before, because a step ended exactly there.
    """

    end_time_fixed: bool
    repeated: bool

    @classmethod
    def of(cls, states: SavedStates) -> TransformedTime:
        """Construct from the states of a run."""
        end_is_fixed = len(states) > 1 and bool(np.isnan(states.step_sizes[-1]))
        repeated = end_is_fixed and bool(states.stepped[-1] == states.stepped[-2])
        if repeated:
            before = ("t", "q", "p", "step_sizes", "tau")
            states = replace(states, **{name: getattr(states, name)[:-1] for name in before})
        return cls(states, end_is_fixed, repeated)

    @cached_property
    def energy_gradient(self) -> Array:
        """(variables,) gradient of the energy with respect to the initial data."""
        states = self.states
        return states.stepper._energy_gradient(states.q[0], states.p[0], states.parameters)

    @cached_property
    def last_step(self) -> Array:
        """(variables,) derivative of the end by the size of the last step, divided by that of the time; 0 if free."""
        states, input_size = self.states, self.states.stepper._input_size
        if not self.end_time_fixed or len(states) < 2:
            return np.zeros(input_size)
        span = states.stepped[-1:] - states.stepped[-2:-1]
        vectors = np.zeros((2, 1, input_size))
        vectors[0, 0, -1] = 1.0
        starts = Starts(states.t[-2:-1].copy(), span, states.q[-2:].copy(), states.p[-2:].copy())
        states.stepper._propagate(starts, vectors, states.parameters, states.options)
        return np.asarray(vectors[1, 0] / vectors[1, 0, T])

    def initial_tangents(self, tangents: Array) -> Array:
        """Add the variation of the energy; see :meth:`PhysicalTime.initial_tangents`."""
        result = tangents.copy()
        result[:, self.states.stepper._energy_index] += tangents @ self.energy_gradient
        result[:, T] = 0.0
        return result

    def final_tangents(self, vectors: Array, now: Array, tangents: Array) -> tuple[Array, Array]:
        """Project the variation of the end onto the fixed final time; see :meth:`PhysicalTime.final_tangents`."""
        now = now - now[:, T, np.newaxis] * self.last_step
        last = now[:, self.states.stepper._output_indices].T[np.newaxis]
        vectors = np.concatenate([vectors if self.repeated else vectors[:-1], last])
        vectors[:, -1] += tangents[:, T]
        return vectors, now

    def step_cotangents(self, seeds: Array) -> Array:
        """Apply the transpose of :meth:`final_tangents`; see :meth:`PhysicalTime.step_cotangents`."""
        result = seeds.copy()
        result[-1, :, T] -= seeds[-1] @ self.last_step
        if self.repeated:
            result[-2] += result[-1]
        return result[: len(self.states)]

    def initial_cotangents(self, derivatives: Array, seeds: Array) -> Array:
        """Apply the transpose of :meth:`initial_tangents`; see :meth:`PhysicalTime.initial_cotangents`."""
        result = derivatives + derivatives[:, self.states.stepper._energy_index, np.newaxis] * self.energy_gradient
        result[:, T] = seeds[:, :, T].sum(axis=0)
        return result


def time_of(states: SavedStates) -> PhysicalTime:
    """Return the treatment of time for the states of a run."""
    return PhysicalTime(states) if states.tau is None else TransformedTime.of(states)
