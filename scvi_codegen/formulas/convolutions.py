"""Convolutions of arrays within sums, ``sum(j in N, c[j-i]*q[j])``, at each place i."""

from collections.abc import Mapping
from dataclasses import replace

from sympy import Expr, Symbol

from scvi_codegen.indices import Access, Convolution, Loop, Place

NESTED = (
    "a sum within a sum must have whole numbers as bounds, or be a convolution of coordinates and parameters over the "
    "axis of a sum, sum(i in N, .. sum(j in N, c[j-i]*q[j])); write sum(i in N, j in N, ..) for a double sum"
)
"""Error message of other sums within sums."""


def convolution_of(
    term: Expr, loop: Loop, accesses: Mapping[Symbol, Access], bounds: Mapping[str, object]
) -> tuple[Expr, Access] | None:
    """Return the factor and the access of a term of the summand of a convolution; ``None`` if it is not one.

    Args:
        term: the product of a factor, c[j-i] and q[j].
        loop: of j.
        accesses: array entries by symbol.
        bounds: loops of the enclosing sums by index.
    """
    entries = {slot: access for slot, access in accesses.items() if loop.index in access.indices}
    found = sorted(
        (slot for slot in term.free_symbols if slot in entries),
        key=lambda slot: not any(place.minus for place in entries[slot].places),
    )
    if len(found) != 2 or term.diff(*found) * found[0] * found[1] != term:
        return None
    by, of = (entries[slot] for slot in found)
    at = bounds.get(by.places[0].minus)
    axes = [k for k, place in enumerate(of.places) if place.index == loop.index]
    plain = of.places[axes[0]] == Place(index=loop.index) and of.array.axes[axes[0]] == loop.end
    whole = isinstance(at, Loop) and at.is_whole and at.end == loop.end and loop.is_whole
    if not (plain and whole) or len(axes) != 1 or by.array.axes != (loop.end,):
        return None
    places = [*of.places]
    places[axes[0]] = Place(index=by.places[0].minus)
    added = Convolution(axes[0], by.array, loop.index)
    return term.diff(*found), replace(of, places=tuple(places), sums=(*of.sums, added))
