"""Masses of array systems: velocities occur as m v**2/2 with a constant m that may differ between elements."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, S, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.indices import Access, Array, Loop

__all__ = ["MassTerm", "check_form", "masses_of", "terms_at_rest", "velocity_symbols"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MassTerm:
    """Contribution to a mass, summed over loops: the m of ``m*v**2/2`` at the coordinate ``access``."""

    loops: tuple[Loop, ...]
    access: Access
    formula: Expr
    slots: tuple[tuple[Symbol, Access], ...]


def masses_of(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[MassTerm, ...]:
    """Return the mass contributions of a term, one per velocity."""
    known, masses = dict(term.slots), []
    for v in velocity_symbols(term, velocities):
        mass = term.formula.diff(v, 2)
        slots = tuple(pair for pair in term.slots if pair[0] in mass.free_symbols)
        access = replace(known[v], array=velocities[known[v].array.name])
        masses.append(MassTerm(loops=term.loops, access=access, formula=mass, slots=slots))
    return tuple(masses)


def velocity_symbols(term: ArrayTerm, velocities: Mapping[str, Array]) -> tuple[Symbol, ...]:
    """Return the symbols of a term that denote velocities."""
    return tuple(slot for slot, access in term.slots if access.array.name in velocities)


def check_form(term: ArrayTerm, velocities: Mapping[str, Array], time: Symbol) -> None:
    """Raise :class:`SystemDefinitionError` unless velocities occur as m v**2/2 with a constant m."""
    coordinates = set(velocities.values())
    varies = {slot for slot, access in term.slots if access.array.name in velocities or access.array in coordinates}
    slots = velocity_symbols(term, velocities)
    derivatives = gradient(term.formula, slots)
    for k, v in enumerate(slots):
        derivative = derivatives.get(k, S.Zero)
        mass = derivative.diff(v)
        if mass.free_symbols & (varies | {time}) or sympy.expand(derivative - mass * v) != 0:
            raise SystemDefinitionError(
                f"in '{term}' the derivative with respect to {v} is {derivative}: the Lagrangian of an "
                "array system may contain velocities as m*v**2/2 only, with a constant mass m"
            )


def terms_at_rest(
    terms: Sequence[ArrayTerm],
    velocities: Mapping[str, Array],
    state: Sequence[Array],
    *,
    negative: bool,
    moving: bool,
) -> tuple[ArrayTerm, ...]:
    """Return the non-zero terms at zero velocity that depend on the state, or those that do not.

    Args:
        terms: of a Lagrangian or a Hamiltonian.
        velocities: the array of coordinates by the name of its velocities.
        state: coordinates and momenta.
        negative: whether to change the signs, as for -H.
        moving: whether to return the terms that depend on the state.
    """
    results = []
    for term in terms:
        at_rest = term.formula.xreplace(dict.fromkeys(velocity_symbols(term, velocities), S.Zero))
        slots = tuple(pair for pair in term.slots if pair[0] in at_rest.free_symbols)
        if at_rest and moving == any(access.array in state for _, access in slots):
            results.append(replace(term, formula=-at_rest if negative else at_rest, slots=slots))
    return tuple(results)
