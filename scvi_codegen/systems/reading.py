"""Systems read from text or from SymPy expressions: the fields of Lagrangian and Hamiltonian systems."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.arrays.elements import unrolled_fields
from scvi_codegen.systems.arrays.reading import arrays_from_sympy, arrays_from_text, definition_of
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.bath import bath_of, friction_without_bath
from scvi_codegen.systems.checks.definition import warn_of_mistakes
from scvi_codegen.systems.constraints import constraint_sides, constraints_of, rate_of_positions
from scvi_codegen.systems.contact import contacts_of, names_in
from scvi_codegen.systems.forces import damping_rate
from scvi_codegen.systems.formulas.expressions import KINKED
from scvi_codegen.systems.formulas.grammar import named_tables
from scvi_codegen.systems.formulas.rotations import RotationNames
from scvi_codegen.systems.formulas.symbols import (
    DOT,
    TIME,
    check_names,
    default_momenta,
    input_formulas,
    name_of_key,
    number,
    symbol,
    with_inputs,
)
from scvi_codegen.systems.formulas.table import functions_of
from scvi_codegen.systems.formulas.translation import Translation, sympy_expression
from scvi_codegen.systems.rotations.points import forces_at_points, rotations_of_frames
from scvi_codegen.systems.system import are_arrays

Read = Callable[[Any], Expr]

TURNING = ("rotations", "directions", "spins")
TORQUES = ("torques", "torques_space")
"""Arguments of ``from_text`` of systems with rotations."""
NOT_OF_ARRAYS = {"noise": "write their entries as coordinates", "point_forces": "give torques and forces by index"}
"""Arguments of ``from_text`` that systems of arrays do not have, and what to do instead."""
NAMES_AT_POINTS = ("body", "frame")
"""Entries of a force at a point that are names."""


def system_from_text(cls: Any, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
    """Return the system of the arguments of ``from_text``, made by ``cls``, and whether warnings were issued.

    Systems of arrays of run-time sizes are returned as they are, others with their entries as coordinates.
    """
    ordinary, parameters, inputs = (arguments[key] for key in ("coordinates", "parameters", "inputs"))
    of_momenta = "momenta" in arguments
    turning = [arguments.get(key) for key in TURNING]
    declared = (parameters, arguments["tables"], *turning)
    if are_arrays(ordinary, *(declarations or () for declarations in declared)) or arguments.get("neighbours"):
        for name, remedy in NOT_OF_ARRAYS.items():
            if arguments.get(name) not in (None, (), []):
                raise SystemDefinitionError(f"{name}= of arrays is not supported: {remedy}")
        return _of_arrays(cls, arrays_from_text(arguments), arguments.get("contacts", ())), True
    names = RotationNames.declared(*turning, momentum=of_momenta)
    coordinates, momenta = (*ordinary, *names.coordinates), arguments.get("momenta", ())
    momenta = default_momenta(ordinary) if momenta is None else tuple(momenta)
    momenta = (*momenta, *default_momenta(names.coordinates)) if of_momenta else momenta
    values = with_inputs(parameters or {}, inputs)
    check_names(ordinary, (*values, *inputs), momenta, (*names.coordinates, *names.symbols))
    velocities = () if of_momenta else tuple(coordinate + DOT for coordinate in coordinates)
    symbols = {key: symbol(key) for key in (*coordinates, *velocities, *momenta, TIME, *values, *inputs)}
    functions = functions_of(arguments["functions"])
    symbols |= names.symbols
    symbols |= named_tables(functions, symbols)
    driven = input_formulas(inputs, symbols[TIME])

    def read(text: str) -> Expr:
        return names.read(text, symbols).xreplace(driven)

    numbers = {key: str(arguments[key]) for key in ("damping", "temperature") if arguments.get(key) is not None}
    return _system(
        cls,
        names,
        "hamiltonian" if of_momenta else "lagrangian",
        lambda _: read,
        {**arguments, **numbers},
        name=arguments["name"],
        coordinates=ordinary,
        momenta=momenta,
        values=values,
        definition=definition_of(arguments) if names.members else {},
        functions=functions,
        inputs=tuple(inputs),
        **({"contacts": contacts_of(arguments["contacts"])} if arguments.get("contacts") else {}),
    )


def _system(
    cls: Any,
    names: RotationNames,
    function: str,
    reader: Callable[[str], Read],
    formulas: Mapping[str, Any],
    *,
    coordinates: Sequence[str],
    momenta: Sequence[str],
    values: Mapping[str, Any],
    **others: Any,
) -> tuple[Any, bool]:
    """Return a system, and whether warnings were issued.

    Args:
        cls: makes the system of its fields.
        names: of rotations, directions and spins.
        function: ``"lagrangian"`` or ``"hamiltonian"``.
        reader: returns the function that reads formulas of a role, which messages contain.
        formulas: of ``function``, forces, torques, dissipation, point_forces, constraints and damping.
        coordinates: names of the ordinary coordinates.
        momenta: names of all momenta of a Hamiltonian.
        values: default value by name of a parameter.
        others: further fields.
    """
    read, members, time = reader("forces"), names.members, symbol(TIME)
    at_points = forces_at_points(formulas.get("point_forces") or (), coordinates, members, read)
    applied, torques, torques_space = (formulas.get(key) for key in ("forces", *TORQUES))
    bath = bath_of(formulas, read, names.in_coordinates, (*coordinates, *names.coordinates))
    damping, dissipation = friction_without_bath(formulas)
    forces = names.forces_by_name(coordinates, read, applied, torques, torques_space, dissipation, at_points)
    variables, parameters = (*coordinates, *names.coordinates), tuple(map(symbol, values))
    q = tuple(map(symbol, variables))
    constraints = constraints_of(
        formulas.get("constraints"),
        reader("constraints"),
        lambda g: rate_of_positions(names.in_coordinates(g), q, time),
    )
    formula = reader(function.capitalize())(formulas[function])
    system = cls(
        coordinates=q,
        **({"momenta": tuple(map(symbol, momenta))} if function == "hamiltonian" else {}),
        **names.fields(function, formula, forces, constraints, variables, parameters),
        damping=damping_rate(damping, reader("damping")),
        time=time,
        parameters=parameters,
        defaults=tuple(number(parameter, value) for parameter, value in values.items()),
        **({"bath": bath} if bath else {}),
        **others,
    )
    of_contacts = map(symbol, names_in(item.table for item in others.get("contacts", ())))
    is_warned = warn_of_mistakes(system, (*of_contacts, *(bath.symbols if bath else ())))
    return system, is_warned or not KINKED.keys().isdisjoint((*coordinates, *momenta, *values))


def system_from_sympy(
    cls: Any,
    function: str,
    formula: Any,
    *,
    name: str,
    coordinates: Sequence[Any],
    momenta: Sequence[Any] | None = None,
    velocities: Sequence[Any] | None = None,
    time: Symbol | None = None,
    parameters: Mapping[Any, float] | None = None,
    forces: Mapping[Any, Any] | None = None,
    dissipation: Any = None,
    damping: Any = None,
    temperature: Any = None,
    noise: Mapping[Any, Any] | None = None,
    constraints: Sequence[Any] = (),
    inputs: Sequence[Any] = (),
    tables: Sequence[str] | Mapping[str, Any] = (),
    neighbours: Mapping[str, Any] | None = None,
    **turning: Any,
) -> Any:
    """Return the system of a SymPy expression, its ``function`` ``"Lagrangian"`` or ``"Hamiltonian"``.

    Other arguments are those of ``cls.from_sympy``; ``turning`` are those of ``TURNING`` and ``TORQUES``.
    """
    turning["rotations"], of_frames = rotations_of_frames(turning.get("rotations"))
    names = RotationNames.declared(*(turning.get(key) for key in TURNING), momentum=momenta is not None)
    if function == "Lagrangian" and are_arrays(q for q in coordinates if isinstance(q, str)):
        if any((velocities, forces, dissipation, damping, temperature, noise, constraints, inputs, *turning.values())):
            raise SystemDefinitionError(
                "from_sympy reads Lagrangian, parameters, tables and neighbours of a system with arrays: give the rest "
                "as text to from_text"
            )
        declared = {"coordinates": list(coordinates), "parameters": parameters, "tables": tables}
        return _of_arrays(cls, arrays_from_sympy(formula, name=name, neighbours=neighbours, **declared))

    def expression_of(value: Any, role: str) -> Expr:
        return sympy_expression(value, role).xreplace(of_frames)

    def reader(role: str) -> Read:
        return lambda value: translation.apply(expression_of(value, role), role).xreplace(driven)

    formula = expression_of(formula, function)
    rate = damping_rate(damping, lambda value: sympy_expression(value, "damping"))
    acting = _forces_of(expression_of, forces, dissipation, turning)
    acting["temperature"] = None if temperature is None else expression_of(temperature, "temperature")
    acting["noise"] = {key: expression_of(sigma, f"noise on {key}") for key, sigma in (noise or {}).items()}
    sides = [side for condition in constraints or () for side in constraint_sides(condition)[0]]
    input_names = tuple(map(name_of_key, inputs))
    constants = with_inputs(_named_parameters(parameters), input_names)
    translation = Translation(
        formula,
        coordinates,
        (*_expressions_in(acting), rate, *(expression_of(side, "constraint") for side in sides)),
        velocities=velocities,
        momenta=momenta or (),
        time=time,
        parameters=tuple(constants),
        inputs=input_names,
    )
    driven = input_formulas(input_names, symbol(TIME))
    ordinary = [q.name for q in translation.coordinates]
    if names.members:
        check_names(ordinary, tuple(constants), (), (*names.coordinates, *names.symbols))
    by_name, noise_by_name = (
        {name_of_key(translation.rules.get(q, q)): value for q, value in acting[kind].items()}
        for kind in ("forces", "noise")
    )
    formulas = {**acting, function.lower(): formula, "forces": by_name, "constraints": constraints, "damping": rate}
    formulas["noise"] = noise_by_name or None
    return _system(
        cls,
        names,
        function.lower(),
        reader,
        formulas,
        name=name,
        coordinates=ordinary,
        momenta=(*(p.name for p in translation.momenta), *default_momenta(names.coordinates)),
        values=dict(zip(map(str, translation.parameters), constants.values(), strict=True)),
        inputs=input_names,
    )[0]


def _forces_of(
    expression_of: Callable[[Any, str], Expr],
    forces: Mapping[Any, Any] | None,
    dissipation: Any,
    turning: Mapping[str, Any],
) -> dict[str, Any]:
    """Return forces, torques, forces at points and dissipation by the names of their arguments, as expressions."""

    def by_key(values: Mapping[Any, Any] | None, role: str) -> dict[Any, Any]:
        return {key: _components(force, f"{role} {key}", expression_of) for key, force in (values or {}).items()}

    def at_point(values: Mapping[str, Any]) -> dict[str, Any]:
        return {
            key: str(value) if key in NAMES_AT_POINTS else _components(value, f"{key} of point_forces", expression_of)
            for key, value in values.items()
        }

    return {
        "forces": by_key(forces, "force on"),
        **{kind: {str(key): tau for key, tau in by_key(turning.get(kind), "torque on").items()} for kind in TORQUES},
        "point_forces": [at_point(values) for values in turning.get("point_forces") or ()],
        "dissipation": None if dissipation is None else expression_of(dissipation, "dissipation"),
    }


def _expressions_in(formulas: Any) -> Iterator[Expr]:
    """Yield the expressions in nested mappings and sequences; texts and ``None`` are none."""
    if isinstance(formulas, Expr):
        yield formulas
    elif isinstance(formulas, Mapping):
        yield from _expressions_in(list(formulas.values()))
    elif isinstance(formulas, list | tuple):
        for part in formulas:
            yield from _expressions_in(part)


def _components(force: Any, role: str, read: Callable[[Any, str], Expr]) -> Any:
    return tuple(read(f, role) for f in force) if isinstance(force, tuple | list) else read(force, role)


def _of_arrays(cls: Any, system: ArraySystem, contacts: Any = ()) -> Any:
    """Return the system of named coordinates of arrays of known sizes, others as they are, without contacts."""
    if contacts and system.sizes:
        raise SystemDefinitionError(f"contacts of '{system.name}' require known sizes: write numbers, such as 'y[4]'")
    return system if system.sizes else cls(**unrolled_fields(system, {}), contacts=contacts_of(contacts))


def _named_parameters(parameters: Mapping[Any, float] | None) -> dict[str, float]:
    """Return default values by name, for keys that are symbols or names."""
    by_name = {name_of_key(key): value for key, value in (parameters or {}).items()}
    if len(by_name) < len(parameters or {}):
        raise SystemDefinitionError("two parameters have the same name: rename one of them")
    return by_name
