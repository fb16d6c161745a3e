"""What is said of steps that were solved and are too long for their motion."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, Protocol

from scvi_codegen.errors import AccuracyWarning
from scvi_codegen.runtime.goal import Goal

__all__ = ["TOLERABLE_ERROR", "unwarned", "warn_of_long_steps"]

TOLERABLE_ERROR: Final = 1e-3
"""Of a step, relative to the state: one that is wrong by more is too long for its motion."""

CONTROLLED: Final = ", or steps that choose their length (t_end= with a tolerance)"

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
