"""Events: where functions of the state cross zero along a motion, as a user asks for them and as they are found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError
from scvi_codegen.given.counts import checked_count

if TYPE_CHECKING:
    from sympy import Expr

__all__ = ["ACCUMULATED", "Crossings", "Event", "EventLike", "as_events"]

Array = NDArray[np.float64]
DIRECTIONS = (-1, 0, 1)
ACCUMULATED = (
    "the crossings of the terminal event '{function}' accumulate at t = {t:.17g}: the run starts at a zero of it, "
    "leaves and is back within a rounding error, as at the last of infinitely many bounces; end the motion here, or "
    "go on with the state held by a constraint"
)


@dataclass(frozen=True, slots=True)
class Event:
    """Zero crossings of a function g(q, v, p, t; inputs, parameters).

    Attributes:
        function: g, as text of the grammar or as a SymPy expression. It may use the coordinates, their velocities
            (``q_dot``), their momenta (``p_q``, or as the Hamiltonian calls them), time ``t``, inputs and parameters.
        direction: 1 for crossings from negative to positive as the run goes, -1 for the opposite, 0 for both.
        terminal: whether the first crossing ends the run; or the number of the crossing that does. Other events that
            are crossed at the same state, such as two walls met in their corner, are recorded as well: look at all.

    Raises:
        EventError: for another direction.
        StateError: for a number of crossings below 0.
    """

    function: str | Expr
    direction: int = 0
    terminal: bool | int = False

    def __post_init__(self) -> None:
        if not isinstance(self.function, str) and not hasattr(self.function, "free_symbols"):
            raise EventError(f"the function of an event is text or a SymPy expression, not {self.function!r}")
        if self.direction not in DIRECTIONS:
            raise EventError(f"the direction of an event is 1, -1 or 0, not {self.direction!r}")
        checked_count(int(self.terminal) if isinstance(self.terminal, bool) else self.terminal, "terminal", least=0)


EventLike: TypeAlias = "Event | str | Expr"
"""An event, or its function alone."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossings:
    """The crossings of one event, in the order of the run.

    At each of them g has its new sign or is 0, and a rounding earlier its old one: a run that starts from such a state
    does not find the same crossing again.

    Attributes:
        event: what was looked for.
        t: (k,) times.
        q, p: (k, m) states.
    """

    event: Event
    t: Array
    q: Array
    p: Array

    def __len__(self) -> int:
        return len(self.t)

    def chosen(self, which: NDArray[np.bool_]) -> Crossings:
        """Return some of the crossings, by (k,) truth values."""
        return replace(self, t=self.t[which], q=self.q[which], p=self.p[which])


def as_events(events: EventLike | Sequence[EventLike] | None) -> tuple[Event, ...]:
    """The events, whether one is given or several, as :class:`Event` or as functions."""
    if events is None:
        return ()
    several = events if isinstance(events, list | tuple) else (events,)
    return tuple(event if isinstance(event, Event) else Event(event) for event in several)
