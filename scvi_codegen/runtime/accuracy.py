"""What is said of steps that were solved and are too long for their motion, and of errors that grew on the way."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError
from scvi_codegen.runtime.goal import Goal

if TYPE_CHECKING:
    from scvi_codegen.runtime.integrator import Integrator

__all__ = ["TOLERABLE_ERROR", "unwarned", "warn_of_long_steps", "warn_of_lost_energy"]

TOLERABLE_ERROR: Final = 1e-3
"""Of a step, relative to the state: one that is wrong by more is too long for its motion; and of a run's energy."""

CONTROLLED: Final = ", or steps that choose their length (t_end= with a tolerance)"

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


@contextmanager
def unwarned() -> Iterator[None]:
    """Inside, and in functions that this decorates, long steps are made on purpose."""
    token = _heard.set(False)
    try:
        yield
    finally:
        _heard.reset(token)


def warn_of_long_steps(trajectory: Steps, *, before: float = 0.0, remedy: str = CONTROLLED) -> None:
    """An :class:`AccuracyWarning` of the worst step of a run of h, unless one ``before`` was a reason for it."""
    error = trajectory.step_error
    controlled = trajectory.goal is not None and not trajectory.goal.tau
    if controlled or not error > TOLERABLE_ERROR or before > TOLERABLE_ERROR or not _heard.get():
        return
    warnings.warn(
        f"the step from t = {trajectory.step_error_t:g} with h = {trajectory.h:g} is too long: the relative error of "
        f"its end is about {error:.1e}; take a shorter h{remedy}",
        AccuracyWarning,
        stacklevel=3,
    )


def warn_of_lost_energy(trajectory: EnergyAtEnds) -> None:
    """An :class:`AccuracyWarning` where steps chose their length and the energy that the motion conserves is another.

    Each step was as accurate as wanted; past a near collision, say, the motion magnifies what is left. The size of an
    energy is that of p.v where it is larger, so that one near zero has a size.
    """
    goal, stepper = trajectory.goal, trajectory.stepper
    if goal is None or goal.tau or not stepper.interface.conserves_energy or not _heard.get():
        return
    ends = trajectory.q[[0, -1]], trajectory.p[[0, -1]], trajectory.t[[0, -1]], trajectory.parameters
    try:
        first, last = energies = stepper.energy(*ends)
        sizes = np.sum(ends[1] * stepper.velocity(*ends), axis=1)
    except StateError:  # beyond the domain of L
        return
    if not abs(last - first) > TOLERABLE_ERROR * np.abs([*energies, *sizes]).max():
        return
    warnings.warn(
        f"the energy went from {first:.3g} to {last:.3g} though each step was as accurate as wanted: the motion "
        "magnifies errors, as near collisions do; take a smaller tolerance, or coordinates in which nothing collides",
        AccuracyWarning,
        stacklevel=3,
    )
