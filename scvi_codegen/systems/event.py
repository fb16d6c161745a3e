"""Events: zero crossings of functions of the state, as specified and as detected; imports no SymPy."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from numbers import Real
from typing import TYPE_CHECKING, Any, Self, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import EventError, MethodWarning, warn
from scvi_codegen.common.representation import clipped, summary
from scvi_codegen.common.validation import checked_count

if TYPE_CHECKING:
    from sympy import Basic, Expr

Array = NDArray[np.float64]
DIRECTIONS = (-1, 0, 1)
COMPARISON = re.compile(r"(>=|<=|>|<)")
LOOPS = re.compile(r"\s+for\b.*", re.DOTALL)
UNDEFINED = "the event function {function} is not finite in the step from t = {t:.17g}"
UNDEFINED_CHANGE = (
    "the {changed} after the event {function} is not finite in the step from t = {t:.17g}: at the state of the event a "
    "formula of then= is undefined, or its restitution is negative; change it, or limit the event by where="
)
ACCUMULATED = (
    "the crossings of the terminal event {function} accumulate at t = {t:.17g}: the run starts at its zero and "
    "returns within a rounding error (Zeno behaviour, as of infinitely many bounces). End the run here, or continue "
    "with a constraint"
)

THROUGH = (
    "the state passes the wall {function} in the step from t = {t:.17g} without an impact: it was at rest there, or "
    "two impacts are closer than rounding. End the run before that time, or let it rest by contacts=[sc.contact(..)]"
)
BEHIND = (
    "the run starts behind the wall {function}, which is {g:.6g} at t = {t:.17g} and must not be negative. Start in "
    "its region, change its sign if the region is the other one, or limit the wall by where="
)

JAMMED = (
    "the changes of the state by {function} do not end in the step from t = {t:.17g}: a point is jammed in a corner "
    "that closes, constraints leave no motion away from it, the new state crosses zero again, or impacts are too many "
    "for a step (a low bounce with a restitution near 1: reduce h, or end the run). Check then= and where="
)


Formula: TypeAlias = "str | Expr | float"
"""Formula as text or a SymPy expression, or a number."""
INSEPARABLE = (
    "the zeros of {function}, a function of time, cannot be separated in the step from t = {t:.17g}: no bound excludes "
    "them, as beside a pole. Change the formula, or limit the steps by max_step= (or h=)"
)
CHATTERS = (
    "1000 changes of the state by {function} before t = {t:.17g} take less than 1e-3 of the mean time between changes: "
    "the motion chatters. Use a smooth formula such as tanh(u/width), sc.friction(..) for dry friction, or end the run"
)
PASSED = (
    "the step from t = {t:.17g} passes a zero that was not found, {function}: the function changes its "
    "sign more often than the search sees. Limit the steps by max_step= (or h=)"
)
SLIDING = (
    "the motion slides on {function} = 0 at t = {t:.17g}: the forces on both sides of this jump point to it (a relay). "
    "It is no dry friction, which sticks there: {lacks}. Write it as sc.friction(slip, limit=F) with F >= 0 at all "
    "states and the reaction on other bodies, or as a smooth force such as tanh(u/width), or end the run there"
)
CORNER = (
    "the motion rests in the corner {function} = 0 at t = {t:.17g}: the forces on both sides point to it and balance "
    "there, as a constraint would. State that as constraints= or sc.contact(..), give a smooth potential such as "
    "sqrt(u**2 + width**2) for abs(u), or start beside the corner"
)


@dataclass(frozen=True, slots=True)
class Event:
    """Zero crossings of a function g(q, v, p, lambda, t; inputs, parameters), which may change the state.

    Attributes:
        function: g, as a formula or a SymPy expression in the coordinates, their velocities (``q_dot``), their momenta
            (``p_q``, or the names of the Hamiltonian), multipliers of constraints (``lambda_1``, in double precision),
            time ``t``, inputs and parameters. For arrays of run-time sizes
            ``"r[i, 0] for i in N"`` is a function for each element; its index may occur in all formulas of the event.
        direction: 1 for crossings from negative to positive in the direction of the run, -1 for the opposite, 0 both.
        terminal: ``True`` if the first crossing ends the run, or the number of the crossing that ends it. Simultaneous
            crossings of other events (two walls in a corner) are recorded as well.
        then: new values of coordinates, of momenta or velocities, and of parameters, by name: ``{"p_y": "-e*p_y"}``,
            ``{"gear": 2}``, formulas of the state at the crossing, from which the run continues.
        where: condition of crossings, ``"x > 1"``, or several of them; other crossings are ignored.
        restitution: of a wall g = 0 (:func:`impact`), its coefficient; instead of ``then``.

    Raises:
        EventError: if the function, the direction, or a change of the state is invalid.
        StateError: if ``terminal`` is negative.
    """

    function: str | Expr
    direction: int = 0
    terminal: bool | int = False
    then: Mapping[str | Expr, Formula] | tuple[tuple[str, Formula], ...] | None = None
    where: str | Basic | tuple[str | Basic, ...] | None = None
    restitution: Formula | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.function, str) and not hasattr(self.function, "free_symbols"):
            raise EventError(f"the function of an event must be text or a SymPy expression, not {self.function!r}")
        if self.direction not in DIRECTIONS:
            raise EventError(f"the direction of an event must be 1, -1 or 0, not {self.direction!r}")
        checked_count(int(self.terminal) if isinstance(self.terminal, bool) else self.terminal, "terminal", least=0)
        if self.restitution is not None and (self.then is not None or self.direction != -1):
            raise EventError(
                f"the wall '{self.function}' must have direction=-1 and no then=: use impact('{self.function}', "
                f"restitution={self.restitution!r})"
            )
        number = 0.0
        with suppress(TypeError, ValueError):  # of formulas with names
            number = float(cast(float, self.restitution))
        if not 0.0 <= number <= 1.0:
            raise EventError(f"the restitution of the wall '{self.function}' is {self.restitution}: give 0 to 1")
        if isinstance(self.then, Mapping):
            object.__setattr__(self, "then", tuple((_name(key), value) for key, value in self.then.items()))
        if self.then is not None and (not isinstance(self.then, tuple) or not self.then):
            raise EventError(
                f"then= of the event '{self.function}' must be new values by name, {{'p_y': '-p_y'}}, not {self.then!r}"
            )
        for name, value in self.changes:
            if not isinstance(value, str | Real) and not hasattr(value, "free_symbols"):
                raise EventError(
                    f"then= of the event '{self.function}' sets '{name}' to {value!r}: give one formula or number for "
                    "each component, by its name"
                )
        if isinstance(self.where, list):
            object.__setattr__(self, "where", tuple(self.where))
        _ = self.conditions

    def check_function(self, moving: Sequence[str], *, constant: bool) -> None:
        """Raise :class:`EventError` for a constant function, and a wall that contains ``moving``, momenta or rates."""
        if constant:
            raise EventError(
                f"the event function '{self.function}' is constant and never crosses zero: use a function of the "
                "state or of time"
            )
        if self.restitution is not None and moving:
            raise EventError(
                f"the wall '{self.function}' of an impact contains '{moving[0]}': a wall is a function of "
                "positions, time and parameters; write the change of the state with then="
            )

    @property
    def title(self) -> str:
        """Name in messages."""
        return f"'{self.function}'"

    @property
    def loops(self) -> str:
        """Loops of an event with a function for each of their elements, ``" for i in N"``; else empty."""
        loops = LOOPS.search(self.function) if isinstance(self.function, str) else None
        return loops[0] if loops else ""

    @property
    def is_text(self) -> bool:
        """Return whether all formulas are text or numbers."""
        return _is_text(tuple(getattr(self, part.name) for part in fields(self)))

    @property
    def changes_state(self) -> bool:
        """Return whether crossings change the state."""
        return self.then is not None or self.restitution is not None

    @property
    def is_wall(self) -> bool:
        """Return whether crossings change the momenta along the gradient of the function."""
        return self.restitution is not None

    @property
    def changes(self) -> tuple[tuple[str, Formula], ...]:
        """Names and new values of the variables that crossings set."""
        return cast("tuple[tuple[str, Formula], ...]", self.then or ())

    @property
    def conditions(self) -> tuple[Formula, ...]:
        """Formulas that are >= 0 where the conditions of ``where`` are satisfied."""
        return conditions_of(self.where)

    @property
    def table(self) -> dict[str, Any]:
        """Table ``[[events]]`` of a model file; ``Event(**table)`` is this event, with formulas as text."""

        def plain(value: Any) -> Any:
            if isinstance(value, tuple):
                return [*map(str, value)]
            return value if isinstance(value, str | int | float) else str(value)

        named = {name: getattr(self, name) for name in ("function", "where", "restitution", "direction", "terminal")}
        unset = {"direction": 0, "terminal": 0}
        table = {name: plain(value) for name, value in named.items() if value != unset.get(name)}
        return table | ({"then": {name: plain(value) for name, value in self.changes}} if self.then else {})


@dataclass(frozen=True, slots=True)
class Kink(Event):
    """Zero of a switching function u, where steps change to the formulas of its other side.

    Attributes:
        mode: parameter that is added to u: 0, or a number beyond all values of u, whose sign then decides.
        power_sides: signs of u with powers of it that are not whole, so that motions there are not smooth at u = 0.
        held: sum of the masks of contacts that keep u at 0, where it has no zeros.
        lacks: the condition of dry friction that a force which jumps at u = 0 violates, if u contains velocities.
    """

    mode: str = field(kw_only=True)
    power_sides: tuple[int, ...] = field(default=(), kw_only=True)
    held: str = field(default="0", kw_only=True)
    lacks: str = field(default="", kw_only=True)

    @property
    def changes_state(self) -> bool:
        """True: the state is the same, but steps end there."""
        return True


BEGINNINGS = ("forward", "backward", "begins")
"""Kinds of transitions at which a slip begins."""


@dataclass(frozen=True, slots=True)
class Refraction(Kink):
    """Zero of a switching function u(q, t) where L jumps: momenta are refracted or reflected, p+ = p- + lambda u_q."""

    @property
    def is_wall(self) -> bool:
        """True."""
        return True


@dataclass(frozen=True, slots=True)
class Transition(Event):
    """End of a mode of a contact, where the run chooses the next modes.

    Attributes:
        contact: number of the contact, from 0.
        gap: its formula, for messages, ``"gap 'y'"`` or ``"slip 'x_dot'"``.
        kind: ``"closes"``, ``"lifts"``, ``"leaves"`` where a condition fails, ``"stops"``, and of slip that begins
            ``"forward"`` or ``"backward"`` in a plane and ``"begins"`` in space.
    """

    contact: int = field(kw_only=True)
    kind: str = field(kw_only=True)
    gap: str = field(kw_only=True)

    @property
    def title(self) -> str:
        """Name in messages."""
        begins = "begins to slip" if self.kind in BEGINNINGS else self.kind
        return f"contact {self.contact + 1} ({self.gap}) {begins}"

    @property
    def changes_state(self) -> bool:
        """True: momenta change at impacts, and constraints with the mode."""
        return True

    def check_function(self, moving: Sequence[str], *, constant: bool) -> None:
        """Accept the function: it is made by contacts, and a number where they act by steps."""


def _is_text(value: Any) -> bool:
    return all(map(_is_text, value)) if isinstance(value, tuple) else isinstance(value, str | int | float | None)


def _name(variable: Any) -> str:
    """Return the name of a variable that an event sets, from text or SymPy."""
    if isinstance(variable, str):
        return variable
    from sympy import Derivative
    from sympy.core.function import AppliedUndef

    if isinstance(variable, Derivative):
        return f"{_name(variable.expr)}_dot"
    return str(variable.name if isinstance(variable, AppliedUndef) else variable)


def conditions_of(where: Any) -> tuple[Formula, ...]:
    """Return the formulas that are >= 0 where a condition, or several of them, are satisfied; none without."""
    if where is None:
        return ()
    return tuple(map(_condition, where if isinstance(where, tuple) else (where,)))


def _condition(condition: Any) -> Formula:
    """Return the formula that is >= 0 where a condition is satisfied, ``"x > 1"`` or a SymPy relation."""
    if isinstance(condition, str):
        parts = COMPARISON.split(condition)
        before = ["".join(parts[:k]) for k in range(len(parts))]  # of operators, in odd places, and of formulas
        outer = [k for k in range(1, len(parts), 2) if before[k].count("(") == before[k].count(")")]
        sides = (before[outer[0]].strip(), "".join(parts[outer[0] + 1 :]).strip()) if len(outer) == 1 else ("", "")
        if all(sides):
            left, right = sides if parts[outer[0]][0] == ">" else sides[::-1]
            return f"({left}) - ({right})"
    elif hasattr(condition, "gts"):
        return cast(Formula, condition.gts - condition.lts)
    raise EventError(f"where= must be a comparison such as 'x > 1', or several of them, not {condition!r}")


def impact(
    function: str | Expr,
    restitution: Formula = 1.0,
    *,
    where: str | Basic | tuple[str | Basic, ...] | None = None,
    terminal: bool | int = False,
) -> Event:
    """Return the event of frictionless impacts on the wall g(q, t) = 0 of the region g > 0.

    The impulse is normal, p += lambda g_q. With ``restitution=1`` it conserves energy, H(p + lambda g_q) - H(p) =
    -lambda g_t; with a coefficient e < 1 it is (1 + e)/2 of that, which is Newton's rule where the kinetic energy is
    quadratic. A point that touches several walls is reflected by each in turn.

    Args:
        function: g, in coordinates, time and parameters; a wall that depends on time moves.
        restitution: coefficient e, a number from 0 to 1 or a formula, whose values must not be negative.
        where, terminal: as of :class:`Event`.
    """
    return Event(function, direction=-1, terminal=terminal, where=where, restitution=restitution)


def modes_of(events: Iterable[Any], parameters: Collection[str], own: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the parameters that runs change: by events, and ``own``, the modes of contacts and kinks."""
    changed = (name for event in events for name, _ in event.changes)
    return *dict.fromkeys(name for name in changed if name in parameters and name not in own), *own


EventLike: TypeAlias = "Event | str | Expr"
"""An event, or its function."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Crossings:
    """Crossings of one event, in the order of the run.

    At each of them g has its new sign or is 0; one rounding error earlier it has the old sign. A run started from such
    a state does not detect the same crossing again. States are those before a change by the event.

    Attributes:
        event: the event.
        t: (k,) times.
        q, p: (k, m) states; NaN, with an :class:`~scvi_codegen.common.errors.EventWarning`, if those of a run exceed 1
            GiB.
        element: (k,) numbers of the elements of its loops, 0 without loops; i for ``"q[i] for i in N"``.
    """

    event: Event
    t: Array
    q: Array
    p: Array
    element: NDArray[np.int64]

    __repr__ = summary("event", "t")

    def __len__(self) -> int:
        return len(self.t)

    def chosen(self, which: NDArray[np.bool_]) -> Self:
        """Return the crossings selected by a (k,) boolean mask."""
        return replace(self, **{name: getattr(self, name)[which] for name in self.columns})

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the arrays with a row for each crossing."""
        return tuple(column.name for column in fields(self) if column.name != "event")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Switches(Crossings):
    """Zeros of the function of a kink where the motion changes to its other side, without touches.

    Attributes:
        side: (k,) 1 where the function becomes positive, -1 where it becomes negative.
    """

    side: NDArray[np.int64]


def as_events(events: EventLike | Sequence[EventLike] | None) -> tuple[Event, ...]:
    """Return a tuple of events from one or several events or functions."""
    if events is None:
        return ()
    several = events if isinstance(events, list | tuple) else (events,)
    return tuple(event if isinstance(event, Event) else Event(event) for event in several)


def warn_of_formulas(of: Any, subject: str) -> None:
    """Warn that steps do not end at kinks of a system or an interface, other than rint and cutoffs of lists."""
    kinks = [u for u in of.kinks if not (u.startswith("cos(pi*") or of.lengths)]
    if kinks:
        u, loop, indices = kinks[0].partition(" for ")
        remedy = "Use short steps (h=, max_step=), or sizes= with at most 256 switching functions"
        if getattr(of, "temperature", None) is not None:
            remedy = "Use short steps (h=) or, with named coordinates, metropolis=True: its averages have no error of h"
        warn(
            f"{subject} does not locate the kinks of this system, such as {clipped(u, 60)} = 0{loop}{indices}: steps "
            f"across them use the formulas as they are and lose order. {remedy}",
            MethodWarning,
        )
