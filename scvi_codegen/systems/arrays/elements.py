"""Elements of arrays of known sizes: fields of the equivalent system of named coordinates q_0, q_1, ..."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sympy import Add, Expr, Matrix, S, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.formulas.array_statements import EntryRules, entry_names, formula_of_entries, known_array
from scvi_codegen.systems.formulas.indices import Array, couples_elements
from scvi_codegen.systems.formulas.rotations import AXES, Forces, RotationNames, momenta_of, torque_symbols
from scvi_codegen.systems.formulas.symbols import number, symbol


def unrolled_fields(
    system: ArraySystem,
    sizes: Mapping[str, int],
    tables: Mapping[str, ArrayLike] | None = None,
    parameters: Mapping[str, ArrayLike] | None = None,
) -> dict[str, Any]:
    """Return the fields of the system of named coordinates; arguments and errors as of :func:`unroll_sums`."""
    written = _rules(system, sizes, tables)
    sizes, names, remaining = written.sizes, written.names, dict(parameters or {})
    fields = {
        array.name: _filled(array, remaining.pop(array.name, system.data.get(array.name, default)), sizes)
        for array, default in zip(system.fields, system.field_defaults, strict=True)
    }
    values = {
        str(name): float(value)
        for array in system.fields
        for name, value in zip(names[array.name].flat, fields[array.name].flat, strict=True)
    }
    numbers = system.constants_by_name
    for name, value in remaining.items():
        if name not in numbers:
            raise SystemDefinitionError(f"'{system.name}' has no parameter '{name}'{closest(name, numbers)}")
        numbers[name] = number(name, value)
    constants = tuple(map(symbol, [*numbers, *values]))
    return {
        "name": system.name,
        "time": system.time,
        "parameters": constants,
        "defaults": (*numbers.values(), *values.values()),
        "functions": system.functions,
        "inputs": system.inputs,
        "damping": system.damping,
        "arrays": tuple(
            replace(known_array(array, sizes), is_field=_is_field(system, array))
            for array in (*system.positions, *system.fields)
        ),
        "indices": {**sizes, **{name: table.tolist() for name, table in written.tables.items()}},
        "lengths": tuple(length for near in system.neighbours for length in near.lengths),
        "definition": {} if system.sizes else system.definition,
        **_formulas(system, written, constants),
    }


def _is_field(system: ArraySystem, array: Array) -> bool:
    """Return whether a term couples neighbouring elements of an array."""
    for term in system.terms:
        accesses = [access for _, access in term.slots]
        if couples_elements(array, accesses, [access for access in accesses if access.array not in system.positions]):
            return True
    return False


def formula_at_sizes(
    system: ArraySystem, text: str, sizes: Mapping[str, int], tables: Mapping[str, ArrayLike] | None
) -> Expr:
    """Return a formula of coordinates, momenta, parameters and time in index notation as one of their entries."""
    of_rotations = (array for rotation in system.rotations for array in rotation.formulas)
    arrays = (*system.state, *system.fields, *of_rotations)
    variables = (*system.parameters, system.time, *map(symbol, system.inputs))
    symbols = {variable.name: variable for variable in variables}
    return formula_of_entries(text, arrays, symbols, system.tables, _rules(system, sizes, tables))


def _rules(system: ArraySystem, sizes: Mapping[str, int], tables: Mapping[str, ArrayLike] | None) -> EntryRules:
    """Return the sizes, index tables and names of entries; raise as :func:`unroll_sums`."""
    in_tables = {table.name: system.data[table.name] for table in system.tables if table.name in system.data}
    arrays = {name: np.asarray(table) for name, table in {**in_tables, **(tables or {})}.items()}
    columns = {name: array[:, None] if array.ndim == 1 else array for name, array in arrays.items()}
    rows = {table.axes[0].name: len(columns[table.name]) for table in system.tables if table.name in columns}
    sizes = {**rows, **sizes}
    for declared, values, kind in (
        (system.sizes, sizes, "size"),
        ([table.name for table in system.tables], columns, "table"),
    ):
        if set(declared) != set(values):
            raise SystemDefinitionError(
                f"the {kind}s of '{system.name}' are {', '.join(declared) or 'none'}: give exactly these"
            )
    names = {array.name: entry_names(array, sizes) for array in (*system.state, *system.fields)}
    for rotation in system.rotations:
        names |= rotation.names(sizes)
    return EntryRules(sizes, columns, names)


def _formulas(system: ArraySystem, written: EntryRules, constants: Sequence[Symbol]) -> dict[str, Any]:
    """Return the coordinates and momenta, and the fields that are formulas of them."""
    members = (member for rotation in system.rotations for _, member in rotation.entries(written.sizes))
    turning = RotationNames([*members])
    coordinates, momenta = (
        tuple(symbol(str(name)) for array in arrays for name in written.names[array.name].flat)
        for arrays in (system.coordinates, system.momenta)
    )
    coordinates = (*coordinates, *map(symbol, turning.coordinates))
    summands, constraints, friction = (
        [*chain(*map(written.formulas, terms))] for terms in (system.terms, system.constraints, system.friction)
    )
    total = {q: Add(*formulas) for q, formulas in written.forces(system.forces).items()}
    forces = _forces_by_name(turning, total)
    names = [coordinate.name for coordinate in coordinates]
    fields = turning.fields(system.function.lower(), Add(*summands), forces, constraints, names, constants)
    if system.function == "Hamiltonian":
        fields["momenta"] = (*momenta, *momenta_of(turning.coordinates))
    if system.bath:
        fields["bath"] = replace(system.bath, dissipation=turning.in_coordinates(Add(*friction)))
    return {"coordinates": coordinates, **fields}


def _forces_by_name(turning: RotationNames, total: dict[Symbol, Expr]) -> Forces:
    """Return the forces by name of a coordinate (one), rotation or direction (three components)."""
    total, by_name = dict(total), list[tuple[str, tuple[Expr, ...]]]()
    for member in turning.members:
        body, space = (
            Matrix([total.pop(component, S.Zero) for component in torque_symbols(member, in_space=in_space)])
            for in_space in (False, True)
        )
        if space != space * 0:
            body += Matrix(len(AXES), len(AXES), member.entries).T * space
        if body != body * 0:
            by_name.append((member.name, tuple(body)))
    return (*((q.name, (force,)) for q, force in total.items()), *by_name)


def _filled(array: Array, value: ArrayLike, sizes: Mapping[str, int]) -> NDArray[np.float64]:
    if np.shape(value) not in ((), array.shape(sizes)):
        raise SystemDefinitionError(f"'{array.name}' has the shape {np.shape(value)}, which does not match {array}")
    return np.broadcast_to(np.asarray(value, dtype=np.float64), array.shape(sizes))
