"""Systems of arrays read from text or from SymPy expressions."""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.arrays.system import (
    ArrayHamiltonian,
    ArrayLagrangian,
    ArraySystem,
    friction,
    momenta_of,
    substituted,
    table_of,
)
from scvi_codegen.systems.bath import bath_of, friction_without_bath
from scvi_codegen.systems.constraints import constraint_sides
from scvi_codegen.systems.contact import names_in
from scvi_codegen.systems.forces import damping_rate
from scvi_codegen.systems.formulas.array_statements import ArrayForce, array_text, parse_constraint, parse_force
from scvi_codegen.systems.formulas.arrays import parse_array, parse_coordinate, parse_sums
from scvi_codegen.systems.formulas.grammar import named_tables, parse_expression
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.neighbours import parse_neighbours
from scvi_codegen.systems.formulas.rotations import MemberArray, member_arrays, torque_components
from scvi_codegen.systems.formulas.symbols import DOT, TIME, input_formulas, number, symbol, with_inputs
from scvi_codegen.systems.formulas.table import functions_of

LISTED = ("coordinates", "directions", "spins", "momenta", "constraints", "inputs", "tables", "point_forces")
"""Arguments that are lists."""
DEFINING = (
    *("coordinates", "rotations", "directions", "spins", "momenta", "lagrangian", "hamiltonian", "dissipation"),
    *("damping", "temperature", "noise", "constraints", "inputs", "tables", "neighbours"),
    *("forces", "torques", "torques_space", "point_forces"),
)
"""Arguments that define a system, in the order of model files."""
FUNCTIONS = "lagrangian", "hamiltonian"
MAPPINGS = "parameters", "rotations", "forces", "torques", "torques_space", "neighbours", "functions"
ABSENT: dict[str, Any] = dict.fromkeys((*LISTED, "contacts"), ()) | {key: {} for key in MAPPINGS}
"""Values of arguments that are left out."""
_pairs = partial(zip, strict=False)


class Names(NamedTuple):
    """Arrays, single symbols by name and index tables that formulas of a system may contain."""

    arrays: tuple[Array, ...]
    symbols: dict[str, Symbol]
    tables: tuple[Array, ...]


def definition_of(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of ``from_text`` that model files contain as they are, without empty ones."""
    defining = {key: value for key in DEFINING if (value := arguments.get(key))}
    return {key: list(value) if key in LISTED else value for key, value in defining.items()}


def arrays_from_text(arguments: Mapping[str, Any]) -> ArraySystem:
    """Return the system of the arguments of ``from_text`` of a Lagrangian or a Hamiltonian.

    >>> print(arrays_from_text({
    ...     "name": "chain", "coordinates": ["q[N]"], "parameters": {"k": 2},
    ...     "lagrangian": "sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)"}))
    chain: L(q[N]) = sum(i in N, q_dot[i]**2/2) + sum(i in N periodic, -k*(q[i+1] - q[i])**2/2)
    """
    given = ABSENT | {key: value for key, value in arguments.items() if value is not None}
    inputs, tables, lagrangian, hamiltonian = given["inputs"], given["tables"], *map(arguments.get, FUNCTIONS)
    coordinates = tuple(map(parse_coordinate, given["coordinates"]))
    momenta = momenta_of(coordinates, arguments.get("momenta"), lagrangian, hamiltonian)
    velocities = () if momenta else tuple(Array(array.name + DOT, array.axes) for array in coordinates)
    members = (given[key] for key in ("rotations", "directions", "spins"))
    rotations = member_arrays(*members, momentum=hamiltonian is not None)
    data, numbers = _values(dict(given["parameters"]))
    data |= tables if isinstance(tables, Mapping) else {}
    values = with_inputs(numbers, inputs)
    fields = {key: parse_array(key) for key in values if "[" in key}
    scalars = {key: value for key, value in values.items() if key not in fields}
    functions = functions_of(given["functions"])
    of_rotations = chain.from_iterable(rotation.formulas for rotation in rotations)
    names = Names(
        arrays=(*coordinates, *momenta, *velocities, *fields.values(), *of_rotations),
        symbols={key: symbol(key) for key in (*scalars, *inputs, TIME)}
        | named_tables(functions, {*values, *(array.name for array in coordinates)}),
        tables=tuple(map(table_of, tables)),
    )
    lengths = {key: names.symbols[key] for key in scalars}
    neighbours = parse_neighbours(given["neighbours"], coordinates, lengths)
    damping, _ = friction_without_bath(given)
    dissipated = parse_sums(given["dissipation"], *names, neighbours) if "dissipation" in given else ()
    resisting, of_bath = ((), dissipated) if "temperature" in given else (dissipated, ())
    rates = chain(_pairs(velocities, coordinates), *(_pairs(of.rates, of.torques()) for of in rotations))
    forces = (*_forces(given, coordinates, rotations, names), *friction(resisting, dict(rates)))
    kind, function = (ArrayLagrangian, lagrangian) if hamiltonian is None else (ArrayHamiltonian, hamiltonian)
    of_inputs = input_formulas(inputs, names.symbols[TIME])
    driven = partial(substituted, rule=of_inputs)
    constant_or_moving = dict.fromkeys(fields.values()) | dict(_pairs(coordinates, velocities))
    condition = partial(parse_constraint, split=constraint_sides, velocities=constant_or_moving)

    def read(formula: Any) -> Expr:
        return parse_expression(str(formula), names.symbols).xreplace(of_inputs)

    system = kind(
        name=arguments["name"],
        coordinates=coordinates,
        momenta=momenta,
        time=names.symbols[TIME],
        parameters=tuple(names.symbols[key] for key in scalars),
        defaults=tuple(scalars.values()),
        fields=tuple(fields.values()),
        field_defaults=tuple(values[key] for key in fields),
        tables=names.tables,
        neighbours=neighbours,
        terms=tuple(map(driven, parse_sums(str(function), *names, neighbours))),
        forces=tuple(map(driven, forces)),
        functions=functions,
        inputs=tuple(inputs),
        constraints=tuple(condition(text, *names) for text in given["constraints"]),
        damping=damping_rate(damping, read),
        bath=bath_of({**given, "dissipation": None}, read, read, ()),
        friction=of_bath,
        rotations=rotations,
        definition=definition_of(arguments),
        data={parse_array(key).name: value for key, value in data.items()},
    )
    system.warn_of_mistakes(map(symbol, names_in(given["contacts"])))
    return system


def _values(parameters: dict[str, Any]) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the arrays of values of fields, by name, and the numbers that are defaults, 1 for these."""
    data = {key: value for key, value in parameters.items() if "[" in key and np.ndim(value)}
    return data, {key: 1.0 if key in data else number(key, value) for key, value in parameters.items()}


def _forces(
    arguments: Mapping[str, Any], coordinates: tuple[Array, ...], rotations: Sequence[MemberArray], names: Names
) -> Iterator[ArrayForce]:
    """Yield generalised forces on coordinates, and torques on rotations with the forces that are vectors."""
    forces = arguments["forces"]
    components = [(target, force, coordinates) for target, force in forces.items() if isinstance(force, str)]
    vectors = {target: force for target, force in forces.items() if not isinstance(force, str)}
    for torque_of, in_space in (({**vectors, **arguments["torques"]}, False), (arguments["torques_space"], True)):
        for target, torque in torque_of.items():
            components += torque_components(rotations, target, torque, in_space=in_space)
    for target, force, arrays in components:
        yield from parse_force(target, force, arrays, (*names.arrays, *arrays), names.symbols, names.tables)


def arrays_from_sympy(lagrangian: Any, **arguments: Any) -> ArraySystem:
    """Return the system of a SymPy expression of ``Sum`` and ``Indexed``; other arguments as of ``from_text``.

    A periodic index is ``Mod(i + 1, N)``, pairs are ``(j, i + 1, N - 1), (i, 0, N - 2)``, a table entry is
    ``q[bonds[b, 0]]``, the velocity of ``q[i]`` is that of ``IndexedBase("q_dot")``.

    >>> from sympy import IndexedBase, Sum, symbols
    >>> q, v, (i, N) = IndexedBase("q"), IndexedBase("q_dot"), symbols("i N", integer=True)
    >>> kinetic, springs = Sum(v[i] ** 2 / 2, (i, 0, N - 1)), Sum((q[i + 1] - q[i]) ** 2 / 2, (i, 0, N - 2))
    >>> chain = arrays_from_sympy(kinetic - springs, name="chain", coordinates=["q[N]"])
    >>> print(*sorted(map(str, chain.terms)), sep=chr(10))
    sum(i in 0..N-2, -(q[i+1] - q[i])**2/2)
    sum(i in N, q_dot[i]**2/2)
    """
    if not isinstance(lagrangian, Expr):
        kind = type(lagrangian).__name__
        raise SystemDefinitionError(f"the Lagrangian is a {kind}, not a SymPy expression (text goes to from_text)")
    return arrays_from_text({**arguments, "lagrangian": array_text(lagrangian)})
