"""What transformed time adds to derivatives: runs that start on a level of the energy, and that end at a time.

Each step has its derivative at the energy of the run, and of the time it takes. The energy is that of the first state,
whose changes it follows. And where a run was to end at a time, or an event ended it, the length of its last step, in
tau, is what brings it there: with w the slopes of the end of that step by its length, w_t that of the time, a change v
of the end leaves v - w v_t / w_t (implicit function theorem). The time of the start moves all times and nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.kept_states import KeptStates
from scvi_codegen.runtime.linearised import Starts

__all__ = ["OwnTime", "TransformedTime", "time_of"]

T = -2
"""Where among all that is given stands t."""


@dataclass(frozen=True)
class OwnTime:
    """A run whose time is its own: nothing is added.

    Attributes:
        states: of the run, those that stand at the ends of steps.
    """

    states: KeptStates

    def begun(self, changes: Array) -> Array:
        """(k, given) changes that the first step is given, of those of all that the run starts from."""
        return changes

    def ended(self, found: Array, now: Array, changes: Array) -> tuple[Array, Array]:
        """(n, told, k) changes of all states and (k, given) at the end, of those that the steps lead to."""
        return found, now

    def seeded(self, seeds: Array) -> Array:
        """(n, k, given) slopes by the ends of steps, of those by states: the transpose of :meth:`ended`."""
        return seeds

    def pulled(self, slopes: Array, seeds: Array) -> Array:
        """(k, given) slopes by all that the run starts from: the transpose of :meth:`begun`."""
        return slopes


@dataclass(frozen=True)
class TransformedTime(OwnTime):
    """A run in transformed time.

    Attributes:
        ends_at_a_time: whether its last state is held at a time: at t_end, or at that of a terminal event.
        repeated: whether the last state is the one before once more, as a step ended there.
    """

    ends_at_a_time: bool
    repeated: bool

    @classmethod
    def of(cls, states: KeptStates) -> TransformedTime:
        """Of the states of a run."""
        held = len(states) > 1 and bool(np.isnan(states.lengths[-1]))
        repeated = held and bool(states.stepped[-1] == states.stepped[-2])
        return cls(_before_last(states) if repeated else states, held, repeated)

    @cached_property
    def level(self) -> Array:
        """(given,) slopes of the energy by all that the run starts from."""
        states = self.states
        return states.stepper.level(states.q[0], states.p[0], states.parameters)

    @cached_property
    def last_step(self) -> Array:
        """(given,) slopes of the end of the last step by its length, over that of the time; 0 where none is held."""
        states, given = self.states, self.states.stepper.given
        if not self.ends_at_a_time or len(states) < 2:
            return np.zeros(given)
        span = states.stepped[-1:] - states.stepped[-2:-1]
        vectors = np.zeros((2, 1, given))
        vectors[0, 0, -1] = 1.0
        starts = Starts(states.t[-2:-1].copy(), span, states.q[-2:].copy(), states.p[-2:].copy())
        states.stepper.linearise(starts, vectors, states.parameters, states.options)
        slopes: Array = vectors[1, 0] / vectors[1, 0, T]
        return slopes

    def begun(self, changes: Array) -> Array:
        """See :meth:`OwnTime.begun`: the energy goes with the start."""
        found = changes.copy()
        found[:, self.states.stepper.energy_place] += changes @ self.level
        found[:, T] = 0.0
        return found

    def ended(self, found: Array, now: Array, changes: Array) -> tuple[Array, Array]:
        """See :meth:`OwnTime.ended`."""
        now = now - now[:, T, np.newaxis] * self.last_step
        last = now[:, self.states.stepper.told].T[np.newaxis]
        found = np.concatenate([found if self.repeated else found[:-1], last])
        found[:, -1] += changes[:, T]
        return found, now

    def seeded(self, seeds: Array) -> Array:
        """See :meth:`OwnTime.seeded`."""
        found = seeds.copy()
        found[-1, :, T] -= seeds[-1] @ self.last_step
        if self.repeated:
            found[-2] += found[-1]
        return found[: len(self.states)]

    def pulled(self, slopes: Array, seeds: Array) -> Array:
        """See :meth:`OwnTime.pulled`."""
        found = slopes + slopes[:, self.states.stepper.energy_place, np.newaxis] * self.level
        found[:, T] = seeds[:, :, T].sum(axis=0)
        return found


def time_of(states: KeptStates) -> OwnTime:
    """How the time of a run goes."""
    return OwnTime(states) if states.tau is None else TransformedTime.of(states)


def _before_last(states: KeptStates) -> KeptStates:
    assert states.tau is not None
    return KeptStates(
        t=states.t[:-1],
        q=states.q[:-1],
        p=states.p[:-1],
        lengths=states.lengths[:-1],
        h=states.h,
        parameters=states.parameters,
        stepper=states.stepper,
        options=states.options,
        tau=states.tau[:-1],
    )
