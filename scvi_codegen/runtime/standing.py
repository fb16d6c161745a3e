"""Short descriptions of runs and results for ``repr``."""

from __future__ import annotations

from typing import Protocol

from scvi_codegen.display.summary import one_line
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.integrator import Integrator

__all__ = ["holds", "lengths_of", "short_title", "stands"]


class Standing(Protocol):
    """Interface required of a run."""

    goal: Goal | None

    @property
    def t(self) -> float: ...
    @property
    def h(self) -> float: ...
    @property
    def steps(self) -> int: ...


class Titled(Protocol):
    """Interface required of the description of an integrator."""

    @property
    def system(self) -> str: ...
    @property
    def method(self) -> str: ...


class StandingStates(Protocol):
    """Interface required of the states of a run."""

    @property
    def stepper(self) -> Integrator: ...
    @property
    def t(self) -> Array: ...
    @property
    def steps(self) -> int: ...


def stands(title: str, solver: str, run: Standing, *, tau: bool = False, awaited: tuple[str, ...] = ()) -> str:
    """Return ``<Run of TITLE; t = 3 after 30 steps of 0.1, solver fixed-point>``.

    Args:
        title: system and method.
        solver: solver of the stage equations, "" if unknown.
        run: the run.
        tau: whether steps are of transformed time.
        awaited: inputs that are not set.
    """
    goal = "" if run.goal is None else f", t_end = {run.goal.t_end:g}"
    solved = f", solver {solver}" if solver else ""
    waits = f", inputs not set: {', '.join(awaited)}" if awaited else ""
    steps = f"{run.steps} steps{lengths_of(run.h, run.goal, tau=tau)}"
    return one_line(run, title, f"t = {run.t:g} after {steps}{goal}{solved}{waits}")


def holds(result: StandingStates, lengths: str) -> str:
    """Return ``<Trajectory of TITLE; 31 states from t = 0 to 3, 30 steps of 0.1>``; ``lengths`` follows "steps"."""
    span = f"{len(result.t)} states from t = {result.t[0]:g} to {result.t[-1]:g}"
    return one_line(result, short_title(result.stepper.interface), f"{span}, {result.steps} steps{lengths}")


def short_title(interface: Titled) -> str:
    """Return the system and the short name of the method."""
    return f"{interface.system}, {interface.method}"


def lengths_of(h: float, goal: Goal | None, *, tau: bool) -> str:
    """Describe the step size of a run."""
    if goal is None:
        return f" of {h:g}{' in tau' * tau}"
    return f" of {goal.tau:g} in tau" if goal.tau else " of adaptive size"
