"""Modes of contacts: their forces at a state, the choice of consistent modes, and impacts with friction.

With the rows r of all contacts (normal g, tangential w) their second rates are r'' = b + W f for the forces f of the
rows, W = G M^-1 G^T. In a mode the forces are unknown at normal rows of closed contacts and at tangential rows of
sticking ones, where r'' = 0; sliding adds -mu d times the normal force at the tangential row. A mode is consistent if
normal forces are >= 0, open contacts have g'' >= 0, sticking ones |tau| <= mu_s lambda, and slip that begins w' d > 0.
There is always a consistent mode without friction; with it none (Painleve's paradox) or several may exist. Impacts obey
the same conditions for impulses and velocities (Newton's restitution in the normal direction).

Sources: P. Painleve, C. R. Acad. Sci. 121 (1895); F. Genot, B. Brogliato, Eur. J. Mech. A 18 (1999); C. Glocker,
*Set-Valued Force Laws* (2001).
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from scvi_codegen.common.errors import ContactError
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.systems.contacts.modes import ContactRows

MOST_AT_ONCE = 6
"""Largest number of contacts whose modes are enumerated."""
ROUNDING = 1e-10
"""Size of gaps, rates and forces, relative to the sizes of their terms, that counts as zero."""


class Mode(NamedTuple):
    """Mode of a contact: closed, sticking, or sliding in a direction +-1, which is 0 without friction."""

    closed: bool
    sticks: bool = False
    direction: int = 0

    @property
    def name(self) -> str:
        """``"open"``, ``"stick"`` or ``"slip"``; a closed contact without friction slips."""
        return "open" if not self.closed else "stick" if self.sticks else "slip"


OPEN, STICK, SMOOTH = Mode(closed=False), Mode(closed=True, sticks=True), Mode(closed=True)
FORWARD, BACKWARD = Mode(closed=True, direction=1), Mode(closed=True, direction=-1)
Modes = tuple[Mode, ...]


@dataclass(frozen=True, eq=False, slots=True)
class ContactTerms:
    """Rows of contacts at a state.

    Attributes:
        places: of each contact among the rows.
        values, rates, second: (k,) gaps (0 of slips), rates, and rates of the rates without forces of contacts.
        response: (k, k) matrix W.
        gradients: (k, m) matrix G.
        coefficients: (n, 3) friction, static friction and restitution; limits of friction without a gap.
        sizes: (2, k) sizes of the terms of values and rates.
    """

    places: Sequence[ContactRows]
    values: Array
    rates: Array
    second: Array
    response: Array
    gradients: Array
    coefficients: Array
    sizes: Array

    def slip(self, contact: int) -> float:
        """Return the slip velocity of a contact with friction."""
        row = self.places[contact].tangential
        return 0.0 if row is None else float(self.rates[row])

    def solved(self, modes: Mapping[int, Mode], right: Array) -> tuple[Array, Array]:
        """Return (k,) forces of the rows with r'' = 0 of imposed ones, and (k,) r'' = right + W f.

        Contacts that are absent from ``modes`` have no forces. Raises ``LinAlgError`` for dependent rows.
        """
        rows, columns, size = list[int](), list[Array](), len(right)
        added = np.zeros(size)
        for contact, mode in modes.items():
            normal, tangential = self.places[contact][:2]
            if normal is not None and mode.closed:
                column = np.zeros(size)
                column[normal] = 1.0
                if tangential is not None:
                    column[tangential] = -self.coefficients[contact, 0] * mode.direction
                rows.append(normal)
                columns.append(column)
            if tangential is not None and mode.sticks:
                rows.append(tangential)
                columns.append(np.eye(size)[tangential])
            elif normal is None and tangential is not None:
                added[tangential] = -self.coefficients[contact, 0] * mode.direction
        forces = added
        if rows:
            C = np.array(columns).T
            solved = np.linalg.solve((self.response @ C)[rows], -(right + self.response @ added)[rows])
            forces = added + C @ solved
        return forces, right + self.response @ forces

    def _limit(self, contact: int, forces: Array, column: int) -> float:
        """Return the largest friction force of a contact, by its coefficient of sliding (0) or sticking (1)."""
        normal = self.places[contact].normal
        return float(self.coefficients[contact, column] * (1.0 if normal is None else forces[normal]))


def chosen_modes(
    terms: ContactTerms,
    t: float,
    *,
    touching: Collection[int] = (),
    resting: Collection[int] = (),
    begun: Mapping[int, int] | None = None,
) -> tuple[Modes, int]:
    """Return the consistent modes at a state that stick most, and how many there are.

    Args:
        terms, t: the rows at the state, and its time.
        touching: contacts whose gap and its rate are 0.
        resting: contacts whose slip is 0.
        begun: directions of contacts whose slip begins, which may not stick at once.

    Raises:
        ContactError: if no mode is consistent, or too many contacts are undecided.
    """
    begun = begun or {}
    options = [_options(terms, k, touching, resting, begun) for k in range(len(terms.places))]
    if sum(len(modes) > 1 for modes in options) > MOST_AT_ONCE:
        raise ContactError(
            f"more than {MOST_AT_ONCE} contacts close or change at once at t = {t:.17g}: their modes are chosen by "
            "enumeration; use fewer contacts"
        )
    consistent = [modes for modes in product(*options) if _is_consistent(terms, modes, options, begun)]
    if not consistent:
        raise ContactError(_paradox(terms, options, t))
    return min(consistent, key=lambda modes: sum(2 * (not mode.sticks) - mode.closed for mode in modes)), len(
        consistent
    )


def _options(
    terms: ContactTerms, k: int, touching: Collection[int], resting: Collection[int], begun: Mapping[int, int]
) -> list[Mode]:
    normal, tangential = terms.places[k][:2]
    free: list[Mode] = [] if normal is None else [OPEN]
    if normal is not None and k not in touching:
        far = terms.values[normal] > ROUNDING * terms.sizes[0, normal]
        if far or terms.rates[normal] > ROUNDING * terms.sizes[1, normal]:
            return free
    if tangential is None:
        return [*free, SMOOTH]
    if k in begun:
        return [*free, Mode(True, direction=begun[k])]
    w = terms.slip(k)
    if k in resting or abs(w) <= ROUNDING * terms.sizes[1, tangential]:
        return [*free, STICK, FORWARD, BACKWARD]
    return [*free, FORWARD if w > 0.0 else BACKWARD]


def _is_consistent(
    terms: ContactTerms, modes: Modes, options: Sequence[Sequence[Mode]], begun: Mapping[int, int]
) -> bool:
    try:
        forces, second = terms.solved(dict(enumerate(modes)), terms.second)
    except np.linalg.LinAlgError:
        return False
    small = ROUNDING * max(float(np.abs(terms.second).max()), float(np.abs(second).max()))
    with np.errstate(divide="ignore"):
        least = small / np.diagonal(terms.response)  # of forces
    for k, mode in enumerate(modes):
        normal, tangential = terms.places[k][:2]
        if len(options[k]) == 1 and not mode.closed:
            continue
        if normal is not None and not (forces[normal] > least[normal] if mode.closed else second[normal] >= -small):
            return False
        if not mode.closed or tangential is None:
            continue
        if mode.sticks and abs(forces[tangential]) > terms._limit(k, forces, 1) + least[tangential]:
            return False
        begins = STICK in options[k]
        if not mode.sticks and begins and not mode.direction * second[tangential] > small:
            return False
        if not mode.sticks and k in begun and mode.direction * second[tangential] < -small:
            return False
    return True


def _paradox(terms: ContactTerms, options: Sequence[Sequence[Mode]], t: float) -> str:
    """Return the message where no mode is consistent."""
    for k, modes in enumerate(options):
        normal, tangential = terms.places[k][:2]
        for mode in modes:
            if normal is None or tangential is None or not mode.direction:
                continue
            friction = terms.coefficients[k, 0] * mode.direction
            entry = terms.response[normal, normal] - friction * terms.response[normal, tangential]
            if entry <= 0.0:
                return (
                    f"no mode of the contacts is consistent at t = {t:.17g}: Painleve's paradox, rigid bodies with "
                    f"this friction have no motion. G M^-1 (G - mu d T)^T = {entry:.3g} of contact {k + 1} must be "
                    "positive: reduce its friction, or change the geometry"
                )
    return (
        f"no mode of the contacts is consistent at t = {t:.17g}: the contacts are redundant or contradict each other. "
        "Use independent contacts"
    )


def impulses(terms: ContactTerms, approaching: Collection[int], closed: Collection[int], t: float) -> Array:
    """Return (k,) impulses of the rows of contacts that approach, one after another, until none does.

    Contacts that are closed take part with restitution 0. The impulse law is that of the modes for velocities: rates
    after the impact are -e times those before it in the normal direction, and the impulses are in the friction cone.

    Raises:
        ContactError: if no impulses satisfy the law.
    """
    total, left = np.zeros(len(terms.rates)), set(approaching)
    for _ in range(100 * max(1, len(left))):
        rates = terms.rates + terms.response @ total
        limits = ROUNDING * terms.sizes[1]
        meeting = [k for k in sorted(left) if rates[_normal(terms, k)] < -limits[_normal(terms, k)]]
        if not meeting:
            return total
        added = next(_impulses_of(terms, meeting[0], [k for k in closed if k != meeting[0]], rates), None)
        if added is None:
            raise ContactError(
                f"no impulses satisfy the law of impact with friction at t = {t:.17g}, contact {meeting[0] + 1}: "
                "reduce its friction"
            )
        total = total + added
    raise ContactError(f"the impacts at t = {t:.17g} do not end: contacts close a corner; set a restitution to 0")


def _normal(terms: ContactTerms, k: int) -> int:
    normal = terms.places[k].normal
    assert normal is not None  # of contacts with a gap
    return normal


def _impulses_of(terms: ContactTerms, first: int, others: Sequence[int], rates: Array) -> Iterator[Array]:
    """Yield the impulses of a contact that approaches and of those that are closed, in consistent modes."""
    options = [
        [STICK, FORWARD, BACKWARD] if terms.places[k].tangential is not None else [SMOOTH] for k in (first, *others)
    ]
    # gap-less friction has no impulses
    small = ROUNDING * float(terms.sizes[1].max())
    for modes in product(options[0], *([OPEN, *closed] for closed in options[1:])):
        right = rates.copy()
        right[_normal(terms, first)] *= 1.0 + terms.coefficients[first, 2]
        by_contact = dict(zip((first, *others), modes, strict=True))
        try:
            impulse, after = terms.solved(by_contact, right)
        except np.linalg.LinAlgError:
            continue
        if all(_obeys(terms, k, mode, impulse, after, small) for k, mode in by_contact.items()):
            yield impulse


def _obeys(terms: ContactTerms, k: int, mode: Mode, impulse: Array, after: Array, small: float) -> bool:
    """Return whether the impulse and the rates of a contact obey the law of impact."""
    normal, tangential = _normal(terms, k), terms.places[k].tangential
    if not mode.closed:
        return bool(after[normal] >= -small)
    least = small / max(float(terms.response[normal, normal]), 1e-300)
    if impulse[normal] < -least:
        return False
    if mode.sticks and tangential is not None:
        return bool(abs(impulse[tangential]) <= terms._limit(k, impulse, 0) + least)
    return mode.direction == 0 or tangential is None or bool(mode.direction * after[tangential] >= -small)
