"""Momentum maps of sums over indices: shifts and turns of whole arrays, each proved by one identity of every kernel.

A shift of all entries of ``q`` leaves sum_e l(q at e) alone if the derivatives of l by its slots of ``q`` add up to 0,
whatever stands in the slots; so the cost of the proof does not depend on how many coordinates there are (Noether).
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sympy import Add, Expr, S, Symbol

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.indexed import IndexedTerm
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.formulas.tape import Tape
from scvi_codegen.indices import Access, Array, Place
from scvi_codegen.mechanics.indexed.system import IndexedSystem
from scvi_codegen.tables.precision import mp

__all__ = ["IndexedMap", "momentum_maps"]

SAMPLES = 4
"""Points where an identity is tried in 60 digits; one that fails at random points would have to vanish at each."""
VANISHES = 1e-40
"""Beside the sum of the sizes of the terms."""
MOST_TURNED = 3
"""Components of places in space."""


@dataclass(frozen=True, slots=True)
class IndexedMap:
    """The momentum of a shift along a component of an array (of all of it: ``None``), or that of a turn of two."""

    array: str
    component: int | None
    other: int | None = None

    @property
    def name(self) -> str:
        """In words."""
        if self.component is None:
            return f"momentum of {self.array}"
        if self.other is None:
            return f"momentum of {self.array}[.., {self.component}]"
        return f"angular momentum of {self.array}[.., {self.component}], {self.array}[.., {self.other}]"


def momentum_maps(system: IndexedSystem) -> tuple[IndexedMap, ...]:
    """All of these that a system has."""
    return tuple(found for array in system.coordinates for found in _maps(system, array))


def _maps(system: IndexedSystem, array: Array) -> Iterator[IndexedMap]:
    last = array.axes[-1]
    components: Sequence[int | None] = [None] if last.name else range(last.number)
    for component in components:
        if all(_vanishes(*_shift(system, term, array, component)) for term in system.potentials):
            yield IndexedMap(array.name, component)
    if not last.name and last.number <= MOST_TURNED:
        for a in range(last.number):
            for b in range(a + 1, last.number):
                turned = all(_vanishes(*_turn(system, term, array, (a, b))) for term in system.potentials)
                if turned and _same_masses(system, array, a, b):
                    yield IndexedMap(array.name, a, b)


def _component(access: Access, array: Array, component: int | None) -> bool:
    if access.array != array:
        return False
    return component is None or access.places[-1] == _whole(component)


def _whole(component: int) -> Place:
    place = Place()
    return Place(base=place.base + component)


def _shift(
    system: IndexedSystem, term: IndexedTerm, array: Array, component: int | None
) -> tuple[list[Expr], list[Symbol]]:
    slots = [slot for slot, access in term.slots if _component(access, array, component)]
    return list(gradient(term.formula, slots).values()), _symbols(system, term)


def _turn(
    system: IndexedSystem, term: IndexedTerm, array: Array, plane: tuple[int, int]
) -> tuple[list[Expr], list[Symbol]]:
    """Parts of sum x_a dl/dx_b - x_b dl/dx_a."""
    parts: list[Expr] = []
    known = _symbols(system, term)
    for (a, b), sign in ((plane, S.One), (plane[::-1], S.NegativeOne)):
        moved = [(slot, access) for slot, access in term.slots if _component(access, array, b)]
        slopes = gradient(term.formula, [slot for slot, _ in moved])
        for place, (_, access) in enumerate(moved):
            partner = symbol(str(Access(array=array, places=(*access.places[:-1], _whole(a)))))
            known += [] if partner in known else [partner]
            parts.append(sign * partner * slopes.get(place, S.Zero))
    return parts, known


def _symbols(system: IndexedSystem, term: IndexedTerm) -> list[Symbol]:
    return [*(slot for slot, _ in term.slots), *system.parameters, system.time]


def _vanishes(parts: Sequence[Expr], symbols: Sequence[Symbol]) -> bool:
    """Whether the sum of the parts is 0 wherever it is tried, and is tried somewhere."""
    if Add(*parts) == 0:
        return True
    tape, chosen, tried = Tape(parts, symbols), random.Random(1), 0
    for _ in range(4 * SAMPLES):
        try:
            values = tape([mp.mpf(chosen.randint(1, 10**6)) / 10**6 + mp.mpf(1) / 3 for _ in symbols])
        except ArithmeticError:
            continue
        if abs(mp.fsum(values)) > VANISHES * mp.fsum(map(abs, values)):
            return False
        tried += 1
    return tried >= SAMPLES


def _same_masses(system: IndexedSystem, array: Array, a: int, b: int) -> bool:
    """Whether two components have the same mass everywhere."""
    masses: tuple[dict[object, Expr], ...] = ({}, {})
    for mass in system.masses:
        for found, component in zip(masses, (a, b), strict=True):
            if _component(mass.access, array, component):
                key = (mass.loops, mass.access.places[:-1])
                found[key] = found.get(key, S.Zero) + mass.formula
    return masses[0] == masses[1]
