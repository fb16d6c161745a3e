"""Systems of arrays read from text or from SymPy expressions."""

from collections.abc import Mapping
from itertools import chain
from typing import Any

import numpy as np
from sympy import Expr

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
from scvi_codegen.systems.constraints import constraint_sides
from scvi_codegen.systems.forces import damping_rate
from scvi_codegen.systems.formulas.array_statements import array_text, parse_constraint, parse_force
from scvi_codegen.systems.formulas.arrays import parse_array, parse_coordinate, parse_sums
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.neighbours import parse_neighbours
from scvi_codegen.systems.formulas.rotations import member_arrays, torque_components
from scvi_codegen.systems.formulas.symbols import DOT, TIME, input_formulas, number, symbol, with_inputs

LISTED = ("coordinates", "directions", "spins", "momenta", "constraints", "inputs", "tables", "point_forces")
"""Arguments that are lists."""
DEFINING = (
    *("coordinates", "rotations", "directions", "spins", "momenta", "lagrangian", "hamiltonian", "dissipation"),
    *("damping", "constraints", "inputs", "tables", "neighbours", "forces", "torques", "torques_space", "point_forces"),
)
"""Arguments that define a system, in the order of model files."""


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
    lagrangian, hamiltonian = arguments.get("lagrangian"), arguments.get("hamiltonian")
    inputs, parameters, tables = (arguments.get(key) or () for key in ("inputs", "parameters", "tables"))
    arrays = tuple(map(parse_coordinate, arguments["coordinates"]))
    conjugate = momenta_of(arrays, arguments.get("momenta"), lagrangian, hamiltonian)
    index_tables = tuple(map(table_of, tables))
    entries = dict(parameters)
    data = {key: value for key, value in entries.items() if "[" in key and np.ndim(value)}
    numbers = {key: 1.0 if key in data else number(key, value) for key, value in entries.items()}
    data |= tables if isinstance(tables, Mapping) else {}
    values = with_inputs(numbers, inputs)
    fields = {key: parse_array(key) for key in values if "[" in key}
    scalars = {key: value for key, value in values.items() if key not in fields}
    velocities = () if conjugate else tuple(Array(array.name + DOT, array.axes) for array in arrays)
    text = str(lagrangian if hamiltonian is None else hamiltonian)
    known = {key: symbol(key) for key in (*scalars, *inputs, TIME)}
    driven = input_formulas(inputs, symbol(TIME))
    lists = parse_neighbours(arguments.get("neighbours") or {}, arrays, {key: known[key] for key in scalars})
    turning = member_arrays(
        *(arguments.get(key) for key in ("rotations", "directions", "spins")), momentum=hamiltonian is not None
    )
    turned = [array for each in turning for array in each.formulas]
    everything = (*arrays, *conjugate, *velocities, *fields.values(), *turned)
    forces = arguments.get("forces") or {}
    targets = [(*pair, arrays) for pair in forces.items() if isinstance(pair[1], str)]
    vectors = {target: force for target, force in forces.items() if not isinstance(force, str)}
    torques, torques_space = (arguments.get(key) or {} for key in ("torques", "torques_space"))
    for by_name, in_space in (({**vectors, **torques}, False), (torques_space, True)):
        for target, torque in by_name.items():
            targets += torque_components(turning, target, torque, in_space=in_space)
    applied = [parse_force(target, force, on, (*everything, *on), known, index_tables) for target, force, on in targets]
    if (dissipation := arguments.get("dissipation")) is not None:
        moving = dict(zip(velocities, arrays, strict=False))
        for each in turning:
            moving |= zip(each.rates, each.torques(), strict=False)
        applied.append(friction(parse_sums(dissipation, everything, known, index_tables, lists), moving))
    kind = ArrayLagrangian if hamiltonian is None else ArrayHamiltonian
    system = kind(
        name=arguments["name"],
        coordinates=arrays,
        momenta=conjugate,
        time=symbol(TIME),
        parameters=tuple(known[key] for key in scalars),
        defaults=tuple(scalars.values()),
        fields=tuple(fields.values()),
        field_defaults=tuple(values[key] for key in fields),
        tables=index_tables,
        neighbours=lists,
        terms=tuple(substituted(term, driven) for term in parse_sums(text, everything, known, index_tables, lists)),
        forces=tuple(substituted(force, driven) for force in chain(*applied)),
        inputs=tuple(inputs),
        constraints=tuple(
            parse_constraint(
                each,
                everything,
                known,
                index_tables,
                split=constraint_sides,
                velocities={**dict.fromkeys(fields.values()), **dict(zip(arrays, velocities, strict=False))},
            )
            for each in arguments.get("constraints") or ()
        ),
        damping=damping_rate(arguments.get("damping"), lambda formula: parse_expression(str(formula), known)),
        rotations=turning,
        definition=definition_of(arguments),
        data={parse_array(key).name: value for key, value in data.items()},
    )
    system.warn_of_mistakes()
    return system


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
