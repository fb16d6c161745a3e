"""Changes of the state at transitions of contacts, as smooth maps of states near those of a run.

A transition into known modes is the impact of a contact that closes and the projection onto the new constraints. With
(G, T) v the rates of the gap and the slip, the impulses p+ - p- = (G - mu d T)^T Lambda + T^T Lambda_t satisfy linear
equations in the modes that they had in the run (``support/run/contacts.h``): G v+ = -e G v- at the contact that closes,
G v+ = 0 at others with an impulse, and T v+ = 0 at slips that stop.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scvi_codegen.codegen.native.options import REASONS
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import projected, roots_of_masses
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.event import Transition

ROUNDING = 1e-9
"""Part of their size below which rates and impulses count as 0."""
FAST = 1e3
"""Speed relative to that of a slip whose direction is kept (contacts.h)."""
SAME_IMPULSE, SAME_MOMENTUM = 1e-6, 1e-13
"""Differences from the run relative to an impulse or a slip, and to momenta, up to which they are the same."""

Change = Callable[[Array, Array, float, Array], Array]
"""Map of q, p, t and parameters."""


class Rows(NamedTuple):
    """Values, rates, second rates without forces of the rows of all contacts, G M^-1 G^T, G, (mu, mu_s, e) of each."""

    value: Array
    rate: Array
    second: Array
    inverse_masses: Array
    gradients: Array
    coefficients: Array

    @classmethod
    def at(cls, stepper: Integrator, state: Array, t: float, parameters: Array) -> "Rows":
        """Evaluate them at a (2m,) state, in the frame of the other constraints."""
        contacts, k, m = stepper.interface.contacts, stepper.interface.masked, stepper.dimension
        idle, imposed = parameters.copy(), parameters.copy()
        for contact in contacts:
            for name in contact.masks:
                place = stepper.interface.parameters.index(name)
                idle[place], imposed[place] = 0.0, float(name in contact.imposing)
        numbers, binding = np.zeros(k * (5 + k + m) + 6 * len(contacts)), stepper.binding
        blocks = map(binding.pointer, (state[:m], state[m:], idle, imposed, numbers))
        if status := binding.function("contact_terms")(t, *blocks, binding.workspace()):
            raise StateError(f"the contacts at t = {t:.17g}, q = {state[:m]} are undefined: {REASONS[status]}")
        value, rate, second, _, _, inverse, gradients, others = np.split(
            numbers, np.cumsum([k, k, k, k, k, k * k, k * m])
        )
        return cls(value, rate, second, inverse.reshape(k, k), gradients.reshape(k, m), others.reshape(2, -1, 3)[0])


class Part(NamedTuple):
    """Rows of a contact with forces. It sticks, or slides in a direction; friction without a gap has no ``normal``."""

    contact: int
    normal: int | None
    slips: list[int]
    rows: list[int]
    direction: Array | None = None

    @classmethod
    def of(cls, k: int, item: ContactRows, direction: Array | None = None) -> "Part":
        """Construct for contact k."""
        slips = [*range(item.tangential or 0, (item.tangential or 0) + item.slips)]
        return cls(k, item.normal, slips, ([] if item.normal is None else [item.normal]) + slips, direction)


class Response:
    """Forces f of rows and the rates w = r + W f after them, linearised at those in known directions of slip d0.

    Imposed rows have w = 0, slips f_t = -mu f_n d, d = w/|w| = d0 + (1 - d0 d0^T)(w - w0)/|w0| + .. .
    """

    def __init__(self, parts: list[Part], of: Rows, right: Array) -> None:
        self.parts, self.rates = parts, right
        self.active = [row for part in parts for row in part.rows]
        self.forces, self.turning = np.zeros(len(right)), np.zeros((len(right), len(right)))
        self.forces, self.rates = self.at(of, right)
        for _, _, slips, _, d in parts:
            if d is not None and (speed := float(np.linalg.norm(self.rates[slips]))):
                self.turning[np.ix_(slips, slips)] = (d @ d * np.eye(len(d)) - np.outer(d, d)) / speed

    def at(self, of: Rows, right: Array) -> tuple[Array, Array]:
        """Return the forces at other rows, and the rates after them, to first order."""
        rates, forces = right + of.inverse_masses @ self.forces, self.forces.copy()
        residual, matrix = rates.copy(), of.inverse_masses.copy()
        for contact, normal, slips, _, direction in self.parts:
            if direction is not None:
                mu, turning = of.coefficients[contact, 0], self.turning[slips]
                size = mu * (1.0 if normal is None else forces[normal])
                residual[slips] = forces[slips] + size * (direction + turning @ (rates - self.rates))
                matrix[slips] = size * turning @ of.inverse_masses
                matrix[slips, slips] += 1.0
                if normal is not None:
                    matrix[slips, normal] += mu * direction
        forces[self.active] -= np.linalg.solve(matrix[np.ix_(self.active, self.active)], residual[self.active])
        return forces, right + of.inverse_masses @ forces


def change_at(
    stepper: Integrator,
    event: Transition,
    before: Array,
    after: Array,
    t: float,
    modes: tuple[Array, Array],
    largest: Array,
) -> Change:
    """Return the state after a transition as a function of that before, in the modes of the run.

    Args:
        stepper, event, t: of the transition.
        before, after: (2m,) states of the run.
        modes: parameters with the modes before and after.
        largest: (m,) largest momenta of the run, whose rounding is no impulse.

    Raises:
        StateError: if the impulses are those of impacts of several contacts.
    """
    q, p = np.split(before, 2)
    start = Rows.at(stepper, before, t, modes[0])
    friction, static, _ = start.coefficients[event.contact]
    if event.kind == "begins" and not static > friction:
        raise StateError(
            f"the direction in which contact {event.contact + 1} begins to slip at t = {t:.17g} has no derivative: it "
            "requires static_friction above friction"
        )
    parts = _impulses(stepper, event, before, after, t, modes[0]) if event.kind == "closes" else []
    normal = stepper.interface.contacts[event.contact].normal
    places = stepper.mode_columns

    def with_restitution(elastic: float) -> Change:
        def rates(of: Rows) -> Array:
            right = of.rate.copy()
            right[normal] *= 1.0 + elastic * of.coefficients[event.contact, 2]
            return right

        impulses = Response(parts, start, rates(start))

        def changed(q: Array, p: Array, t: float, parameters: Array) -> Array:
            old, new = parameters.copy(), parameters.copy()
            old[places], new[places] = modes[0][places], modes[1][places]
            q, p, _ = projected(stepper, q, p, t, old)
            if parts:
                of = Rows.at(stepper, np.concatenate([q, p]), t, old)
                p = p + of.gradients.T @ impulses.at(of, rates(of))[0]
            return np.concatenate(projected(stepper, q, p, t, new)[:2])

        return changed

    closes = event.kind == "closes"
    changes = [with_restitution(elastic) for elastic in ((1.0, 0.0) if closes else (0.0,))]  # 0 where it creates energy
    roots = roots_of_masses(stepper, q, t, modes[0])
    differences = (
        *(change(q, p, t, modes[0])[len(q) :] - after[len(q) :] for change in changes),
        after[len(q) :] - p,
        largest,
    )
    *errors, impulse, momentum = (float(np.abs(difference / roots).max()) for difference in differences)
    if not min(errors) <= SAME_IMPULSE * (impulse if closes else momentum) + SAME_MOMENTUM * momentum:
        raise StateError(
            f"{event.title} at t = {t:.17g} with several impacts, at once or one after another, of reduced "
            "restitution, or without collision: derivatives through them are not available"
        )
    return changes[int(np.argmin(errors))]


def slip_of(stepper: Integrator, k: int) -> Change:
    """Return slip k as a function of the state."""
    slips = Part.of(k, stepper.interface.contacts[k]).slips
    return lambda q, p, t, parameters: Rows.at(stepper, np.concatenate([q, p]), t, parameters).rate[slips]


def kept_direction(stepper: Integrator, k: int, state: Array, t: float, parameters: Array) -> Change:
    """Return the vector, slip k in space or where this begins its rate, whose direction it keeps from a state on.

    Raises:
        StateError: if neither has this direction, that of slip that begins while another contact slides in space.
    """
    contacts, named = stepper.interface.contacts, stepper.parameters_by_name(parameters)
    values = np.array([named[name] for name in contacts[k].directions])
    ahead, speed = values[3:], float(np.sqrt(np.linalg.norm(values[1:3]))) / FAST
    closed = [(j, item) for j, item in enumerate(contacts) if item.closed is None or named[item.closed]]
    slides = [j for j, item in closed if item.slips and not any(named[name] for name in item.sticks)]
    directions = {j: np.array([named[contacts[j].directions[0]]]) for j in slides} | {k: ahead}
    start, slips = Rows.at(stepper, state, t, parameters), Part.of(k, contacts[k]).slips
    if _is_along(start.rate[slips], ahead, speed):
        return slip_of(stepper, k)
    begins = Response([Part.of(j, item, directions.get(j)) for j, item in closed], start, start.second)
    rates, size = begins.rates[slips], float(np.abs(start.second[slips]).max())
    if any(contacts[j].slips == 2 and j != k for j in slides) or not _is_along(rates, ahead, size):
        raise StateError(f"slip {k + 1} begins at t = {t:.17g} while another one turns: derivatives are unavailable")
    return lambda q, p, t, parameters: begins.at(
        of := Rows.at(stepper, np.concatenate([q, p]), t, parameters), of.second
    )[1][slips]


def _is_along(vector: Array, direction: Array, scale: float) -> bool:
    size = float(np.linalg.norm(vector))
    return ROUNDING * scale < size and float(np.abs(vector - size * direction).max()) < SAME_IMPULSE * size


def _impulses(
    stepper: Integrator, event: Transition, before: Array, after: Array, t: float, parameters: Array
) -> list[Part]:
    """Return the contacts with an impulse, in the modes they had in the run."""
    contacts, named = stepper.interface.contacts, stepper.parameters_by_name(parameters)
    first, last = (Rows.at(stepper, state, t, parameters) for state in (before, after))
    q, p = np.split(before, 2)
    sizes = np.sqrt(np.abs(np.diag(first.inverse_masses) * (p @ stepper.velocity(q, p, t, parameters))))
    taking_part = [
        Part.of(k, item) for k, item in enumerate(contacts) if k == event.contact or named.get(str(item.closed))
    ]
    rows = [row for part in taking_part for row in part.rows]
    total, parts = np.zeros(len(first.rate)), []
    total[rows] = np.linalg.lstsq(first.inverse_masses[np.ix_(rows, rows)], (last.rate - first.rate)[rows])[0]
    for part in taking_part:
        rate = last.rate[part.slips]
        speed = float(np.linalg.norm(rate))
        slides = part.slips and speed > ROUNDING * sizes[part.slips].max()
        if total[part.rows[0]] > ROUNDING * total[contacts[event.contact].normal]:
            parts.append(part._replace(direction=rate / speed) if slides else part)
    return parts
