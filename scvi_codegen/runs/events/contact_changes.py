"""Changes of the state at transitions of contacts, as smooth maps of states near those of a run.

A transition into known modes is the impact of a contact that closes and the projection onto the new constraints. With
(G, T) v the rates of the gap and the slip, the impulses p+ - p- = (G - mu d T)^T Lambda + T^T Lambda_t satisfy linear
equations in the modes that they had in the run (``support/run/contacts.h``): G v+ = -e G v- at the contact that closes,
G v+ = 0 at others with an impulse, and T v+ = 0 at slips that stop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from scvi_codegen.codegen.native.options import REASONS
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.projection import projected, roots_of_masses
from scvi_codegen.systems.event import Transition

ROUNDING = 1e-9
"""Part of their size below which rates and impulses count as 0."""
SAME_IMPULSE, SAME_MOMENTUM = 1e-6, 1e-13
"""Differences from the run relative to an impulse, and to momenta, up to which an impulse is the same."""

Change = Callable[[Array, Array, float, Array], Array]
"""Map of q, p, t and parameters."""


class Impulse(NamedTuple):
    """Impulse of a row of a contact: normal, or of a slip that stops.

    Attributes:
        contact, row: numbers.
        slides: row of the slip and its direction if the contact slides, else ``None``.
        restitution: whether the row is that of the contact that closes with its restitution.
    """

    contact: int
    row: int
    slides: tuple[int, float] | None = None
    restitution: bool = False


class Rows(NamedTuple):
    """Rates of the rows of all contacts, G M^-1 G^T, G, and (mu, mu_s, e) of each contact."""

    rate: Array
    inverse_masses: Array
    gradients: Array
    coefficients: Array

    @classmethod
    def at(cls, stepper: Integrator, q: Array, p: Array, t: float, parameters: Array) -> Rows:
        """Evaluate them, in the frame of the other constraints."""
        contacts, k, m = stepper.interface.contacts, stepper.interface.masked, stepper.dimension
        idle, imposed = parameters.copy(), parameters.copy()
        for contact in contacts:
            masks = (contact.closed, contact.sticks, contact.direction)
            for name, value in zip(masks, (1.0, 1.0, 0.0), strict=True):
                if name is not None:
                    idle[stepper.parameters.index(name)] = 0.0
                    imposed[stepper.parameters.index(name)] = value
        numbers, binding = np.zeros(k * (3 + k + m) + 3 * len(contacts)), stepper.binding
        blocks = map(binding.pointer, (q, p, idle, imposed, numbers))
        if status := binding.function("contact_terms")(t, *blocks, binding.workspace()):
            raise StateError(f"the contacts at t = {t:.17g}, q = {q} are undefined: {REASONS[status]}")
        _, rate, _, inverse, gradients, others = np.split(numbers, np.cumsum([k, k, k, k * k, k * m]))
        return cls(rate, inverse.reshape(k, k), gradients.reshape(k, m), others.reshape(-1, 3))


def change_at(
    stepper: Integrator, event: Transition, before: Array, after: Array, t: float, modes: tuple[Array, Array]
) -> Change:
    """Return the state after a transition as a function of that before, in the modes of the run.

    Args:
        stepper, event, t: of the transition.
        before, after: (2m,) states of the run.
        modes: parameters with the modes before and after.

    Raises:
        StateError: if the impulses are those of several impacts, one after another.
    """
    m, places = stepper.dimension, [*map(stepper.parameters.index, stepper.modes)]

    def onto(q: Array, p: Array, t: float, values: Array, new: Array) -> tuple[Array, Array]:
        values = values.copy()
        values[places] = new[places]
        return projected(stepper, q, p, t, values)[:2]

    def by(impulses: list[Impulse]) -> Change:
        def changed(q: Array, p: Array, t: float, values: Array) -> Array:
            q, p = onto(q, p, t, values, modes[0])
            if impulses:
                p = p + _sum_of(impulses, Rows.at(stepper, q, p, t, values))
            return np.concatenate(onto(q, p, t, values, modes[1]))

        return changed

    if event.kind != "closes":
        return by([])
    q, p = np.split(before, 2)
    changes = [by([]), *(by(impulses) for impulses in _impulses(stepper, event, before, after, t, modes[0]))]
    roots = roots_of_masses(stepper, q, t, modes[0])
    errors = [float(np.abs((change(q, p, t, modes[0]) - after)[m:] / roots).max()) for change in changes]
    impulse, largest = (float(np.abs(momenta / roots).max()) for momenta in (after[m:] - p, p))
    if not min(errors) <= SAME_IMPULSE * impulse + SAME_MOMENTUM * largest:
        raise StateError(
            f"the contact '{event.function}' closes at t = {t:.17g} with several impacts, one after another: "
            "derivatives through them are not available"
        )
    return changes[int(np.argmin(errors))]


def _impulses(
    stepper: Integrator, event: Transition, before: Array, after: Array, t: float, parameters: Array
) -> list[list[Impulse]]:
    """Return the impulses of an impact by the modes they had in the run, with restitution and without; [] if none."""
    contacts, named = stepper.interface.contacts, dict(zip(stepper.parameters, parameters.tolist(), strict=True))
    (q, p), (q1, p1) = np.split(before, 2), np.split(after, 2)
    first, last = Rows.at(stepper, q, p, t, parameters), Rows.at(stepper, q1, p1, t, parameters)
    sizes = np.sqrt(np.abs(np.diag(first.inverse_masses) * (p @ stepper.velocity(q, p, t, parameters))))
    meets = contacts[event.contact].normal
    taking_part = [k for k, item in enumerate(contacts) if k == event.contact or (item.closed and named[item.closed])]
    rows = [row for k in taking_part for row in contacts[k][:2] if row is not None]
    total = np.zeros(len(first.rate))
    total[rows] = np.linalg.lstsq(first.inverse_masses[np.ix_(rows, rows)], (last.rate - first.rate)[rows])[0]
    elastic: list[Impulse] = []
    for k in taking_part:
        normal, slip = contacts[k].normal, contacts[k].tangential
        if normal is None or not total[normal] > ROUNDING * total[meets]:
            continue
        stops = slip is not None and abs(last.rate[slip]) <= ROUNDING * sizes[slip]
        slides = None if slip is None or stops else (slip, float(np.sign(last.rate[slip])))
        elastic.append(Impulse(k, normal, slides, k == event.contact))
        elastic += [Impulse(k, slip)] if slip is not None and stops else []
    return [elastic, [impulse._replace(restitution=False) for impulse in elastic]]


def _sum_of(impulses: list[Impulse], of: Rows) -> Array:
    """Return the (m,) change of the momenta by impulses of rows."""
    columns, active = np.zeros((len(of.rate), len(impulses))), [impulse.row for impulse in impulses]
    for column, impulse in zip(columns.T, impulses, strict=True):
        column[impulse.row] = 1.0
        if impulse.slides is not None:
            slip, direction = impulse.slides
            column[slip] = -of.coefficients[impulse.contact, 0] * direction
    elasticity = np.array([impulse.restitution * of.coefficients[impulse.contact, 2] for impulse in impulses])
    sizes = np.linalg.solve(of.inverse_masses[active] @ columns, -(1.0 + elasticity) * of.rate[active])
    return np.asarray(of.gradients.T @ (columns @ sizes))
