"""Unrolling of indexed systems: for known sizes, the equivalent system of named coordinates.

The unrolled system supports what indexed systems do not (Newton's iteration, verification reports, the derivation
page, ensembles, derivatives), and its integrator is derived independently, so the two can be compared.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sympy import Add, Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.indexed import IndexedTerm
from scvi_codegen.formulas.indexed_forces import IndexedForce
from scvi_codegen.formulas.symbols import DOT, number, symbol
from scvi_codegen.indices import Access, Array, Loop, Place
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.indexed.system import INDEXED, IndexedSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.validation.argument_types import MAPPING, checks_arguments

__all__ = ["unroll_sums"]

Elements = Mapping[str, int]
Tables = Mapping[str, NDArray[np.int64]]


@checks_arguments(SystemDefinitionError, system=INDEXED, sizes=MAPPING, tables=MAPPING, parameters=MAPPING)
def unroll_sums(
    system: IndexedSystem,
    sizes: Mapping[str, int],
    *,
    tables: Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> MechanicalSystem:
    """Return the system of the coordinates q_0, q_1, .. (r_0_0, r_0_1, ..), the last axis of an array running fastest.

    Args:
        system: the indexed system to unroll.
        sizes: value of every size.
        tables: index tables of shape (rows, columns) by name.
        parameters: numbers and arrays by name, others keep their defaults; entries of arrays become parameters k_0, ..

    Raises:
        SystemDefinitionError: for unknown names, wrong shapes, and an index outside its array.

    >>> chain = IndexedSystem.from_text(
    ...     name="chain", coordinates=["q[N]"],
    ...     lagrangian="sum(i in N, q_dot[i]**2/2) - sum(i in 0..N-2, (q[i+1] - q[i])**2/2)")
    >>> unroll_sums(chain, {"N": 2}).formula
    q_0_dot**2/2 + q_1_dot**2/2 - (-q_0 + q_1)**2/2
    """
    given, places = dict(parameters or {}), {name: _columns(table) for name, table in (tables or {}).items()}
    for known, named, what in (
        (system.sizes, sizes, "size"),
        ([table.name for table in system.tables], places, "table"),
    ):
        if set(known) != set(named):
            raise SystemDefinitionError(
                f"the {what}s of '{system.name}' are {', '.join(known) or 'none'}: give exactly these"
            )
    fields = {
        array.name: _filled(array, given.pop(array.name, default), sizes)
        for array, default in zip(system.fields, system.field_defaults, strict=True)
    }
    names = {array.name: _names(array, sizes) for array in (*system.state, *system.fields)}
    values = {
        str(name): float(value)
        for array in system.fields
        for name, value in zip(names[array.name].flat, fields[array.name].flat, strict=True)
    }
    numbers = {each.name: value for each, value in zip(system.parameters, system.defaults, strict=True)}
    for name, value in given.items():
        if name not in numbers:
            raise SystemDefinitionError(f"'{system.name}' has no parameter '{name}'{closest(name, numbers)}")
        numbers[name] = number(name, value)
    written = _Elements(sizes, places, names)
    summands = [term.formula.xreplace(rule) for term in system.terms for _, rule in written.rules(term)]
    acting = written.forces(system.forces)
    coordinates, momenta = (
        tuple(symbol(str(name)) for array in arrays for name in names[array.name].flat)
        for arrays in (system.coordinates, system.momenta)
    )
    same: dict[str, Any] = {
        "name": system.name,
        "coordinates": coordinates,
        "time": system.time,
        "parameters": tuple(map(symbol, [*numbers, *values])),
        "defaults": (*numbers.values(), *values.values()),
        "forces": tuple(Add(*acting.get(q, ())) for q in coordinates) if acting else (),
        "inputs": system.inputs,
    }
    if momenta:
        return HamiltonianSystem(**same, momenta=momenta, hamiltonian=Add(*summands))
    held = tuple(term.formula.xreplace(rule) for term in system.constraints for _, rule in written.rules(term))
    return LagrangianSystem(**same, lagrangian=Add(*summands), constraints=held)


def _columns(table: ArrayLike) -> NDArray[np.int64]:
    """Return an index table as a two-dimensional array; one axis becomes one column."""
    found = np.asarray(table)
    return found[:, None] if found.ndim == 1 else found


def _names(array: Array, sizes: Mapping[str, int]) -> NDArray[np.str_]:
    shape = array.shape(sizes)
    flat = ["_".join([array.name, *map(str, place)]) for place in np.ndindex(*shape)]
    return np.array(flat, dtype=np.str_).reshape(shape)


def _filled(array: Array, value: ArrayLike, sizes: Mapping[str, int]) -> NDArray[np.float64]:
    if np.shape(value) not in ((), array.shape(sizes)):
        raise SystemDefinitionError(f"'{array.name}' has the shape {np.shape(value)}, which does not match {array}")
    return np.broadcast_to(np.asarray(value, dtype=np.float64), array.shape(sizes))


def _elements(loops: Sequence[Loop], sizes: Mapping[str, int]) -> Iterator[Elements]:
    """Yield the values of all indices."""
    if not loops:
        yield {}
        return
    last = loops[-1]
    for outer in _elements(loops[:-1], sizes):
        first = outer[last.behind] + 1 if last.behind else last.first.at(sizes)
        for k in range(first, last.end.at(sizes)):
            yield {**outer, last.index: k}


@dataclass(frozen=True, slots=True)
class _Elements:
    """Substitution of array accesses by symbols, at given values of the indices.

    Attributes:
        sizes, tables: value of every size; index tables.
        names: names of the entries of each array.
    """

    sizes: Mapping[str, int]
    tables: Tables
    names: Mapping[str, NDArray[np.str_]]

    def rules(self, of: IndexedTerm | IndexedForce) -> Iterator[tuple[Elements, dict[Symbol, Symbol]]]:
        """Yield the values of the indices with the symbol that replaces each access."""
        for at in _elements(of.loops, self.sizes):
            yield at, {slot: self.entry(access, at, of.loops) for slot, access in of.slots}

    def forces(self, forces: Sequence[IndexedForce]) -> dict[Symbol, list[Expr]]:
        """Return the contributions to the force on each coordinate."""
        found: dict[Symbol, list[Expr]] = {}
        for force in forces:
            for at, rule in self.rules(force):
                for access, formula in force.targets:
                    found.setdefault(self.entry(access, at, force.loops), []).append(formula.xreplace(rule))
        return found

    def entry(self, access: Access, at: Elements, loops: Sequence[Loop]) -> Symbol:
        """Return the symbol of an array entry."""
        periods = {loop.index: loop.end.at(self.sizes) for loop in loops if loop.periodic}
        try:
            places = tuple(_place(place, at, periods, self.sizes, self.tables) for place in access.places)
        except IndexError as error:
            raise SystemDefinitionError(f"{access} at {dict(at)}: {error}") from error
        if any(not 0 <= place < length for place, length in zip(places, access.array.shape(self.sizes), strict=True)):
            raise SystemDefinitionError(
                f"{access} has the index {list(places)}, which is outside of {access.array}, at {dict(at)}"
            )
        name = access.array.name
        if name in self.names:
            return symbol(str(self.names[name][places]))
        return symbol(str(self.names[name.removesuffix(DOT)][places]) + DOT)


def _place(place: Place, at: Elements, periods: Mapping[str, int], sizes: Mapping[str, int], tables: Tables) -> int:
    if place.table:
        return int(tables[place.table][at[place.index], place.column])
    if not place.index:
        return place.base.at(sizes)
    k = at[place.index] + place.base.number
    return k % periods[place.index] if place.index in periods else k
