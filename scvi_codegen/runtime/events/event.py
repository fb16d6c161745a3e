"""Events: zero crossings of functions of the state, as specified and as detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import EventError
from scvi_codegen.representation import summary
from scvi_codegen.validation import checked_count

if TYPE_CHECKING:
    from sympy import Expr

Array = NDArray[np.float64]
DIRECTIONS = (-1, 0, 1)
ACCUMULATED = (
    "the crossings of the terminal event '{function}' accumulate at t = {t:.17g}: the run starts at its zero and "
    "returns within a rounding error (Zeno behaviour, as of infinitely many bounces). End the run here, or continue "
    "with a constraint"
)


@dataclass(frozen=True, slots=True)
class Event:
    """Zero crossings of a function g(q, v, p, t; inputs, parameters).

    Attributes:
        function: g, as a formula or a SymPy expression in the coordinates, their velocities (``q_dot``), their momenta
            (``p_q``, or the names of the Hamiltonian), time ``t``, inputs and parameters.
        direction: 1 for crossings from negative to positive in the direction of the run, -1 for the opposite, 0 both.
        terminal: ``True`` if the first crossing ends the run, or the number of the crossing that ends it. Simultaneous
            crossings of other events (two walls in a corner) are recorded as well.

    Raises:
        EventError: if the function or the direction is invalid.
        StateError: if ``terminal`` is negative.
    """

    function: str | Expr
    direction: int = 0
    terminal: bool | int = False

    def __post_init__(self) -> None:
        if not isinstance(self.function, str) and not hasattr(self.function, "free_symbols"):
            raise EventError(f"the function of an event must be text or a SymPy expression, not {self.function!r}")
        if self.direction not in DIRECTIONS:
            raise EventError(f"the direction of an event must be 1, -1 or 0, not {self.direction!r}")
        checked_count(int(self.terminal) if isinstance(self.terminal, bool) else self.terminal, "terminal", least=0)


EventLike: TypeAlias = "Event | str | Expr"
"""An event, or its function."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossings:
    """Crossings of one event, in the order of the run.

    At each of them g has its new sign or is 0; one rounding error earlier it has the old sign. A run started from such
    a state does not detect the same crossing again.

    Attributes:
        event: the event.
        t: (k,) times.
        q, p: (k, m) states.
    """

    event: Event
    t: Array
    q: Array
    p: Array

    __repr__ = summary("event", "t")

    def __len__(self) -> int:
        return len(self.t)

    def chosen(self, which: NDArray[np.bool_]) -> Crossings:
        """Return the crossings selected by a (k,) boolean mask."""
        return replace(self, t=self.t[which], q=self.q[which], p=self.p[which])


def as_events(events: EventLike | Sequence[EventLike] | None) -> tuple[Event, ...]:
    """Return a tuple of events from one or several events or functions."""
    if events is None:
        return ()
    several = events if isinstance(events, list | tuple) else (events,)
    return tuple(event if isinstance(event, Event) else Event(event) for event in several)
