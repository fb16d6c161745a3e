"""Places of contacts in a compiled step: read from stored programs, without symbolic libraries."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntFlag, StrEnum, auto
from typing import NamedTuple

from scvi_codegen.systems.contact import Impacts


class ContactMode(StrEnum):
    """Mode of a contact; one without friction that is closed slips."""

    OPEN = auto()
    STICK = auto()
    SLIP = auto()


class Dependence(IntFlag):
    """Rows that other contacts impose, in the mask ``held`` of a contact (contacts.h)."""

    HELD = 1
    LOADED = 2
    STUCK = 4


class ContactRows(NamedTuple):
    """Places of a contact among the masked rows and the parameters of a system; ``None`` for what it does not have.

    Attributes:
        normal, tangential: numbers of its row of the gap and of the first of its slips among the masked constraints.
        slips: number of slips: 1 in a plane, 2 in space, 0 without friction.
        closed, sticks: names of the masks of its mode, of each slip.
        directions: of slip: d in a plane; in space whether it slips, and vectors of two components each (contacts.h).
        held: name of the mask whose bits are its :class:`Dependence`; its gap or slip stays 0 without transitions.
        title: its name or formula, for messages.
        transitions: kinds, functions and conditions of its transitions
            (:class:`~scvi_codegen.systems.event.Transition`).
        impacts: their law.
        quantities: names and formulas of the intermediate quantities in its transitions that no contact before it has,
            each after those in its formula: the velocity of a body is one of that of the body before it.
        varies: whether the friction with which it slides depends on the state or on time.
    """

    normal: int | None
    tangential: int | None
    slips: int
    closed: str | None
    sticks: tuple[str, ...]
    directions: tuple[str, ...]
    held: str
    title: str
    transitions: tuple[tuple[str, ...], ...]
    impacts: str = Impacts.SEQUENTIAL
    quantities: tuple[tuple[str, str], ...] = ()
    varies: bool = False

    def mode(self, parameters: Mapping[str, float]) -> ContactMode:
        """Return its mode by the values of its masks."""
        depends = Dependence(int(parameters[self.held]))
        if self.closed and not (parameters[self.closed] or Dependence.LOADED in depends):
            return ContactMode.OPEN
        slides = not self.slips or any(parameters[name] for name in self.directions)
        return ContactMode.SLIP if slides and Dependence.HELD not in depends else ContactMode.STICK

    @property
    def stepped(self) -> ContactRows:
        """The contact by steps alone: changes of its mode have no functions, and where it exists is the first's."""
        kind, _, *where = min(self.transitions, key=lambda transition: transition[0] != "closes")
        return self._replace(transitions=((kind, "1", *where),), quantities=())

    @property
    def masks(self) -> tuple[str, ...]:
        """Names of the parameters of its mode."""
        return *self.imposing, *self.directions, self.held

    @property
    def imposing(self) -> tuple[str, ...]:
        """Names of the masks of its rows."""
        return *(() if self.closed is None else (self.closed,)), *self.sticks
