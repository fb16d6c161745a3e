"""Constraints of sums over indices: g(entries of arrays at e, parameters, t) = 0 at every element e of loops.

    m q'' = F + G^T lambda,        g(q, t) = 0,        G = g_q,        hidden in it G v + g_t = 0

with a multiplier lambda for every element. Rods between the places ``bonds[b, 0]`` and ``bonds[b, 1]`` of a net are
``sum(k in 3, (r[bonds[b, 0], k] - r[bonds[b, 1], k])**2) = l[b]**2 for b in B``. Each is of few entries, so that
G M^-1 G^T is a sparse matrix, whose pattern is that of the net: known when a run begins.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sympy import Add, Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.canonical import unsupported_part
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.indexed import IndexedTerm
from scvi_codegen.indices import Access

if TYPE_CHECKING:
    from scvi_codegen.mechanics.indexed.system import IndexedSystem

__all__ = ["bend_of", "check_constraints", "constraint_text", "held_slots", "slopes_of"]


def constraint_text(term: IndexedTerm) -> str:
    """As it is written."""
    return f"{term.formula} = 0" + (f" for {', '.join(map(str, _named(term)))}" if term.loops else "")


def _named(term: IndexedTerm) -> Iterator[object]:
    behind = {loop.behind for loop in term.loops}
    return (loop for loop in term.loops if loop.index not in behind)


def check_constraints(system: IndexedSystem) -> None:
    """Raise :class:`SystemDefinitionError` for constraints of a Hamiltonian, of nothing, of velocities, of inputs."""
    if system.constraints and system.momenta:
        raise SystemDefinitionError("constraints stand beside a lagrangian, whose masses they are held by")
    for term in system.constraints:
        shown = constraint_text(term)
        if problem := unsupported_part(term.formula):
            raise SystemDefinitionError(f"in the constraint '{shown}' of '{system.name}': {problem}")
        arrays = {access.array for _, access in term.slots}
        if moving := arrays - {*system.state, *system.fields}:
            name = min(array.name for array in moving)
            raise SystemDefinitionError(
                f"the constraint '{shown}' names the velocity {name}: those of sums over indices are of positions"
            )
        if not held_slots(system, term):
            raise SystemDefinitionError(f"there is no coordinate in the constraint '{shown}'")
        driven = {each for each in term.formula.free_symbols if each.name.rsplit("_", 1)[0] in system.inputs}
        if driven:
            raise SystemDefinitionError(
                f"the constraint '{shown}' depends on an input, which may jump: make it a parameter or a formula in t"
            )


def held_slots(system: IndexedSystem, term: IndexedTerm) -> tuple[tuple[Symbol, Access], ...]:
    """The coordinates in a constraint."""
    return tuple(pair for pair in term.slots if pair[1].array in system.coordinates)


def slopes_of(system: IndexedSystem, term: IndexedTerm) -> tuple[Expr, ...]:
    """G of one element, by its coordinates, and g_t behind."""
    variables = [*(slot for slot, _ in held_slots(system, term)), system.time]
    slopes = gradient(term.formula, variables)
    return tuple(slopes.get(k, Add()) for k in range(len(variables)))


def bend_of(system: IndexedSystem, term: IndexedTerm, velocities: tuple[Symbol, ...]) -> Expr:
    """d^2 g / dt^2 along a straight motion with these velocities, one a coordinate: v^T g_qq v + 2 g_qt v + g_tt."""
    variables = [*(slot for slot, _ in held_slots(system, term)), system.time]
    rates = [*velocities, Add(1)]
    slopes = gradient(term.formula, variables)
    rate = Add(*(slope * rates[k] for k, slope in slopes.items()))
    return Add(*(slope * rates[k] for k, slope in gradient(rate, variables).items()))
