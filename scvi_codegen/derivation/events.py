"""Changes of the state by events: maps, impulses of impacts, and their derivatives."""

from collections.abc import Iterable, Iterator
from contextlib import suppress

from scvi_codegen.errors import ExpressionError
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.runtime.events.event import Event

IMPULSE = "p := p + (1 + e)/2 lambda n, H(q, p + lambda n) - H(q, p) + lambda g_t = 0"
SALTATION = """Derivatives by saltation matrices (scvi_codegen.runtime.events.saltation): of z = (q, p) := R(z, t)
    dz := R_z (dz + X- dt) + R_t dt - X+ dt, dt = -g_z dz/(g_z X- + g_t)
    X-, X+: derivatives of the steps before and after the event with respect to their sizes"""


def events_text(events: Iterable[Event], system: MechanicalSystem) -> str:
    """Return the formulas of events in lines; of an impact its impulse, normal n = g_q, g_t and restitution e."""
    return "\n".join(["Events:", *(line for event in events for line in _lines(event, system)), SALTATION])


def _lines(event: Event, system: MechanicalSystem) -> Iterator[str]:
    conditions = event.where if isinstance(event.where, tuple) else (event.where,)
    yield f"  g = {event.function} = 0" + "".join(f", {each}" for each in conditions if each is not None)
    yield from (f"    {name} := {value}" for name, value in event.changes)
    if event.restitution is None:
        return
    yield f"    {IMPULSE}"
    names = [*map(str, system.coordinates)]
    known = {name: symbol(name) for name in (*names, *map(str, system.parameters), TIME)}
    with suppress(ExpressionError):  # entries of arrays, components of rotations
        g = parse_expression(str(event.function), known)
        yield f"    n = ({', '.join(str(g.diff(known[name])) for name in names)}), g_t = {g.diff(known[TIME])}"
    yield f"    e = {event.restitution}"
