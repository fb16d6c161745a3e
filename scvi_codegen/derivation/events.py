"""Changes of the state by events: maps, and impulses of impacts."""

from collections.abc import Iterable, Iterator, Sequence

from scvi_codegen.formulas.array_entries import is_indexed
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.runtime.events.event import Event

IMPULSE = "p := p + (1 + e)/2 lambda n, H(q, p + lambda n) - H(q, p) + lambda g_t = 0"


def events_text(events: Iterable[Event], coordinates: Sequence[str], parameters: Sequence[str]) -> str:
    """Return the formulas of events in lines; of an impact its impulse, normal n = g_q, g_t and restitution e."""
    return "\n".join(["Events:", *(line for event in events for line in _lines(event, coordinates, parameters))])


def _lines(event: Event, coordinates: Sequence[str], parameters: Sequence[str]) -> Iterator[str]:
    conditions = event.where if isinstance(event.where, tuple) else (event.where,)
    yield f"  g = {event.function} = 0" + "".join(f", {each}" for each in conditions if each is not None)
    yield from (f"    {name} := {value}" for name, value in event.changes)
    if event.restitution is None:
        return
    yield f"    {IMPULSE}"
    function = str(event.function)
    known = {name: symbol(name) for name in (*coordinates, *parameters, TIME)}
    if not is_indexed(function):
        g = parse_expression(function, known)
        yield f"    n = ({', '.join(str(g.diff(known[name])) for name in coordinates)}), g_t = {g.diff(known[TIME])}"
    yield f"    e = {event.restitution}"
