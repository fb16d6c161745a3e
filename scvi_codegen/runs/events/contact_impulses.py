"""Modes of contacts along a run with the directions of their slips and their impulses at impacts."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.common.errors import EventWarning, StateError, warn
from scvi_codegen.runs.events.contact_changes import ROUNDING, SAME_IMPULSE, SAME_MOMENTUM, Part, Rows
from scvi_codegen.runs.results.recomputation import BeforeChange, before_changes
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.projection import projected, roots_of_masses
from scvi_codegen.systems.contacts.rows import ContactMode
from scvi_codegen.systems.event import Transition

Mode = tuple[float, tuple[str, ...]]


class Directions(NamedTuple):
    """Directions of slips from times on.

    Attributes:
        t: (k,) times of the start and of changes of modes or directions.
        vectors: (k, contacts, slips) unit vectors of the slips after them, in the components of ``slip=``; 0 of
            contacts that are open, stick or have no friction. In space a direction turns with the slip until the next
            time.
    """

    t: Array
    vectors: Array


class Impacts(NamedTuple):
    """Impulses of contacts at impacts, also at those without collision.

    Attributes:
        t: (k,) times, one for each contact with an impulse.
        contact: (k,) numbers of the contacts, from 0.
        impulse: (k, 1 + slips) normal and tangential impulses, in units of momentum if the gap is a distance.
    """

    t: Array
    contact: NDArray[np.int64]
    impulse: Array


class ContactModes(list[Mode]):
    """Times from which contacts have modes, with these modes; further their slips and impacts."""

    def __init__(self, changes: Iterable[Mode], runs: Sequence[Any]) -> None:
        super().__init__(changes)
        self._runs = runs

    @property
    def directions(self) -> Directions:
        """Directions of slips along the run."""
        parts = [_directions(run) for run in self._runs]
        return Directions(*(np.concatenate(of) for of in zip(*parts, strict=True)))

    @property
    def impacts(self) -> Impacts:
        """Impulses of contacts after the start, from the jumps of momenta: p+ - p- = G^T P at the rows G that touch.

        Of contacts that depend on each other P has the least norm, with a warning. Impacts below 1e-9 of the speed of
        the motion are left out.

        Raises:
            StateError: if the run does not contain all states and located transitions, or other changes act with them.
        """
        parts = [_impacts(run) for run in self._runs]
        return Impacts(*(np.concatenate(of) for of in zip(*parts, strict=True)))


def _directions(run: Any) -> Directions:
    contacts = run.stepper.interface.contacts
    starts = [float(run.t[0]), *(() if run.modes is None else run.modes.t.tolist())]
    vectors = np.zeros((len(starts), len(contacts), max(1, *(item.slips for item in contacts))))
    for row, t in enumerate(starts):
        named = run.stepper.parameters_by_name(run.parameters_on_sides(t))
        for k, item in enumerate(contacts):
            if item.slips and item.mode(named) is ContactMode.SLIP:
                values = np.array([named[name] for name in item.directions])
                vector = values if item.slips == 1 else values[3:] if values[3:].any() else values[1:3]
                vectors[row, k, : item.slips] = vector / np.linalg.norm(vector)
    changed = [row for row in range(len(starts)) if not row or np.any(vectors[row] != vectors[row - 1])]
    return Directions(np.array(starts)[changed], vectors[changed])


def _impacts(run: Any) -> Impacts:
    contacts = run.stepper.interface.contacts
    at_impacts = [
        (before.t, k, impulse)
        for row, before in sorted(before_changes(run, run.energy()).items())
        for k, impulse in _impulses_at(run, row, before)
    ]
    impulses = np.zeros((len(at_impacts), max(1 + item.slips for item in contacts)))
    for number, (_, _, impulse) in enumerate(at_impacts):
        impulses[number, : len(impulse)] = impulse
    times, numbers = ([of[place] for of in at_impacts] for place in range(2))
    return Impacts(np.array(times, float), np.array(numbers, np.int64), impulses)


def _impulses_at(run: Any, row: int, before: BeforeChange) -> list[tuple[int, Array]]:
    """Return the contacts with impulses at a saved state after changes, and these impulses."""
    closing, t = {event.contact for event in before.events if isinstance(event, Transition)}, before.t
    if not closing:
        return []
    stepper, after = run.stepper, np.concatenate([run.q[row], run.p[row]])
    old, new = (run.parameters_on_sides(float(run.t[k])) for k in (row - 1, row))
    q, p, _ = projected(stepper, before.q, before.p, t, old)
    start = Rows.at(stepper, np.concatenate([q, p]), t, old)
    extent = np.abs(start.gradients) @ np.abs(np.asarray(run.q)).max(axis=0)
    parts = [
        Part.of(k, item)
        for k, item in enumerate(stepper.interface.contacts)
        if item.normal is not None and (k in closing or abs(start.value[item.normal]) <= ROUNDING * extent[item.normal])
    ]
    rows = [number for part in parts for number in part.rows]
    jump = (Rows.at(stepper, after, t, old).rate - start.rate)[rows]
    inverse = start.inverse_masses[np.ix_(rows, rows)]
    speeds = np.sqrt(np.abs(np.diag(inverse) * (p @ stepper.velocity(q, p, t, old))))
    if not np.any(np.abs(jump) > ROUNDING * speeds):
        return []
    impulses = np.zeros(len(start.rate))
    impulses[rows], _, rank, _ = np.linalg.lstsq(inverse, jump, rcond=ROUNDING)
    error = projected(stepper, q, p + start.gradients.T @ impulses, t, new)[1] - run.p[row]
    roots = roots_of_masses(stepper, q, t, old)
    sizes = (np.abs(of / roots).max() for of in (error, run.p[row] - p, np.abs(np.asarray(run.p)).max(axis=0)))
    missing, change, momentum = sizes
    if missing > SAME_IMPULSE * change + SAME_MOMENTUM * momentum:
        raise StateError(
            f"the impulses of contacts at t = {t:.17g} are unknown: other changes of the state act with them"
        )
    if rank < len(rows):
        warn(f"impulses of contacts at t = {t:.17g} depend on each other: only their resultant is unique", EventWarning)
    acts = np.zeros(len(impulses), bool)
    acts[rows] = np.abs(impulses[rows]) * np.diag(inverse) > ROUNDING * speeds
    return [(part.contact, impulses[part.rows]) for part in parts if acts[part.rows[0]]]
