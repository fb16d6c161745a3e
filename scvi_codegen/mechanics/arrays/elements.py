"""Elements of arrays of known sizes: fields of the equivalent system of named coordinates q_0, q_1, ..."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sympy import Add, Expr, Matrix, S, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.array_statements import ArrayForce
from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.formulas.rotations.arrays import torque_symbols
from scvi_codegen.formulas.rotations.members import AXES, momenta_of
from scvi_codegen.formulas.rotations.names import Forces, RotationNames
from scvi_codegen.formulas.symbols import DOT, number, symbol
from scvi_codegen.indices import Access, Array, Loop, Place, Size
from scvi_codegen.mechanics.arrays.system import ArraySystem

Elements = Mapping[str, int]
Tables = Mapping[str, NDArray[np.int64]]


def unrolled_fields(
    system: ArraySystem,
    sizes: Mapping[str, int],
    tables: Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Return the fields of the system of named coordinates; arguments and errors as of :func:`unroll_sums`."""
    in_tables = {table.name: system.data[table.name] for table in system.tables if table.name in system.data}
    columns = {name: _columns(table) for name, table in {**in_tables, **(tables or {})}.items()}
    remaining = dict(parameters or {})
    rows = {table.axes[0].name: len(columns[table.name]) for table in system.tables if table.name in columns}
    sizes = {**rows, **sizes}
    for known, named, what in (
        (system.sizes, sizes, "size"),
        ([table.name for table in system.tables], columns, "table"),
    ):
        if set(known) != set(named):
            raise SystemDefinitionError(
                f"the {what}s of '{system.name}' are {', '.join(known) or 'none'}: give exactly these"
            )
    fields = {
        array.name: _filled(array, remaining.pop(array.name, system.data.get(array.name, default)), sizes)
        for array, default in zip(system.fields, system.field_defaults, strict=True)
    }
    names = {array.name: _names(array, sizes) for array in (*system.state, *system.fields)}
    for turning in system.rotations:
        names |= turning.names(sizes)
    values = {
        str(name): float(value)
        for array in system.fields
        for name, value in zip(names[array.name].flat, fields[array.name].flat, strict=True)
    }
    numbers = {each.name: value for each, value in zip(system.parameters, system.defaults, strict=True)}
    for name, value in remaining.items():
        if name not in numbers:
            raise SystemDefinitionError(f"'{system.name}' has no parameter '{name}'{closest(name, numbers)}")
        numbers[name] = number(name, value)
    written = _Elements(sizes, columns, names)
    constants = tuple(map(symbol, [*numbers, *values]))
    return {
        "name": system.name,
        "time": system.time,
        "parameters": constants,
        "defaults": (*numbers.values(), *values.values()),
        "inputs": system.inputs,
        "damping": system.damping,
        "arrays": tuple(known_array(array, sizes) for array in (*system.positions, *system.fields)),
        "definition": {} if system.sizes else system.definition,
        **_formulas(system, written, constants),
    }


def _formulas(system: ArraySystem, written: _Elements, constants: Sequence[Symbol]) -> dict[str, Any]:
    """Return the coordinates and momenta, and the fields that are formulas of them."""
    turning = RotationNames([member for each in system.rotations for _, member in each.entries(written.sizes)])
    coordinates, momenta = (
        tuple(symbol(str(name)) for array in arrays for name in written.names[array.name].flat)
        for arrays in (system.coordinates, system.momenta)
    )
    coordinates = (*coordinates, *map(symbol, turning.coordinates))
    summands, constraints = (
        [term.formula.xreplace(rule) for term in terms for _, rule in written.rules(term)]
        for terms in (system.terms, system.constraints)
    )
    total = {q: Add(*formulas) for q, formulas in written.forces(system.forces).items()}
    forces: Any = _forces_by_name(turning, total)
    if not turning.members:
        forces = tuple(total.get(q, S.Zero) for q in coordinates) if total else ()
    fields = turning.fields(
        system.function.lower(), Add(*summands), forces, constraints, [each.name for each in coordinates], constants
    )
    if system.function == "Hamiltonian":
        fields["momenta"] = (*momenta, *momenta_of(turning.coordinates))
    return {"coordinates": coordinates, **fields}


def _forces_by_name(turning: RotationNames, total: dict[Symbol, Expr]) -> Forces:
    """Return the forces by name of a coordinate (one), rotation or direction (three components)."""
    total, by_name = dict(total), list[tuple[str, tuple[Expr, ...]]]()
    for member in turning.members:
        body, space = (
            Matrix([total.pop(each, S.Zero) for each in torque_symbols(member, in_space=in_space)])
            for in_space in (False, True)
        )
        if space != space * 0:
            body += Matrix(len(AXES), len(AXES), member.entries).T * space
        if body != body * 0:
            by_name.append((member.name, tuple(body)))
    return (*((q.name, (force,)) for q, force in total.items()), *by_name)


def known_array(array: Array, sizes: Mapping[str, int]) -> Array:
    """Return the declaration with whole numbers as sizes."""
    return replace(array, axes=tuple(Size("", length) for length in array.shape(sizes)))


def _columns(table: ArrayLike) -> NDArray[np.int64]:
    """Return an index table as a two-dimensional array; one axis becomes one column."""
    array = np.asarray(table)
    return array[:, None] if array.ndim == 1 else array


def _names(array: Array, sizes: Mapping[str, int]) -> NDArray[np.str_]:
    return np.array(known_array(array, sizes).elements, dtype=np.str_).reshape(array.shape(sizes))


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

    def rules(self, of: ArrayTerm | ArrayForce) -> Iterator[tuple[Elements, dict[Symbol, Symbol]]]:
        """Yield the values of the indices with the symbol that replaces each access."""
        for at in _elements(of.loops, self.sizes):
            yield at, {slot: self.entry(access, at, of.loops) for slot, access in of.slots}

    def forces(self, forces: Sequence[ArrayForce]) -> dict[Symbol, list[Expr]]:
        """Return the contributions to the force on each coordinate."""
        by_coordinate: dict[Symbol, list[Expr]] = {}
        for force in forces:
            for at, rule in self.rules(force):
                for access, formula in force.targets:
                    by_coordinate.setdefault(self.entry(access, at, force.loops), []).append(formula.xreplace(rule))
        return by_coordinate

    def entry(self, access: Access, at: Elements, loops: Sequence[Loop]) -> Symbol:
        """Return the symbol of an array entry."""
        periods = {loop.index: loop.end.at(self.sizes) for loop in loops if loop.periodic}
        try:
            indices = tuple(_place(each, at, periods, self.sizes, self.tables) for each in access.places)
        except IndexError as error:
            raise SystemDefinitionError(f"{access} at {dict(at)}: {error}") from error
        if any(not 0 <= each < length for each, length in zip(indices, access.array.shape(self.sizes), strict=True)):
            raise SystemDefinitionError(
                f"{access} has the index {list(indices)}, which is outside of {access.array}, at {dict(at)}"
            )
        name = access.array.name
        if name in self.names:
            return symbol(str(self.names[name][indices]))
        return symbol(str(self.names[name.removesuffix(DOT)][indices]) + DOT)


def _place(subscript: Place, at: Elements, periods: Mapping[str, int], sizes: Mapping[str, int], tables: Tables) -> int:
    if subscript.table:
        return int(tables[subscript.table][at[subscript.index], subscript.column])
    if not subscript.index:
        return subscript.base.at(sizes)
    k = at[subscript.index] + subscript.base.number
    return k % periods[subscript.index] if subscript.index in periods else k
