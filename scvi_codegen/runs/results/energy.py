"""Energy along saved states: which part of its change is an error, and what to call it.

Forces, damping, constraints that do work, a function that depends on time, and impacts change the energy of the exact
motion. Where their work W is known, the balance E - E0 - W is the error; elsewhere only the change can be shown.
"""

from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.results.export import Array
from scvi_codegen.runs.results.recomputation import exchanged_energy
from scvi_codegen.runs.results.saved_states import SavedStates

MOST_BALANCED_STEPS, MOST_BALANCED_COORDINATES = 10_000, 12
"""Limits for a balance that was not asked for: Newton's iteration repeats each step, in some tens of microseconds."""


def energy_reason(stepper: Any) -> str | None:
    """Return why the energy of a motion changes, so that its change is no error; ``None`` if it is conserved."""
    if stepper.changes_states or stepper.interface.contacts:
        return "contacts do work" if stepper.interface.contacts else "events change the state"
    reason: str | None = stepper.interface.changes_energy
    return reason


class EnergyAccount(NamedTuple):
    """Change of the energy along saved states.

    Attributes:
        reason: why the exact energy changes; ``None`` if it is conserved.
        initial: energy E0 of the first state; ``None`` if it is at most 1e-8 of p.v, as of a pendulum that starts
            horizontally, so that errors are not relative to it.
        change: (n,) E - E0.
        work: (n,) work of forces and damping, and energy exchanged at events; ``None`` if unknown or none.
    """

    reason: str | None
    initial: float | None
    change: Array
    work: Array | None = None

    @property
    def is_error(self) -> bool:
        """True if :attr:`values` are errors: the energy is conserved, or its work is known."""
        return self.reason is None or self.work is not None

    @property
    def values(self) -> Array:
        """(n,) E - E0, or E - E0 - W if the work is known."""
        return self.change if self.work is None else self.change - self.work

    @property
    def scale(self) -> float:
        """|E0| for errors that are relative to it; 1 for others, and for changes."""
        return 1.0 if self.initial is None or not self.is_error else abs(self.initial)

    @property
    def title(self) -> str:
        """Name of ``abs(values) / scale``."""
        if not self.is_error:
            return f"energy change |E - E0|: {self.reason}"
        if self.work is not None:
            return f"energy balance |E - E0 - W|{'' if self.initial is None else ' / |E0|'}"
        return "energy error" if self.initial is None else "relative energy error"


def energy_account(states: Any, *, limited: bool = False) -> EnergyAccount:
    """Return the change of the energy along a trajectory, or a recorded run, of which the work is unknown.

    ``limited``: compute the work only for short runs of few coordinates.
    """
    energy, stepper = np.asanyarray(states.energy()), states.stepper
    reason, work = energy_reason(stepper), None
    is_short = 0 < states.steps <= MOST_BALANCED_STEPS and stepper.dimension <= MOST_BALANCED_COORDINATES
    if reason is not None and isinstance(states, SavedStates) and (is_short or not limited):
        work = exchanged_energy(states, energy)
    initial, change = float(energy[0]), energy - energy[:1]
    is_size = initial != 0.0
    if is_size and np.abs(change).max() > 1e-3 * abs(initial):
        with suppress(StateError):  # arrays of a system defined by a Hamiltonian have no velocities
            action = np.abs(np.sum(states.p * states.velocity, axis=-1)).max()  # p.v, twice the kinetic energy
            is_size = abs(initial) > 1e-8 * action
    return EnergyAccount(reason, initial if is_size else None, change, work)
