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
from scvi_codegen.systems.event import Transition

ROUNDING = 1e-9
"""Part of their size below which rates and impulses count as 0."""
SAME_IMPULSE, SAME_MOMENTUM = 1e-6, 1e-13
"""Differences from the run relative to an impulse, and to momenta, up to which an impulse is the same."""

Change = Callable[[Array, Array, float, Array], Array]
"""Map of q, p, t and parameters."""


class Impulse(NamedTuple):
    """Impulse of the row of a gap, with the row of the slip and its direction if it slides, or of a slip that stops."""

    contact: int
    row: int
    slides: tuple[int, float] | None = None


class Rows(NamedTuple):
    """Rates of the rows of all contacts, G M^-1 G^T, G, and (mu, mu_s, e) of each contact."""

    rate: Array
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
                idle[place], imposed[place] = 0.0, float(name not in contact.directions)
        numbers, binding = np.zeros(k * (3 + k + m) + 3 * len(contacts)), stepper.binding
        blocks = map(binding.pointer, (state[:m], state[m:], idle, imposed, numbers))
        if status := binding.function("contact_terms")(t, *blocks, binding.workspace()):
            raise StateError(f"the contacts at t = {t:.17g}, q = {state[:m]} are undefined: {REASONS[status]}")
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
    q, p = np.split(before, 2)
    impulses = _impulses(stepper, event, before, after, t, modes[0]) if event.kind == "closes" else []
    places = stepper.mode_columns

    def with_restitution(elastic: float) -> Change:
        def changed(q: Array, p: Array, t: float, parameters: Array) -> Array:
            old, new = parameters.copy(), parameters.copy()
            old[places], new[places] = modes[0][places], modes[1][places]
            q, p, _ = projected(stepper, q, p, t, old)
            if impulses:
                p = p + _momenta(impulses, event.contact, elastic, Rows.at(stepper, np.concatenate([q, p]), t, old))
            return np.concatenate(projected(stepper, q, p, t, new)[:2])

        return changed

    changes = [with_restitution(elastic) for elastic in (1.0, 0.0)]  # 0 where it would create energy
    if event.kind != "closes":
        return changes[0]
    roots = roots_of_masses(stepper, q, t, modes[0])
    differences = (
        *(change(q, p, t, modes[0])[len(q) :] - after[len(q) :] for change in changes),
        after[len(q) :] - p,
        p,
    )
    *errors, impulse, momentum = (float(np.abs(difference / roots).max()) for difference in differences)
    if not min(errors) <= SAME_IMPULSE * impulse + SAME_MOMENTUM * momentum:
        raise StateError(
            f"{event.title} at t = {t:.17g} with several impacts, one after another, or by "
            "Poisson's law: derivatives through them are not available"
        )
    return changes[int(np.argmin(errors))]


def _impulses(
    stepper: Integrator, event: Transition, before: Array, after: Array, t: float, parameters: Array
) -> list[Impulse]:
    """Return the impulses of an impact in the modes they had in the run."""
    contacts, named = stepper.interface.contacts, stepper.parameters_by_name(parameters)
    first, last = (Rows.at(stepper, state, t, parameters) for state in (before, after))
    q, p = np.split(before, 2)
    sizes = np.sqrt(np.abs(np.diag(first.inverse_masses) * (p @ stepper.velocity(q, p, t, parameters))))
    taking_part = [k for k, item in enumerate(contacts) if k == event.contact or (item.closed and named[item.closed])]
    rows = [row for k in taking_part for row in (contacts[k].normal, contacts[k].tangential) if row is not None]
    total = np.zeros(len(first.rate))
    total[rows] = np.linalg.lstsq(first.inverse_masses[np.ix_(rows, rows)], (last.rate - first.rate)[rows])[0]
    impulses: list[Impulse] = []
    for k in taking_part:
        normal, slip = contacts[k].normal, contacts[k].tangential
        if normal is None or not total[normal] > ROUNDING * total[contacts[event.contact].normal]:
            continue
        if slip is None:
            impulses.append(Impulse(k, normal))
        elif abs(last.rate[slip]) <= ROUNDING * sizes[slip]:
            impulses += [Impulse(k, normal), Impulse(k, slip)]
        else:
            impulses.append(Impulse(k, normal, (slip, float(np.sign(last.rate[slip])))))
    return impulses


def _momenta(impulses: list[Impulse], closing: int, elastic: float, of: Rows) -> Array:
    """Return the (m,) change of the momenta; ``elastic`` multiplies the restitution of the contact that closes."""
    columns, active = np.zeros((len(of.rate), len(impulses))), [impulse.row for impulse in impulses]
    right = -of.rate[active]
    for j, (contact, row, slides) in enumerate(impulses):
        columns[row, j] = 1.0
        if slides is not None:
            columns[slides[0], j] = -of.coefficients[contact, 0] * slides[1]
    right[[impulse.contact == closing for impulse in impulses].index(True)] *= (
        1.0 + elastic * of.coefficients[closing, 2]
    )
    return np.asarray(of.gradients.T @ (columns @ np.linalg.solve(of.inverse_masses[active] @ columns, right)))
