"""Legendre transform of arrays of run-time sizes whose kinetic energy couples the velocities of one element only.

    L = sum_e l(q, v_e, t),    l = l_0 + b . v_e + v_e . C v_e/2    has    H = sum_e (p_e - b) . C^-1 (p_e - b)/2 - l_0

where the velocities v_e of the elements e are disjoint, and b and C depend on positions, parameters and t: charges in a
magnetic field, pendulums in spherical angles, masses that depend on the position.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from sympy import Add, Expr, S, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.arrays.system import ArrayHamiltonian, ArraySystem
from scvi_codegen.systems.derived_expressions import coupled_blocks
from scvi_codegen.systems.formulas.array_statements import ArrayForce
from scvi_codegen.systems.formulas.arrays import ArrayTerm, term_of
from scvi_codegen.systems.formulas.expressions import gradient_tuple, hessian
from scvi_codegen.systems.formulas.indices import Access, Array
from scvi_codegen.systems.formulas.symbols import DOT, symbol
from scvi_codegen.systems.legendre.transform import inverse_form


@dataclass(frozen=True, slots=True, kw_only=True)
class SiteHamiltonian:
    """Hamiltonian of a Lagrangian, with the maps between velocities and momenta.

    Attributes:
        system: the Hamiltonian.
        momenta: L_v by entry of the arrays of momenta, in positions and velocities.
        velocities: H_p by entry of the arrays of velocities, in positions and momenta.
    """

    system: ArrayHamiltonian
    momenta: tuple[ArrayForce, ...]
    velocities: tuple[ArrayForce, ...]


def site_hamiltonian(system: ArraySystem) -> SiteHamiltonian | None:
    """Return the Hamiltonian of a Lagrangian with terms of this form; ``None`` of others."""
    moving = {array.name + DOT: Array(f"p_{array.name}", array.axes) for array in system.coordinates}
    moved = any(_moving(force, moving) for force in system.forces)
    if system.momenta or system.rotations or system.constraints or system.damping != 0 or moved:
        return None
    kinetic = [term for term in system.terms if _moving(term, moving)]
    still = [term for term in system.terms if not _moving(term, moving)]
    sites = [_of_site(term, moving) for term in kinetic]
    groups = _sums_by_sites(filter(None, sites))
    of_groups = [_transformed(group, moving) for group in groups]
    accessed = chain.from_iterable(_moving(group, moving).values() for group in groups)
    if None in sites or None in of_groups or not _each_once([*accessed], system.coordinates):
        return None
    energies, momenta, velocities = zip(*filter(None, of_groups), strict=True) if of_groups else ((), (), ())
    hamiltonian = ArrayHamiltonian(
        **{name: getattr(system, name) for name in COMMON},
        momenta=tuple(moving.values()),
        terms=(*energies, *(replace(term, formula=-term.formula) for term in still)),
    )
    return SiteHamiltonian(system=hamiltonian, momenta=tuple(momenta), velocities=tuple(velocities))


COMMON = (
    *("name", "coordinates", "time", "parameters", "defaults", "fields", "field_defaults", "tables"),
    *("neighbours", "forces", "inputs"),
)
"""Fields that a Lagrangian and its Hamiltonian have in common."""


def _moving(term: ArrayTerm | ArrayForce, moving: dict[str, Array]) -> dict[Symbol, Access]:
    """Return the velocities in a term."""
    return {slot: access for slot, access in term.slots if access.array.name in moving}


def _of_site(term: ArrayTerm, moving: dict[str, Array]) -> ArrayTerm | None:
    """Return a term with indices site0, site1, .. along the axes; ``None`` if elements share velocities."""
    places = [(*zip(access.places, access.array.axes, strict=True),) for access in _moving(term, moving).values()]
    indices = {tuple(place.index for place, _ in axes if place.index) for axes in places}
    loops = {loop.index: loop for loop in term.loops}
    if len(indices) != 1 or any(loop.behind or not loop.is_whole for loop in term.loops):
        return None
    (order,) = indices
    along = [(place, axis) for place, axis in chain(*places) if place.index]
    if any(place.table for place, _ in chain(*places)) or sorted(order) != sorted(loops):
        return None
    if any(place.base.number or loops[place.index].end != axis for place, axis in along):
        return None
    names = {"": ""} | {index: f"site{k}" for k, index in enumerate(order)}
    rule, accesses = dict[Symbol, Symbol](), dict[Symbol, Access]()
    for slot, access in term.slots:
        renamed = replace(access, places=tuple(replace(place, index=names[place.index]) for place in access.places))
        rule[slot] = symbol(str(renamed))
        accesses[rule[slot]] = renamed
    sites = tuple(replace(loops[index], index=names[index]) for index in order)
    return term_of(sites, term.formula.xreplace(rule), accesses)


def _sums_by_sites(terms: Iterable[ArrayTerm]) -> list[ArrayTerm]:
    """Return the sum of all terms of the same sites."""
    groups: dict[tuple[object, ...], ArrayTerm] = {}
    for term in terms:
        former = groups.get(term.loops, replace(term, formula=S.Zero))
        groups[term.loops] = term_of(term.loops, former.formula + term.formula, dict((*former.slots, *term.slots)))
    return [*groups.values()]


def _each_once(accesses: Sequence[Access], coordinates: Sequence[Array]) -> bool:
    """Return whether every coordinate has one velocity: of the axes that are numbers every place occurs."""
    for array in coordinates:
        places = [access.places for access in accesses if access.array.name == array.name + DOT]
        numbers = {tuple(str(place) for place in entry_places if not place.index) for entry_places in places}
        if not places or len(numbers) != len(places):
            return False
        fixed = [axis for axis, place in zip(array.axes, places[0], strict=False) if not place.index]
        if any(axis.name for axis in fixed) or len(places) != math.prod(axis.number for axis in fixed):
            return False
    return True


def _transformed(group: ArrayTerm, moving: dict[str, Array]) -> tuple[ArrayTerm, ArrayForce, ArrayForce] | None:
    """Return the term of H, and the gradients of l by velocities and of H by momenta."""
    rates = _moving(group, moving)
    v = [*rates]
    p_accesses = [replace(access, array=moving[access.array.name]) for access in rates.values()]
    p = [symbol(str(access)) for access in p_accesses]
    entries, derivatives = hessian(group.formula, v), gradient_tuple(group.formula, v)
    if any(entry.free_symbols & set(v) for entry in entries.values()):
        return None
    at_rest = dict.fromkeys(v, S.Zero)
    shifted = [momentum - rate.xreplace(at_rest) for momentum, rate in zip(p, derivatives, strict=True)]
    blocks = coupled_blocks(entries, len(v))
    if any(len(block) == 1 and (block[0], block[0]) not in entries for block in blocks):
        return None
    try:
        energy = Add(*(inverse_form(entries, block, shifted) for block in blocks), -group.formula.xreplace(at_rest))
    except SystemDefinitionError:  # too large a block
        return None
    accesses = {**dict(group.slots), **dict(zip(p, p_accesses, strict=True))}
    return (
        term_of(group.loops, energy, accesses),
        _gradient(group, p_accesses, derivatives, accesses),
        _gradient(group, [*rates.values()], gradient_tuple(energy, p), accesses),
    )


def _gradient(
    group: ArrayTerm, targets: Sequence[Access], formulas: Sequence[Expr], accesses: dict[Symbol, Access]
) -> ArrayForce:
    occurring = set().union(*(formula.free_symbols for formula in formulas))
    slots = tuple((slot, access) for slot, access in accesses.items() if slot in occurring)
    return ArrayForce(loops=group.loops, slots=slots, targets=tuple(zip(targets, formulas, strict=True)))
