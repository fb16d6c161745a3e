"""Saved states of a run with the data needed for dense output, events and derivatives."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import MethodError
from scvi_codegen.runs.states.times import number_until
from scvi_codegen.runs.states.words import scalar
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed, FixedSteps, StepPlan

Array = NDArray[np.float64]
ROUNDINGS, STEP_END_TOLERANCE = 4.0, 1e-6


def checked_row(row: Any, count: int) -> int:
    """Return a row index counted from the start, negative ones from the end; IndexError or TypeError for others."""
    if isinstance(row, bool) or not hasattr(row, "__index__"):
        raise TypeError(f"the index of a state must be a whole number or a slice (run[-1], run[10:]), not {row!r}")
    number = operator.index(row)
    if not -count <= number < count:
        raise IndexError(f"the index {number} is out of range: the trajectory has {count} states")
    return number % count


@dataclass(slots=True, kw_only=True, eq=False)
class SavedStates:
    """Saved states with the data for dense output and events; other fields as of :class:`Trajectory`.

    Attributes:
        step_sizes: (n,) size of the step that follows each state, NaN for a state within a step.
        tau: (n,) values of tau in transformed time, else ``None``; ``step_sizes`` are then steps of tau.
    """

    t: Array
    q: Array
    p: Array
    step_sizes: Array
    h: float
    parameters: Array
    stepper: Integrator = field(repr=False)
    plan: StepPlan = field(repr=False)
    options: SolverOptions | None = field(default=None, repr=False)
    tau: Array | None = None
    steps: int = 0
    step_error: float = math.nan
    worst_step_time: float = math.nan

    @property
    def stepped(self) -> Array:
        """(n,) independent variable of the steps: tau or t."""
        return self.t if self.tau is None else self.tau

    @property
    def has_fixed_steps(self) -> bool:
        """Whether the steps have one size, but for those that end at events and output times."""
        return isinstance(self.plan, FixedSteps)

    @property
    def forward(self) -> float:
        """1, or -1 for a run backward in time."""
        return math.copysign(1.0, self.t[-1] - self.t[0])

    @property
    def grid_tolerance(self) -> Array:
        """(n,) distances within which a time counts as the end of a step: times are rounded."""
        rounding = ROUNDINGS * np.finfo(float).eps * np.abs(self.stepped).max()
        return np.asarray(np.fmax(STEP_END_TOLERANCE * np.abs(self.step_sizes), rounding))

    def __len__(self) -> int:
        return len(self.t)

    def parameters_on_sides(self, t: float) -> Array:
        """Return the parameters of the steps after time t, with the modes of contacts and kinks in the run."""
        modes = getattr(self, "modes", None)
        if modes is None:
            if len(self.stepper.modes) > len(self.stepper.interface.mode_names):
                raise MethodError(
                    "values of parameters that events set are not stored in recordings: energies and other functions "
                    "of parameters are those of integrate(..) with the same events"
                )
            return self.parameters
        parameters = self.parameters.copy()
        parameters[self.stepper.mode_columns] = modes.at(t, self.forward)
        return parameters

    def _restarted(self, k: int, h: float) -> Memory:
        """Return a run from saved state k with fixed steps h."""
        settings: dict[str, Any] = {"parameters": self.parameters, "options": self.options}
        return Memory.started(self.stepper, self.q[k], self.p[k], plan=Fixed(h), t=scalar(self.t[k]), **settings)


@dataclass(frozen=True, slots=True, eq=False)
class ModeHistory:
    """Values of ``stepper.modes`` along a run: parameters that events set, modes of contacts and of kinks.

    Attributes:
        t: (k,) times of changes, in the order of the run.
        values: (k + 1, modes) values before the first change and after each.
        ambiguous: whether several motions of contacts were consistent at a transition since the start.
        missed: tolerance of an adaptive step that missed that of the run, by rounding of the gaps of contacts, else 0.
    """

    t: Array
    values: Array
    ambiguous: bool = False
    missed: float = 0.0

    def at(self, t: float, forward: float) -> Array:
        """Return (modes,) values after time t; ``forward`` is -1 for a run backward in time."""
        changes = int(number_until(self.t, t, forward))
        return np.asarray(self.values[changes])

    def between(self, low: float, high: float) -> ModeHistory:
        """Return the history between two times, low <= high."""
        inside = np.flatnonzero((low <= self.t) & (self.t <= high))
        if not len(inside):  # no change since the last one before
            earlier = (self.t < low) if not len(self.t) or self.t[0] <= self.t[-1] else (self.t > high)
            last = int(np.count_nonzero(earlier))
            return ModeHistory(self.t[:0], self.values[last : last + 1], self.ambiguous, self.missed)
        return ModeHistory(self.t[inside], self.values[inside[0] : inside[-1] + 2], self.ambiguous, self.missed)

    @classmethod
    def joined(cls, histories: Sequence[ModeHistory]) -> ModeHistory:
        """Return the history of consecutive parts of a run."""
        values = [*(part.values[:-1] for part in histories), histories[-1].values[-1:]]
        ambiguous, missed = any(part.ambiguous for part in histories), max(part.missed for part in histories)
        return cls(np.concatenate([part.t for part in histories]), np.concatenate(values), ambiguous, missed)


def times_of_changes(states: Any) -> Array:
    """Return the sorted times of events that change the state, and of transitions of contacts and kinks."""
    transitions = getattr(states, "transitions", ())
    if not (states.events or transitions or states.modes):
        return np.empty(0)
    times = [of.t for of in states.events if of.event.changes_state] + [of.t for of in transitions]
    times += [] if states.modes is None else [states.modes.t]
    values = np.concatenate([np.asarray(of, float) for of in times]) if times else np.empty(0)
    return np.asarray(states.forward * np.unique(states.forward * values))


def in_modes(states: SavedStates, quantity: Callable[[Any, Any, Any, Array], Array]) -> Array:
    """Return a (n, ..) quantity of (q, p, t, parameters), with the modes after each state."""
    modes = getattr(states, "modes", None)
    if modes is None or not len(modes.t):
        return quantity(states.q, states.p, states.t, states.parameters_on_sides(float(states.t[-1])))
    rows = number_until(modes.t, states.t, states.forward)
    parts = [np.flatnonzero(rows == number) for number in np.unique(rows)]
    values = [
        quantity(states.q[part], states.p[part], states.t[part], states.parameters_on_sides(float(states.t[part[0]])))
        for part in parts
    ]
    return np.concatenate(values)
