"""Runs with contacts: pieces of constant modes, each ended by the first transition of a contact.

A piece is an ordinary run of the step with the masks of its modes, whose terminal events are the transitions: a gap or
a normal force that vanishes, a slip that stops, a friction force that reaches its limit. After each the impulses of
impacts and the modes are determined (:mod:`.modes`), the state is projected onto the constraints of the new modes, and
the run continues: with fixed steps first to the end of the step, with adaptive ones by a new step.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import Any, TypeAlias

import numpy as np

from scvi_codegen.codegen.native.options import STATUS
from scvi_codegen.common.errors import ContactError, EventWarning, MethodError, StateError, warn
from scvi_codegen.runs.contacts.modes import ROUNDING, ContactTerms, Mode, Modes, chosen_modes, impulses
from scvi_codegen.runs.results.joining import joined
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.systems.contacts.modes import ContactRows
from scvi_codegen.systems.event import Event

Stepper: TypeAlias = Any
Trajectory: TypeAlias = Any
"""Types of modules that import this one."""

FEWEST_HITS, RATIO, REST = 8, 1e-3, 1e-8
"""Number of intervals between impacts that decrease geometrically, their relative spread, and the remaining time
relative to that since the first impact, at which a contact comes to rest."""
WHOLE = 1e-9
"""Part of a step that counts as rounding of its end."""
PENETRATION, STEPS = 1e-9, 1000
"""Negative gap at a start, relative to its size, that is rounding; parts of a run of adaptive steps that measure it."""


@dataclass(frozen=True, eq=False, slots=True)
class ContactsOfStepper:
    """Contacts of a stepper.

    Attributes:
        places: rows and parameters of each contact.
        events: their transitions, in the order of the contacts.
        in_piece: whether runs are pieces, in given modes.
    """

    places: tuple[ContactRows, ...]
    events: tuple[Event, ...]
    in_piece: bool = False

    @property
    def kinds(self) -> list[tuple[int, str]]:
        """Contact and kind of each event."""
        kinds: list[tuple[int, str]] = []
        for k, place in enumerate(self.places):
            kinds += [(k, kind) for kind in ("close", "lift") if place.normal is not None]
            kinds += [(k, kind) for kind in ("stop", "backward", "forward") if place.tangential is not None]
        return kinds

    def masks(self, modes: Modes) -> dict[str, float]:
        """Return the values of the parameters of modes."""
        values: dict[str, float] = {}
        for place, mode in zip(self.places, modes, strict=True):
            named = {place.closed: mode.closed, place.sticks: mode.sticks, place.direction: mode.direction}
            values |= {name: float(value) for name, value in named.items() if name is not None}
        return values

    def modes(self, parameters: dict[str, Any]) -> Modes:
        """Return the modes of the values of their parameters."""
        return tuple(
            Mode(
                place.closed is None or bool(parameters[place.closed]),
                place.sticks is not None and bool(parameters[place.sticks]),
                0 if place.direction is None else int(parameters[place.direction]),
            )
            for place in self.places
        )


def terms_at(
    stepper: Stepper, contacts: ContactsOfStepper, q: Array, p: Array, t: float, named: Any, duration: float
) -> ContactTerms:
    """Return the rows of all contacts at a state; gaps are as large as their terms and their motion in a duration."""
    modes = contacts.places
    idle = stepper._parameters({**named, **contacts.masks((Mode(False),) * len(modes))})
    imposed = stepper._parameters({**named, **contacts.masks((Mode(True, True),) * len(modes))})
    k, m, n = stepper.interface.masked, stepper.dimension, len(modes)
    numbers, binding = np.zeros(k * (3 + k + m) + 3 * n), stepper.binding
    blocks = [binding.pointer(np.ascontiguousarray(x, float)) for x in (q, p, idle, imposed)]
    status = binding.function("contact_terms")(t, *blocks, binding.pointer(numbers), binding.workspace())
    if status:
        raise ContactError(f"the contacts are undefined at t = {t:.17g}, q = {q}: {STATUS[status]}")
    values, rates, second, response, gradients, coefficients = np.split(numbers, np.cumsum([k, k, k, k * k, k * m]))
    G = gradients.reshape(k, m)
    velocity, W = stepper.velocity(q, p, t, idle), response.reshape(k, k)
    bounds = np.sqrt(np.abs(np.diagonal(W) * (p @ velocity)))  # |G v| <= sqrt(G M^-1 G^T) sqrt(v^T M v)
    moving = bounds + np.abs(rates - G @ velocity)
    sizes = np.array([np.abs(G) @ np.abs(q) + moving * duration + np.abs(second) * duration**2, moving])
    return ContactTerms(modes, values, rates, second, W, G, coefficients.reshape(n, 3), sizes)


class ContactRun:
    """Run with contacts, from a state (q, p) at t; ``named`` are its parameters by name."""

    def __init__(self, stepper: Stepper, events: Sequence[Event], q: Array, p: Array, t: float, named: Any) -> None:
        assert stepper._contacts is not None
        if any(event.changes_state for event in events):
            raise StateError("events that change the state are not available with contacts: make them terminal")
        self.contacts, self.own = stepper._contacts, len(events)
        self.stepper: Stepper = stepper.with_events((*events, *self.contacts.events))
        self.stepper._contacts = replace(self.contacts, in_piece=True)
        self.q, self.p, self.t, self.named = q, p, t, dict(named)
        self.modes: Modes = (Mode(False),) * len(self.contacts.places)
        self.duration = 0.0  # of a step, by which gaps are measured
        self.hits: dict[int, list[float]] = {}
        self.pieces: list[Trajectory] = []
        self._warned = False

    def start(self) -> None:
        """Determine the first modes, after impacts of contacts that are closed and approach."""
        terms = self._terms()
        for k, place in enumerate(self.contacts.places):
            row = place.normal
            if row is not None and terms.values[row] < -PENETRATION * terms.sizes[0, row]:
                raise ContactError(
                    f"the run starts with the gap of contact {k + 1} at {terms.values[row]:.6g}, which must not be "
                    "negative: correct the initial positions, or the sign of the gap"
                )
        at = terms.values, ROUNDING * terms.sizes[0]
        touching = [k for k, place in enumerate(self.contacts.places) if _touches(place, *at)]
        self._change(touching, (), {})

    def integrate(self, plan: dict[str, Any], t_end: float, h: float | None) -> Trajectory:
        """Return the run to t_end, with fixed steps h or adaptive steps with the arguments ``plan``."""
        self.duration = abs(t_end - self.t) / STEPS if h is None else abs(h)
        self.start()
        begin, forward = self.t, h is None or h > 0
        while (self.t < t_end) == forward and self.t != t_end:
            steps = {**plan, "t_end": t_end}
            if h is not None:
                done = (self.t - begin) / h
                nearest = begin + round(done) * h
                whole = abs(done - round(done)) <= WHOLE
                end = begin + ceil(done) * h
                if not whole and (end < t_end) == forward:
                    steps = {"h": end - self.t, "steps": 1}
                elif whole or nearest == self.t:
                    steps = {"h": h, "t_end": t_end}
                else:
                    steps = {"h": t_end - self.t, "steps": 1}
            if self._piece(steps):
                break
        if not self.pieces:
            self._piece({**plan, "t_end": t_end} if h is None else {"h": h, "steps": 0})
        whole_run = joined(self.pieces)
        return replace(whole_run, events=whole_run.events[: self.own])

    def _piece(self, steps: dict[str, Any]) -> bool:
        """Run to the next transition and change the modes; return whether an event of the user ended the run."""
        named = {**self.named, **self.contacts.masks(self.modes)}
        if any(mode.closed for mode in self.modes) or self.stepper.interface.masked < len(self.stepper.constraints):
            self.q, self.p = self.stepper.project(self.q, self.p, t=self.t, parameters=named)
        piece = self.stepper.integrate(
            self.q, self.p, t=self.t, parameters=named, check_growth=None if "h" in steps else False, **steps
        )
        self.pieces.append(piece)
        self.q, self.p, self.t = np.array(piece.q[-1]), np.array(piece.p[-1]), float(piece.t[-1])
        if piece.ended_by is not None:
            transitions = piece.events[self.own :]
            kinds = [kind for kind, crossings in zip(self.contacts.kinds, transitions, strict=True) if len(crossings)]
            if not kinds:
                return True
            begun = {k: 1 if kind == "forward" else -1 for k, kind in kinds if kind in ("forward", "backward")}
            closing = [k for k, kind in kinds if kind == "close"]
            self._change(closing, [k for k, kind in kinds if kind == "stop"], begun)
        return False

    def _terms(self) -> ContactTerms:
        return terms_at(self.stepper, self.contacts, self.q, self.p, self.t, self.named, self.duration)

    def _change(self, closing: Collection[int], stopping: Collection[int], begun: dict[int, int]) -> None:
        """Apply impacts of closing contacts, then choose the modes and project the state onto their constraints."""
        terms, places = self._terms(), self.contacts.places
        closed = [k for k, mode in enumerate(self.modes) if mode.closed and places[k].normal is not None]
        touching, resting = {*closed}, {*stopping, *(k for k, mode in enumerate(self.modes) if mode.sticks)} - {*begun}
        approaching = [k for k in closing if terms.rates[places[k].normal or 0] < 0.0]
        if approaching:
            limits = ROUNDING * terms.sizes[0]
            met = {k for k, place in enumerate(places) if _touches(place, terms.values, limits)} - {*closed}
            approaching = sorted({*approaching} | met)
            impulse = self._impulses(terms, approaching, closed)
            self.p = self.p + terms.gradients.T @ impulse
            before, terms = terms, self._terms()
            for k in (*approaching, *closed):
                row, along = places[k].normal, places[k].tangential
                if (
                    row is not None
                    and impulse[row] > 0.0
                    and (before.coefficients[k, 2] == 0.0 or k not in approaching)
                ):
                    touching.add(k)
                if along is not None and abs(terms.rates[along]) <= ROUNDING * before.sizes[1, along]:
                    resting.add(k)
            limits = ROUNDING * before.sizes[1]
            touching = {k for k in touching if terms.rates[places[k].normal or 0] <= limits[places[k].normal or 0]}
            touching |= self._at_rest(approaching)
        self.modes, count = chosen_modes(terms, self.t, touching=touching, resting=resting, begun=begun)
        if count > 1 and not self._warned:
            self._warned = True
            warn(
                f"{count} modes of the contacts are consistent at t = {self.t:.6g}; the run continues in the one that "
                "sticks most",
                EventWarning,
            )

    def _impulses(self, terms: ContactTerms, approaching: Collection[int], closed: Collection[int]) -> Array:
        """Return the impulses of impacts; with restitution 0 where Newton's law would create kinetic energy."""
        impulse = impulses(terms, approaching, closed, self.t)
        gain = impulse @ (terms.rates + terms.response @ impulse / 2)
        if gain > 1e-9 * abs(impulse @ terms.rates) and not any(place.normal is None for place in terms.places):
            warn(
                f"the restitution of an impact at t = {self.t:.6g} would create kinetic energy with friction: it is 0",
                EventWarning,
            )
            plastic = terms.coefficients.copy()
            plastic[:, 2] = 0.0
            impulse = impulses(replace(terms, coefficients=plastic), approaching, closed, self.t)
        return impulse

    def _at_rest(self, approaching: Collection[int]) -> set[int]:
        """Return the contacts whose impacts accumulate: their intervals decrease geometrically and few remain."""
        resting = set[int]()
        for k in approaching:
            times = self.hits.setdefault(k, [])
            times.append(self.t)
            gaps = np.abs(np.diff(times[-FEWEST_HITS - 1 :]))
            if len(gaps) < FEWEST_HITS or not gaps.all():
                continue
            ratios = gaps[1:] / gaps[:-1]
            spread = np.ptp(ratios) <= RATIO * ratios[-1] + 1e3 * np.spacing(abs(self.t)) / gaps[-1]
            remaining = gaps[-1] * ratios[-1] / (1.0 - ratios[-1]) if ratios.max() < 1.0 else np.inf
            if spread and remaining < REST * abs(times[-1] - times[0]):
                resting.add(k)
                times.clear()
        return resting


def _touches(place: ContactRows, values: Array, limits: Array) -> bool:
    return place.normal is not None and abs(values[place.normal]) <= limits[place.normal]


def _of_piece(piece: Trajectory) -> tuple[Any, ContactsOfStepper, dict[str, Any], Modes]:
    """Return the stepper of a piece of constant modes, its contacts, its parameters by name, and the modes."""
    stepper: Stepper = piece.stepper
    if stepper._contacts is None:
        raise MethodError(f"{stepper.title} has no contacts: pass contacts= to compile_stepper")
    named = stepper.parameters_by_name(piece.parameters)
    return stepper, stepper._contacts, named, stepper._contacts.modes(named)


def contact_modes(piece: Trajectory) -> tuple[str, ...]:
    """Return the names of the modes of a piece."""
    return tuple(mode.name for mode in _of_piece(piece)[3])


def contact_forces(piece: Trajectory) -> Array:
    """Return (n, contacts, 2) normal and tangential forces at the states of a piece of constant modes."""
    stepper, contacts, named, modes = _of_piece(piece)
    first = len(stepper.constraints) - stepper.interface.masked
    multipliers, forces = piece.multipliers(), np.zeros((len(piece.t), len(modes), 2))
    states = zip(piece.q, piece.p, piece.t.tolist(), strict=True)
    friction = np.array([terms_at(stepper, contacts, q, p, t, named, 0.0).coefficients[:, 0] for q, p, t in states])
    for k, (place, mode) in enumerate(zip(contacts.places, modes, strict=True)):
        if place.normal is not None:
            forces[:, k, 0] = multipliers[:, first + place.normal]
        if place.tangential is not None:
            size = 1.0 if place.normal is None else forces[:, k, 0]
            slides = -mode.direction * friction[:, k] * size
            forces[:, k, 1] = multipliers[:, first + place.tangential] if mode.sticks else slides
    return forces
