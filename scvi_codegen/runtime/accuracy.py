"""What is said of steps that were solved and are too long for their motion, and of errors that grew on the way."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import islice
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError, warn
from scvi_codegen.runtime.goal import Goal

if TYPE_CHECKING:
    from scvi_codegen.runtime.integrator import Integrator

__all__ = [
    "GROSS_ERROR",
    "MET",
    "TOLERABLE_ERROR",
    "unwarned",
    "warn_of_energies",
    "warn_of_long_steps",
    "warn_of_lost_energies",
    "warn_of_lost_energy",
    "warnings_wanted",
]

TOLERABLE_ERROR: Final = 1e-3
"""Of a step, relative to the state: one that is wrong by more is too long for its motion; and of a run's energy."""

CONTROLLED: Final = ", or steps that choose their length (t_end= with a tolerance)"

GROSS_ERROR: Final = 0.5
"""Of the energy of a run by steps of one length that tell no error; it swings by less while these are short enough."""

MOST_ASKED: Final = 1000
"""Trajectories of an ensemble."""

MAGNIFIED: Final = (
    "though each step was as accurate as wanted: the motion magnifies errors, as near collisions do; take a smaller "
    "tolerance, or coordinates in which nothing collides"
)
MET: Final = (
    "though the motion conserves it: steps are too long, perhaps where bodies nearly meet; take a shorter h, or an SVI "
    "by steps that choose their length (t_end=)"
)

Array = NDArray[np.float64]

_heard: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)


class Steps(Protocol):
    """What a trajectory tells of its steps."""

    @property
    def goal(self) -> Goal | None: ...
    @property
    def h(self) -> float: ...
    @property
    def step_error(self) -> float: ...
    @property
    def step_error_t(self) -> float: ...


class EnergyAtEnds(Protocol):
    """What a trajectory tells of its states, the first and the last among them."""

    @property
    def goal(self) -> Goal | None: ...
    @property
    def stepper(self) -> Integrator: ...
    @property
    def t(self) -> Array: ...
    @property
    def q(self) -> Array: ...
    @property
    def p(self) -> Array: ...
    @property
    def parameters(self) -> Array: ...


class StatesOfMany(Protocol):
    """What an ensemble tells of its trajectories: times, positions, momenta, status and steps of each."""

    @property
    def goals(self) -> tuple[Goal, ...]: ...
    @property
    def stepper(self) -> Integrator: ...
    @property
    def parameters(self) -> Array: ...
    def each(self) -> Iterator[tuple[Array, Array, Array, str, int]]: ...


@contextmanager
def unwarned() -> Iterator[None]:
    """Inside, and in functions that this decorates, long steps are made on purpose."""
    token = _heard.set(False)
    try:
        yield
    finally:
        _heard.reset(token)


def warnings_wanted() -> bool:
    """Return whether accuracy warnings are wanted: not inside :func:`unwarned`."""
    return _heard.get()


def warn_of_long_steps(trajectory: Steps, *, before: float = 0.0, remedy: str = CONTROLLED) -> None:
    """An :class:`AccuracyWarning` of the worst step of a run of h, unless one ``before`` was a reason for it."""
    error = trajectory.step_error
    controlled = trajectory.goal is not None and not trajectory.goal.tau
    if controlled or not error > TOLERABLE_ERROR or before > TOLERABLE_ERROR or not _heard.get():
        return
    warn(
        f"the step from t = {trajectory.step_error_t:g} with h = {trajectory.h:g} is too long: the relative error of "
        f"its end is about {error:.1e}; take a shorter h{remedy}",
        AccuracyWarning,
    )


def warn_of_lost_energy(trajectory: EnergyAtEnds) -> None:
    """An :class:`AccuracyWarning` where steps chose their length and the energy that is conserved is another."""
    goal, stepper = trajectory.goal, trajectory.stepper
    if goal is None or goal.tau or not stepper.interface.conserves_energy or not _heard.get():
        return
    if energies := _lost_energies(stepper, trajectory.t, trajectory.q, trajectory.p, trajectory.parameters):
        warn_of_energies(*energies)


def warn_of_lost_energies(ensemble: StatesOfMany) -> None:
    """The same of an ensemble: of the worst of its trajectories, of which so many are asked."""
    goals, stepper = ensemble.goals, ensemble.stepper
    if not goals or not stepper.interface.conserves_energy or not _heard.get():
        return
    found = {}
    for j, (t, q, p, _, _) in islice(enumerate(ensemble.each()), 0, None, -(-len(goals) // MOST_ASKED)):
        if len(t) and (energies := _lost_energies(stepper, t, q, p, ensemble.parameters[j])):
            found[j] = energies
    worst = max(found, key=lambda j: lost_part(*found[j]), default=None)
    if worst is not None:
        warn_of_energies(*found[worst], where=f" of trajectory {worst}")


def warn_of_energies(
    first: float, last: float, size: float, *, tolerable: float = TOLERABLE_ERROR, where: str = "", why: str = MAGNIFIED
) -> None:
    """An :class:`AccuracyWarning` where an energy that the motion conserves is another at the end.

    Args:
        first, last: energies.
        size: of a part of one: that of p.v, so that an energy near zero has a size.
        tolerable: part of the largest of the three.
        where: which motion, in words.
        why: what may be the cause, and what to do.
    """
    if lost_part(first, last, size) > tolerable and _heard.get():
        warn(f"the energy{where} went from {first:.3g} to {last:.3g} {why}", AccuracyWarning)


def lost_part(first: float, last: float, size: float) -> float:
    """By what part of its size an energy changed; 0 of one that is not known."""
    part = abs(last - first) / max(abs(first), abs(last), size, sys.float_info.min)
    return part if part == part else 0.0


def _lost_energies(
    stepper: Integrator, t: Array, q: Array, p: Array, parameters: Array
) -> tuple[float, float, float] | None:
    """Of the first and the last state the energies, and the largest p.v, if it takes that to tell whether they are one.

    Nothing beyond the domain of L. Most runs end with the energy they began with, which is known without velocities.
    """
    apart = max(1, len(t) - 1)
    t, q, p = (np.ascontiguousarray(states[::apart]) for states in (t, q, p))
    try:
        energies = stepper.energies_of(t, q, p, parameters)
        first, last = float(energies[0]), float(energies[-1])
        if not lost_part(first, last, 0.0) > TOLERABLE_ERROR:
            return None
        sizes = np.sum(p * stepper.velocity(q, p, t, parameters), axis=1)
    except StateError:
        return None
    return first, last, float(np.abs(sizes).max())
