"""Systems read from text or from SymPy expressions: the fields of Lagrangian and Hamiltonian systems."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.arrays.elements import unrolled_fields
from scvi_codegen.systems.arrays.reading import arrays_from_sympy, arrays_from_text, definition_of
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.checks.definition import warn_of_mistakes
from scvi_codegen.systems.constraints import constraint_sides, constraints_of, rate_of_positions
from scvi_codegen.systems.forces import damping_rate
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
from scvi_codegen.systems.formulas.translation import Translation, sympy_expression
from scvi_codegen.systems.rotations.points import forces_at_points, rotations_of_frames
from scvi_codegen.systems.system import are_arrays

Read = Callable[[Any], Expr]

TURNING = ("rotations", "directions", "spins")
TORQUES = ("torques", "torques_space")
"""Arguments of ``from_text`` of systems with rotations."""


def system_from_text(cls: Any, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
    """Return the system of the arguments of ``from_text``, made by ``cls``, and whether warnings were issued.

    Systems of arrays of run-time sizes are returned as they are, others with their entries as coordinates.
    """
    ordinary, parameters, inputs = (arguments[each] for each in ("coordinates", "parameters", "inputs"))
    of_momenta = "momenta" in arguments
    turning = [arguments.get(each) for each in TURNING]
    declared = (parameters, arguments["tables"], *turning)
    if are_arrays(ordinary, *(each or () for each in declared)) or arguments.get("neighbours"):
        if arguments.get("point_forces"):
            raise SystemDefinitionError("point_forces of arrays are not supported: give torques and forces by index")
        return _of_arrays(cls, arrays_from_text(arguments)), True
    names = RotationNames.declared(*turning, momentum=of_momenta)
    coordinates, momenta = (*ordinary, *names.coordinates), arguments.get("momenta", ())
    momenta = default_momenta(ordinary) if momenta is None else tuple(momenta)
    momenta = (*momenta, *default_momenta(names.coordinates)) if of_momenta else momenta
    values = with_inputs(parameters or {}, inputs)
    check_names(ordinary, (*values, *inputs), momenta, (*names.coordinates, *names.symbols))
    velocities = () if of_momenta else tuple(coordinate + DOT for coordinate in coordinates)
    symbols = {each: symbol(each) for each in (*coordinates, *velocities, *momenta, TIME, *values, *inputs)}
    symbols |= names.symbols
    driven = input_formulas(inputs, symbols[TIME])

    def read(text: str) -> Expr:
        return names.read(text, symbols).xreplace(driven)

    damping = arguments["damping"]
    return _system(
        cls,
        names,
        "hamiltonian" if of_momenta else "lagrangian",
        lambda _: read,
        {**arguments, "damping": None if damping is None else str(damping)},
        name=arguments["name"],
        coordinates=ordinary,
        momenta=momenta,
        values=values,
        definition=definition_of(arguments) if names.members else {},
        inputs=tuple(inputs),
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
    applied, torques, torques_space = (formulas.get(each) for each in ("forces", *TORQUES))
    forces = names.forces_by_name(
        coordinates, read, applied, torques, torques_space, formulas.get("dissipation"), at_points
    )
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
        damping=damping_rate(formulas.get("damping"), reader("damping")),
        time=time,
        parameters=parameters,
        defaults=tuple(number(each, value) for each, value in values.items()),
        **others,
    )
    return system, warn_of_mistakes(system)


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
    names = RotationNames.declared(*(turning.get(each) for each in TURNING), momentum=momenta is not None)
    if function == "Lagrangian" and are_arrays(each for each in coordinates if isinstance(each, str)):
        others = (velocities, forces, dissipation, damping, constraints, inputs, *turning.values())
        if any(others):
            raise SystemDefinitionError(
                "from_sympy reads Lagrangian, parameters, tables and neighbours of a system with arrays: give the rest "
                "as text to from_text"
            )
        declared = {"coordinates": list(coordinates), "parameters": parameters, "tables": tables}
        return _of_arrays(cls, arrays_from_sympy(formula, name=name, neighbours=neighbours, **declared))

    def expression_of(value: Any, role: str) -> Expr:
        return sympy_expression(value, role).xreplace(of_frames)

    formula = expression_of(formula, function)
    applied = {q: _components(f, f"force on {q}", expression_of) for q, f in (forces or {}).items()}
    torques, torques_space = (
        {str(key): _components(f, f"torque on {key}", expression_of) for key, f in (turning.get(each) or {}).items()}
        for each in TORQUES
    )
    friction = None if dissipation is None else expression_of(dissipation, "dissipation")
    points = [
        {
            k: _components(f, f"{k} of point_forces", expression_of) if k not in ("body", "frame") else str(f)
            for k, f in each.items()
        }
        for each in turning.get("point_forces") or ()
    ]
    acted = [f for each in (applied, torques, torques_space, *points) for f in each.values() if not isinstance(f, str)]
    rate = damping_rate(damping, lambda each: sympy_expression(each, "damping"))
    conditions = [expression_of(g, "constraint") for each in constraints or () for g in constraint_sides(each)[0]]
    input_names = tuple(name_of_key(each) for each in inputs)
    constants = with_inputs(_named_parameters(parameters), input_names)
    translation = Translation(
        formula,
        coordinates,
        (*sympy.flatten(acted), *(() if friction is None else (friction,)), rate, *conditions),
        velocities=velocities,
        momenta=momenta or (),
        time=time,
        parameters=tuple(constants),
        inputs=input_names,
    )
    driven = input_formulas(input_names, symbol(TIME))

    def reader(role: str) -> Read:
        return lambda each: translation.apply(expression_of(each, role), role).xreplace(driven)

    ordinary = [q.name for q in translation.coordinates]
    if names.members:
        check_names(ordinary, tuple(constants), (), (*names.coordinates, *names.symbols))
    formulas = {
        function.lower(): formula,
        "forces": {name_of_key(translation.rules.get(q, q)): f for q, f in applied.items()},
        "torques": torques,
        "torques_space": torques_space,
        "dissipation": friction,
        "point_forces": points,
        "constraints": constraints,
        "damping": rate,
    }
    return _system(
        cls,
        names,
        function.lower(),
        reader,
        formulas,
        name=name,
        coordinates=ordinary,
        momenta=(*(p.name for p in translation.momenta), *default_momenta(names.coordinates)),
        values=dict(zip((each.name for each in translation.parameters), constants.values(), strict=True)),
        inputs=input_names,
    )[0]


def _components(force: Any, role: str, read: Callable[[Any, str], Expr]) -> Any:
    return tuple(read(f, role) for f in force) if isinstance(force, tuple | list) else read(force, role)


def _of_arrays(cls: Any, system: ArraySystem) -> Any:
    """Return the system of named coordinates of arrays of known sizes, others as they are."""
    return system if system.sizes else cls(**unrolled_fields(system, {}))


def _named_parameters(parameters: Mapping[Any, float] | None) -> dict[str, float]:
    """Return default values by name, for keys that are symbols or names."""
    by_name = {name_of_key(key): value for key, value in (parameters or {}).items()}
    if len(by_name) < len(parameters or {}):
        raise SystemDefinitionError("two parameters have the same name: rename one of them")
    return by_name
