"""Momentum maps of array systems: translations and rotations of whole arrays, proved by one identity per kernel.

sum_e l(q at e) is invariant under a translation of all entries of ``q`` if the derivatives of l with respect to its
entries of ``q`` add up to 0 identically (Noether); so the cost of the proof does not depend on the number of
coordinates.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, TypeAlias

from sympy import Expr, S

from scvi_codegen.systems.arrays.system import ArraySystem, force_of
from scvi_codegen.systems.formulas.array_statements import ArrayForce
from scvi_codegen.systems.formulas.expressions import sums_to_zero
from scvi_codegen.systems.formulas.indices import Access, Array, ArrayMap, Place, Size
from scvi_codegen.systems.formulas.symbols import DOT, symbol

MAX_ROTATED_COMPONENTS = 3
"""Largest number of components for which rotations are tested (points in space)."""


def momentum_maps(system: ArraySystem) -> tuple[ArrayMap, ...]:
    """Return all momentum maps of these kinds that a system has."""
    moving = {array.name + DOT for array in system.coordinates}
    if any(access.array.name in moving for term in system.constraints for _, access in term.slots):
        return ()  # nonholonomic
    if system.bath or (system.coupled_terms and system.damping != 0):
        return ()
    return tuple(momentum_map for array in system.coordinates for momentum_map in _maps(system, array))


def _forces(system: ArraySystem) -> Iterator[ArrayForce]:
    """Yield what one element of each sum adds to the rates of momenta (-H_p: to those of positions)."""
    yield from system.all_forces
    yield from (force_of(term, system.coordinates) for term in system.constraints)  # G^T lambda, for any lambda
    moving = (*system.coordinates, *(_velocity(array) for array in system.coordinates))
    yield from (force_of(term, moving) for term in system.coupled_terms)


def _maps(system: ArraySystem, array: Array) -> Iterator[ArrayMap]:
    last, forces = array.axes[-1] if array.axes else Size("", 0), list(_forces(system))
    components: Sequence[int | None] = range(last.number) if array.axes and not last.name else [None]

    def vanishes(work: Callable[..., list[Expr]], **direction: Any) -> bool:
        return all(sums_to_zero(work(force=force, array=array, **direction)) for force in forces)

    yield from (ArrayMap(array.name, component) for component in components if vanishes(_shift, component=component))
    if system.momenta and vanishes(_phase, system=system):
        yield ArrayMap(array.name, None, phase=True)
    if not last.name and last.number <= MAX_ROTATED_COMPONENTS:
        for plane in combinations(range(last.number), 2):
            if vanishes(_turn, system=system, plane=plane) and _same_masses(system, array, *plane):
                yield ArrayMap(array.name, *plane)


def _component(access: Access, array: Array, component: int | None) -> bool:
    if access.array != array:
        return False
    return component is None or access.places[-1] == Place(base=Size("", component))


def _shift(force: ArrayForce, array: Array, component: int | None) -> list[Expr]:
    moved = [pair for pair in force.targets if _component(pair[0], array, component)]
    by = {slot: symbol(f"{slot} shift") for slot, _ in moved if slot.sums}  # the sums of any coefficients
    return [derivative * by.get(slot, S.One) for slot, derivative in moved]


def _turn(system: ArraySystem, force: ArrayForce, array: Array, plane: tuple[int, int]) -> list[Expr]:
    """Return the terms of sum x_a dl/dx_b - x_b dl/dx_a, for the array and its momenta."""
    (a, b), arrays = plane, [array, *_conjugate(system, array)]
    at_a, at_b = Place(base=Size("", a)), Place(base=Size("", b))
    pairs = [((x, to), (x, by), sign) for x in arrays for to, by, sign in ((at_b, at_a, 1), (at_a, at_b, -1))]
    return _rotated_terms(force, pairs)


def _phase(system: ArraySystem, force: ArrayForce, array: Array) -> list[Expr]:
    """Return the terms of sum p dl/dq - q dl/dp."""
    (momenta,) = _conjugate(system, array)
    return _rotated_terms(force, [((array, None), (momenta, None), 1), ((momenta, None), (array, None), -1)])


def _conjugate(system: ArraySystem, array: Array) -> tuple[Array, ...]:
    return (system.momenta[system.coordinates.index(array)],) if system.momenta else (_velocity(array),)


def _velocity(array: Array) -> Array:
    return Array(array.name + DOT, array.axes)


Entry: TypeAlias = tuple[Array, Place | None]
"""Array with a last index, or without one for all of its entries."""


def _rotated_terms(force: ArrayForce, pairs: Sequence[tuple[Entry, Entry, int]]) -> list[Expr]:
    """Return the terms of the derivative along the motion of entries of the first kind by those of the second."""
    parts: list[Expr] = []
    for (array, last), (other, by), sign in pairs:
        for access, derivative in force.targets:
            if access.array != array or (last is not None and access.places[-1] != last):
                continue
            indices = access.places if by is None else (*access.places[:-1], by)
            parts.append(sign * symbol(str(replace(access, array=other, places=indices))) * derivative)
    return parts


def _same_masses(system: ArraySystem, array: Array, a: int, b: int) -> bool:
    """Return whether two components have equal masses in all elements."""
    masses: tuple[dict[object, Expr], ...] = ({}, {})
    for mass in system.masses:
        for by_term, component in zip(masses, (a, b), strict=True):
            ((access, formula),) = mass.targets
            if _component(access, array, component):
                key = (mass.loops, access.places[:-1])
                by_term[key] = by_term.get(key, S.Zero) + formula
    return masses[0] == masses[1]
