"""Contacts along runs: first modes, reasons why none is possible, and the modes and forces of a trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np

from scvi_codegen.codegen.native.options import REASONS
from scvi_codegen.common.errors import AccuracyWarning, ContactError, EventWarning, MethodError, StateError, warn
from scvi_codegen.runs.events.contact_changes import Rows
from scvi_codegen.runs.results.saved_states import Array, SavedStates
from scvi_codegen.runs.states.validation import Parameters, States
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.systems.contact import MOST_ROWS
from scvi_codegen.systems.contacts.rows import ContactMode

REFUSALS = {
    1: "the run starts at t = {t:.17g} with the gap of contact {k} at {value:.6g}, which must not be negative: "
    "correct the initial positions, the range of the joint, or the sign of the gap",
    3: "no impulses satisfy the law of impact with friction at t = {t:.17g}, contact {k}: reduce its friction",
    4: "friction of contact {k} is {value:.6g} at t = {t:.17g}: friction must not be negative, nor undefined. Correct "
    "the formula or the number, as with max(0, ..)",
    6: "static friction of contact {k} is {value:.6g} at t = {t:.17g}: at rest it must not be less than that of "
    "sliding. Correct one of the formulas or numbers, as with max(..)",
    7: "restitution of contact {k} is {value:.6g} at t = {t:.17g}: it must not be negative, nor exceed 1. Correct the "
    "formula or the number, as with max(0, min(1, ..))",
    2: "neither forces nor impulses of the contacts are consistent at t = {t:.17g}: the contacts contradict each "
    "other, or none were found. Reduce friction, or use fewer contacts",
    5: "contact {k} pulls, or exceeds its friction, at t = {t:.17g} in each mode that was tried: limit the steps by "
    "max_step= (or h=), or reduce its friction",
    8: "steps of all sizes create energy at t = {t:.17g}, at last {value:.3g}: the motion ends there (a collision, a "
    "singularity), or closed contacts nearly depend on each other, as of legs that pass straight. Set t_end before "
    "that time, or give another tolerance, or h (fixed step size)",
    9: f"more than {MOST_ROWS} gaps and slips are near in a step from t = {{t:.17g}}, of contact {{k}} and others: "
    "leave some out, or reduce h",
}
"""Messages by the reasons of contacts.h."""
NOISE = 1e-9
"""Part of the momenta that rounding changes in a step, from which on it may be why adaptive steps fail."""
SOON = 1e-9
"""Time relative to that of a failure of adaptive steps, after which friction is undefined if that is why they fail."""
UNSOLVED = 1e-6
"""Residual of contact problems of steps without a warning, that of the last update of a step (contact_steps.h)."""
PARTS = 0.5 ** np.arange(4, -1, -1)
"""Parts of a step after which friction is evaluated."""
ROUNDED = (
    "rounding of the gaps of closed contacts changes the momenta by {part:.1e} of their size in a step, and by more in "
    "shorter ones, as on nearly straight legs: give fixed steps (h=), or a larger tolerance"
)


def refusal_of(stepper: Integrator, watch: Any, t: float) -> ContactError | None:
    """Return why contacts allow no motion at time t, ``None`` if they do."""
    reason, contact = getattr(watch, "refusal", 0), getattr(watch, "refused", 0)
    if not reason:
        return None
    named = contact and f"{contact} ({stepper.interface.contacts[contact - 1].title})"
    return ContactError(REFUSALS[reason].format(t=t, k=named, value=watch.behind))


def modes_in_failure(stepper: Integrator, watch: Any) -> str:
    """Return a sentence on the closed contacts in which a step failed, empty without any."""
    contacts = stepper.interface.contacts
    named = dict(zip(stepper.modes, list(watch.mode), strict=False)) if contacts and watch.begun else {}
    modes = [(k, contact, contact.mode(named)) for k, contact in enumerate(contacts, 1) if named]
    closed = [f"contact {k} ({of.title}): {mode}" for k, of, mode in modes if mode is not ContactMode.OPEN]
    part = getattr(watch, "rounded", 0.0)
    reason = f". Or {ROUNDED.format(part=part)}" if part > NOISE else ""
    return f"{reason}. Modes of contacts: {', '.join(closed)}" if closed else ""


def undefined_friction(run: Any, watch: Any) -> ContactError | None:
    """Return the error of a closed contact whose friction is undefined in the step that failed, or soon."""
    stepper, values = run.stepper, run.parameters.copy()
    contacts = stepper.interface.contacts
    if not (contacts and watch.begun):
        return None
    values[stepper.mode_columns] = list(watch.mode)[: len(stepper.modes)]
    named, velocity = stepper.parameters_by_name(values), stepper.velocity(run.q, run.p, run.t, values)
    closed = [k for k, contact in enumerate(contacts) if contact.mode(named) is not ContactMode.OPEN]
    for ahead in (run._step_size or SOON * abs(run.t)) * PARTS:
        state, t = np.concatenate([run.q + ahead * velocity, run.p]), run.t + ahead
        try:
            friction = Rows.at(stepper, state, t, values).coefficients[:, :2].sum(axis=1)
        except StateError:  # forces of the system end there, too
            return None
        for k in closed:
            if not np.isfinite(friction[k]):
                title = f"{k + 1} ({contacts[k].title})"
                return ContactError(REFUSALS[4].format(k=title, value=friction[k], t=t))
    return None


def check_forward(run: Any) -> None:
    """Raise :class:`ContactError` for a run backward in time with contacts: what slid before it stuck is unknown."""
    backward = run.h < 0.0 if run.h is not None else run.plan.t_end < run.t
    if run.stepper.interface.contacts and backward:
        raise ContactError("runs with contacts go forward in time: give h > 0, or a final time after the start")


def warn_of_choices(stepper: Integrator, watch: Any) -> None:
    """Warn of several motions, impacts without collision, a replaced restitution, a missed tolerance, a residual."""
    if stepper.by_steps and watch.steps.residual > UNSOLVED:
        warn(
            f"contact problems of steps were solved up to {watch.steps.residual:.1g} of their forces, with a "
            f"compliance of up to {watch.steps.compliance:.1g} (run.contact_residual, run.compliance): reduce h, or "
            "locate transitions",
            AccuracyWarning,
        )
    if getattr(watch, "ambiguous", 0):
        warn(
            "a transition has several motions, with contacts open, sticking or sliding, as in Painleve's paradox; the "
            "run has one of them: reduce friction, or change the geometry",
            EventWarning,
        )
    if contact := getattr(watch, "jumps", 0):
        warn(
            f"impact without collision at t = {watch.jumped:.17g}, contact {contact} "
            f"({stepper.interface.contacts[contact - 1].title}): no forces are consistent with its friction "
            "(Painleve's paradox), and impulses, the limit of stiff contact, change the slip",
            EventWarning,
        )
    if getattr(watch, "restitutes_less", 0):
        warn(
            "the restitution of an impact would have created kinetic energy with friction: it was reduced, so that "
            "none is created",
            EventWarning,
        )
    if getattr(watch, "corner_ends", 0):
        warn("impacts in a corner do not end: the last ones were without restitution", EventWarning)
    if missed := getattr(watch, "missed", 0.0):
        warn(
            f"some adaptive steps have a tolerance of up to {missed:.2g}: {ROUNDED.format(part=watch.rounded)}",
            AccuracyWarning,
        )


def in_first_modes(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters, duration: float
) -> tuple[Array, Array]:
    """Return a state after the impacts of contacts that are closed, on the constraints of their first modes.

    Args:
        stepper, q, p, t, parameters: of the start.
        duration: time of the run, relative to whose rounding contacts are at rest.

    Raises:
        ContactError: if a gap is negative, or no mode is consistent.
    """
    binding = stepper.binding
    q1, p1 = (np.array(part, float) for part in stepper._states.pair(q, p))
    values = stepper._parameters(parameters)
    watch, numbers = binding.new("watch *"), [binding.pointer(part) for part in (q1, p1, values)]
    watch.pace = abs(duration)
    status = binding.function("begin_contacts")(watch, t, *numbers, binding.workspace())
    if status:
        reason = f"the contacts are undefined at t = {t:.17g}, q = {q!r}: {REASONS[status]}"
        raise refusal_of(stepper, watch, t) or ContactError(reason)
    warn_of_choices(stepper, watch)
    return q1, p1


def contact_modes(states: Any) -> list[tuple[float, tuple[str, ...]]]:
    """Return the times from which contacts have modes, and these."""
    stepper: Any = _with_contacts(states)
    starts = [float(states.t[0]), *states.modes.t.tolist()] if states.modes is not None else [float(states.t[0])]
    result: list[tuple[float, tuple[str, ...]]] = []
    for t in starts:
        named = stepper.parameters_by_name(states.parameters_on_sides(t))
        names = tuple(contact.mode(named).value for contact in stepper.interface.contacts)
        if not result or result[-1][1] != names:
            result.append((t, names))
    return result


def contact_forces(states: Any) -> Array:
    """Return (n, contacts, 1 + slips) normal and tangential forces, at a transition those after it.

    Of contacts that depend on each other, as of the legs of a table, only the resultant is unique: these are the
    centre of the forces within the limits of friction, for small loads of least norm, with a warning.
    """
    stepper: Any = _with_contacts(states)
    contacts, binding, total = stepper.interface.contacts, stepper.binding, np.zeros(stepper.interface.masked)
    forces = np.zeros((len(states), len(contacts), 1 + max(1, *(contact.slips for contact in contacts))))
    unique = True
    for row, (q, p, t) in enumerate(zip(states.q, states.p, states.t.tolist(), strict=True)):
        parameters = states.parameters_on_sides(t)
        named = stepper.parameters_by_name(parameters)
        blocks = [np.ascontiguousarray(part, float) for part in (q, p, parameters)]
        binding.function("contact_forces")(t, *map(binding.pointer, (*blocks, total)), binding.workspace())
        unique &= not any(named[contact.held] for contact in contacts)
        for j, contact in enumerate(contacts):
            if contact.normal is not None:
                forces[row, j, 0] = total[contact.normal]
            if contact.tangential is not None:
                forces[row, j, 1 : 1 + contact.slips] = total[contact.tangential : contact.tangential + contact.slips]
    if not unique:
        warn("the contacts depend on each other: their forces are not unique, only their resultant is", EventWarning)
    return forces


def _with_contacts(states: SavedStates) -> Integrator:
    if not states.stepper.interface.contacts:
        raise MethodError(f"{states.stepper.title} has no contacts: pass contacts= to compile_stepper")
    return states.stepper
